"""`tactile-rt hz` and `codecs`: a short look at a stream, and what devices can speak."""

import re
import tomllib

import pytest

LINE = re.compile(r" *(\d+\.\d) Hz, jitter p50 .* missing 0, corrupt 0, duplicates 0")


@pytest.mark.parametrize(
    "arguments",
    [("synthetic:2x1", "--seconds", "0.2"), ("synthetic:2x1?seconds=0.2&pace=fast",)],
)
def test_a_look_of_less_than_a_second_is_told_of(call, arguments):
    code, out, err = call("hz", *arguments)
    assert (code, err) == (0, "")
    title, line = out.splitlines()
    assert title == "synthetic: 2 elements x 1 channels, nominally 1000 Hz"
    match = LINE.fullmatch(line)
    assert match is not None and float(match[1]) > 0


def test_the_description_of_a_frame_is_printed_to_be_changed(call, tmp_path):
    code, said, _ = call("codecs", "--frame", "kwr75")
    assert code == 0 and tomllib.loads(said)["sync"] == "48 AA"
    mine = tmp_path / "mine.toml"
    mine.write_text(said.replace("1000.0", "500.0"))
    code, _, told = call("describe", f"serial:///dev/none?codec=binary_frame&mapping={mine}")
    assert code == 2 and "/dev/none" in told


def test_a_frame_that_is_not_described_is_one_line(refused):
    said = refused("codecs", "--frame", "bota2")
    assert "no described frame 'bota2'; did you mean bota?" in said
