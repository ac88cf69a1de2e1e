"""The mirror image of an array: a left one for a model of the right one."""

import re
from dataclasses import dataclass, field

from tactile_rt.errors import ConfigError

__all__ = ["Mirror"]

Quaternion = tuple[float, float, float, float]

AXES = ("x", "y", "z")
# A component of a vector, as in fx, x, acc_x, bx2; and of what kind a vector of this unit is.
COMPONENT = re.compile(r"(?:[A-Za-z]?|.*[_.\- ])([xyz])\d*")
POLAR = ("N", "m", "m/s", "m/s^2", "m/s2")
AXIAL = ("N m", "T", "rad/s")
UNTOLD = ("rad", "1", "")  # angles about who knows what, counts of who knows what


@dataclass(frozen=True)
class Mirror:
    """The array's mirror image: a left array for a model of the right one, or back.

    Bases are reflected along an axis n of the mount frame, S = 1 - 2 n n^T. What is left of an
    element's frame R is turned into a right-handed one again by an axis a of its own,
    T = 1 - 2 a a^T: p' = S p, R' = S R T. A force is a vector, a moment a pseudovector: in the
    element's frame f' = T f and m' = -T m. The mirror image of the mirror image is the array
    itself.

    Attributes:
        axis: Axis of the mount frame, x, y or z, that points from side to side.
        element_axis: Axis of the element's frame that is flipped: for whiskers z, across the plane
            of their curvature; where elements have the mount's axes, the same as `axis`.
        signs: Factor 1 or -1 by output channel, where its name and unit do not tell (an angle, a
            count).
    """

    axis: str = "x"
    element_axis: str = "z"
    signs: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for what in ("axis", "element_axis"):
            if getattr(self, what) not in AXES:
                raise ConfigError(f"mirror.{what} is x, y or z, not {getattr(self, what)!r}")
        for channel, sign in self.signs.items():
            if sign not in (1, -1):
                raise ConfigError(f"mirror.signs.{channel} is 1 or -1, not {sign}")

    def sign(self, channel: str, unit: str) -> int:
        """What a channel's values are multiplied by.

        Raises:
            ConfigError: neither its name and unit nor `signs` tell.
        """
        if channel in self.signs:
            return self.signs[channel]
        component = COMPONENT.fullmatch(channel)
        if component and unit in (*POLAR, *AXIAL):
            return -1 if (component[1] == self.element_axis) == (unit in POLAR) else 1
        if unit in (*POLAR, *AXIAL, *UNTOLD):
            raise ConfigError(
                f"mirror: nothing tells whether {channel} ({unit}) changes its sign; set "
                f"mirror.signs.{channel} to 1 or -1"
            )
        return 1

    def pose(
        self, position: tuple[float, float, float], orientation: Quaternion
    ) -> tuple[tuple[float, float, float], Quaternion]:
        """The pose of the mirror image: position (m) and unit quaternion (w, x, y, z), w >= 0."""
        x, y, z = (0.0 - p if a == self.axis else p for a, p in zip(AXES, position, strict=True))
        # S and T are half turns about their axes times -1, and the two -1 cancel in S R T.
        w, *v = _times(_times(_half_turn(self.axis), orientation), _half_turn(self.element_axis))
        # The first that is not zero is positive: two quaternions of one rotation are then equal.
        flip = next((q < 0 for q in (w, *v) if q), False)
        a, b, c, d = ((0.0 - q if flip else q) + 0.0 for q in (w, *v))
        return (x, y, z), (a, b, c, d)


def _half_turn(axis: str) -> Quaternion:
    x, y, z = (float(a == axis) for a in AXES)
    return 0.0, x, y, z


def _times(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton's product."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )
