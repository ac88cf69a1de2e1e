"""RDMs of units gathered from many sessions, without keeping the units.

Pearson's r over units needs their number, sums and products alone, and those add up: a session's
half-means of all bootstraps shrink to a few numbers each, and animals pool in any combination.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.rdm import CONSTANT, UPPER

__all__ = ["Moments", "moments_of"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over units of responses to six stimuli.

    Attributes:
        units: (...) The number of units that the sums run over.
        sums: (..., 6) The sum over units of the response to each stimulus.
        products: (..., 6, 6) The sum over units of the products of the responses to two stimuli.
    """

    units: Floats
    sums: Floats
    products: Floats

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(
            self.units + other.units, self.sums + other.sums, self.products + other.products
        )

    def rdm(self) -> Floats:
        """RDMs (..., 15); NaN where a stimulus's response is the same in all units."""
        units = np.maximum(self.units, 1)[..., None]
        mean = self.sums / units
        covariance = self.products - units[..., None] * mean[..., :, None] * mean[..., None, :]
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)
        scale = np.diagonal(self.products, axis1=-2, axis2=-1)
        deviation = np.sqrt(np.where(variance > np.sqrt(CONSTANT) * scale, variance, np.nan))
        correlation = covariance / (deviation[..., :, None] * deviation[..., None, :])
        return np.asarray(1 - correlation[..., UPPER[0], UPPER[1]])


def moments_of(patterns: Floats, counted: NDArray[np.bool_] | None = None) -> Moments:
    """Moments of responses (..., 6, unit).

    Args:
        patterns: the responses.
        counted: (..., unit) which units count; default: all.
    """
    if counted is None:
        units = np.full(patterns.shape[:-2], float(patterns.shape[-1]))
    else:
        units = counted.sum(axis=-1, dtype=np.float64)
        patterns = np.where(counted[..., None, :], patterns, 0.0)
    return Moments(
        units=units,
        sums=patterns.sum(axis=-1),
        products=np.matmul(patterns, np.swapaxes(patterns, -1, -2)),
    )
