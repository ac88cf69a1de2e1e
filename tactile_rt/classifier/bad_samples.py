"""Values that no sensor measures: not a number, infinite, or absurd."""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.stream import Chunk

__all__ = ["without_bad_samples"]

# Far beyond any load, and far below where squares of float32 overflow.
ABSURD = 1e9


def without_bad_samples(chunk: Chunk) -> tuple[Chunk, int]:
    """Mark elements invalid that claim a value which is none.

    Returns:
        The chunk itself where nothing is wrong, else a copy with those elements marked and zero;
        and how many element samples were marked that had not been.
    """
    # One product is the cheapest look at all values: what is wrong with any of them shows in it.
    if np.vdot(chunk.values, chunk.values) < ABSURD**2:
        return chunk, 0
    largest = np.abs(chunk.values).max(axis=2)  # (n, element); NaN if one is
    good: NDArray[np.bool_] = largest < ABSURD
    bad = int((chunk.valid & ~good).sum())
    values = np.where(good[..., None], chunk.values, np.float32(0))
    return Chunk(chunk.seq, chunk.t_ns, values, chunk.valid & good), bad
