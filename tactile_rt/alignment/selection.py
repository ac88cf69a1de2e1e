"""Selection of sessions and units of recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.settings import no_such

TASKS = ("discrimination", "detection")
CELLS = ("excitatory", "inhibitory")
# Depth below the pia in um, as drawn by the recordings' author (github.com/cxrodgers/my,
# plot.py), who calls the depths below 1366 um L6b.
LAYERS_UM = {
    "L1": (0.0, 128.0),
    "L2/3": (128.0, 419.0),
    "L4": (419.0, 626.0),
    "L5": (626.0, 1006.0),
    "L6": (1006.0, 1366.0),
}


@dataclass(frozen=True)
class Selection:
    """Criteria for the sessions and units to keep; by default all are kept."""

    # task of the sessions, ``discrimination`` or ``detection``; None for both
    task: str | None = None
    # patterns with ``*`` and ``?``, one of which must match a part of a session's name; empty for
    # all
    sessions: tuple[str, ...] = ()
    # range of the units' depth below the pia in um, the upper limit excluded; None for all
    depth_um: tuple[float, float] | None = None
    # type of the units, ``excitatory`` or ``inhibitory`` (putative); None for both
    cells: str | None = None

    @classmethod
    def of(
        cls,
        task: str | None = None,
        sessions: Sequence[str] = (),
        depth: str | None = None,
        cells: str | None = None,
    ) -> "Selection":
        """Parse a selection; `depth` is a layer, ``L4``, or a range in um, ``419-626``.

        Raises:
            ConfigError: the task, layer or cell type does not exist, or the range is invalid.
        """
        for what, value, known in (("task", task, TASKS), ("cell type", cells, CELLS)):
            if value is not None and value not in known:
                raise ConfigError(f"no {what} {value!r}: there are {name_some(known, 8)}")
        return cls(task, tuple(sessions), _parse_depths(depth) if depth else None, cells)

    def takes(self, session: str) -> bool:
        """Return whether a session's name matches the selection."""
        return not self.sessions or any(fnmatchcase(session, f"*{p}*") for p in self.sessions)

    def units(
        self, depth: NDArray[np.float64] | None, inhibitory: NDArray[Any] | None, number: int
    ) -> NDArray[np.bool_]:
        """Return a mask (unit,) of a session's selected units.

        Args:
            depth: (unit,) in um below the pia; None if unknown.
            inhibitory: (unit,) True or 1 for a putative inhibitory unit; None if unknown.

        Raises:
            ConfigError: units are selected by a property that is unknown for the session.
        """
        kept = np.ones(number, dtype=np.bool_)
        if self.depth_um is not None:
            if depth is None:
                raise ConfigError("has no column units/depth to select by")
            low, high = self.depth_um
            kept &= (depth >= low) & (depth < high)
        if self.cells is not None:
            if inhibitory is None:
                raise ConfigError("has no column units/inhibitory of 0 and 1 to select by")
            kept &= inhibitory == (self.cells == "inhibitory")
        return kept

    def __str__(self) -> str:
        parts = [
            self.task or "",
            " or ".join(self.sessions),
            "{:g}-{:g} um deep".format(*self.depth_um) if self.depth_um else "",
            self.cells or "",
        ]
        return ", ".join(part for part in parts if part)


def _parse_depths(text: str) -> tuple[float, float]:
    layers = {name.replace("/", ""): depths for name, depths in LAYERS_UM.items()}
    if (known := layers.get(text.upper().replace("/", ""))) is not None:
        return known
    low, _, high = text.partition("-")
    try:
        depths = float(low), float(high)
    except ValueError:
        depths = (0.0, 0.0)
    if not 0 <= depths[0] < depths[1] < np.inf:
        raise ConfigError(
            f"depth {text!r} is neither a layer ({', '.join(LAYERS_UM)}) nor a range in um, 419-626"
        )
    return depths


TARGET_PARTS = ("all", *LAYERS_UM, *CELLS)


def part_of(animals: Sequence[Animal], part: str) -> tuple[Animal, ...]:
    """Select the units of one part of cortex; animals without such units are left out.

    The borders of layers are those of `LAYERS_UM`, though they differ between mice: units near a
    border are assigned by depth alone.
    """
    if part not in TARGET_PARTS:
        raise ConfigError(no_such("part of cortex", part, TARGET_PARTS))
    if part == "all":
        return tuple(animals)
    kept = []
    for animal in animals:
        sessions = tuple(cut for s in animal.sessions if (cut := _cut_session(s, part)) is not None)
        if sessions:
            kept.append(replace(animal, sessions=sessions))
    return tuple(kept)


def _cut_session(session: NeuralSession, part: str) -> NeuralSession | None:
    selection = Selection(depth_um=LAYERS_UM.get(part), cells=part if part in CELLS else None)
    try:
        chosen = selection.units(session.depth, session.inhibitory, session.rates.shape[1])
    except ConfigError:  # depth or type of the units is unknown
        return None
    if not chosen.any():
        return None
    return replace(
        session,
        rates=session.rates[:, chosen],
        course=None if session.course is None else session.course[..., chosen],
        depth=None if session.depth is None else session.depth[chosen],
        inhibitory=None if session.inhibitory is None else session.inhibitory[chosen],
    )
