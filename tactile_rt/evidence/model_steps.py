"""What a step of a model file costs here: size, loading, memory, time."""

import gc
import os
import resource
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import ModelCard, load_model
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.evidence.records import Record

__all__ = ["Subject", "measure_model", "step_times"]

TURNS = 5
TAIL = "<= 1.3"  # p99 over p50 of every step
COLD = 2  # steps after another process had the core: they find their weights gone from its caches


@dataclass(frozen=True)
class Subject:
    """A model file to measure, and the bars that it must meet; without one it is only reported.

    Attributes:
        name: The name of the file in its figures.
        path: The model file, of kind "step".
        step_ms: The bar of the median step's CPU time in ms.
        load_ms: The bar of the CPU time of loading in ms.
    """

    name: str
    path: Path
    step_ms: str = ""
    load_ms: str = ""


def measure_model(subject: Subject, steps: int) -> list[Record]:
    """Measure one file of kind "step": size, loading, memory, steps.

    Args:
        subject: the file and its bars.
        steps: to time, in all.

    Raises:
        ModelError: the file cannot be used.
    """
    name, path = f"inference.{subject.name}", subject.path
    path.read_bytes()  # so that the file is cached
    gc.collect()
    before, began = _resident(), time.process_time()
    session, card = load_model(path)
    load = time.process_time() - began
    turns, interruptions, grown = [], [], 0
    for _ in range(TURNS):
        seconds, interrupted = step_times(session, card, -(-steps // TURNS))
        grown = grown or _resident() - before
        turns.append(1e3 * seconds)
        interruptions.append(interrupted)
    p50, p99 = np.percentile(turns, 50), np.percentile(turns, 99)
    how = f"network alone, {np.size(turns)} steps, one thread"
    return [
        Record(f"{name}.size", path.stat().st_size / 1e6, "MB", how=card.precision),
        Record(f"{name}.load", 1e3 * load, "ms CPU", subject.load_ms, how="file cached"),
        Record(f"{name}.memory", grown / 1e6, "MB", how="resident, after the steps"),
        Record(f"{name}.step_p50", float(p50), "ms CPU", subject.step_ms, "45 ms budget", how),
        Record(
            f"{name}.step_tail",
            float(p99 / p50),
            "x p50",
            TAIL,
            _tail(np.ravel(turns), np.ravel(interruptions)),
            how,
        ),
    ]


def _tail(taken: NDArray[np.float64], interrupted: NDArray[np.bool_]) -> str:
    """The 99th percentile in words, also without the steps that others had the core before."""
    said = f"p99 {np.percentile(taken, 99):.3g} ms CPU"
    if interrupted.any() and not interrupted.all():
        alone = np.percentile(taken[~interrupted], 99) / np.percentile(taken[~interrupted], 50)
        share = 100 * interrupted.mean()
        said += (
            f"; in or up to {COLD} steps before {share:.2g} % of them another process had the "
            f"core, the others' is {alone:.3g} x"
        )
    return said


def step_times(
    session: ort.InferenceSession, card: ModelCard, steps: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """CPU time of each step of episodes of noise, run as the classifier runs them, s.

    And whether the system took the core away in it, or shortly before: such a step finds its
    weights gone from the caches, and takes more CPU time itself.
    """
    rng = np.random.default_rng(0)
    scale = np.array(card.scale, dtype=np.float32)
    offset = np.zeros(card.array.shape, dtype=np.float32)
    sigma = np.broadcast_to(np.array(card.floor, dtype=np.float32), card.array.shape)
    shape = (card.steps, card.substeps, *card.array.shape)
    noise = rng.standard_normal(shape, dtype=np.float32) * scale
    stepper = Stepper(session, card)
    taken, interrupted = np.empty(steps), np.zeros(steps, dtype=np.bool_)
    seen, cold = _preemptions(), 0
    for step in range(-card.steps, steps):  # an episode to warm up
        if step % card.steps == 0:
            stepper.begin(offset, sigma)
        stepper.samples[0] = noise[step % card.steps]
        began = time.thread_time()
        stepper.run()
        took = time.thread_time() - began
        before, seen = seen, _preemptions()
        cold = COLD + 1 if seen > before else max(0, cold - 1)
        if step >= 0:
            taken[step], interrupted[step] = took, cold > 0
    return taken, interrupted


def _preemptions() -> int:
    """How often this thread had to give its core away; 0 where the system does not tell."""
    which = getattr(resource, "RUSAGE_THREAD", None)
    return 0 if which is None else resource.getrusage(which).ru_nivcsw


def _resident() -> int:
    """Bytes of memory that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
