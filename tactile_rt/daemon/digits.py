"""The fewest digits that read back as the same float32.

JSON's encoder knows double precision alone, and writes 0.1 as 0.10000000149011612.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["shortest"]

MOST = 9  # digits tell any float32 from all others; 6 and fewer always survive it
FEWEST = 6
SMALLEST, LARGEST = 1e-13, 1e8  # where powers of ten and products with them are exact enough


def _scales() -> NDArray[np.float64]:
    """(256,) by the bits of a float32's exponent: the power of ten that leaves 9
    digits before the point, or 10."""
    decimal = np.floor((np.arange(256) - 127) * np.log10(2.0)).astype(int)
    return np.array([10.0 ** min(max(MOST - 1 - e, 0), 22) for e in decimal])


SCALES = _scales()


def shortest(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """The same numbers in double precision, each moved to the decimal with the fewest digits that
    is nearer to it than to any other float32: what is written of it is short, and no less exact.

    Args:
        values: any shape. NaN and infinities stay.
    """
    singles = np.ascontiguousarray(values, np.float32).ravel()
    exact = singles.astype(np.float64)
    size = np.abs(exact)
    within = (size >= SMALLEST) & (size < LARGEST)
    scale = SCALES[singles.view(np.uint32) >> 23 & 0xFF]
    # Whole numbers below 2^53 and powers of ten up to 10^22 are exact in double precision, so that
    # their quotient is the very double that the decimal is read as.
    found = np.rint(exact * scale) / scale
    found[~within] = exact[~within]
    for n in range(1, MOST - FEWEST + 1):
        scale_n = scale / 10.0**n
        fewer = np.rint(exact * scale_n) / scale_n
        np.copyto(found, fewer, where=within & (fewer.astype(np.float32) == singles))
    for i in np.flatnonzero(~within & (size > 0) & np.isfinite(size)).tolist():
        found[i] = float(str(singles[i]))
    made: NDArray[Any] = found.reshape(values.shape)
    return made
