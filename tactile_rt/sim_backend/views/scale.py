"""How forces are drawn: one scale for colours and arrows, stated in round numbers."""

from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

__all__ = ["ForceScale", "round_number"]

RGBA = tuple[float, float, float, float]

_COLOURS = mpl.colormaps["plasma_r"]
_UNTOUCHED: RGBA = (0.62, 0.62, 0.62, 1.0)
_FELT = 0.01  # of the top: less is drawn as untouched
_LONGEST = 1.5  # arrows grow no longer than this, so that a snap does not cross the picture
_HEARD_OF = 98.0  # percentile of the moments' strongest forces that gets the top colour


def round_number(value: float) -> float:
    """The nearest of 1, 2, 5, 10, 20, ... (on a logarithmic scale)."""
    if not value > 0:
        return 1.0
    choices = [m * 10.0**e for e in range(-9, 10) for m in (1, 2, 5)]
    return min(choices, key=lambda c: abs(np.log(c / value)))


@dataclass(frozen=True)
class ForceScale:
    """Colours and arrow lengths of forces.

    Attributes:
        top_mn: The force that gets the strongest colour, mN.
        arrow_mm: The length of that force's arrow, mm in the world.
    """

    top_mn: float
    arrow_mm: float

    @classmethod
    def fitting(cls, forces: NDArray[np.float64], extent_mm: float) -> "ForceScale":
        """For forces (moment, element) in N, in a picture that shows extent_mm of height."""
        strongest = 1e3 * forces.max(axis=1)
        touched = strongest[strongest > 0.02 * strongest.max()]
        top = float(np.percentile(touched, _HEARD_OF)) if len(touched) else 0.0
        return cls(round_number(top / 1.2), round_number(0.2 * extent_mm))

    def felt(self, force_mn: float) -> bool:
        """Whether a force is drawn at all."""
        return force_mn >= _FELT * self.top_mn

    def colour(self, force_mn: float) -> RGBA:
        """RGBA of a force; grey for none."""
        if not self.felt(force_mn):
            return _UNTOUCHED
        r, g, b, a = _COLOURS(0.12 + 0.83 * min(force_mn / self.top_mn, 1.0))
        return r, g, b, a

    def length(self, force_mn: float) -> float:
        """Length of a force's arrow, mm."""
        return self.arrow_mm * min(force_mn / self.top_mn, _LONGEST)
