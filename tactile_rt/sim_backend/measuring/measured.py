"""All that is measured of an array's recording, before anything is compared with a description."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tactile_rt.errors import ConfigError
from tactile_rt.sim_backend.measuring.findings import SIGMAS, Figure
from tactile_rt.sim_backend.measuring.resting import Rest, find_rest
from tactile_rt.sim_backend.measuring.ringing import Ring, find_swings, fit_ring
from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk

__all__ = ["Measured", "measure"]

MISSING = 0.1  # of a recording's samples, at most
LEAST = 64  # samples


@dataclass(frozen=True, eq=False)
class Measured:
    """What a recording of an array tells.

    Attributes:
        rate: The sample rate by the time stamps, Hz.
        rests: The rest of each whisker that was at rest for long enough, by its name.
        rings: The free swings of each whisker that was plucked, by its name.
    """

    rate: Figure
    rests: dict[str, Rest]
    rings: dict[str, list[Ring]]


def measure(spec: ArraySpec, recorded: Chunk, bandwidth_hz: float = 0.0) -> Measured:
    """Find rest and plucks in a recording, and measure both.

    Args:
        spec: the array.
        recorded: all samples.
        bandwidth_hz: of the sensor's low-pass, as it is described; 0: none.

    Raises:
        ConfigError: too few samples, too many missing, or no whisker is at rest for 3 s.
    """
    rate = _rate(recorded)
    rests: dict[str, Rest] = {}
    away: list[NDArray[np.float32]] = []
    hz = rate.value
    for i, name in enumerate(spec.elements):
        values = _whole(recorded, i)
        rest = None if values is None else find_rest(values, hz, bandwidth_hz)
        if values is None or rest is None:
            away.append(np.zeros((0, spec.shape[1]), np.float32))
            continue
        rests[name] = rest
        at_s = np.arange(len(values)) / hz
        levels = [np.interp(at_s, rest.at_s, of_channel) for of_channel in rest.levels.T]
        noise = np.hypot(rest.noise, rest.step / 12**0.5)
        noise[noise == 0] = np.inf
        away.append(((values - np.stack(levels, axis=1)) / noise).astype(np.float32))
    if not rests:
        raise ConfigError(
            f"{spec.name}: no whisker is valid, and at rest for 3 s; record the array untouched "
            "for a minute, then pluck its whiskers, with some seconds between"
        )
    rings: dict[str, list[Ring]] = {}
    for swing in find_swings(away, hz):
        ring = fit_ring(away[swing.element][swing.begin : swing.end], hz)
        if ring is not None:
            rings.setdefault(spec.elements[swing.element], []).append(ring)
    return Measured(rate, rests, rings)


def _rate(recorded: Chunk) -> Figure:
    """The slope of counts over times."""
    if len(recorded) < LEAST:
        raise ConfigError(f"the recording has {len(recorded)} samples: {LEAST} are the least")
    count = int(recorded.seq[-1] - recorded.seq[0]) + 1
    if len(recorded) < (1 - MISSING) * count:
        raise ConfigError(
            f"the recording lacks {count - len(recorded)} of {count} samples: see `tactile-rt hz`"
        )
    t_s = (recorded.t_ns - recorded.t_ns[0]) / NS_PER_S
    if not t_s[-1] > 0:
        raise ConfigError("the recording's time stamps do not advance")
    line = stats.linregress(recorded.seq - recorded.seq[0], t_s)
    error = SIGMAS * line.stderr / line.slope
    return Figure(1 / line.slope, (1 - error) / line.slope, (1 + error) / line.slope)


def _whole(recorded: Chunk, element: int) -> NDArray[np.float32] | None:
    """(n, channel) readings of an element, straight lines where a few are missing; else None."""
    valid = recorded.valid[:, element] & np.isfinite(recorded.values[:, element]).all(axis=1)
    seq = recorded.seq[valid] - recorded.seq[0]
    values: NDArray[np.float32] = recorded.values[valid, element]
    count = int(recorded.seq[-1] - recorded.seq[0]) + 1
    if len(seq) < (1 - MISSING) * count:
        return None
    if len(seq) < count:
        every = np.arange(count)
        filled = [np.interp(every, seq, of_channel) for of_channel in values.T]
        values = np.stack(filled, axis=1).astype(np.float32)
    return values
