"""Parts of an animal's cortex as targets of their own: a layer, or a type of cell.

A mouse's borders differ from those of `selection.LAYERS_UM`, and what lies at a border is what its
depth says.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.models.alignment.neural import Animal, NeuralSession
from tactile_rt.models.alignment.selection import CELLS, LAYERS_UM
from tactile_rt.settings import no_such

__all__ = ["TARGET_PARTS", "part_of"]

TARGET_PARTS = ("all", *LAYERS_UM, *CELLS)


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
    low, high = LAYERS_UM[part]
    return (session.depth >= low) & (session.depth < high)
