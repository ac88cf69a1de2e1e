"""The drive of an active array: whisking that a command changes while it runs.

protraction = offset(t) + amplitude(t) sin(phase(t)), d phase / dt = 2 pi frequency(t)

Frequency, amplitude and offset glide to what was commanded last, each through three lags of first
order in series, 40 ms each: 99 % of a change is there after a third of a second. Such a filter
never overshoots, so no sequence of commands turns a base further than the commands themselves do;
and its output has a continuous second derivative, so neither angle, velocity nor acceleration ever
jump. Between two commands all of it has a closed form: the angle at a time does not depend on when
or in which pieces it is asked for.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker
from tactile_rt.sim_backend.trajectories import coupled

LAG_S: Final = 0.04
FASTEST_HZ: Final = 30.0  # a mouse explores at up to 25
LARGEST_RAD: Final = 1.05  # 60 degrees to either side of rest
STEEPEST: Final = 1e4  # rad/s^2 of a steady whisk: 23 degrees at 25 Hz
# rad/s^2 that no sequence of commands exceeds. With w, a, o the gliding values, W, L their largest:
# a w^2 <= 1.37e4 on the chords of what may be commanded, 2 a' w <= 2 (L / lag) W,
# a w' <= L W / lag, and o'' + a'' <= 4 L / lag^2.
MOST: Final = 3.2e4


@dataclass(frozen=True)
class Whisking:
    """What an active array is told to do: protraction = offset + amplitude sin(2 pi f t).

    Attributes:
        frequency_hz: The cycles per second, 0 to 30; at 0 the whiskers are held at the offset.
        amplitude_rad: The turn to either side of the offset, rad.
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
        """What the lags run towards."""
        amplitude = self.amplitude_rad if self.frequency_hz else 0.0
        return np.array([self.frequency_hz, amplitude, self.offset_rad])


@dataclass(frozen=True)
class _Segment:
    """From one command to the next.

    Attributes:
        aim: The (3,) frequency, amplitude and offset commanded.
        away: The (lag, 3) distance of each lag's output from the aim at the start, the last lag
            last.
        phase: The phase of the whisking at the start, rad.
    """

    start_s: float
    aim: Floats
    away: Floats
    phase: float

    def at(self, t_s: Floats) -> tuple[Floats, Floats]:
        """((n, lag, 3) how far each lag is from the aim, (n,) phase) at these times."""
        k = ((t_s - self.start_s) / LAG_S)[:, None]
        first, second, third = self.away
        away = np.stack(
            [first + 0 * k, second + k * first, third + k * (second + k / 2 * first)], axis=1
        )
        away *= np.exp(-k)[:, None]
        # What a lag is away from the aim, over all time, is the lag's time constant times the sum
        # of what it and those before it are away now.
        ahead = LAG_S * (self.away[:, 0].sum() - away[:, :, 0].sum(axis=1))
        turns = self.aim[0] * (t_s - self.start_s) + ahead
        return away, self.phase + 2 * np.pi * turns


class Drive:
    """A `Trajectory` without end that commands change."""

    duration_s = math.inf

    def __init__(self, whisking: Whisking) -> None:
        aim = whisking._aim
        still = np.zeros((3, 3))
        still[:, 1:] = -aim[1:]  # amplitude and offset grow; there is no frequency to begin from
        self._segments = [_Segment(0.0, aim, still, 0.0)]

    def command(self, whisking: Whisking, t_s: float) -> None:
        """Glide towards another motion from this time on, which is not before the last one's.

        The angles at earlier times stay what they were, as far back as the command before.
        """
        last = self._segments[-1]
        if t_s < last.start_s:
            raise ValueError(f"a command at {t_s} s after one at {last.start_s} s")
        away, phase = last.at(np.array([t_s]))
        aim = whisking._aim
        turned = math.fmod(float(phase[0]), 2 * math.pi)
        self._segments = [last, _Segment(t_s, aim, away[0] + last.aim - aim, turned)]

    def protraction(self, t_s: Floats) -> Floats:
        """(n,) turn of the bases from rest at these times, rad, rostral positive."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)
        now = self._segments[-1]
        angle = _angle(now, np.maximum(t, now.start_s))
        early = t < now.start_s
        if early.any():
            angle[early] = _angle(self._segments[0], t[early])
        return angle

    def offsets(self, t_s: Floats, whiskers: tuple[Whisker, ...]) -> Floats:
        """See `Trajectory`; rows are coupled as in the rat."""
        theta = self.protraction(t_s)
        return coupled(np.repeat(theta[:, None], len(whiskers), axis=1), whiskers)


def _angle(segment: _Segment, t_s: Floats) -> Floats:
    away, phase = segment.at(t_s)
    _, amplitude, offset = (segment.aim + away[:, -1]).T
    angle: Floats = offset + amplitude * np.sin(phase)
    return angle
