"""What docs/reference/drivers.md shows does what it says, and add-a-sensor.md shows a codec."""

import re
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tactile_rt.drivers.codec import Codec
from tactile_rt.drivers.device_source import DeviceOptions
from tactile_rt.drivers.emulation.faults import KINDS, read_faults
from tactile_rt.drivers.opening import CanOptions, SerialOptions
from tactile_rt.sources.combined import _File
from tests.helpers.codec_contract import CodecCase, CodecContract

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "reference" / "drivers.md").read_text(encoding="utf-8")
HOW_TO = (ROOT / "docs" / "how-to" / "add-a-sensor.md").read_text(encoding="utf-8")


def block(language: str, word: str, page: str = GUIDE) -> str:
    """The one block of code with this word in it."""
    found = re.findall(rf"```{language}[^\n]*\n(.*?)```", page, re.S)
    (text,) = [text for text in found if word in text]
    return text


def fingertip() -> Codec:
    names: dict = {"__name__": "fingertip"}
    exec(block("python", "class Fingertip", HOW_TO), names)
    return names["Fingertip"](names["FingertipOptions"]())


class TestTheExampleIsACodec(CodecContract):
    case = CodecCase(
        fingertip, lambda: np.random.default_rng(1).uniform(-5, 5, (40, 1, 3)), 0.501e-3
    )


def test_the_faults_are_a_schedule(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(block("toml", "[[fault]]"))
    assert [f.kind for f in read_faults(path).faults] == ["bit_flip", "unplug", "clock_drift"]


def test_the_combined_arrays_are_combined() -> None:
    file = msgspec.convert(tomllib.loads(block("toml", "[[source]]")), _File)
    assert [part.name for part in file.source] == ["left", "right"]


@pytest.mark.parametrize(
    "names",
    [
        set(KINDS),
        *(set(o.__dataclass_fields__) for o in (DeviceOptions, SerialOptions, CanOptions)),
    ],
)
def test_every_name_is_in_the_guide(names: set[str]) -> None:
    assert not {name for name in names if f"`{name}`" not in GUIDE}
