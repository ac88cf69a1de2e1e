"""Whisker morphology: the published measurements and the geometry that follows from them.

Lengths in mm and angles in rad here, as the field publishes them; `array.py` converts.
"""

import csv
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray

__all__ = ["YOUNG_MODULUS_PA", "Whisker", "mouse_whiskers", "rotation"]

YOUNG_MODULUS_PA = 5e9  # Zweifel et al. (2021), PNAS 118(27)
DENSITY_BASE, DENSITY_TIP = 1260.0, 1690.0  # kg/m^3, Belli et al. (2017)
DAMPING_RATIO = 0.32  # of the first mode, Zweifel et al. (2021)
FRICTION = 0.5
THINNEST_TIP_MM = 0.0015


@dataclass(frozen=True)
class Whisker:
    """One whisker: a tapered, planar, parabolic beam on its base point.

    Attributes:
        name: row letter and column, e.g. ``C2``.
        row, column: place on the grid, counted from 0 (row A, column 0).
        length: arc length S, mm.
        curvature: a of y = a x^2 in the whisker's plane, 1/mm.
        base: base point in the array frame, mm.
        angles: base angles (theta, phi, zeta): azimuth, elevation, torsion, rad.
    """

    name: str
    row: int
    column: int
    length: float
    curvature: float
    base: tuple[float, float, float]
    angles: tuple[float, float, float]

    def radius(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Radius (mm) at arc length s (mm): linear from base to tip (Belli et al. 2017)."""
        row, column = self.row + 1, self.column
        base = (0.041 + 0.002 * self.length + 0.011 * row - 0.0039 * column) / 2
        slope = 0.0012 + 0.00017 * row - 0.000066 * column + 0.00011 * column**2
        tip = max((base - slope * self.length) / 2, THINNEST_TIP_MM)
        return base + (tip - base) * np.asarray(s) / self.length

    def density(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mass density (kg/m^3) at arc length s (mm)."""
        return DENSITY_BASE + (DENSITY_TIP - DENSITY_BASE) * np.asarray(s) / self.length

    def bending_stiffness(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """E I (N mm^2) at arc length s (mm), I = pi r^4 / 4."""
        return YOUNG_MODULUS_PA * 1e-6 * np.pi * self.radius(s) ** 4 / 4

    def centreline(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (len(s), 3) at arc lengths s (mm) in the whisker frame, mm.

        The whisker leaves its base along +x and curves towards +y.
        """
        a = self.curvature
        x = np.linspace(0.0, self.length, 2001)
        arc = x * np.sqrt(1 + (2 * a * x) ** 2) / 2 + np.arcsinh(2 * a * x) / (4 * a)
        at = np.interp(s, arc, x)
        return np.stack([at, a * at**2, np.zeros_like(at)], axis=-1)

    @property
    def orientation(self) -> NDArray[np.float64]:
        """(3, 3) rotation from the whisker frame to the array frame (Knutsen et al. 2008)."""
        theta, phi, zeta = self.angles
        return (
            rotation("z", theta - np.pi / 2) @ rotation("y", -phi) @ rotation("x", zeta + np.pi / 2)
        )


def rotation(axis: str, angle: float) -> NDArray[np.float64]:
    """(3, 3) right-handed rotation by angle (rad) about the x, y or z axis."""
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i] = np.sin(angle)
    matrix[i, j] = -matrix[j, i]
    return matrix


def mouse_whiskers() -> tuple[Whisker, ...]:
    """The 30 right-side mystacial whiskers of the mouse (Bresee et al. 2023)."""
    text = resources.files(__package__).joinpath("data/mouse.csv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return tuple(
        Whisker(
            name=row["whisker"],
            row=int(row["row"]) - 1,
            column=int(row["col"]),
            length=float(row["arc_length_mm"]),
            curvature=float(row["curvature_a_per_mm"]),
            base=(float(row["base_x_mm"]), float(row["base_y_mm"]), float(row["base_z_mm"])),
            angles=(
                float(row["base_theta_rad"]),
                float(row["base_phi_rad"]),
                float(row["base_zeta_rad"]),
            ),
        )
        for row in csv.DictReader(lines)
    )
