"""Options as written in a URL."""

from dataclasses import dataclass

import pytest

from tactile_rt.settings import parse_options, take_options
from tactile_rt.stream import ConfigError


@dataclass(frozen=True)
class Line:
    baud: int = 9600
    dtr: bool = True


@dataclass(frozen=True)
class Device:
    base: int = 0x100
    scale: float = 1.0
    name: str = ""


def test_each_takes_what_it_knows():
    fields = {"base": "0x2A0", "baud": "115200", "dtr": "false", "scale": "2.5e-3", "name": "7"}
    line, device = take_options("sensor", fields, Line, Device)
    assert line == Line(115200, False)
    assert device == Device(0x2A0, 2.5e-3, "7")
    assert take_options("sensor", {}, Line, Device) == (Line(), Device())


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"bade": "1"}, "sensor has no option 'bade'; did you mean ba"),
        ({"zzz": "1"}, "sensor has no option 'zzz'; there are baud, dtr"),
        ({"baud": "fast"}, "sensor: baud: expected a whole number, got 'fast'"),
        ({"dtr": "maybe"}, "sensor: dtr: expected true or false, got 'maybe'"),
    ],
)
def test_a_mistake_is_named(fields, said):
    with pytest.raises(ConfigError, match=said):
        parse_options("sensor", fields, Line)
