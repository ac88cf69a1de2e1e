"""Emulated arrays for the daemon: bumps go by, faults come on the beat, every write is timed."""

import itertools
import time
from array import array
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.emulation.emulator import Emulator
from tactile_rt.drivers.emulation.endpoints import SerialEndpoint, SlcanEndpoint
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sources.synthetic import SyntheticOptions, SyntheticSource
from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source

__all__ = ["Played", "Stage", "fault_beat", "play"]

# What a device's own buffer loses beside a restart of its counter nobody could count: while a busy
# machine keeps the daemon waiting, nothing shall be lost here.
FIFO_BYTES = 64 << 20
LOOP_S = 6.0  # of signal, that comes again and again: four bumps
QUIET_AT_S = 0.6  # in it: a model first measures what it feels untouched
PIECE_S = 0.064
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
class Stage:
    """An emulated array that speaks the native protocol.

    Attributes:
        wire: ``serial`` or ``slcan``.
        spec: what it is.
        samples: that it measures, at `spec`'s rate; then it falls silent.
        link: a name for its port.
        faults: what goes wrong.
        options: of the codec.
    """

    wire: str
    spec: ArraySpec
    samples: int
    link: str
    faults: tuple[Fault, ...] = ()
    options: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Played:
    """What an array did.

    Attributes:
        fate: (n,) `Fate` of each sample.
        at_ns: (n,) host time at which it was first handed to the line; 0: never whole.
        duplicated: copies sent beyond one per sample.
        faults: (kind, seconds of the stream, duration) of each fault.
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
    found = []
    for at_s, kind in zip(
        np.arange(first_s, seconds - 3.0, every_s), itertools.cycle(kinds), strict=False
    ):
        found.append(replace(kind, at_s=float(at_s)))
    return tuple(found)


class _Bumps(Source):
    """What a synthetic array feels, in a loop; to be played when it is due."""

    live = False

    def __init__(self, spec: ArraySpec, samples: int) -> None:
        super().__init__(spec)
        elements, channels = spec.shape
        made = SyntheticSource(
            f"{elements}x{channels}", SyntheticOptions(spec.rate_hz, LOOP_S, pace="fast")
        )
        loop = np.concatenate([chunk.values for chunk in made])
        self._loop = np.roll(loop, -round(QUIET_AT_S * spec.rate_hz), axis=0)
        self._left = samples
        self._sent = 0
        self._piece = max(1, round(PIECE_S * spec.rate_hz))

    def read(self, timeout: float | None = None) -> Chunk | None:
        n = min(self._piece, self._left)
        if n == 0:
            raise EndOfStream
        seq = self._sent + np.arange(n, dtype=np.int64)
        self._sent, self._left = self._sent + n, self._left - n
        t_ns = np.round(seq * (NS_PER_S / self.spec.rate_hz)).astype(np.int64)
        values = self._loop[seq % len(self._loop)]
        return Chunk(seq, t_ns, values, np.ones(values.shape[:2], np.bool_))

    def close(self) -> None:
        self._left = 0


class _Bytes(bytes):
    """A sample's packet that knows which one it is."""

    nth: int


class _Frames(list[Any]):
    """The same on CAN."""

    nth: int


class _Timed:
    """An endpoint that writes down when each sample is handed to it."""

    at_ns: "array[int]"

    def send(self, packet: Any, answer: bool = False) -> bool:
        nth = getattr(packet, "nth", -1)  # what was damaged has lost it
        if nth >= 0 and not self.at_ns[nth]:
            self.at_ns[nth] = time.monotonic_ns()
        sent: bool = super().send(packet, answer)  # type: ignore[misc]
        return sent


class _TimedSerial(_Timed, SerialEndpoint):
    pass


class _TimedSlcan(_Timed, SlcanEndpoint):
    pass


def play(pipe: Connection, stage: Stage) -> None:
    """Say the URL; then obey ``unplug``, ``replug`` (say when), ``end`` (of what it measures),
    ``done`` (whether), ``where`` (in words), ``played``: say a `Played`."""
    kind = _TimedSerial if stage.wire == "serial" else _TimedSlcan
    endpoint = kind(stage.link, fifo_bytes=FIFO_BYTES)
    endpoint.at_ns = array("q", bytes(8 * stage.samples))
    codec = make_codec("serial" if stage.wire == "serial" else "can", "native", stage.options)
    codec.spec = stage.spec
    encode, counter = codec.encode, itertools.count()

    def numbered(chunk: Chunk) -> list[Any]:
        packets = []
        for packet in encode(chunk):
            known = (_Bytes if isinstance(packet, bytes) else _Frames)(packet)
            known.nth = next(counter)
            packets.append(known)
        return packets

    codec.encode = numbered  # type: ignore[method-assign]
    faults = FaultSchedule(stage.faults) if stage.faults else None
    bumps = _Bumps(stage.spec, stage.samples)
    with Emulator(codec, bumps, endpoint, faults) as emulator:
        query = "&".join(f"{k}={v}" for k, v in {"codec": "native", **stage.options}.items())
        pipe.send(f"{emulator.address}?{query}")
        while True:
            try:
                word = pipe.recv()
            except EOFError:
                return
            if word == "unplug":
                emulator.unplug()
                pipe.send(time.monotonic_ns())
            elif word == "replug":
                emulator.replug()
                pipe.send(time.monotonic_ns())
            elif word == "done":
                pipe.send(emulator.done)
            elif word == "where":
                pipe.send(
                    f"{emulator.log.sent} of {stage.samples} measured, {endpoint.backlog} bytes "
                    f"not sent, {'heard' if endpoint.heard else 'unheard'}"
                )
            elif word == "end":
                bumps.close()
                pipe.send(time.monotonic_ns())
            else:
                log = emulator.log
                known = np.array(endpoint.at_ns, np.int64)[: len(log.fate)]
                struck = tuple((f.kind, float(f.at_s or 0.0), f.duration_s) for f in stage.faults)
                pipe.send(Played(log.fate, known, log.duplicated, struck))
