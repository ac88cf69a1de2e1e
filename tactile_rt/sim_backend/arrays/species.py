"""The animals' arrays: published measurements of their whiskers, by the name of the species.

The tables are in ``data/``, one line a whisker of the right side; a species is added by its table
and a line in `SPECIES`.
"""

import csv
import difflib
from collections.abc import Callable
from importlib import resources
from types import MappingProxyType

import numpy as np

from tactile_rt import extensions
from tactile_rt.errors import ConfigError, name_some
from tactile_rt.sim_backend.arrays.whisker_array import (
    MOUNT,
    Mount,
    WhiskerArray,
    both_sides,
    centred_mount,
    mirrored,
)
from tactile_rt.sim_backend.arrays.whiskers import Whisker

__all__ = ["ROBOTS", "SPECIES", "mouse_whiskers", "robot_text", "species_array"]

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


def mouse_whiskers() -> tuple[Whisker, ...]:
    """The 30 right-side mystacial whiskers of the mouse (Bresee et al. 2023)."""
    return _measured("mouse.csv")


def rat_whiskers() -> tuple[Whisker, ...]:
    """The 30 right-side mystacial whiskers of the rat (Belli et al. 2017, 2018)."""
    return _measured("rat.csv")


def _measured(file: str) -> tuple[Whisker, ...]:
    text = resources.files(__package__).joinpath("data", file).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return tuple(Whisker.from_columns(row) for row in csv.DictReader(lines))


SPECIES: dict[str, Callable[[], tuple[Whisker, ...]]] = {
    "mouse": mouse_whiskers,
    "rat": rat_whiskers,
}
SIDES = ("right", "left", "both")


def species_array(name: str) -> WhiskerArray:
    """The array of an animal: ``mouse``, ``rat``, ``mouse-left``, ``rat-both`` ...

    ``mouse`` is ``mouse-right``. An animal's left side alone is mounted as its right side's mirror
    image, whiskers reaching along world -x, so that a mirrored sweep gives mirrored loads; both
    sides stand on one head, mounted as for the right side alone. The rat's pose in the published
    sweeps is not known: its head is turned as the mouse's and placed so that the mean of its base
    points is where the mouse's is.
    """
    animal, _, side = name.partition("-")
    known = [*SPECIES, *(f"{a}-{s}" for a in SPECIES for s in SIDES)]
    if name not in known:
        known += [*ROBOTS, *extensions.added_names(extensions.ARRAYS)]
        near = difflib.get_close_matches(name, known, 1)
        raise ConfigError(
            f"no simulated array {name!r}: "
            + (f"did you mean {near[0]}?" if near else f"there are {name_some(known, 8)}")
            + " (or give a .csv or .toml file)"
        )
    side = side or "right"
    whiskers = SPECIES[animal]()
    right = WhiskerArray(f"{animal}-right", whiskers, _mount(whiskers))
    if side == "left":
        left = tuple(mirrored(w) for w in whiskers)
        return WhiskerArray(f"{animal}-left", left, right.mount.mirrored())
    return right if side == "right" else both_sides(right, f"{animal}-both")


def _mount(whiskers: tuple[Whisker, ...]) -> Mount:
    mouse = mouse_whiskers()
    if whiskers == mouse:
        return MOUNT
    middle = MOUNT.position + MOUNT.rotation @ np.mean([w.base for w in mouse], axis=0)
    return centred_mount(whiskers, tuple(middle), MOUNT.roll_pitch_yaw)
