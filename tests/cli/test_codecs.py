"""`tactile-rt codecs`: what devices can speak."""

import tomllib


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
