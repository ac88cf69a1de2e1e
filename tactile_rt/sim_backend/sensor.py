"""Imperfections of a real sensor, applied to the loads that the physics computes.

    gain and cross-talk -> bandwidth -> hysteresis -> bias, drift, flicker and white noise
    -> dead whiskers -> quantisation -> saturation -> drops, latency and jitter of the time stamps

Every effect is off by default and then changes nothing. Each effect has its own random generator,
so that switching one on does not change the random numbers of the others.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.sim_backend.sensor_model import SensorModel

log = logging.getLogger("tactile_rt.sim_backend")

# Cross-talk between forces and moments needs a length to become a fraction: 10 mm, the ratio of
# the published clipping limits of 10 mN m and 1 N (Chung et al. 2025).
FULL_SCALE = {"N": 1.0, "N m": 1e-2}
EFFECTS = ("gain", "crosstalk", "bias", "drift", "noise", "dead", "jitter", "drop", "flicker")
# Fields that leave the values unchanged.
NOT_VALUES = ("drift_time_s", "latency_ms", "jitter_ms", "drop_probability")
NS_PER_MS = 1_000_000
# Flicker noise is a sum of Ornstein-Uhlenbeck processes, two per decade of their time constants,
# from about the sample's period to this: its density is A^2 / f within some per cent above 0.1 mHz.
SLOWEST_S, PER_DECADE = 1e4, 2
# The delays' correlation time in samples is this times the square of the mean delay in periods:
# then a delay hardly ever shrinks by a period between samples, which would swap the two.
JITTER_MEMORY = 30.0


class Sensor:
    """A sensor model applied to one stream: true samples go in, received samples come out.

    The result does not depend on how the samples were cut into chunks. Invalid values count as no
    load.

    Args:
        described: the array's described sensor, whose errors add to the model's; None without one.
        drawn: whether to add the noise, offset and drift of the description; else only its
            deterministic properties count: resolution and saturation.

    Attributes:
        dead: The (element,) bool mask of dead elements.
        bias: The (element, channel) constant offset, SI.
        saturated: The number of readings (of one channel in one sample) clipped so far.
    """

    def __init__(
        self,
        model: SensorModel,
        spec: ArraySpec,
        seed: int | Sequence[int] = 0,
        described: SensorSpec | None = None,
        drawn: bool = True,
    ) -> None:
        self._model, self._spec, self._drawn = model, spec, drawn
        seeds = np.random.SeedSequence(seed).spawn(len(EFFECTS))
        self._rng = {e: np.random.default_rng(s) for e, s in zip(EFFECTS, seeds, strict=True)}

        def per_channel(force: float, moment: float) -> NDArray[np.float64]:
            size = {"N": float(force), "N m": float(moment)}
            return np.array([size.get(unit, 0.0) for unit in spec.units])

        def look_up(name: str, counts: bool = True) -> NDArray[np.float64]:
            channels = described.channels if described and counts else ()
            return np.array([getattr(c, name) for c in channels] or [0.0] * len(spec.channels))

        self._alters = described is not None or any(
            getattr(model, f.name) for f in fields(SensorModel) if f.name not in NOT_VALUES
        )
        self._latency_ms = model.latency_ms + (described.latency_ms if described else 0.0)
        self._mix = _draw_crosstalk(self._rng["crosstalk"], spec) * model.crosstalk_channels
        gain = 1 + model.gain * self._rng["gain"].standard_normal(spec.shape)
        self._mix += gain[..., None] * np.eye(spec.shape[1])
        self._neighbours = _find_neighbours(spec)
        self._noise = per_channel(model.noise_force, model.noise_moment)
        self._noise = np.hypot(self._noise, described.noise() if described and drawn else 0.0)
        self._flicker = per_channel(model.flicker_force, model.flicker_moment)
        # A process of time constant T has the density 4 v T / (1 + (2 pi f T)^2); the sum over T
        # in steps of a factor r is v / (f ln r).
        self._flicker *= math.sqrt(math.log(10) / PER_DECADE)
        self._hysteresis = per_channel(model.hysteresis_force, model.hysteresis_moment)
        self._period_s = 1.0 / spec.rate_hz
        decades = math.log10(SLOWEST_S / (self._period_s / math.pi))
        powers = np.arange(0, decades * PER_DECADE) / PER_DECADE
        self._flicker_times_s = self._period_s / math.pi * 10.0**powers
        self._drift = per_channel(model.drift_force, model.drift_moment)
        self._drift = np.hypot(self._drift, look_up("drift", drawn))
        self._range = per_channel(model.range_force, model.range_moment)
        self._range[self._range == 0] = np.inf
        if described:
            self._range = np.minimum(self._range, look_up("range"))
        self._resolution = per_channel(model.resolution_force, model.resolution_moment)
        self._resolution = np.maximum(self._resolution, look_up("resolution"))
        bias = np.hypot(per_channel(model.bias_force, model.bias_moment), look_up("offset", drawn))
        self.bias = bias * self._rng["bias"].standard_normal(spec.shape)
        self.dead = self._rng["dead"].random(len(spec.elements)) < model.dead_probability
        rows = sorted({row for row, _ in spec.grid})
        broken = self._rng["dead"].random(len(rows)) < model.dead_row_probability
        self.dead |= np.isin([row for row, _ in spec.grid], np.array(rows)[broken])
        self.saturated = 0
        self.dropped = 0
        # State after the last sample: its time, drift and flicker of unit spread, outputs of the
        # low-pass and the hysteresis, and the normal variate of its delay.
        self._taken_ns: int | None = None
        self._drift_state: NDArray[np.float64] | None = None
        self._flicker_state = np.zeros(0)
        self._filtered: NDArray[np.float64] | None = None
        self._play_state: NDArray[np.float64] | None = None
        self._delay_variate: float | None = None
        self._received = 0  # samples received so far
        self._latest_ns = np.int64(np.iinfo(np.int64).min)  # time stamps less their sample's count

    def push(self, chunk: Chunk) -> Chunk | None:
        """Convert true samples to those that the host receives; None if all are dropped."""
        since = self._compute_intervals(chunk.t_ns)
        values = self._compute_readings(chunk, since) if self._alters else chunk.values
        t_ns = chunk.t_ns
        if self._latency_ms or self._model.jitter_ms:
            delay = np.full(len(chunk), float(self._latency_ms))
            if self._model.jitter_ms:
                delay += self._model.jitter_ms * self._draw_delays(since)
            t_ns = t_ns + np.rint(delay * NS_PER_MS).astype(np.int64)
        seq, valid = chunk.seq, chunk.valid
        if self._model.drop_probability:
            kept = self._rng["drop"].random(len(chunk)) >= self._model.drop_probability
            self.dropped += int((~kept).sum())
            if not kept.any():
                return None
            seq, t_ns, values, valid = seq[kept], t_ns[kept], values[kept], valid[kept]
        if self._model.jitter_ms:
            t_ns = self._order_stamps(t_ns)
        if values is chunk.values and t_ns is chunk.t_ns:
            return chunk
        return Chunk(seq, t_ns, values, valid)

    def _compute_intervals(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Compute the (n,) times since the previous sample, s; infinite for the first."""
        before = t_ns[0] if self._taken_ns is None else self._taken_ns
        since = np.maximum(np.diff(t_ns, prepend=before), 0) / NS_PER_S
        if self._taken_ns is None:
            since[0] = np.inf
        self._taken_ns = int(t_ns[-1])
        return since

    def _compute_readings(self, chunk: Chunk, since: NDArray[np.float64]) -> NDArray[np.float32]:
        """Compute the (n, element, channel) readings of true samples."""
        trusted = chunk.valid[..., None] & ~self.dead[:, None]
        values = self._mix_channels(np.where(trusted, chunk.values, 0.0).astype(np.float64))
        if self._model.bandwidth_hz:
            self._low_pass(values, since)
        if self._hysteresis.any():
            self._follow(values)
        values += self.bias
        if self._drift.any():
            values += self._drift * self._draw_drift(since)
        if self._flicker.any():
            values += self._flicker * self._draw_flicker(since)
        if self._noise.any():
            values += self._noise * self._rng["noise"].standard_normal(values.shape)
        values[:, self.dead] = self.bias[self.dead]
        on = self._resolution > 0
        values[..., on] = np.rint(values[..., on] / self._resolution[on]) * self._resolution[on]
        beyond = np.abs(values) > self._range
        # For a sweep set (not drawn), the caller counts saturated readings instead.
        if self._drawn and not self.saturated and beyond.any():
            element, channel = np.argwhere(beyond)[0, 1:]
            log.warning(
                "%s of %s is beyond the %g %s that the sensor can read",
                self._spec.channels[channel], self._spec.elements[element],
                self._range[channel], self._spec.units[channel],
            )  # fmt: skip
        self.saturated += int(beyond.sum())
        values = np.where(beyond, np.copysign(self._range, values), values)
        return values.astype(np.float32)

    def _mix_channels(self, loads: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply gain and cross-talk between channels and elements to loads."""
        values = np.zeros_like(loads)
        # Sums in a fixed order: a matrix product's rounding may depend on the number of samples.
        for source in range(loads.shape[2]):
            values += self._mix[:, :, source] * loads[:, :, source, None]
        if self._model.crosstalk_elements:
            beside = np.concatenate([loads, np.zeros_like(loads[:, :1])], axis=1)
            for neighbour in self._neighbours:
                values += self._model.crosstalk_elements * beside[:, neighbour]
        return values

    def _low_pass(self, values: NDArray[np.float64], since: NDArray[np.float64]) -> None:
        """Apply a first-order low-pass to samples, in place."""
        keeps = np.exp(-2 * np.pi * self._model.bandwidth_hz * since)
        for i in range(len(values)):
            if self._filtered is not None:
                values[i] += keeps[i] * (self._filtered - values[i])
            self._filtered = values[i].copy()

    def _follow(self, values: NDArray[np.float64]) -> None:
        """Apply hysteresis to samples, in place: Prandtl's play operator."""
        followed = np.zeros_like(values[0]) if self._play_state is None else self._play_state
        for i in range(len(values)):
            followed = np.clip(followed, values[i] - self._hysteresis, values[i] + self._hysteresis)
            values[i] = followed
        self._play_state = followed

    def _draw_drift(self, since: NDArray[np.float64]) -> NDArray[np.float64]:
        """Draw (n, element, channel) drift of unit spread: an exact Ornstein-Uhlenbeck process."""
        steps = self._rng["drift"].standard_normal((len(since), *self.bias.shape))
        keeps = np.exp(-since / self._model.drift_time_s)
        for i, keep in enumerate(keeps.tolist()):
            if self._drift_state is not None:
                steps[i] = keep * self._drift_state + math.sqrt(1 - keep**2) * steps[i]
            self._drift_state = steps[i]
        return steps

    def _draw_flicker(self, since: NDArray[np.float64]) -> NDArray[np.float64]:
        """Draw (n, element, channel) 1/f noise: a sum of processes of several time constants."""
        total = np.empty((len(since), *self.bias.shape))
        shape = (len(self._flicker_times_s), *self.bias.shape)
        for i, passed in enumerate(since.tolist()):
            keep = np.exp(-passed / self._flicker_times_s)[:, None, None]
            fresh = self._rng["flicker"].standard_normal(shape)
            if len(self._flicker_state):
                fresh = keep * self._flicker_state + np.sqrt(1 - keep**2) * fresh
            self._flicker_state = fresh
            total[i] = fresh.sum(axis=0)
        return total

    def _draw_delays(self, since: NDArray[np.float64]) -> NDArray[np.float64]:
        """Draw (n,) exponentially distributed delays of unit mean, correlated in time."""
        draws = self._rng["jitter"].standard_normal(len(since))
        jitter_s = self._model.jitter_ms * 1e-3
        forgets_s = JITTER_MEMORY * jitter_s**2 / self._period_s
        for i, passed in enumerate(since.tolist()):
            if self._delay_variate is not None and forgets_s > self._period_s:
                keep = math.exp(-passed / forgets_s)
                draws[i] = keep * self._delay_variate + math.sqrt(1 - keep**2) * draws[i]
            self._delay_variate = float(draws[i])
        # Map the normal to the exponential distribution by their upper tail probabilities.
        return -np.log(0.5 * np.array([math.erfc(x / math.sqrt(2)) for x in draws]))

    def _order_stamps(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Raise each time stamp to at least a nanosecond after its predecessor."""
        count = self._received + np.arange(len(t_ns))
        ahead = np.maximum.accumulate(np.maximum(t_ns - count, self._latest_ns))
        self._received += len(t_ns)
        self._latest_ns = ahead[-1]
        ordered: NDArray[np.int64] = ahead + count
        return ordered


def _draw_crosstalk(rng: np.random.Generator, spec: ArraySpec) -> NDArray[np.float64]:
    """Draw (element, channel, source channel) shares of up to 1, SI; 0 on the diagonal."""
    n, channels = spec.shape
    full = np.array([FULL_SCALE.get(unit, 0.0) for unit in spec.units])
    ratio = np.divide.outer(full, np.where(full > 0, full, np.inf))
    share = rng.uniform(-1, 1, (n, channels, channels))
    leaks: NDArray[np.float64] = share * ratio * (1 - np.eye(channels))
    return leaks


def _find_neighbours(spec: ArraySpec) -> list[NDArray[np.int64]]:
    """Find the (element,) indices of neighbours in each of four directions; -1 without one."""
    at = {cell: i for i, cell in enumerate(spec.grid)}
    return [
        np.array([at.get((row + down, column + right), -1) for row, column in spec.grid])
        for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1))
    ]
