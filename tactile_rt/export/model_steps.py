"""Measured cost of a model file's step on this computer: size, loading, memory, time."""

import gc
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import ModelCard, load_model
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.models.evaluation.records import Record

TAIL = "<= 1.3"  # p99 over p50 of every step


@dataclass(frozen=True)
class Subject:
    """Model file to measure, with the limits that its CPU times must meet.

    Attributes:
        path: The model file, of kind "step".
        step_ms: Limit of the median step's CPU time, ms; empty to only report the time.
        load_ms: Limit of the CPU time of loading, ms; empty to only report the time.
    """

    name: str
    path: Path
    step_ms: str = ""
    load_ms: str = ""


def measure_model(subject: Subject, steps: int) -> list[Record]:
    """Return the size, loading time, memory and step times of a model file.

    Raises:
        ModelError: the file cannot be used.
    """
    name, path = f"inference.{subject.name}", subject.path
    path.read_bytes()  # so that the file is cached
    gc.collect()
    before, began = _read_resident(), time.process_time()
    session, card = load_model(path)
    load = time.process_time() - began
    ms = 1e3 * step_times(session, card, steps)
    grown = _read_resident() - before
    p50, p99 = np.percentile(ms, [50, 99])
    how = f"network alone, {steps} steps, one thread"
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
            f"p99 {p99:.3g} ms CPU",
            how,
        ),
    ]


def step_times(session: ort.InferenceSession, card: ModelCard, steps: int) -> NDArray[np.float64]:
    """Run episodes of noise as the classifier does; return CPU times, (step,) s."""
    rng = np.random.default_rng(0)
    scale = np.array(card.scale, dtype=np.float32)
    offset = np.zeros(card.array.shape, dtype=np.float32)
    sigma = np.broadcast_to(np.array(card.floor, dtype=np.float32), card.array.shape)
    shape = (card.steps, card.substeps, *card.array.shape)
    noise = rng.standard_normal(shape, dtype=np.float32) * scale
    stepper = Stepper(session, card)
    taken = np.empty(steps)
    for step in range(-card.steps, steps):  # an episode to warm up
        if step % card.steps == 0:
            stepper.begin(offset, sigma)
        stepper.samples[0] = noise[step % card.steps]
        began = time.thread_time()
        stepper.run()
        if step >= 0:
            taken[step] = time.thread_time() - began
    return taken


def _read_resident() -> int:
    """Return the resident memory of this process, in bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")
