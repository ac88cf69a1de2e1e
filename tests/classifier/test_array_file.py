"""What array a file describes, and what is wrong with one that describes none."""

from pathlib import Path

import pytest

from tactile_rt.classifier.array_file import read_array
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.core.errors import TactileError
from tactile_rt.testing import small_spec


def refusal_of(file: Path) -> str:
    with pytest.raises(TactileError) as caught:
        read_array(file)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_json_is_read_as_describe_writes_it(call, tmp_path: Path) -> None:
    file = tmp_path / "array.json"
    assert call("describe", "synthetic:3x2", "--out", file)[0] == 0
    assert read_array(file).elements == ("A0", "A1", "A2")
    file.write_text(small_spec().to_json())
    assert read_array(file) == small_spec()


def test_of_a_model_it_is_the_array_that_it_was_made_for() -> None:
    assert read_array(shipped_model()).shape == (30, 6)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.json", "{", "not JSON, as `tactile-rt describe` writes it"),
        ("a.json", small_spec().to_json().replace("1000.0", '"fast"'), "rate_hz: expected a num"),
        ("a.json", small_spec().to_json().replace('"A1"', '"A0"'), "elements repeat"),
        ("a.onnx", "no model", "is not a readable ONNX model: it is text"),
        ("robot.toml", 'name = "robot"\n', "--out robot.json`"),
    ],
)
def test_what_describes_none_is_refused_in_one_line(
    tmp_path: Path, name: str, text: str, said: str
) -> None:
    file = tmp_path / name
    file.write_text(text)
    found = refusal_of(file)
    assert str(file) in found and said in found


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    for name in ("none.json", "none.onnx"):
        assert name in refusal_of(tmp_path / name)
