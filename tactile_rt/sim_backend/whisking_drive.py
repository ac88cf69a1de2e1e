"""The drive of an active array: whisking that a command changes while it runs.

protraction = offset(t) + amplitude(t) sin(phase(t)), d phase / dt = 2 pi frequency(t)

Frequency, amplitude and offset follow the last command, each through three first-order lags of 40
ms in series: 99 % of a change is complete after a third of a second. Such a filter never
overshoots, so no sequence of commands rotates a base further than the commands themselves do; and
its output has a continuous second derivative, so angle, velocity and acceleration never jump.
Between two commands the motion has a closed form: the angle at a time does not depend on when or in
which pieces it is computed.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker
from tactile_rt.sim_backend.trajectories import couple_whiskers

LAG_S: Final = 0.04
FASTEST_HZ: Final = 30.0  # a mouse explores at up to 25
LARGEST_RAD: Final = 1.05  # 60 degrees to either side of rest
STEEPEST: Final = 1e4  # rad/s^2 of a steady whisk: 23 degrees at 25 Hz
# rad/s^2 that no sequence of commands exceeds. With w, a, o the filtered values, W, L their limits:
# a w^2 <= 1.37e4 on chords between permitted commands, 2 a' w <= 2 (L / lag) W,
# a w' <= L W / lag, and o'' + a'' <= 4 L / lag^2.
MOST: Final = 3.2e4


@dataclass(frozen=True)
class Whisking:
    """A whisking command: protraction = offset + amplitude sin(2 pi f t).

    Attributes:
        frequency_hz: The cycles per second, 0 to 30; at 0 the whiskers are held at the offset.
        amplitude_rad: The rotation to either side of the offset, rad.
        offset_rad: The middle of the whisking from rest, rad, rostral positive. Offset and
            amplitude together stay within 1.05 rad (60 degrees).

    Raises:
        ConfigError: out of range, or a steady acceleration beyond 10,000 rad/s^2.
    """

    frequency_hz: float
    amplitude_rad: float
    offset_rad: float

    def __post_init__(self) -> None:
        if not 0 <= self.frequency_hz <= FASTEST_HZ:
            raise ConfigError(
                f"whisking: the frequency must be 0 to {FASTEST_HZ:g} Hz, not {self.frequency_hz:g}"
            )
        if not 0 <= self.amplitude_rad <= LARGEST_RAD:
            raise ConfigError(
                f"whisking: the amplitude must be 0 to {LARGEST_RAD:g} rad (60 degrees), not "
                f"{self.amplitude_rad:.4g} rad"
            )
        if not abs(self.offset_rad) + self.amplitude_rad <= LARGEST_RAD:
            raise ConfigError(
                f"whisking: an offset of {self.offset_rad:.4g} rad with an amplitude of "
                f"{self.amplitude_rad:.4g} leaves the range of {LARGEST_RAD:g} rad (60 degrees) to "
                "either side of rest: make one smaller"
            )
        turn = 2 * math.pi * self.frequency_hz
        if self.amplitude_rad * turn**2 > STEEPEST:
            slower = math.sqrt(STEEPEST / self.amplitude_rad) / (2 * math.pi)
            raise ConfigError(
                f"whisking: {self.amplitude_rad:.4g} rad at {self.frequency_hz:g} Hz accelerate by "
                f"{self.amplitude_rad * turn**2:.0f} rad/s^2, more than {STEEPEST:g}: whisk at "
                f"{math.floor(10 * slower) / 10:g} Hz or less"
            )

    @property
    def _aim(self) -> Floats:
        """The (3,) target of the lags: frequency, amplitude, offset."""
        amplitude = self.amplitude_rad if self.frequency_hz else 0.0
        return np.array([self.frequency_hz, amplitude, self.offset_rad])


@dataclass(frozen=True)
class _Segment:
    """The motion between two commands, as the state of its lags at the start.

    Attributes:
        aim: The (3,) frequency, amplitude and offset commanded.
        away: The (lag, 3) differences of the lags' outputs from the aim at the start, in series.
        phase: The phase of the whisking at the start, rad.
    """

    start_s: float
    aim: Floats
    away: Floats
    phase: float

    def at(self, t_s: Floats) -> tuple[Floats, Floats]:
        """Compute the lags' (n, lag, 3) differences from the aim, and (n,) phases, at times."""
        k = ((t_s - self.start_s) / LAG_S)[:, None]
        first, second, third = self.away
        away = np.stack(
            [first + 0 * k, second + k * first, third + k * (second + k / 2 * first)], axis=1
        )
        away *= np.exp(-k)[:, None]
        # The integral over all time of a lag's difference from the aim is the time constant times
        # the sum of the present differences of that lag and the lags before it.
        ahead = LAG_S * (self.away[:, 0].sum() - away[:, :, 0].sum(axis=1))
        turns = self.aim[0] * (t_s - self.start_s) + ahead
        return away, self.phase + 2 * np.pi * turns


class Drive:
    """An endless whisking `Trajectory` that commands change while it runs."""

    duration_s = math.inf

    def __init__(self, whisking: Whisking) -> None:
        aim = whisking._aim
        still = np.zeros((3, 3))
        still[:, 1:] = -aim[1:]  # amplitude and offset grow from 0; the frequency starts at its aim
        self._segments = [_Segment(0.0, aim, still, 0.0)]

    def command(self, whisking: Whisking, t_s: float) -> None:
        """Change smoothly to another motion from `t_s` on, the last command's time or later.

        Angles at earlier times stay the same, as far back as the command before.
        """
        last = self._segments[-1]
        if t_s < last.start_s:
            raise ValueError(f"a command at {t_s} s after one at {last.start_s} s")
        away, phase = last.at(np.array([t_s]))
        aim = whisking._aim
        turned = math.fmod(float(phase[0]), 2 * math.pi)
        self._segments = [last, _Segment(t_s, aim, away[0] + last.aim - aim, turned)]

    def protraction(self, t_s: Floats) -> Floats:
        """Compute the (n,) protraction from rest at times, rad, rostral positive."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)
        now = self._segments[-1]
        angle = _compute_angle(now, np.maximum(t, now.start_s))
        early = t < now.start_s
        if early.any():
            angle[early] = _compute_angle(self._segments[0], t[early])
        return angle

    def offsets(self, t_s: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
        """Compute rotations from rest, see `Trajectory.offsets`; rows are coupled as in the rat."""
        theta = self.protraction(t_s)
        return couple_whiskers(np.repeat(theta[:, None], len(whiskers), axis=1), whiskers)


def _compute_angle(segment: _Segment, t_s: Floats) -> Floats:
    away, phase = segment.at(t_s)
    _, amplitude, offset = (segment.aim + away[:, -1]).T
    angle: Floats = offset + amplitude * np.sin(phase)
    return angle
