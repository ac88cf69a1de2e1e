"""Geometry and material of a whisker, which a table row can describe.

Lengths in mm and angles in rad here, as the field publishes them; `world` converts.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError

Floats = NDArray[np.float64]
GAUSS = np.polynomial.legendre.leggauss(5)  # nodes, weights: exact to degree 9

YOUNG_MODULUS_PA = 5e9  # Zweifel et al. (2021), PNAS 118(27)
DENSITY_BASE, DENSITY_TIP = 1260.0, 1690.0  # kg/m^3, Belli et al. (2017)
DAMPING_RATIO = 0.32  # of the first mode, Zweifel et al. (2021)
FRICTION = 0.5
THINNEST_TIP_MM = 0.0015
STRAIGHT = 1e-9  # curvature times length below which arc and chord agree to the last digit
SLENDER = 10.0  # least length in base radii for which beam theory holds

# Columns of a table of whiskers, one whisker a row, and the fields that they fill.
REQUIRED = (
    *("whisker", "row", "col", "arc_length_mm", "curvature_a_per_mm"),
    *("base_x_mm", "base_y_mm", "base_z_mm"),
    *("base_theta_rad", "base_phi_rad", "base_zeta_rad"),
)
OPTIONAL = {
    "base_radius_mm": "base_radius",
    "tip_radius_mm": "tip_radius",
    "young_modulus_pa": "young_modulus",
    "density_base_kg_m3": "density_base",
    "density_tip_kg_m3": "density_tip",
    "damping_ratio": "damping_ratio",
    "friction": "friction",
    "mount_stiffness_nm_rad": "mount_stiffness",
    "mount_damping_nms_rad": "mount_damping",
}
NOT_NEGATIVE = ("damping_ratio", "friction", "mount_stiffness", "mount_damping")
POSITIVE = {"arc_length_mm": "length"} | {
    column: field for column, field in OPTIONAL.items() if field not in NOT_NEGATIVE
}
# In the columns' units: a value outside is in a wrong unit, or cannot be simulated.
PLAUSIBLE = {
    "arc_length_mm": (0.1, 500.0),
    "base_radius_mm": (5e-4, 50.0),
    "tip_radius_mm": (5e-4, 50.0),
    "young_modulus_pa": (1e4, 1e13),
    "density_base_kg_m3": (100.0, 1e5),
    "density_tip_kg_m3": (100.0, 1e5),
}
TURN = 2 * math.pi  # rad; a larger angle must be in degrees
SOFTEST_MOUNT = 1e-12  # N m / rad: a mouse's whisker has 1e-6 at its base
NAME = re.compile(r"[\w.+-]+")  # MuJoCo's names are cut at spaces and joined by slashes
TAKEN = ("world", "head", "object")  # bodies that share a model with the whiskers


@dataclass(frozen=True)
class Whisker:
    """A whisker: a tapered, planar, parabolic beam, mounted at its base point.

    Attributes:
        name: The whisker's name, without spaces, e.g. ``C2``: row letter and column.
        row, column: The whisker's cell on the array's grid, counted from 0 (row A, column 0).
        length: The arc length S from base to tip, mm.
        curvature: The coefficient a of y = a x^2 in the whisker's plane, 1/mm; 0 is straight, and a
            negative value curves towards -y.
        base: The base point (x, y, z) in the array frame, mm.
        angles: The base angles (theta, phi, zeta): azimuth, elevation, torsion, rad.
        base_radius, tip_radius: The radii of the cone at its two ends, mm; equal for a cylinder,
            never thicker at the tip.
        young_modulus: Young's modulus E of the material, Pa.
        density_base, density_tip: The mass density at either end, kg/m^3.
        damping_ratio: The damping ratio of the first mode (1 is critical).
        mount_stiffness: The rotational stiffness of the whisker's mount, about each axis across the
            whisker, N m / rad; 0 for a rigid mount.
        mount_damping: The rotational damping of the mount, N m s / rad.
    """

    name: str
    row: int
    column: int
    length: float
    curvature: float
    base: tuple[float, float, float]
    angles: tuple[float, float, float]
    base_radius: float
    tip_radius: float
    young_modulus: float = YOUNG_MODULUS_PA
    density_base: float = DENSITY_BASE
    density_tip: float = DENSITY_TIP
    damping_ratio: float = DAMPING_RATIO
    friction: float = FRICTION
    mount_stiffness: float = 0.0
    mount_damping: float = 0.0

    def __post_init__(self) -> None:
        who = f"whisker {self.name}"
        if not NAME.fullmatch(self.name) or self.name in TAKEN:
            raise ConfigError(
                f"whisker {self.name!r}: a name is letters, digits, '.', '-', '+' and '_', and "
                f"none of {', '.join(TAKEN)}"
            )
        if self.row < 0 or self.column < 0:
            raise ConfigError(f"{who}: row and column are counted from 0")
        for what in (self.base, self.angles, (self.curvature,)):
            if not all(map(math.isfinite, what)):
                raise ConfigError(f"{who}: base, angles and curvature must be finite")
        # Messages name the columns of a table, which include the unit.
        for column, name in POSITIVE.items():
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{who}: {column} must be positive, not {getattr(self, name):g}")
        for column, name in OPTIONAL.items():
            if name in NOT_NEGATIVE and not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"{who}: {column} must be 0 or more, not {getattr(self, name):g}")
        if 0 < self.mount_stiffness < SOFTEST_MOUNT:
            raise ConfigError(
                f"{who}: mount_stiffness_nm_rad must be {SOFTEST_MOUNT:g} or more, or 0 for a "
                f"mount that does not give, not {self.mount_stiffness:g}: mind the unit"
            )
        if self.mount_damping and not self.mount_stiffness:
            raise ConfigError(
                f"{who}: mount_damping_nms_rad needs mount_stiffness_nm_rad; give that, too"
            )
        for column, (least, most) in PLAUSIBLE.items():
            value = getattr(self, POSITIVE[column])
            if not least <= value <= most:
                raise ConfigError(
                    f"{who}: {column} must be {least:g} to {most:g}, not {value:g}: mind the unit"
                )
        if self.tip_radius > self.base_radius:
            raise ConfigError(
                f"{who}: tip_radius_mm {self.tip_radius:g} exceeds base_radius_mm "
                f"{self.base_radius:g}; a whisker is nowhere thicker than at its base"
            )
        if self.length < SLENDER * self.base_radius:
            raise ConfigError(
                f"{who}: arc_length_mm {self.length:g} is less than {SLENDER:g} times "
                f"base_radius_mm {self.base_radius:g}; a whisker is slender (both are in mm)"
            )

    @classmethod
    def from_columns(cls, values: Mapping[str, object]) -> "Whisker":
        """Make a whisker from a table row: text or numbers by column name.

        Columns: `REQUIRED`, `OPTIONAL`; grid rows count from 1, as in the field's tables. The
        default material is keratin; a radius or density of the base alone holds for the tip, too.
        """
        given = {k: v for k, v in values.items() if v is not None and v != ""}
        missing = [column for column in REQUIRED if column not in given]
        if missing:
            raise ConfigError(f"no {missing[0]}; give it a value")
        name = given["whisker"]
        if not isinstance(name, str):
            raise ConfigError(f"whisker must be a name, in quotes, not {name!r}")
        row, column = _read_integer(given, "row", 1) - 1, _read_integer(given, "col", 0)
        length = _read_number(given, "arc_length_mm")
        fields = {field: _read_number(given, at) for at, field in OPTIONAL.items() if at in given}
        for base, tip in (
            ("base_radius_mm", "tip_radius_mm"),
            ("density_base_kg_m3", "density_tip_kg_m3"),
        ):
            if base in given:
                fields.setdefault(OPTIONAL[tip], fields[OPTIONAL[base]])
            elif tip in given:
                raise ConfigError(f"{tip} is given without {base}; give that, too")
        if "base_radius" not in fields:
            radii = keratin_radii(length, row, column)
            fields["base_radius"], fields["tip_radius"] = radii
        x, y, z = (_read_number(given, f"base_{axis}_mm") for axis in "xyz")
        theta, phi, zeta = (_read_angle(given, f"base_{a}_rad") for a in ("theta", "phi", "zeta"))
        return cls(
            name=name.strip(),
            row=row,
            column=column,
            length=length,
            curvature=_read_number(given, "curvature_a_per_mm"),
            base=(x, y, z),
            angles=(theta, phi, zeta),
            **fields,
        )

    def radius(self, s: Floats) -> Floats:
        """Return the radius (mm) at arc length s (mm): linear from base to tip."""
        base, tip = self.base_radius, self.tip_radius
        return base + (tip - base) * np.asarray(s) / self.length

    def density(self, s: Floats) -> Floats:
        """Return the mass density (kg/m^3) at arc length s (mm): linear from base to tip."""
        base, tip = self.density_base, self.density_tip
        return base + (tip - base) * np.asarray(s) / self.length

    def bending_stiffness(self, s: Floats) -> Floats:
        """Return the bending stiffness E I (N mm^2) at arc length s (mm)."""
        return self.young_modulus * 1e-6 * np.pi * self.radius(s) ** 4 / 4

    def centreline(self, s: Floats) -> Floats:
        """Return centreline points (len(s), 3) at arc lengths s, mm, in the whisker frame.

        The whisker leaves its base along +x and curves towards +y (-y if negatively curved).
        """
        a = self.curvature
        if abs(a) * self.length < STRAIGHT:
            at = np.clip(np.asarray(s, dtype=np.float64), 0.0, self.length)
        else:
            x = np.linspace(0.0, self.length, 2001)
            arc = x * np.sqrt(1 + (2 * a * x) ** 2) / 2 + np.arcsinh(2 * a * x) / (4 * a)
            at = np.interp(s, arc, x)
        return np.stack([at, a * at**2, np.zeros_like(at)], axis=-1)

    @property
    def orientation(self) -> Floats:
        """Rotation (3, 3) from the whisker frame to the array frame (Knutsen et al. 2008)."""
        theta, phi, zeta = self.angles
        return (
            rotation("z", theta - np.pi / 2) @ rotation("y", -phi) @ rotation("x", zeta + np.pi / 2)
        )


def link_nodes(whisker: Whisker, links: int) -> Floats:
    """Return arc lengths (links + 2,), mm, of base, joints (at cell midpoints) and tip."""
    joints = (np.arange(links) + 0.5) * (whisker.length / links)
    return np.concatenate([[0.0], joints, [whisker.length]])


def joint_stiffness(whisker: Whisker, start: float, stop: float) -> float:
    """Return the stiffness (uN m / rad) of the joint at a cell's midpoint.

    Under a force at the tip, the joint deflects it as much as this cell of the beam does, by the
    integral of (L - s)^2 / E I: near a thin tip, more than E I at the midpoint would give.
    """
    s, weights = start + (GAUSS[0] + 1) * (stop - start) / 2, GAUSS[1] * (stop - start) / 2
    lever = whisker.length - s
    bend = float(weights @ (lever**2 / whisker.bending_stiffness(s)))  # 1/N
    return (whisker.length - (start + stop) / 2) ** 2 / bend * 1e3


def link_inertia(whisker: Whisker, start: float, stop: float) -> tuple[float, float, float, float]:
    """Return a link's mass (mg), centroid (mm from start), axial and transverse inertia (mg mm^2).

    The taper is included: with uniform links the mass would lie too far out, and the whisker's
    first resonance would be up to 3 % too low.
    """
    x, weights = (GAUSS[0] + 1) * (stop - start) / 2, GAUSS[1] * (stop - start) / 2
    radius = whisker.radius(start + x)
    mass = weights * whisker.density(start + x) * 1e-3 * np.pi * radius**2
    total = float(mass.sum())
    centre = float(mass @ x / total)
    axial = float(mass @ radius**2 / 2)
    return total, centre, axial, float(mass @ (radius**2 / 4 + (x - centre) ** 2))


def rotation(axis: str, angle: float | Floats) -> Floats:
    """Return right-handed rotation matrices (..., 3, 3) by angles (rad) about x, y or z."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., 3 - i - j, 3 - i - j] = 1.0
    matrix[..., i, i] = matrix[..., j, j] = np.cos(angle)
    matrix[..., j, i] = np.sin(angle)
    matrix[..., i, j] = -matrix[..., j, i]
    return matrix


def keratin_radii(length: float, row: int, column: int) -> tuple[float, float]:
    """Return base and tip radius (mm) of a rat's or mouse's whisker (Belli et al. 2017).

    They are regressions on arc length (mm) and grid cell (row and column from 0). The tip is half
    as thick as the radius slope leaves it, and at least `THINNEST_TIP_MM`, as in the published
    simulator: short rostral whiskers would otherwise end before their tip.
    """
    base = (0.041 + 0.002 * length + 0.011 * (row + 1) - 0.0039 * column) / 2
    slope = 0.0012 + 0.00017 * (row + 1) - 0.000066 * column + 0.00011 * column**2
    return base, max((base - slope * length) / 2, THINNEST_TIP_MM)


def _read_number(values: Mapping[str, object], column: str) -> float:
    value = values[column]
    try:
        number = float(value) if isinstance(value, str | int | float) else math.nan
    except (ValueError, OverflowError):
        raise ConfigError(f"{column} is not a number: {value!r}") from None
    if isinstance(value, bool) or not math.isfinite(number):
        raise ConfigError(f"{column} is not a finite number: {value!r}")
    return number


def _read_angle(values: Mapping[str, object], column: str) -> float:
    number = _read_number(values, column)
    if abs(number) > TURN:
        raise ConfigError(f"{column} must be within a turn, 6.28, not {number:g}: mind the unit")
    return number


def _read_integer(values: Mapping[str, object], column: str, least: int) -> int:
    number = _read_number(values, column)
    if not number.is_integer() or number < least:
        raise ConfigError(f"{column} must be a whole number from {least}, not {values[column]!r}")
    return int(number)
