"""What a real sensor makes of the loads that the physics gives: imperfections of one's choice.

    gain and cross-talk -> bias, drift, noise -> dead whiskers -> saturation -> quantisation
    -> drops, latency and jitter of the time stamps

Everything is off by default, and what is off changes nothing. Each effect has a random generator
of its own, so that switching one on leaves the draws of the others as they were.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk, ConfigError

__all__ = ["Sensor", "SensorModel"]

# Cross-talk between forces and moments needs a length to be a fraction: 10 mm, the ratio of the
# published clipping limits of 10 mN m and 1 N (Chung et al. 2025).
FULL_SCALE = {"N": 1.0, "N m": 1e-2}
EFFECTS = ("gain", "crosstalk", "bias", "drift", "noise", "dead", "jitter", "drop")
# What leaves the values as they are.
NOT_VALUES = ("drift_time_s", "latency_ms", "jitter_ms", "drop_probability")
NS_PER_MS = 1_000_000
LARGEST = 1e6  # of any value: beyond it time stamps and single precision overflow


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """How a sensor falls short of the truth; 0 switches an effect off.

    Forces are in N, moments in N m, and apply to the channels of that unit; channels of other
    units see only what concerns whole samples (time stamps, drops) or all channels (gain,
    ``crosstalk_elements``, dead).

    Attributes:
        gain: The calibration error: relative standard deviation of every channel's constant gain.
        crosstalk_channels: The largest share that leaks from one channel of an element to another,
            as a fraction of full scale (1 N, 10 mN m); each share is drawn uniformly from +- this.
        crosstalk_elements: The share of each grid neighbour's reading (up, down, left, right) that
            an element's same channel receives.
        bias_force, bias_moment: The constant offset: standard deviation over channels, N and N m.
        drift_force, drift_moment: The wandering offset: standard deviation at any one time, N and N
            m.
        drift_time_s: The time constant of the drift, s.
        noise_force, noise_moment: The white noise: standard deviation per sample, N and N m.
        dead_probability: The probability of each element to be dead, drawn once. A dead element
            reads its bias (0 without one) for ever; its ``valid`` stays True, because a robot does
            not know.
        range_force, range_moment: The largest reading of either sign, where the sensor saturates, N
            and N m.
        resolution_force, resolution_moment: The quantisation step, N and N m; readings round to the
            nearest, after saturation.
        latency_ms: The time from the sample to its time stamp, which is that of the host's receipt,
            ms.
        jitter_ms: The mean (and standard deviation) of a further, exponentially distributed delay
            of each time stamp, ms; a sample is never received before its predecessor.
        drop_probability: The probability of each sample to be dropped, independently; dropped
            samples leave gaps in ``seq``.

    The drift is an Ornstein-Uhlenbeck process and not a random walk: it stays within a stated
    spread however long the stream runs, and is the same process whenever one starts to look.

    Raises:
        ConfigError: a negative value or one beyond a million, a share or probability above 1, a
            drop probability of 1, or a drift time that is not positive.
    """

    gain: float = 0.0
    crosstalk_channels: float = 0.0
    crosstalk_elements: float = 0.0
    bias_force: float = 0.0
    bias_moment: float = 0.0
    drift_force: float = 0.0
    drift_moment: float = 0.0
    drift_time_s: float = 60.0
    noise_force: float = 0.0
    noise_moment: float = 0.0
    dead_probability: float = 0.0
    range_force: float = 0.0
    range_moment: float = 0.0
    resolution_force: float = 0.0
    resolution_moment: float = 0.0
    latency_ms: float = 0.0
    jitter_ms: float = 0.0
    drop_probability: float = 0.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(SensorModel)):
            value = getattr(self, name)
            if not 0 <= value <= LARGEST:
                bound = f"at most {LARGEST:g}" if value > 0 else "0 or more"
                raise ConfigError(f"{name} must be {bound}, not {value}")
        for name in ("crosstalk_channels", "crosstalk_elements", "dead_probability"):
            if getattr(self, name) > 1:
                raise ConfigError(f"{name} must lie between 0 and 1, not {getattr(self, name)}")
        if self.drop_probability >= 1:
            raise ConfigError(f"drop_probability must be less than 1, not {self.drop_probability}")
        if self.drift_time_s == 0:
            raise ConfigError("drift_time_s must be more than 0")


class Sensor:
    """A sensor model at work on one stream: push true samples, take what the host receives.

    The result does not depend on how the samples were cut into chunks. What is not valid counts
    as no load.

    Args:
        model: what is wrong with the sensor.
        spec: the array that it belongs to.
        seed: of everything that is drawn.

    Attributes:
        dead: The (element,) bool that tells which elements are dead.
        bias: The (element, channel) constant offset, SI.
        saturated: The number of readings (of one channel in one sample) clipped so far.
        dropped: The number of samples dropped so far.
    """

    def __init__(self, model: SensorModel, spec: ArraySpec, seed: int | Sequence[int] = 0) -> None:
        self._model = model
        seeds = np.random.SeedSequence(seed).spawn(len(EFFECTS))
        self._rng = {e: np.random.default_rng(s) for e, s in zip(EFFECTS, seeds, strict=True)}

        def per_channel(force: float, moment: float) -> NDArray[np.float64]:
            size = {"N": float(force), "N m": float(moment)}
            return np.array([size.get(unit, 0.0) for unit in spec.units])

        self._alters = any(
            getattr(model, f.name) for f in fields(SensorModel) if f.name not in NOT_VALUES
        )
        self._mix = _leaks(self._rng["crosstalk"], spec) * model.crosstalk_channels
        gain = 1 + model.gain * self._rng["gain"].standard_normal(spec.shape)
        self._mix += gain[..., None] * np.eye(spec.shape[1])
        self._neighbours = _neighbours(spec)
        self._noise = per_channel(model.noise_force, model.noise_moment)
        self._drift = per_channel(model.drift_force, model.drift_moment)
        self._range = per_channel(model.range_force, model.range_moment)
        self._range[self._range == 0] = np.inf
        self._resolution = per_channel(model.resolution_force, model.resolution_moment)
        bias = per_channel(model.bias_force, model.bias_moment)
        self.bias = bias * self._rng["bias"].standard_normal(spec.shape)
        self.dead = self._rng["dead"].random(len(spec.elements)) < model.dead_probability
        self.saturated = 0
        self.dropped = 0
        self._wander: NDArray[np.float64] | None = None  # drift of the last sample, its spread 1
        self._taken_ns = 0  # when that sample was taken
        self._received = 0  # samples received so far
        self._latest_ns = np.int64(np.iinfo(np.int64).min)  # time stamps less their sample's count

    def push(self, chunk: Chunk) -> Chunk | None:
        """Take true samples, return those that the host receives, or None when all are dropped."""
        values = self._readings(chunk) if self._alters else chunk.values
        t_ns = chunk.t_ns
        if self._model.latency_ms or self._model.jitter_ms:
            delay = np.full(len(chunk), float(self._model.latency_ms))
            if self._model.jitter_ms:
                late = self._rng["jitter"].standard_exponential(len(chunk))
                delay += self._model.jitter_ms * late
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

    def _readings(self, chunk: Chunk) -> NDArray[np.float32]:
        """(n, element, channel) what the sensor reads."""
        trusted = chunk.valid[..., None] & ~self.dead[:, None]
        values = self._mixed(np.where(trusted, chunk.values, 0.0).astype(np.float64))
        values += self.bias
        if self._drift.any():
            values += self._drift * self._wandering(chunk.t_ns)
        if self._noise.any():
            values += self._noise * self._rng["noise"].standard_normal(values.shape)
        values[:, self.dead] = self.bias[self.dead]
        beyond = np.abs(values) > self._range
        self.saturated += int(beyond.sum())
        values = np.where(beyond, np.copysign(self._range, values), values)
        on = self._resolution > 0
        values[..., on] = np.rint(values[..., on] / self._resolution[on]) * self._resolution[on]
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

    def _wandering(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, element, channel) drift of unit spread: an Ornstein-Uhlenbeck process, exactly."""
        steps = self._rng["drift"].standard_normal((len(t_ns), *self.bias.shape))
        for i, t in enumerate(t_ns.tolist()):
            if self._wander is not None:
                passed = max(t - self._taken_ns, 0) / NS_PER_S
                keeps = math.exp(-passed / self._model.drift_time_s)
                steps[i] = keeps * self._wander + math.sqrt(1 - keeps**2) * steps[i]
            self._wander, self._taken_ns = steps[i], t
        return steps

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
