"""Trajectories of the whiskers' bases: regular whisking, or a recorded trajectory.

A whisker's base rotates in azimuth (theta, protraction), elevation (phi) and torsion (zeta); the
last two follow the first with a slope that differs from row to row.
"""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import convert, read_csv
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker

# d phi / d theta and d zeta / d theta of rows A-E (Knutsen et al. 2008, Neuron)
ELEVATION_SLOPES = (0.398, 0.591, 0.578, 0.393, 0.217)
TORSION_SLOPES = (-0.9, -0.284, 0.243, 0.449, 0.744)
ANGLES = ("theta", "phi", "zeta")
COLUMN = re.compile(r"(theta|phi|zeta)_deg(?:_(.+))?")
LARGEST_DEG = 120.0  # more must be an absolute angle or another unit, not an angle from rest


class Trajectory(Protocol):
    """Protocol of a motion of the whiskers' bases in time."""

    @property
    def duration_s(self) -> float:
        """Duration in s; infinite if it has no end."""

    def offsets(self, t_s: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
        """Compute rotations from the resting angles, (len(t_s), whisker, 3) rad, at times, s.

        Protraction, elevation and torsion; positive protraction is rostral on both sides. The
        bases stand still at time 0 and before.
        """


@dataclass(frozen=True)
class Whisk:
    """Regular sinusoidal whisking, with rows coupled as in the rat.

    Attributes:
        frequency_hz: The whisking cycles per second, Hz.
        protraction_deg, retraction_deg: The largest rotation forward and back from rest, degrees.
        ramp_s: The time from rest to full amplitude, s.
        duration_s: The length of the whole trajectory, s.
    """

    frequency_hz: float = 8.0
    protraction_deg: float = 35.0
    retraction_deg: float = 10.0
    ramp_s: float = 0.1
    duration_s: float = 1.5

    def __post_init__(self) -> None:
        limits = {
            "frequency_hz": (0.0, 50.0),
            "protraction_deg": (-LARGEST_DEG, LARGEST_DEG),
            "retraction_deg": (-LARGEST_DEG, LARGEST_DEG),
            "ramp_s": (0.01, 60.0),
            "duration_s": (0.01, 600.0),
        }
        for name, (low, high) in limits.items():
            if not low <= getattr(self, name) <= high:
                raise ConfigError(
                    f"whisk: {name} must be {low:g} to {high:g}, not {getattr(self, name):g}"
                )

    def offsets(self, t_s: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
        """Compute rotations from rest, see `Trajectory.offsets`."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)[:, None]
        phase = 2 * np.pi * self.frequency_hz * t  # 0 is fully retracted
        middle = (self.protraction_deg - self.retraction_deg) / 2
        amplitude = (self.protraction_deg + self.retraction_deg) / 2
        theta = np.radians(middle - amplitude * np.cos(phase)) * _ramp(t / self.ramp_s)
        return couple_whiskers(np.repeat(theta, len(whiskers), axis=1), whiskers)


@dataclass(frozen=True)
class Recorded:
    """A recorded trajectory, interpolated by a cubic spline: see `read_trajectory`.

    Attributes:
        turns: The (sample, whisker, 3) rotations from the resting angles, rad.
    """

    times_s: Floats
    turns: Floats
    names: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Duration in s."""
        return float(self.times_s[-1])

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times_s, self.turns - self.turns[0])

    def offsets(self, t_s: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
        """Compute rotations, see `Trajectory.offsets`; after the end they stay constant."""
        at = [self.names.index(w.name) for w in whiskers]
        t = np.clip(np.asarray(t_s, dtype=np.float64), 0.0, self.duration_s)
        moved = self._spline(t)
        turns: Floats = self.turns[0] + moved * _ramp(t / Whisk.ramp_s)[:, None, None]
        return turns[:, at]


def _ramp(x: Floats) -> Floats:
    """Return a smooth step from 0 (x <= 0) to 1 (x >= 1).

    The first two derivatives are continuous.
    """
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 - 15 * x + 6 * x**2)


def couple_whiskers(theta: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
    """Extend protractions (n, whisker) by elevation and torsion to (n, whisker, 3), rad."""
    slopes = np.array([[1.0, *_slopes(w.row)] for w in whiskers])
    turns: Floats = theta[:, :, None] * slopes
    return turns


def _slopes(row: int) -> tuple[float, float]:
    # A robot may have more rows than an animal: those only protract.
    known = row < len(ELEVATION_SLOPES)
    return (ELEVATION_SLOPES[row], TORSION_SLOPES[row]) if known else (0.0, 0.0)


def read_trajectory(path: Path, whiskers: tuple[Whisker, ...]) -> Recorded:
    """Read a recorded trajectory of base angles.

    The file has a header and one line for each time: ``time_s``, then rotations from rest in
    degrees, rostral positive: ``theta_deg`` of all whiskers, ``theta_deg_C`` of a row,
    ``theta_deg_C2`` of one whisker; the most specific column counts. ``phi_deg`` and ``zeta_deg``
    likewise; without them elevation and torsion follow theta (Knutsen et al. 2008).
    """
    table = read_csv(path)
    columns, lines = table.columns, [row.line for row in table.rows]
    if columns[0] != "time_s":
        raise ConfigError(f"{table.where}: the first column must be time_s, not {columns[0]!r}")
    rows = np.array([list(convert(row, dict[str, float], lax=True).values()) for row in table.rows])
    names = {w.name for w in whiskers}
    letters = {_letter(w.row) for w in whiskers}
    found: dict[tuple[str, str], int] = {}
    for i, column in enumerate(columns[1:], start=1):
        match = COLUMN.fullmatch(column)
        target = (match[2] or "") if match else ""
        if match is None or (target and target not in names | letters):
            raise ConfigError(
                f"{table.where}: column {column!r} is none of theta_deg, phi_deg, zeta_deg, or "
                "these with _ and the letter of a row or the name of a whisker of the array"
            )
        found[match[1], target] = i
    if len(rows) < 4:
        raise ConfigError(f"{path}: {len(rows)} samples; a cubic spline needs at least 4")
    times = rows[:, 0]
    if (late := np.flatnonzero(np.diff(times) <= 0)).size:
        raise ConfigError(f"{path}:{lines[late[0] + 1]}: time_s does not increase")
    if (far := np.argwhere(np.abs(rows[:, 1:]) > LARGEST_DEG)).size:
        raise ConfigError(
            f"{path}:{lines[far[0, 0]]}: {columns[far[0, 1] + 1]} is beyond "
            f"{LARGEST_DEG:g} degrees; give the rotation from rest"
        )
    turns = np.empty((len(times), len(whiskers), 3))
    for k, whisker in enumerate(whiskers):
        for j, angle in enumerate(ANGLES):
            keys = [(angle, target) for target in (whisker.name, _letter(whisker.row), "")]
            at = next((found[key] for key in keys if key in found), None)
            if at is not None:
                turns[:, k, j] = np.radians(rows[:, at])
            elif angle == "theta":
                raise ConfigError(f"{path}: no theta_deg for whisker {whisker.name}")
            else:
                turns[:, k, j] = turns[:, k, 0] * _slopes(whisker.row)[j - 1]
    return Recorded(times - times[0], turns, tuple(w.name for w in whiskers))


def _letter(row: int) -> str:
    return chr(ord("A") + row)


def base_angles(trajectory: Trajectory, t_s: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
    """Compute base angles (time, whisker, 3), rad: theta, phi, zeta in the morphology's convention.

    On the left side, where azimuth and torsion are mirrored, protraction lowers theta.
    """
    resting = np.array([w.angles for w in whiskers])
    angles: Floats = resting + mirror(whiskers) * trajectory.offsets(t_s, whiskers)
    return angles


def mirror(whiskers: tuple[Whisker, ...]) -> Floats:
    """Return (whisker, 3) signs by which a rostral rotation changes theta, phi and zeta."""
    sides = [-1.0 if w.base[0] < 0 else 1.0 for w in whiskers]
    return np.array([(side, 1.0, side) for side in sides])
