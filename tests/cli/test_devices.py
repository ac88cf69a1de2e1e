"""`tactile-rt hz`: what it prints of a short look, and of a stream that ends."""

import re

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
