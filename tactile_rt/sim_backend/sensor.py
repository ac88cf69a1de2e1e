"""What a real sensor makes of the loads that the physics gives: imperfections of one's choice.

    gain and cross-talk -> bandwidth -> hysteresis -> bias, drift, flicker and white noise
    -> dead whiskers -> quantisation -> saturation -> drops, latency and jitter of the time stamps

Everything is off by default, and what is off changes nothing. Each effect has a random generator
of its own, so that switching one on leaves the draws of the others as they were.
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

# Cross-talk between forces and moments needs a length to be a fraction: 10 mm, the ratio of the
# published clipping limits of 10 mN m and 1 N (Chung et al. 2025).
FULL_SCALE = {"N": 1.0, "N m": 1e-2}
EFFECTS = ("gain", "crosstalk", "bias", "drift", "noise", "dead", "jitter", "drop", "flicker")
# What leaves the values as they are.
NOT_VALUES = ("drift_time_s", "latency_ms", "jitter_ms", "drop_probability")
NS_PER_MS = 1_000_000
# Flicker noise is the sum of processes that forget in times from about the sample's period to this,
# two a decade: its density is A^2 / f within some per cent from a tenth of a millihertz on.
SLOWEST_S, PER_DECADE = 1e4, 2
# A delay is remembered for so many samples as it is periods long, squared: then it hardly ever
# shrinks by a period from one sample to the next, which would turn the two round.
JITTER_MEMORY = 30.0


class Sensor:
    """A sensor model at work on one stream: push true samples, take what the host receives.

    The result does not depend on how the samples were cut into chunks. What is not valid counts
    as no load.

    Args:
        described: what the array's description says of its sensor, which adds to the model; None:
            nothing.
        drawn: whether what the description says of noise, offset and drift counts; else only what
            is the same at every time does, which is how it rounds and where it saturates.

    Attributes:
        dead: The (element,) bool that tells which elements are dead.
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

        def said(name: str, counts: bool = True) -> NDArray[np.float64]:
            channels = described.channels if described and counts else ()
            return np.array([getattr(c, name) for c in channels] or [0.0] * len(spec.channels))

        self._alters = described is not None or any(
            getattr(model, f.name) for f in fields(SensorModel) if f.name not in NOT_VALUES
        )
        self._latency_ms = model.latency_ms + (described.latency_ms if described else 0.0)
        self._mix = _leaks(self._rng["crosstalk"], spec) * model.crosstalk_channels
        gain = 1 + model.gain * self._rng["gain"].standard_normal(spec.shape)
        self._mix += gain[..., None] * np.eye(spec.shape[1])
        self._neighbours = _neighbours(spec)
        self._noise = per_channel(model.noise_force, model.noise_moment)
        self._noise = np.hypot(self._noise, described.noise() if described and drawn else 0.0)
        self._flicker = per_channel(model.flicker_force, model.flicker_moment)
        # A process that forgets in T has the density 4 v T / (1 + (2 pi f T)^2); their sum over T
        # in steps of a factor r is v / (f ln r).
        self._flicker *= math.sqrt(math.log(10) / PER_DECADE)
        self._hysteresis = per_channel(model.hysteresis_force, model.hysteresis_moment)
        self._period_s = 1.0 / spec.rate_hz
        decades = math.log10(SLOWEST_S / (self._period_s / math.pi))
        powers = np.arange(0, decades * PER_DECADE) / PER_DECADE
        self._forgets_s = self._period_s / math.pi * 10.0**powers
        self._drift = per_channel(model.drift_force, model.drift_moment)
        self._drift = np.hypot(self._drift, said("drift", drawn))
        self._range = per_channel(model.range_force, model.range_moment)
        self._range[self._range == 0] = np.inf
        if described:
            self._range = np.minimum(self._range, said("range"))
        self._resolution = per_channel(model.resolution_force, model.resolution_moment)
        self._resolution = np.maximum(self._resolution, said("resolution"))
        bias = np.hypot(per_channel(model.bias_force, model.bias_moment), said("offset", drawn))
        self.bias = bias * self._rng["bias"].standard_normal(spec.shape)
        self.dead = self._rng["dead"].random(len(spec.elements)) < model.dead_probability
        rows = sorted({row for row, _ in spec.grid})
        broken = self._rng["dead"].random(len(rows)) < model.dead_row_probability
        self.dead |= np.isin([row for row, _ in spec.grid], np.array(rows)[broken])
        self.saturated = 0
        self.dropped = 0
        # of the last sample: when it was taken, drift and flicker of spread 1, load behind the
        # low-pass, reading behind the hysteresis, and what its delay is drawn from
        self._taken_ns: int | None = None
        self._wander: NDArray[np.float64] | None = None
        self._flickers = np.zeros(0)
        self._passed: NDArray[np.float64] | None = None
        self._followed: NDArray[np.float64] | None = None
        self._hurry: float | None = None
        self._received = 0  # samples received so far
        self._latest_ns = np.int64(np.iinfo(np.int64).min)  # time stamps less their sample's count

    def push(self, chunk: Chunk) -> Chunk | None:
        """Take true samples, return those that the host receives, or None when all are dropped."""
        since = self._since_s(chunk.t_ns)
        values = self._readings(chunk, since) if self._alters else chunk.values
        t_ns = chunk.t_ns
        if self._latency_ms or self._model.jitter_ms:
            delay = np.full(len(chunk), float(self._latency_ms))
            if self._model.jitter_ms:
                delay += self._model.jitter_ms * self._lateness(since)
            t_ns = t_ns + np.rint(delay * NS_PER_MS).astype(np.int64)
        seq, valid = chunk.seq, chunk.valid
        if self._model.drop_probability:
            kept = self._rng["drop"].random(len(chunk)) >= self._model.drop_probability
            self.dropped += int((~kept).sum())
            if not kept.any():
                return None
            seq, t_ns, values, valid = seq[kept], t_ns[kept], values[kept], valid[kept]
        if self._model.jitter_ms:
            t_ns = self._in_order(t_ns)
        if values is chunk.values and t_ns is chunk.t_ns:
            return chunk
        return Chunk(seq, t_ns, values, valid)

    def _since_s(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n,) time since the sample before, s; infinite before the first."""
        before = t_ns[0] if self._taken_ns is None else self._taken_ns
        since = np.maximum(np.diff(t_ns, prepend=before), 0) / NS_PER_S
        if self._taken_ns is None:
            since[0] = np.inf
        self._taken_ns = int(t_ns[-1])
        return since

    def _readings(self, chunk: Chunk, since: NDArray[np.float64]) -> NDArray[np.float32]:
        """(n, element, channel) what the sensor reads."""
        trusted = chunk.valid[..., None] & ~self.dead[:, None]
        values = self._mixed(np.where(trusted, chunk.values, 0.0).astype(np.float64))
        if self._model.bandwidth_hz:
            self._low_pass(values, since)
        if self._hysteresis.any():
            self._follow(values)
        values += self.bias
        if self._drift.any():
            values += self._drift * self._wandering(since)
        if self._flicker.any():
            values += self._flicker * self._flickering(since)
        if self._noise.any():
            values += self._noise * self._rng["noise"].standard_normal(values.shape)
        values[:, self.dead] = self.bias[self.dead]
        on = self._resolution > 0
        values[..., on] = np.rint(values[..., on] / self._resolution[on]) * self._resolution[on]
        beyond = np.abs(values) > self._range
        # of a set's sweeps, who makes them counts
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

    def _mixed(self, loads: NDArray[np.float64]) -> NDArray[np.float64]:
        """Loads with their gain and with what leaks from other channels and elements."""
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
        """Let each sample go towards its load by what a first-order low-pass lets through."""
        keeps = np.exp(-2 * np.pi * self._model.bandwidth_hz * since)
        for i in range(len(values)):
            if self._passed is not None:
                values[i] += keeps[i] * (self._passed - values[i])
            self._passed = values[i].copy()

    def _follow(self, values: NDArray[np.float64]) -> None:
        """Drag each reading behind its load, with play (Prandtl's operator)."""
        followed = np.zeros_like(values[0]) if self._followed is None else self._followed
        for i in range(len(values)):
            followed = np.clip(followed, values[i] - self._hysteresis, values[i] + self._hysteresis)
            values[i] = followed
        self._followed = followed

    def _wandering(self, since: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, element, channel) drift of unit spread: an Ornstein-Uhlenbeck process, exactly."""
        steps = self._rng["drift"].standard_normal((len(since), *self.bias.shape))
        keeps = np.exp(-since / self._model.drift_time_s)
        for i, keep in enumerate(keeps.tolist()):
            if self._wander is not None:
                steps[i] = keep * self._wander + math.sqrt(1 - keep**2) * steps[i]
            self._wander = steps[i]
        return steps

    def _flickering(self, since: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, element, channel) sum of processes of unit spread that forget in different times."""
        total = np.empty((len(since), *self.bias.shape))
        shape = (len(self._forgets_s), *self.bias.shape)
        for i, passed in enumerate(since.tolist()):
            keep = np.exp(-passed / self._forgets_s)[:, None, None]
            fresh = self._rng["flicker"].standard_normal(shape)
            if len(self._flickers):
                fresh = keep * self._flickers + np.sqrt(1 - keep**2) * fresh
            self._flickers = fresh
            total[i] = fresh.sum(axis=0)
        return total

    def _lateness(self, since: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) delays of unit mean, exponentially distributed, in which neighbours are alike."""
        draws = self._rng["jitter"].standard_normal(len(since))
        jitter_s = self._model.jitter_ms * 1e-3
        forgets_s = JITTER_MEMORY * jitter_s**2 / self._period_s
        for i, passed in enumerate(since.tolist()):
            if self._hurry is not None and forgets_s > self._period_s:
                keep = math.exp(-passed / forgets_s)
                draws[i] = keep * self._hurry + math.sqrt(1 - keep**2) * draws[i]
            self._hurry = float(draws[i])
        # from a normal to an exponential distribution, by the share that lies above
        return -np.log(0.5 * np.array([math.erfc(x / math.sqrt(2)) for x in draws]))

    def _in_order(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Hold every time stamp back to a nanosecond after its predecessor's."""
        count = self._received + np.arange(len(t_ns))
        ahead = np.maximum.accumulate(np.maximum(t_ns - count, self._latest_ns))
        self._received += len(t_ns)
        self._latest_ns = ahead[-1]
        ordered: NDArray[np.int64] = ahead + count
        return ordered


def _leaks(rng: np.random.Generator, spec: ArraySpec) -> NDArray[np.float64]:
    """(element, channel, channel it comes from) share of unit size, SI; 0 on the diagonal."""
    n, channels = spec.shape
    full = np.array([FULL_SCALE.get(unit, 0.0) for unit in spec.units])
    ratio = np.divide.outer(full, np.where(full > 0, full, np.inf))
    share = rng.uniform(-1, 1, (n, channels, channels))
    leaks: NDArray[np.float64] = share * ratio * (1 - np.eye(channels))
    return leaks


def _neighbours(spec: ArraySpec) -> list[NDArray[np.int64]]:
    """For each of four directions: (element,) index of the neighbour there; -1 for none."""
    at = {cell: i for i, cell in enumerate(spec.grid)}
    return [
        np.array([at.get((row + down, column + right), -1) for row, column in spec.grid])
        for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1))
    ]
