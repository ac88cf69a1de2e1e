"""Comparison of measured with described values, and measurements of a sensor at rest.

Intervals are 95 % confidence intervals.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tactile_rt.core.errors import name_some
from tactile_rt.core.stream.sensor_spec import ChannelSpec, SensorSpec
from tactile_rt.sim_backend.measuring.resting import FORGETS_S, TO_SIGMA, Rest, drift_likelihood
from tactile_rt.sim_backend.transducer import FASTEST_HZ

MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
SIGMAS = 1.96  # half of an interval, in standard errors
EVEN = 1.2  # largest ratio of an interval's halves that is written as +- one number
MANY = 6  # largest number of whiskers that are named
NOISIER = 1.5  # times the noise of most whiskers: such a whisker is named
FEWEST = 4  # whiskers needed to estimate the spread of offsets
STRANGE = 5.0  # times the usual offset: such a whisker is named
OTHER = 8.0  # drop of log-likelihood at which a whisker's drift certainly differs from most
SURE = 1.92  # drop of log-likelihood at the ends of an interval
DRIFTS = np.geomspace(1e-3, 1e3, 560)  # in standard deviations of the noise
SAME_RATE = 1e-3  # clocks differ by less
HIDDEN = "noise is less than half a step: rounding hides it"


class Figure(NamedTuple):
    """An estimate of a non-negative quantity, and its 95 % confidence interval.

    Attributes:
        value: The best estimate; 0 if only an upper limit is known.
        high: The upper end of the interval, or the limit.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        if not self.value:
            return f"at most {self.high:.2g}" if self.high else "0"
        above = self.high - self.value
        if above > EVEN * (self.value - self.low):
            return f"{self.value:.3g} ({self.low:.2g} to {self.high:.2g})"
        percent = 100 * above / self.value
        if percent < 0.1:
            return f"{self.value:.4g}"
        if percent < 1:
            return f"{self.value:.4g} +- {percent:.1f} %"
        return f"{self.value:.3g} +- {percent:.0f} %"


class Edit(NamedTuple):
    """A value to write into an array's file.

    Attributes:
        path: The place of the value in the file: names of tables, the index in an array of tables,
            and the key, e.g. ``("sensor", "channel", 0, "drift")``.
    """

    path: tuple[str | int, ...]
    value: float
    why: str


@dataclass(frozen=True)
class ArrayFinding:
    """A quantity of an array as described and as measured, and edits of its file.

    Attributes:
        what: The name of the quantity, e.g. ``noise density of mz``.
        described: The value in the array's file; None if it has none.
    """

    what: str
    unit: str
    described: float | None
    measured: Figure | None
    note: str = ""
    edits: tuple[Edit, ...] = ()

    def words(self) -> tuple[str, str, str, str, str]:
        """Return name, unit, described value, measured value, and their ratio as text."""
        described = "" if self.described is None else f"{self.described:.4g}"
        measured = "-" if self.measured is None else str(self.measured)
        value = self.described and self.measured and self.measured.value
        ratio = f"{value / self.described:.3g}" if value and self.described else ""
        return self.what, self.unit, described, measured, ratio


def make_estimate(value: float, error: float) -> Figure:
    """Make an estimate whose interval is `value` divided and multiplied by 1 + `error`."""
    return Figure(value, value / (1 + error), value * (1 + error))


def pool_figures(figures: Sequence[Figure], apart: float) -> tuple[Figure, list[int]]:
    """Pool estimates of one quantity; return their median and the indices of outliers.

    The median's interval includes each estimate's uncertainty and their scatter.

    Args:
        figures: at least one; each with a value, not just an upper limit.
        apart: the factor from the median above which an estimate, if significant, is an outlier.
    """
    logs = np.log([f.value for f in figures])
    errors = np.array([math.log(f.high / f.value) for f in figures])
    away = np.abs(logs - np.median(logs)) > np.maximum(math.log(apart), errors)
    alike = ~away if len(figures) > 2 else away | True
    centre = np.median(logs[alike])
    spread = TO_SIGMA * np.median(np.abs(logs[alike] - centre))
    each = max(math.sqrt(np.mean(errors[alike] ** 2)), SIGMAS * spread)
    half = each * (MEDIAN if alike.sum() > 2 else 1.0) / math.sqrt(alike.sum())
    return make_estimate(float(np.exp(centre)), math.expm1(half)), np.flatnonzero(~alike).tolist()


def spread_of(values: Sequence[float], known: float) -> Figure:
    """Estimate the standard deviation of zero-mean values, and its interval.

    Args:
        known: the variance from other causes, which is subtracted.
    """
    total, n = float(np.square(values).sum()), len(values)
    least, most = (total / float(stats.chi2.ppf(p, n)) for p in (0.975, 0.025))
    if least <= known:
        return Figure(0.0, 0.0, math.sqrt(most))
    return Figure(*(math.sqrt(variance - known) for variance in (total / n, least, most)))


def change(
    path: tuple[str | int, ...], described: float | None, found: Figure, why: str = ""
) -> tuple[Edit, ...]:
    """Return the edit that corrects a described value; empty if it is in the interval.

    If only an upper limit was measured, a value above it is set to the limit.
    """
    if described is not None and found.low <= described <= found.high:
        return ()
    return (Edit(path, float(f"{found.value or found.high:.4g}"), f"{found}{why}"),)


def compare_sensor(
    sensor: SensorSpec,
    rate: Figure,
    rests: Mapping[str, Rest],
    untouched: Mapping[str, NDArray[np.float64]],
) -> list[ArrayFinding]:
    """Compare measured rate, noise, resolution, drift and offset with a sensor's description.

    Args:
        untouched: for each whisker, the (channel,) readings at rest that the description predicts.
    """
    edits = change(("sensor", "rate_hz"), sensor.rate_hz, make_estimate(rate.value, SAME_RATE))
    note = ""
    if edits and rate.low > FASTEST_HZ:
        edits, note = (), f"left: the simulation samples at {FASTEST_HZ:g} Hz at most"
    findings = [ArrayFinding("rate", "Hz", sensor.rate_hz, rate, note, edits)]
    passed_hz = replace(sensor, rate_hz=rate.value).noise_bandwidth_hz
    for c, channel in enumerate(sensor.channels):
        resting = _ChannelAtRest(c, channel, rests)
        drift = resting.drift()
        known = drift.measured.value if drift.measured else 0.0
        findings += [resting.noise(passed_hz, known), resting.resolution()]
        findings += [drift, resting.offset(untouched, known)]
    return findings


class _ChannelAtRest:
    """Measurements of one channel, over all whiskers at rest."""

    def __init__(self, number: int, channel: ChannelSpec, rests: Mapping[str, Rest]) -> None:
        self._number, self._channel = number, channel
        self._rests = rests
        # Readings that never change mean a broken wire, not a quiet sensor.
        self._live = [n for n, r in rests.items() if r.noise[number] > 0 or r.step[number] > 0]
        self._fine = [n for n in self._live if not rests[n].coarse[number]]

    def noise(self, passed_hz: float, drift: float) -> ArrayFinding:
        c = self._number
        figures = []
        if 2 * len(self._fine) <= len(self._live):
            steps = [self._rests[name].step[c] for name in self._live]
            most = float(np.median(steps)) / 2 / math.sqrt(passed_hz) if steps else 0.0
            note = HIDDEN if steps else "every whisker always reads the same"
            found = Figure(0.0, 0.0, most) if steps else None
            return self._report("noise_density", found, note, "per root of a hertz")
        for name in self._fine:
            rest = self._rests[name]
            # The residual of drift in a detrended block is not noise.
            left = drift**2 * rest.block_s / (7.5 * FORGETS_S) + rest.step[c] ** 2 / 12
            white = math.sqrt(max(rest.noise[c] ** 2 - left, 0.1 * rest.noise[c] ** 2))
            counted = len(rest.levels) * (rest.size - 2)
            error = SIGMAS * MEDIAN / math.sqrt(2 * counted) * (rest.noise[c] / white) ** 2
            figures.append(make_estimate(white / math.sqrt(passed_hz), error))
        figure, strange = pool_figures(figures, NOISIER)
        unlike = [self._fine[k] for k in strange]
        notes = [f"unlike most: {name_some(unlike, MANY)}"] if unlike else []
        if dead := [name for name in self._rests if name not in self._live]:
            notes.append(f"always read the same: {name_some(dead, MANY)}")
        return self._report("noise_density", figure, "; ".join(notes), "per root of a hertz")

    def resolution(self) -> ArrayFinding:
        steps = np.array([self._rests[name].step[self._number] for name in self._live])
        if not len(steps):
            return self._report("resolution", None, "every whisker always reads the same")
        step = float(np.median(steps))
        note = "" if step else "readings lie on no grid"
        return self._report("resolution", Figure(step, 0.999 * step, 1.001 * step), note)

    def drift(self) -> ArrayFinding:
        c, rests = self._number, [self._rests[name] for name in self._fine]
        if 2 * len(rests) <= len(self._live):
            return self._report("drift", None, HIDDEN if self._live else "")
        span_s = float(np.median([np.ptp(rest.at_s) for rest in rests]))
        if span_s < FORGETS_S:
            note = f"rest spans {span_s:.0f} s, and a drift takes {FORGETS_S:g} s"
            return self._report("drift", None, note)
        sizes = DRIFTS * float(np.median([rest.noise[c] for rest in rests]))
        each = np.array([drift_likelihood(rest, c, sizes) for rest in rests])
        alike = np.full(len(each), True)
        if len(each) > 2:
            alike = each.max(axis=1) - each[:, np.median(each.argmax(axis=1)).astype(int)] < OTHER
        total = each[alike].sum(axis=0)
        likely = np.flatnonzero(total > total.max() - SURE)
        low, high = likely[0] - 1, min(likely[-1] + 1, len(sizes) - 1)
        found = Figure(0.0, 0.0, float(sizes[high]))
        if low >= 0:
            found = Figure(float(sizes[total.argmax()]), float(sizes[low]), float(sizes[high]))
        strange = [self._fine[k] for k in np.flatnonzero(~alike)]
        note = f"unlike most: {name_some(strange, MANY)}" if strange else ""
        return self._report("drift", found, note)

    def offset(self, untouched: Mapping[str, NDArray[np.float64]], drift: float) -> ArrayFinding:
        c, names = self._number, self._live
        off = np.array([self._rests[name].level[c] - untouched[name][c] for name in names])
        if self._channel.field and len(off):  # the common offset is due to the magnet
            off -= np.median(off)
        usual = TO_SIGMA * np.median(np.abs(off)) if len(off) else 0.0
        errors = np.array([self._rests[name].level_error[c] for name in names])
        alike = np.abs(off) <= STRANGE * np.maximum(usual, errors)
        if alike.sum() < FEWEST:
            note = f"{len(off)} whiskers, and a spread takes {FEWEST}"
            return self._report("offset", None, note)
        # Subtract the errors of the levels themselves.
        figure = spread_of(off[alike].tolist(), drift**2 + float(np.mean(errors**2)))
        strange = [name for name, normal in zip(names, alike, strict=True) if not normal]
        note = f"unlike most: {name_some(strange, MANY)}" if strange else ""
        return self._report("offset", figure, note)

    def _report(self, key: str, found: Figure | None, note: str, per: str = "") -> ArrayFinding:
        described = getattr(self._channel, key)
        edits = change(("sensor", "channel", self._number, key), described, found) if found else ()
        what = f"{key.replace('_', ' ')} of {self._channel.name}"
        unit = " ".join(part for part in (self._channel.unit, per) if part)
        return ArrayFinding(what, unit, described, found, note, edits)
