"""Parts of an animal's cortex as targets of their own: a layer, or a type of cell.

Depths are below the pia. The borders are those that the recordings' author draws
(github.com/cxrodgers/my, plot.py); a single mouse's differ, and what lies at a border is what its
depth says.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.neural import Animal, NeuralSession
from tactile_rt.settings import no_such
from tactile_rt.stream import ConfigError

__all__ = ["CELLS", "LAMINAE", "TARGET_PARTS", "part_of"]

# (from, to) in um below the pia
LAMINAE = {
    "L2/3": (128.0, 419.0),
    "L4": (419.0, 626.0),
    "L5": (626.0, 1006.0),
    "L6": (1006.0, 1366.0),
}
CELLS = ("excitatory", "inhibitory")  # putative, by the width of their spikes
TARGET_PARTS = ("all", *LAMINAE, *CELLS)


def part_of(animals: Sequence[Animal], part: str) -> tuple[Animal, ...]:
    """The same animals with the units of a part alone; who has none is left out.

    Raises:
        ConfigError: no such part.
    """
    if part not in TARGET_PARTS:
        raise ConfigError(no_such("part of cortex", part, TARGET_PARTS))
    if part == "all":
        return tuple(animals)
    kept = []
    for animal in animals:
        sessions = tuple(cut for s in animal.sessions if (cut := _cut(s, part)) is not None)
        if sessions:
            kept.append(replace(animal, sessions=sessions))
    return tuple(kept)


def _cut(session: NeuralSession, part: str) -> NeuralSession | None:
    chosen = _chosen(session, part)
    if chosen is None or not chosen.any():
        return None
    return replace(
        session,
        rates=session.rates[:, chosen],
        course=None if session.course is None else session.course[..., chosen],
        depth=None if session.depth is None else session.depth[chosen],
        inhibitory=None if session.inhibitory is None else session.inhibitory[chosen],
    )


def _chosen(session: NeuralSession, part: str) -> NDArray[np.bool_] | None:
    """Which units are of a part; None where nobody knows."""
    if part in CELLS:
        if session.inhibitory is None:
            return None
        return session.inhibitory if part == "inhibitory" else ~session.inhibitory
    if session.depth is None:
        return None
    low, high = LAMINAE[part]
    return (session.depth >= low) & (session.depth < high)
