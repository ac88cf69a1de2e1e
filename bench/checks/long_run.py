"""The shipped model in the classifier for days: nothing grows, and the end is like the beginning.

python -m bench.checks.long_run [STEPS]      1,000,000 by default, some 20 minutes of CPU

Touches of every length and strength, rests, silences of the line, NaN and infinite samples, dead
and stuck whiskers, denormals and values past the clip, in chunks of random sizes. Prints resident
memory; 1 is returned if that grew by more than 2 MB after the warm-up, if a posterior is no
number, or if the last touches give other decisions than in a classifier that was just made.
"""

import gc
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.classifier.model_file import read_model, shipped_model
from tactile_rt.core.stream import NS_PER_S, Chunk

STEPS, WARM_UP, REPORTS = 1_000_000, 20_000, 10
GROWTH, DIFFERENCE = 2e6, 1e-4  # bytes; of a posterior, from the baseline's sums in another order
BLOCK, QUIET = 2000, 200  # samples
BAD = np.array([np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e9], dtype=np.float32)
CARD = read_model(shipped_model())[0]
PERIOD_NS = CARD.period_ns
SPEC = replace(CARD.array, rate_hz=NS_PER_S / PERIOD_NS)
SCALE, FLOOR = np.array(CARD.scale, np.float32), np.array(CARD.floor, np.float32)


class Weather:
    """Blocks of a stream, each of other faults, and chunks of them."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        shape = (5 * BLOCK, *SPEC.shape)
        self.noise = self.rng.standard_normal(shape, dtype=np.float32) * FLOOR
        self.loads = self.rng.standard_cauchy(shape).astype(np.float32) * SCALE
        self.t = self.seq = 0

    def block(self, bad: bool) -> np.ndarray:
        """(BLOCK, element, channel) SI."""
        rng = self.rng
        at, to = rng.integers(0, 4 * BLOCK, 2)
        values = self.noise[at : at + BLOCK].copy()
        start = QUIET
        while start < BLOCK - 50:
            stop = min(BLOCK - 25, start + int(rng.choice([3, 40, 130, 1500])))
            values[start:stop] += 10 ** rng.uniform(-2, 2) * self.loads[to + start : to + stop]
            start = stop + int(rng.integers(25, 150))
        return self.spoilt(values) if bad else values

    def spoilt(self, values: np.ndarray) -> np.ndarray:
        rng, (dead, stuck, faint, full) = self.rng, self.rng.integers(0, SPEC.shape[0], 4)
        values[:, dead] = 0
        if rng.random() < 0.3:  # it mostly sticks under load, and then nothing is ever released
            values[BLOCK // 3 :, stuck] = values[BLOCK // 3, stuck]
        values[BLOCK // 2 :, faint] *= 1e-38
        values[BLOCK // 4 : BLOCK // 3, full] = 1e5
        hit = rng.random(values.shape[:2]) < rng.choice([0.0, 0.001, 0.05])
        values[hit] = rng.choice(BAD, hit.sum())[:, None]
        return values

    def chunks(self, values: np.ndarray) -> Iterator[Chunk]:
        self.t += int(self.rng.choice([0, 3, 200])) * PERIOD_NS  # 3 are bridged, 200 are not
        done = 0
        while done < len(values):
            part = values[done : done + int(self.rng.choice([1, 2, 7, 60, 500]))]
            index = np.arange(len(part), dtype=np.int64)
            t_ns, seq = self.t + index * PERIOD_NS, self.seq + index
            yield Chunk(seq, t_ns, part, np.ones(part.shape[:2], dtype=np.bool_))
            done += len(part)
            self.t, self.seq = self.t + len(part) * PERIOD_NS, self.seq + len(part)


def classifier() -> Classifier:
    return Classifier(shipped_model(), SPEC, mode="sliding", every=CARD.steps)


def push(into: Classifier, chunks: Iterable[Chunk]) -> list[Classification]:
    decisions = [d for chunk in chunks for d in into.push(chunk)]
    assert all(np.isfinite(d.probabilities).all() for d in decisions)
    return decisions


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main(steps: int = STEPS, warm_up: int = WARM_UP) -> int:
    weather, used = Weather(0), classifier()
    start = report = decided = 0
    while used.stats.steps < warm_up + steps:
        decided += len(push(used, weather.chunks(weather.block(bad=True))))
        if used.stats.steps >= warm_up + report * steps // REPORTS:
            gc.collect()
            start = start or resident()
            report += 1
            sys.stdout.write(f"{used.stats.steps:>9} steps, {resident() / 1e6:.2f} MB resident\n")
            sys.stdout.flush()
    grown, stats = resident() - start, used.stats
    weather.t += 1200 * PERIOD_NS  # a silence; the resampler stays in phase
    last = [chunk for _ in range(2) for chunk in weather.chunks(weather.block(bad=False))]
    got, expected = push(used, last), push(classifier(), last)
    same = [(d.onset_ns, d.step, d.label) for d in got] == [
        (d.onset_ns, d.step, d.label) for d in expected
    ]
    posteriors = [np.array([d.probabilities for d in side]) for side in (got, expected)]
    worst = abs(posteriors[0] - posteriors[1]).max() if same else np.nan
    sys.stdout.write(
        f"{stats.steps} steps, {decided} decisions, {stats.bad_samples} bad samples, "
        f"{stats.bad_steps} bad steps, {time.process_time():.0f} CPU s\n"
        f"grown by {grown / 1e3:.0f} kB; the last {len(got)} decisions {'' if same else 'NOT '}as "
        f"in a fresh classifier, posteriors within {worst:.1e}\n"
    )
    return 0 if grown <= GROWTH and same and worst <= DIFFERENCE else 1


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:2])))
