"""Robots' arrays: published devices with whiskers, by name, and what reads them.

The descriptions are in ``data/``, with their sources; an array is added by its .toml file and a
line in `ROBOTS`. One that is read by a codec of its own has that codec's name.
"""

from importlib import resources
from types import MappingProxyType

__all__ = ["ROBOTS", "robot_text"]

# By name: the options of the serial URL that reads the array.
ROBOTS = MappingProxyType(
    {
        "hx711_whisker": "codec=hx711_whisker",
        "mlx_hex": "codec=mlx_hex",
        "rattechan": "codec=anyskin&magnetometers=3&temperature=false&rate_hz=300",
    }
)


def robot_text(name: str) -> str:
    """The description of one of `ROBOTS`: what is in its .toml file."""
    file = resources.files(__package__).joinpath("data", f"{name}.toml")
    return file.read_text(encoding="utf-8")
