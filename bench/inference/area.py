"""Benchmark area `inference`: the shipped model on a synthetic stream, and steps of networks of
full size. The latter are made here and need the `train` extra.
"""

import itertools
import tempfile
import time
from pathlib import Path

import numpy as np

from bench.inference.window_speed import window_speed
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.classifier.session import Session
from tactile_rt.core.packages import install_extra
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.export.model_steps import Subject, measure_model
from tactile_rt.models.evaluation.records import Record

RATE_HZ = 1000
PERIOD_NS = NS_PER_S // RATE_HZ
QUIET, TOUCH = 500, 1100  # samples: time for release and baseline, then more than one episode
NOISE, FORCE = 2e-6, 1e-4  # N, and a thousandth of it in N m: what whiskers feel
CHUNK = 9
CONSUMER_SLEEP_S = 0.05  # per chunk of 9 ms: a consumer five times too slow
QUEUE_CHUNKS = 16
NETWORKS = 4  # of full size: two, each in fp32 and int8


class Pulses(Source):
    """Touch and rest in turn, as noise of two strengths.

    Args:
        spec: what array to be.
        samples: how many there are.
        live: in real time, as a device; else as fast as they are read.

    Attributes:
        late_s: The longest delay from when a chunk's last sample was due to its reading, s.
    """

    def __init__(self, spec: ArraySpec, samples: int, live: bool) -> None:
        super().__init__(spec)
        self.live = live
        self.late_s = 0.0
        self._samples = samples
        self._start_ns: int | None = None
        self._rng = np.random.default_rng(0)
        self._unit = np.array([1.0 if u == "N" else 1e-3 for u in spec.units], dtype=np.float32)

    def read(self, timeout: float | None = None) -> Chunk | None:
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns()
        first = self.stats.delivered
        if first >= self._samples:
            raise EndOfStream
        seq = np.arange(first, min(first + CHUNK, self._samples), dtype=np.int64)
        t_ns = self._start_ns + seq * PERIOD_NS
        if self.live:
            wait = (int(t_ns[-1]) - time.monotonic_ns()) / NS_PER_S
            if timeout is not None and wait > timeout:
                time.sleep(timeout)
                return None
            time.sleep(max(0.0, wait))
            late = (time.monotonic_ns() - int(t_ns[-1])) / NS_PER_S
            self.late_s = max(self.late_s, late)
        touching = (seq % (QUIET + TOUCH) >= QUIET)[:, None, None]
        strength = np.where(touching, FORCE, NOISE).astype(np.float32) * self._unit
        noise = self._rng.standard_normal((len(seq), *self.spec.shape), dtype=np.float32)
        self.stats.delivered += len(seq)
        return Chunk(
            seq, t_ns, noise * strength, np.ones((len(seq), len(self.spec.elements)), bool)
        )

    def close(self) -> None:
        self._samples = 0


def run(quick: bool) -> list[Record]:
    """Measure the shipped model: size, loading, one step, and a consumer that is too slow; then
    steps of models (those of full size not when `quick`), and windows beside the same network
    written plainly.
    """
    records = _load(3 if quick else 20) + _steps(200 if quick else 5000) + _slow(2 if quick else 10)
    shipped = Subject("shipped", shipped_model(), step_ms="<= 2")
    records += measure_model(shipped, 300 if quick else 3000)
    return [*records, *_full_size(quick), *window_speed(quick)]


def _full_size(quick: bool) -> list[Record]:
    """Steps of the published networks, and how many of them could be measured."""
    records, measured, why = [], 0, "random weights"
    if quick:
        why = "full size: left out of a quick look"
    else:
        try:
            from bench.inference.full_size import full_size
        except ModuleNotFoundError as error:
            why = f"full size: needs {error.name} ({install_extra('train')})"
        else:
            with tempfile.TemporaryDirectory() as folder:
                for subject in full_size(Path(folder)):
                    records.append(measure_model(subject, 500))
                    measured += 1
                    subject.path.unlink()
    count = Record("inference.full_size", measured, f"of {NETWORKS}", how=why)
    return [*itertools.chain(*records), count]


def _load(times: int) -> list[Record]:
    path = shipped_model()
    _, card = load_model(path)
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        Classifier(path, card.array)
        taken.append(time.perf_counter() - began)
    size = path.stat().st_size / 1e6
    how = f"median of {times}, file cached, first step included"
    return [
        Record("inference.size", size, "MB", "<= 5", "fits the wheel", path.name),
        Record("inference.load", 1e3 * float(np.median(taken)), "ms", how=how),
    ]


def _steps(steps: int) -> list[Record]:
    _, card = load_model(shipped_model())
    classifier = Classifier(shipped_model(), card.array)
    episodes = -(-steps // card.steps)
    source = Pulses(card.array, episodes * (QUIET + TOUCH), live=False)
    wall: list[float] = []
    cpu: list[float] = []  # of everything since the step before: resampling and detection too
    spent = 0.0
    for chunk in source:
        began = time.thread_time()
        decisions = classifier.push(chunk)
        spent += time.thread_time() - began
        for decision in decisions:
            if decision.step > 1:  # before the first there was rest
                wall.append(decision.latency_s)
                cpu.append(spent)
            spent = 0.0
    budget = f"{card.substeps * card.period_ns / 1e6:.0f} ms step budget"
    network = f"network alone, {len(wall)} steps, one thread"
    whole = f"resampler, detector and network, {RATE_HZ} Hz, {len(cpu)} steps"
    return [
        Record("inference.step_p50", _ms(wall, 50), "ms", "", budget, network),
        Record("inference.step_p99", _ms(wall, 99), "ms", "<= 10", budget, network),
        Record("inference.cpu_p50", _ms(cpu, 50), "ms CPU", "", budget, whole),
        Record("inference.cpu_p99", _ms(cpu, 99), "ms CPU", "<= 10", budget, whole),
    ]


def _slow(seconds: int) -> list[Record]:
    """A live stream whose consumer is too slow: it must lose samples, but know how many."""
    _, card = load_model(shipped_model())
    source = Pulses(card.array, seconds * RATE_HZ, live=True)
    classifier = Classifier(shipped_model(), card.array)
    taken, skipped, expected = 0, 0, 0
    with Session(source, classifier, queue_chunks=QUEUE_CHUNKS) as session:
        for chunk, _ in session:
            time.sleep(CONSUMER_SLEEP_S)
            skipped += int(chunk.seq[0]) - expected
            expected = int(chunk.seq[-1]) + 1
            taken += len(chunk)
    how = (
        f"{seconds} s live at {RATE_HZ} Hz, consumer sleeps {1e3 * CONSUMER_SLEEP_S:.0f} ms a chunk"
    )
    lost = source.stats.delivered - taken
    uncounted = abs(lost - session.dropped) + abs(skipped - session.dropped)
    return [
        # A reader that waited for its consumer would fall behind by seconds.
        Record("inference.slow_late", 1e3 * source.late_s, "ms", "<= 45", "one step", how),
        Record("inference.slow_dropped", session.dropped, "samples", "", "consumer too slow", how),
        Record("inference.slow_uncounted", uncounted, "samples", "== 0", "losses add up", how),
    ]


def _ms(seconds: list[float], percentile: float) -> float:
    return 1e3 * float(np.percentile(seconds, percentile))
