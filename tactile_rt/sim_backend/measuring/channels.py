"""The channels of a sensor at rest, beside its description."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.sensor_spec import ChannelSpec, SensorSpec
from tactile_rt.sim_backend.measuring.findings import (
    MEDIAN,
    SIGMAS,
    TO_SIGMA,
    ArrayFinding,
    Figure,
    about,
    change,
    listed,
    pooled,
    spread_of,
)
from tactile_rt.sim_backend.measuring.resting import FORGETS_S, Rest, drift_likelihood
from tactile_rt.sim_backend.transducer import FASTEST_HZ

__all__ = ["compare_sensor"]

NOISIER = 1.5  # than most whiskers: it is named
FEWEST = 4  # whiskers that an offset's spread is told from
STRANGE = 5.0  # an offset so many times as large as most are
OTHER = 8.0  # of a log-likelihood: a whisker whose drift is surely not that of most
SURE = 1.92  # of a log-likelihood, at the ends of an interval
DRIFTS = np.geomspace(1e-3, 1e3, 560)  # in standard deviations of the noise
SAME_RATE = 1e-3  # clocks differ by less
HIDDEN = "noise is less than half a step: rounding hides it"


def compare_sensor(
    sensor: SensorSpec,
    rate: Figure,
    rests: Mapping[str, Rest],
    untouched: Mapping[str, NDArray[np.float64]],
) -> list[ArrayFinding]:
    """Rate, and noise, resolution, drift and offset of every channel.

    Args:
        untouched: (channel,) readings at rest by whisker, as the description has them.
    """
    edits = change(("sensor", "rate_hz"), sensor.rate_hz, about(rate.value, SAME_RATE))
    note = ""
    if edits and rate.low > FASTEST_HZ:
        edits, note = (), f"left: the simulation samples at {FASTEST_HZ:g} Hz at most"
    findings = [ArrayFinding("rate", "Hz", sensor.rate_hz, rate, note, edits)]
    passed_hz = replace(sensor, rate_hz=rate.value).noise_bandwidth_hz
    for c, channel in enumerate(sensor.channels):
        said = _Channel(c, channel, rests)
        drift = said.drift()
        known = drift.measured.value if drift.measured else 0.0
        findings += [said.noise(passed_hz, known), said.resolution()]
        findings += [drift, said.offset(untouched, known)]
    return findings


class _Channel:
    """One channel of all whiskers at rest."""

    def __init__(self, number: int, channel: ChannelSpec, rests: Mapping[str, Rest]) -> None:
        self._number, self._channel = number, channel
        self._rests = rests
        # Readings that never change tell of a broken wire, not of a quiet sensor.
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
            return self._finding("noise_density", found, note, "per root of a hertz")
        for name in self._fine:
            rest = self._rests[name]
            # What a drift leaves in a block, from which a line was taken, is no noise.
            left = drift**2 * rest.block_s / (7.5 * FORGETS_S) + rest.step[c] ** 2 / 12
            white = math.sqrt(max(rest.noise[c] ** 2 - left, 0.1 * rest.noise[c] ** 2))
            counted = len(rest.levels) * (rest.size - 2)
            error = SIGMAS * MEDIAN / math.sqrt(2 * counted) * (rest.noise[c] / white) ** 2
            figures.append(about(white / math.sqrt(passed_hz), error))
        figure, strange = pooled(figures, NOISIER)
        notes = [f"unlike most: {listed([self._fine[k] for k in strange])}"] if strange else []
        if dead := [name for name in self._rests if name not in self._live]:
            notes.append(f"always read the same: {listed(dead)}")
        return self._finding("noise_density", figure, "; ".join(notes), "per root of a hertz")

    def resolution(self) -> ArrayFinding:
        steps = np.array([self._rests[name].step[self._number] for name in self._live])
        if not len(steps):
            return self._finding("resolution", None, "every whisker always reads the same")
        step = float(np.median(steps))
        note = "" if step else "readings lie on no grid"
        return self._finding("resolution", Figure(step, 0.999 * step, 1.001 * step), note)

    def drift(self) -> ArrayFinding:
        c, rests = self._number, [self._rests[name] for name in self._fine]
        if 2 * len(rests) <= len(self._live):
            return self._finding("drift", None, HIDDEN if self._live else "")
        span_s = float(np.median([np.ptp(rest.at_s) for rest in rests]))
        if span_s < FORGETS_S:
            note = f"rest spans {span_s:.0f} s, and a drift takes {FORGETS_S:g} s"
            return self._finding("drift", None, note)
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
        note = f"unlike most: {listed(strange)}" if strange else ""
        return self._finding("drift", found, note)

    def offset(self, untouched: Mapping[str, NDArray[np.float64]], drift: float) -> ArrayFinding:
        c, names = self._number, self._live
        off = np.array([self._rests[name].level[c] - untouched[name][c] for name in names])
        if self._channel.field and len(off):  # what all share is the magnet's
            off -= np.median(off)
        usual = TO_SIGMA * np.median(np.abs(off)) if len(off) else 0.0
        errors = np.array([self._rests[name].level_error[c] for name in names])
        alike = np.abs(off) <= STRANGE * np.maximum(usual, errors)
        if alike.sum() < FEWEST:
            note = f"{len(off)} whiskers, and a spread takes {FEWEST}"
            return self._finding("offset", None, note)
        # The levels themselves are not known better than this.
        figure = spread_of(off[alike].tolist(), drift**2 + float(np.mean(errors**2)))
        strange = [name for name, one in zip(names, alike, strict=True) if not one]
        note = f"unlike most: {listed(strange)}" if strange else ""
        return self._finding("offset", figure, note)

    def _finding(self, key: str, found: Figure | None, note: str, per: str = "") -> ArrayFinding:
        described = getattr(self._channel, key)
        edits = change(("sensor", "channel", self._number, key), described, found) if found else ()
        what = f"{key.replace('_', ' ')} of {self._channel.name}"
        unit = " ".join(part for part in (self._channel.unit, per) if part)
        return ArrayFinding(what, unit, described, found, note, edits)
