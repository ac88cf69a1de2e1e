"""Measurement of a tare: the readings of an untouched array, and their noise.

All statistics are medians, so that single spikes have no effect. Noise is 1.4826 times the median
absolute deviation from the median of a sample's own block, an eighth of the recording (for normal
noise this is the standard deviation; slow changes do not count). It is no smaller than the smallest
step between two readings: the resolution, for a converter that is quieter than its last digit.

An element is refused if it was touched (a block's median differs from the overall median by more
than 3 times the noise, or 5 consecutive samples do by more than 8 times) or if it drifts (its last
quarter differs from its first by more than 2 times). A constant load reads as no load.
"""

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.calibration.calibrated_source import CalibratedSource
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.stream import ArraySpec, Chunk, EndOfStream, Source, concatenate

Floats = NDArray[np.float64]

BLOCKS = 8
LEAST_SAMPLES = 8 * BLOCKS  # a block's median must be more accurate than the limits below
TO_SIGMA = 1.4826  # standard deviation of normal noise over its median absolute deviation
TOUCH, DRIFT = 3.0, 2.0  # largest differences of block and quarter medians, in units of noise
TAP, TAP_SAMPLES = 8.0, 5  # likewise for single samples, and the number of them in a row
PATIENCE_S = 3.0  # wait in addition to the requested seconds
SLICE_S = 0.1


@dataclass(frozen=True, eq=False)
class Tare:
    """Offset and noise of each channel of an untouched array.

    Attributes:
        offset: (element, channel) median, raw units; 0 for an element with too few valid samples.
        noise: (element, channel) standard deviation of a sample, raw units; 0 likewise.
        changes: share of readings that differ from the previous one; the least of all elements.
        samples: (element,) number of valid samples.
        seconds: Time from the first sample to the last one, s.
    """

    spec: ArraySpec
    offset: NDArray[np.float64]
    noise: NDArray[np.float64]
    changes: float
    samples: NDArray[np.int64]
    seconds: float

    @property
    def untared(self) -> tuple[str, ...]:
        """Names of the elements with too few valid samples for a tare."""
        return tuple(
            e for e, n in zip(self.spec.elements, self.samples, strict=True) if n < LEAST_SAMPLES
        )


def tare(source: Source, seconds: float = 2.0) -> Tare:
    """Measure the tare of an array while nothing touches it.

    Args:
        source: source of raw samples; of a calibrated source, the raw source is read.
        seconds: duration by the stream's own time.

    Raises:
        ConfigError: the array is touched or drifts (names element, channel and time), or too few
            samples came.
        SourceError: the source is silent, or broke.
    """
    while isinstance(source, CalibratedSource):
        source = source.source
    if not 0 < seconds < np.inf:
        raise ConfigError(f"seconds must be positive, not {seconds:g}")
    whole = concatenate(record(source, seconds))
    t_s = (whole.t_ns - whole.t_ns[0]) * 1e-9
    offset, noise = np.zeros(source.spec.shape), np.zeros(source.spec.shape)
    samples = whole.valid.sum(axis=0)
    if samples.max() < LEAST_SAMPLES:
        needed = np.ceil(1.5 * LEAST_SAMPLES / source.spec.rate_hz)
        raise ConfigError(
            f"{source.spec.name}: {samples.max()} valid samples in {t_s[-1]:.2g} s, and a tare "
            f"needs {LEAST_SAMPLES}: take {max(needed, np.ceil(seconds) + 1):g} s or more"
        )
    troubles, changes = [], 1.0
    for i, element in enumerate(source.spec.elements):
        if samples[i] < LEAST_SAMPLES:
            continue
        quiet = whole.valid[:, i]
        values = whole.values[quiet, i].astype(np.float64)
        offset[i], noise[i] = _measure_rest(values)
        changes = min(changes, float((values[1:] != values[:-1]).mean(axis=0).max()))
        if trouble := _diagnose(values, offset[i], noise[i], t_s[quiet], source.spec):
            troubles.append(f"element {element} {trouble}")
    if troubles:
        more = f" (and {len(troubles) - 1} more elements)" if len(troubles) > 1 else ""
        raise ConfigError(f"{source.spec.name}: {troubles[0]}{more}")
    return Tare(source.spec, offset, noise, changes, samples.astype(np.int64), float(t_s[-1]))


def record(source: Source, seconds: float) -> list[Chunk]:
    """Read chunks of a stream until its own time has advanced by `seconds`."""
    chunks: list[Chunk] = []
    end = None
    patience = time.monotonic() + seconds + PATIENCE_S
    while end is None or chunks[-1].t_ns[-1] < end:
        try:
            chunk = source.read(SLICE_S)
        except EndOfStream:
            break
        if chunk is not None:
            chunks.append(chunk)
            end = chunks[0].t_ns[0] + round(seconds * 1e9)
        elif time.monotonic() > patience:
            break
    if not chunks:
        raise SourceError(f"{source.spec.name}: no sample came; see `tactile-rt doctor`")
    return chunks


def _split_blocks(values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    return np.array_split(values, BLOCKS)


def _measure_rest(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return offset and noise of an element, each (channel,), from valid samples (n, channel)."""
    off = np.concatenate([np.abs(b - np.median(b, axis=0)) for b in _split_blocks(values)])
    steps = np.diff(np.sort(values, axis=0), axis=0)
    step = np.where(steps > 0, steps, np.inf).min(axis=0)
    noise = np.maximum(TO_SIGMA * np.median(off, axis=0), np.where(np.isfinite(step), step, 0.0))
    return np.median(values, axis=0), noise


def _diagnose(values: Floats, offset: Floats, noise: Floats, t_s: Floats, spec: ArraySpec) -> str:
    """Describe the touch or drift of an element's worst channel; empty text if at rest."""
    scale = np.where(noise > 0, noise, 1.0)  # without noise, no reading has changed, either
    medians = np.stack([np.median(b, axis=0) for b in _split_blocks(values)])
    quarter = len(values) // 4
    quarters = [np.median(part, axis=0) for part in (values[:quarter], values[-quarter:])]
    away = np.abs(medians - offset) / scale
    drift = np.abs(quarters[1] - quarters[0]) / scale
    beyond = (np.abs(values - offset) > TAP * scale).astype(np.int64)
    running = sum(beyond[k : len(beyond) - TAP_SAMPLES + k + 1] for k in range(TAP_SAMPLES))
    tapped = np.asarray(running) == TAP_SAMPLES
    if away.max() <= TOUCH and drift.max() <= DRIFT and not tapped.any():
        return ""
    worst = int(np.maximum(np.maximum(away.max(axis=0), drift), TAP * tapped.any(axis=0)).argmax())
    what = spec.channels[worst]
    unit = "" if spec.units[worst] in ("", "1") else f" {spec.units[worst]}"
    jumps = np.abs(np.diff(medians[:, worst]))
    # A ramp spreads over the blocks; a touch comes and goes within one or two.
    if drift[worst] > DRIFT and jumps.max() <= 0.5 * np.ptp(medians[:, worst]):
        by = abs(quarters[1][worst] - quarters[0][worst])
        return (
            f"drifts: {what} went by {by:.4g}{unit} ({drift[worst]:.0f} times its noise) in "
            f"{t_s[-1]:.2g} s; let the sensor warm up, and tare again"
        )
    furthest = int(np.abs(values[:, worst] - offset[worst]).argmax())
    by = abs(values[furthest, worst] - offset[worst])
    return (
        f"is being touched: {what} moved by {by:.4g}{unit} ({by / scale[worst]:.0f} times its "
        f"noise) at {t_s[furthest]:.2g} s; leave the array alone, and tare again"
    )
