"""Benchmark area `inference`: the shipped model on a synthetic stream, and steps of networks of
full size beside the machine's roofline. The latter are made here and need the `train` extra.
"""

import gc
import importlib
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.benchmarks.records import Record
from tactile_rt.benchmarks.roofline import Machine, measure_machine, products, roofline_s, zeros
from tactile_rt.classifier import Classifier
from tactile_rt.model_file import ModelCard, load_model, shipped_model
from tactile_rt.session import Session
from tactile_rt.stream import ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.timebase import NS_PER_S

__all__ = ["Pulses", "Subject", "measure_model", "run", "step_times"]

RATE_HZ = 1000
PERIOD_NS = NS_PER_S // RATE_HZ
QUIET, TOUCH = 500, 1100  # samples: time for release and tare, then more than one episode
NOISE, FORCE = 2e-6, 1e-4  # N, and a thousandth of it in N m: what whiskers feel
CHUNK = 9
CONSUMER_SLEEP_S = 0.05  # per chunk of 9 ms: a consumer five times too slow
QUEUE_CHUNKS = 16
TAIL = "<= 1.3"  # p99 over p50 of every step
CLASSES = 117  # of the published networks
LOAD_INT8_MS = "<= 1000"
# (name, attender, bar of fp32, bar of int8): p50 over the roofline
FULL_SIZE = (("intersection_ln", "none", "<= 1.25", "<= 1.6"), ("gpt", "gpt", "<= 1.4", "<= 1.7"))


@dataclass(frozen=True)
class Subject:
    """A model file to measure, and the bars that it must meet; without one it is only reported."""

    name: str
    path: Path
    over_roofline: str = ""
    step_ms: str = ""
    load_ms: str = ""


class Pulses(Source):
    """Touch and rest in turn, as noise of two strengths.

    Args:
        spec: what array to be.
        samples: how many there are.
        live: in real time, as a device; else as fast as they are read.

    Attributes:
        late_s: the latest that a chunk has been read after its last sample was due, s.
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
    steps of models beside what the machine could do (those of full size not when `quick`).
    """
    records = _load(3 if quick else 20) + _steps(200 if quick else 5000) + _slow(2 if quick else 10)
    machine = measure_machine(5 if quick else 30)
    how = "best of one core, in this process, CPU time"
    records += [
        Record(
            "inference.machine.fp32", machine.fp32 / 1e9, "GFLOP/s", how=f"{how}, 256x1024x1024"
        ),
        Record("inference.machine.int8", machine.int8 / 1e9, "GOP/s", how=f"{how}, 256x1024x1024"),
        Record("inference.machine.memory", machine.memory / 1e9, "GB/s", how=f"{how}, 134 MB read"),
    ]
    shipped = Subject("shipped", shipped_model(), step_ms="<= 2")
    records += measure_model(shipped, machine, 300 if quick else 3000)
    made, skipped = 0, "left out of a quick look" if quick else ""
    with tempfile.TemporaryDirectory() as folder:
        subjects = iter(()) if quick else _full_size(Path(folder))
        while True:
            try:
                subject = next(subjects)
            except StopIteration:
                break
            except (ModuleNotFoundError, AttributeError) as error:
                skipped = f"skipped from here on: {error}"
                break
            records += measure_model(subject, machine, 300)
            subject.path.unlink()
            made += 1
    how = skipped or f"Intersection-LN and with GPT, random weights, {CLASSES} classes"
    records.append(Record("inference.full_size", made, "of 4 models", "", "", how))
    return records


def measure_model(subject: Subject, machine: Machine | None, steps: int) -> list[Record]:
    """Measure one file of kind "step": size, loading, memory, steps, and these over the roofline.

    Raises:
        ModelError: the file cannot be used.
    """
    name, path = f"inference.{subject.name}", subject.path
    session, card = load_model(path)
    del session
    gc.collect()
    before, began = _resident(), time.perf_counter()
    session, card = load_model(path)
    load = time.perf_counter() - began
    taken = 1e3 * step_times(session, card, steps)
    grown = _resident() - before
    p50, p99 = np.percentile(taken, 50), np.percentile(taken, 99)
    how = f"network alone, {steps} steps, one thread"
    records = [
        Record(f"{name}.size", path.stat().st_size / 1e6, "MB", how=card.precision),
        Record(f"{name}.load", 1e3 * load, "ms", subject.load_ms, how="file cached"),
        Record(f"{name}.memory", grown / 1e6, "MB", how="resident, after the steps"),
        Record(f"{name}.step_p50", float(p50), "ms CPU", subject.step_ms, "45 ms budget", how),
        Record(f"{name}.step_tail", float(p99 / p50), "x p50", TAIL, f"p99 {p99:.3g} ms CPU", how),
    ]
    if machine is not None:
        work = products(path)
        least = 1e3 * roofline_s(machine, work)
        operations = sum(p.operations for p in work) / 1e6
        weights = sum(p.weights for p in work) / 1e6
        records.append(
            Record(
                f"{name}.over_roofline",
                float(p50 / least),
                "x",
                subject.over_roofline,
                f"roofline {least:.3g} ms",
                f"{len(work)} products, {operations:.3g} M operations, {weights:.3g} MB of weights",
            )
        )
    return records


def step_times(session: ort.InferenceSession, card: ModelCard, steps: int) -> NDArray[np.float64]:
    """CPU time of each step of a running episode (it begins anew every `card.steps`), s.

    Inputs and outputs are bound beforehand, the state in two sets of buffers that change places.
    """
    rng = np.random.default_rng(0)
    feed = zeros(card)
    shape = feed["samples"].shape
    noise = rng.standard_normal((card.steps, *shape), dtype=np.float32) * np.array(card.scale)
    feed["sigma"] += np.array(card.floor, dtype=np.float32)
    values = {name: ort.OrtValue.ortvalue_from_numpy(array) for name, array in feed.items()}
    logits = ort.OrtValue.ortvalue_from_numpy(np.zeros((1, len(card.labels)), dtype=np.float32))
    blank = {s.name: feed[s.name] for s in card.state}
    sets = [
        {name: ort.OrtValue.ortvalue_from_numpy(array) for name, array in blank.items()}
        for _ in range(2)
    ]
    bindings = []
    for old, new in (sets, sets[::-1]):
        binding = session.io_binding()
        for name, value in (values | old).items():
            binding.bind_ortvalue_input(name, value)
        binding.bind_ortvalue_output("logits", logits)
        for name, value in new.items():
            binding.bind_ortvalue_output(f"{name}_next", value)
        bindings.append(binding)
    taken = np.empty(steps)
    for step in range(-card.steps, steps):  # an episode to warm up
        which = step % 2
        if step % card.steps == 0:
            for name, array in blank.items():
                sets[which][name].update_inplace(array)
        values["samples"].update_inplace(noise[step % card.steps].astype(np.float32))
        began = time.thread_time()
        session.run_with_iobinding(bindings[which])
        spent = time.thread_time() - began
        if step >= 0:
            taken[step] = spent
    return taken


def _full_size(folder: Path) -> Iterator[Subject]:
    """Make the published networks with random weights, one file at a time.

    Raises:
        ModuleNotFoundError: without torch, or without a way to make int8 of them.
    """
    training: Any = importlib.import_module("tactile_rt.models.checkpoints")
    ead: Any = importlib.import_module("tactile_rt.models.ead")
    exporting: Any = importlib.import_module("tactile_rt.export.onnx_step")
    torch: Any = importlib.import_module("torch")
    _, card = load_model(shipped_model())
    labels = tuple(f"class{i}" for i in range(CLASSES))
    card = msgspec.structs.replace(card, name="random", labels=labels, provenance={}, figures={})
    for name, attender, fp32, int8 in FULL_SIZE:
        torch.manual_seed(0)
        config = ead.EADConfig(CLASSES, encoder="zhuang-intersection-ln", attender=attender)
        path, small = folder / f"{name}.onnx", folder / f"{name}.int8.onnx"
        exporting.export_step(training.TactileClassifier(card.array, config), card, path)
        gc.collect()
        quantise: Callable[[Path, Path], object] | None = None
        try:
            quantise = importlib.import_module("tactile_rt.export.precision").to_int8
            quantise(path, small)
        except (ModuleNotFoundError, AttributeError):
            pass
        yield Subject(f"{name}.fp32", path, over_roofline=fp32)
        if quantise is None:
            raise ModuleNotFoundError("int8: no tactile_rt.export.precision.to_int8")
        yield Subject(f"{name}.int8", small, over_roofline=int8, load_ms=LOAD_INT8_MS)


def _resident() -> int:
    """Bytes of memory that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


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
