"""An emulated device in a process of its own, told what to do through a pipe."""

import time
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.sources.synthetic import synthetic_spec
from tactile_rt.testing import FakeCan, FakeSerial

__all__ = ["Log", "Stage", "emulate", "signal"]


@dataclass(frozen=True)
class Stage:
    """An emulated native device.

    Attributes:
        wire: ``serial`` or ``slcan``.
        samples: that it measures.
        elements: of six channels each, at 1 kHz.
        pace: ``realtime`` or ``fast``.
        faults: what goes wrong.
        seed: of the signal and the faults.
        options: of the codec.
        link: a name for its port.
    """

    wire: str
    samples: int
    elements: int = 10
    pace: str = "fast"
    faults: tuple[Fault, ...] = ()
    seed: int = 0
    options: dict[str, str] = field(default_factory=dict)
    link: str | None = None


@dataclass(frozen=True)
class Log:
    """What the device did with each sample: see `DeviceLog`."""

    fate: NDArray[np.uint8]
    duplicated: int


def signal(stage: Stage) -> NDArray[np.float32]:
    """(n, element, channel) what it measures, the same in every process."""
    draw = np.random.default_rng(stage.seed)
    sizes = np.array([1e-2, 1e-2, 1e-2, 1e-4, 1e-4, 1e-4])
    values = draw.normal(size=(stage.samples, stage.elements, 6)) * sizes
    as_sent: NDArray[np.float32] = values.astype(np.float32)
    return as_sent


def emulate(pipe: Connection, stage: Stage) -> None:
    """Say the URL; then obey ``unplug``, ``replug`` (say when), ``done`` (whether), ``log``."""
    faults = FaultSchedule(stage.faults, stage.seed) if stage.faults else None
    kind: Any = FakeSerial if stage.wire == "serial" else FakeCan
    fake = kind(
        signal(stage), spec=synthetic_spec(stage.elements, 6, 1000.0), faults=faults,
        pace=stage.pace, options=stage.options, link=stage.link,
    )  # fmt: skip
    with fake:
        pipe.send(fake.url)
        while True:
            try:
                word = pipe.recv()
            except EOFError:
                return
            if word == "unplug":
                began = time.monotonic_ns()
                fake.unplug()
                pipe.send(began)
            elif word == "replug":
                fake.replug()
                pipe.send(time.monotonic_ns())
            elif word == "done":
                pipe.send(fake.emulator.done)
            else:
                log = fake.emulator.log
                pipe.send(Log(log.fate, log.duplicated))
