"""The emulated arrays of all rigs: they speak the native protocol, and every write is timed.

`EmulatedArray` is one in this process. `play` is one in a process of its own, so that what it
costs is not on the bill of what is measured; it is told what to do through a pipe.
"""

import itertools
import os
import time
from array import array
from contextlib import suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.drivers.emulation.device import EmulatedDevice
from tactile_rt.drivers.emulation.endpoints import SerialEndpoint, SlcanEndpoint
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sources.synthetic import SyntheticOptions, SyntheticSource

# What a device's own buffer loses beside a restart of its counter nobody could count: while a busy
# machine keeps the host waiting, nothing shall be lost here.
FIFO_BYTES = 64 << 20
GAP = 20  # samples from one that is missing, or damaged, to the next, in such a mood
LOOP_S = 6.0  # of bumps, that come again and again: four of them
PIECE_S = 0.064
PRIORITY = -15
# Each strikes within a moment, so that what is undisturbed is known; none beside another.
KINDS = (
    Fault("bit_flip", at_s=1.0, amount=3),
    Fault("drop", at_s=1.0, amount=4),
    Fault("unplug", at_s=1.0, duration_s=0.3),
    Fault("duplicate", at_s=1.0, amount=2),
    Fault("stall", at_s=1.0, duration_s=0.05),
    Fault("truncate", at_s=1.0, amount=40),
    Fault("burst", at_s=1.0, amount=30),
    Fault("clock_drift", at_s=1.0, amount=150, duration_s=1.0),
    Fault("clock_jump", at_s=1.0, amount=0.5),
    Fault("sequence_reset", at_s=1.0),
)


@dataclass(frozen=True)
class ArrayScript:
    """An emulated array that speaks the native protocol, and what happens to it.

    Attributes:
        wire: The line that the array is on: ``serial``, or ``slcan`` for a CAN bus behind slcan.
        spec: The description of the array, with its rate.
        samples: Number of samples that the array measures before it falls silent.
        link: A path that stays the port's name when the array is plugged in again; None: none.
        signal: What the array feels: ``bumps`` that go by, or ``noise``.
        pace: The pace of the samples: ``realtime``, or as ``fast`` as the host takes them.
        faults: The faults that strike the array's line.
        seed: The seed of the noise and of the faults' times.
        options: Options of the native codec, as in a URL.
    """

    wire: str
    spec: ArraySpec
    samples: int
    link: str | None = None
    signal: str = "bumps"
    pace: str = "realtime"
    faults: tuple[Fault, ...] = ()
    seed: int = 0
    options: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Played:
    """What an array did.

    Attributes:
        fate: (n,) `Fate` of each sample.
        at_ns: (n,) host time at which each sample was first handed to the line, ns; 0: never whole.
        duplicated: Copies that were sent beyond one packet per sample.
        faults: Kind, second of the stream and duration in s of each fault that is due at a time.
    """

    fate: NDArray[np.uint8]
    at_ns: NDArray[np.int64]
    duplicated: int
    faults: tuple[tuple[str, float, float], ...]


def fault_beat(wire: str, seconds: float, first_s: float, every_s: float) -> tuple[Fault, ...]:
    """One fault after the other, all kinds in turn; the last three seconds are undisturbed."""
    kinds = list(KINDS)
    if wire == "slcan":  # of frames, not of bytes
        kinds = [replace(f, amount=1) if f.kind == "truncate" else f for f in KINDS]
        kinds.append(Fault("can_error", at_s=1.0))
    times = np.arange(first_s, seconds - 3.0, every_s).tolist()
    return tuple(
        replace(kind, at_s=at_s) for at_s, kind in zip(times, itertools.cycle(kinds), strict=False)
    )


def bumps(script: ArrayScript) -> NDArray[np.float32]:
    """(n, element, channel) some seconds of what a synthetic array feels, quiet at first."""
    elements, channels = script.spec.shape
    options = SyntheticOptions(script.spec.rate_hz, LOOP_S, pace="fast")
    made = SyntheticSource(f"{elements}x{channels}", options)
    return np.concatenate([chunk.values for chunk in made])


def noise(script: ArrayScript) -> NDArray[np.float32]:
    """(n, element, channel) other values in every sample, the same in every process."""
    draw = np.random.default_rng(script.seed)
    sizes = np.array([1e-2 if unit == "N" else 1e-4 for unit in script.spec.units])
    values = draw.normal(size=(script.samples, *script.spec.shape)) * sizes
    as_sent: NDArray[np.float32] = values.astype(np.float32)
    return as_sent


SIGNALS = {"bumps": bumps, "noise": noise}


class LoopedSource(Source):
    """A signal that comes again and again until so many samples are delivered; not live.

    Args:
        spec: What the samples are.
        signal: (n, element, channel) SI.
        samples: Number of samples that there are; None: one round of the signal.
    """

    live = False
    every, pace = 1, 1.0  # of so many samples one is measured; and how often

    def __init__(
        self, spec: ArraySpec, signal: NDArray[np.float32], samples: int | None = None
    ) -> None:
        super().__init__(spec)
        self._loop = signal.astype(np.float32, copy=False)
        self._left = len(signal) if samples is None else samples
        self._sent, self._t_ns = 0, 0.0
        self._piece = max(1, round(PIECE_S * spec.rate_hz))

    def read(self, timeout: float | None = None) -> Chunk | None:
        n = min(self._piece, self._left)
        if n == 0:
            raise EndOfStream
        seq = self._sent + np.arange(n, dtype=np.int64)
        self._sent, self._left = self._sent + n, self._left - n
        period_ns = NS_PER_S / self.spec.rate_hz / self.pace
        t_ns = np.round(self._t_ns + np.arange(n) * period_ns).astype(np.int64)
        self._t_ns += n * period_ns
        seq, t_ns = seq[:: self.every], t_ns[:: self.every]
        values = self._loop[seq % len(self._loop)]
        return Chunk(seq, t_ns, values, np.ones(values.shape[:2], np.bool_))

    def close(self) -> None:
        self._left = 0


class _Bytes(bytes):
    """A sample's packet that knows which one it is, and whether the line swallows it."""

    nth: int
    swallowed: bool


class _Frames(list[Any]):
    """The same on CAN."""

    nth: int
    swallowed: bool


class _Timed:
    """An endpoint that writes down when each sample is first handed to it."""

    at_ns: "array[int]"

    def send(self, packet: Any, answer: bool = False) -> bool:
        if getattr(packet, "swallowed", False):
            return True
        nth = getattr(packet, "nth", -1)  # what was damaged has lost it
        if nth >= 0 and not self.at_ns[nth]:
            self.at_ns[nth] = time.monotonic_ns()
        sent: bool = super().send(packet, answer)  # type: ignore[misc]
        return sent


class _TimedSerial(_Timed, SerialEndpoint):
    pass


class _TimedSlcan(_Timed, SlcanEndpoint):
    pass


class EmulatedArray(EmulatedDevice):
    """An array as its script says; a context manager, plugged in while entered.

    Args:
        script: What the array is and what happens to it.
        signal: (n, element, channel) SI, in place of the script's signal.

    Attributes:
        mood: What the array does from now on: ``well``; ``silent``: nothing comes; ``stuck``: the
            same values again and again; ``no_number``: NaN; ``slow``: at half its rate;
            ``fast``: at twice its rate; ``fails``: its status says that a sensor fails;
            ``uncounted``: its counter stands;
            ``gaps``, ``corrupt``: every twentieth sample is missing, or damaged.
    """

    def __init__(self, script: ArrayScript, signal: NDArray[np.float32] | None = None) -> None:
        serial = script.wire == "serial"
        self.wire = "serial" if serial else "can"  # type: ignore[misc]
        self._script = script
        self._endpoint = (_TimedSerial if serial else _TimedSlcan)(
            script.link, fifo_bytes=FIFO_BYTES
        )
        self._endpoint.at_ns = array("q", bytes(8 * script.samples))
        felt = SIGNALS[script.signal](script) if signal is None else signal
        self._last = felt[0]
        self._source = LoopedSource(script.spec, felt, script.samples)
        faults = FaultSchedule(script.faults, script.seed) if script.faults else None
        options = dict(script.options)
        codec = make_codec(self.wire, "native", options)
        super().__init__(
            self._source, "native", codec, self._endpoint, options=options, faults=faults,
            pace=script.pace,
        )  # fmt: skip
        encode, counter = self.codec.encode, itertools.count()

        self.mood = "well"

        def numbered(chunk: Chunk) -> list[Any]:
            packets = []
            for packet in encode(self._felt(chunk)):
                known = (_Bytes if isinstance(packet, bytes) else _Frames)(packet)
                nth = known.nth = next(counter)
                known.swallowed = self.mood == "silent" or (self.mood == "gaps" and nth % GAP == 0)
                if self.mood == "corrupt" and nth % GAP == 0 and isinstance(packet, bytes):
                    known = _Bytes(packet[:-3] + bytes(b ^ 0xFF for b in packet[-3:]))
                    known.nth, known.swallowed = nth, False
                packets.append(known)
            return packets

        self.codec.encode = numbered  # type: ignore[method-assign]

    def _felt(self, chunk: Chunk) -> Chunk:
        """What the array's mood makes of what it feels."""
        values = chunk.values
        self._source.every = 2 if self.mood == "slow" else 1
        self._source.pace = 2.0 if self.mood == "fast" else 1.0
        self.codec.status = 2 if self.mood == "fails" else 0
        if self.mood == "stuck":
            values = np.broadcast_to(self._last, values.shape).copy()
        elif self.mood == "no_number":
            values = np.full_like(values, np.nan)
        self._last = values[-1]
        seq = np.zeros_like(chunk.seq) if self.mood == "uncounted" else chunk.seq
        return Chunk(seq, chunk.t_ns, values, chunk.valid)

    def end(self) -> None:
        """Measure nothing more; what is measured still goes out."""
        self._source.close()

    def where(self) -> str:
        """How far the array has come, in words."""
        return (
            f"{self.log.sent} of {self._script.samples} measured, "
            f"{self._endpoint.backlog} bytes not sent, "
            f"{'heard' if self._endpoint.heard else 'unheard'}"
        )

    def played(self) -> Played:
        """What the array has done so far."""
        log = self.log
        fate = log.fate
        at_ns = np.array(self._endpoint.at_ns, np.int64)[: len(fate)]
        due = [f for f in self._script.faults if f.at_s is not None]
        struck = tuple((f.kind, float(f.at_s or 0.0), f.duration_s) for f in due)
        return Played(fate, at_ns, log.duplicated, struck)


def play(pipe: Connection, script: ArrayScript) -> None:
    """Be an array in a process of its own, for `Helper`: say the URL, then obey until it hangs up.

    The words: ``mood NAME`` (say when), ``unplug`` (say when it began), ``replug`` (say when it was
    done), ``number TEXT`` (be the array of that serial number), ``end`` (of what is measured; say
    when), ``done`` (say whether), ``where`` (in words), ``played`` (a `Played`).
    """
    with suppress(OSError):  # a device has a processor of its own; where that is allowed
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    with EmulatedArray(script) as device:
        pipe.send(device.url)
        while True:
            try:
                word = pipe.recv()
            except EOFError:
                return
            began = time.monotonic_ns()
            answer: Any = began
            if word.startswith("mood "):
                device.mood = word.removeprefix("mood ")
            elif word.startswith("number "):
                device.codec.serial_number = word.removeprefix("number ")
            elif word == "unplug":
                device.unplug()
            elif word == "replug":
                device.replug()
                answer = time.monotonic_ns()
            elif word == "end":
                device.end()
            elif word == "done":
                answer = device.done
            elif word == "where":
                answer = device.where()
            else:
                answer = device.played()
            pipe.send(answer)
