"""Codec of any serial sensor with frames of fixed length, described in a TOML file."""

import textwrap
from dataclasses import dataclass
from functools import cache
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.catalogue import FRAMES
from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.ascii_mapping import read_mapping
from tactile_rt.drivers.codecs.endings import EndFinder, Found, StrideFinder
from tactile_rt.drivers.codecs.frame_layout import FrameLayout, as_bytes
from tactile_rt.drivers.codecs.frame_mapping import FrameMapping
from tactile_rt.drivers.codecs.framing import FrameFinder

DISTINCT = 4  # least bytes of an ending that no measurement contains


@dataclass(frozen=True, kw_only=True)
class FrameOptions:
    """Options of a device with a shipped description of its frame.

    Attributes:
        rate_hz: Rate at which the device sends or is polled, Hz; 0 for that of its description.
    """

    rate_hz: float = 0.0


@dataclass(frozen=True)
class BinaryFrameOptions(FrameOptions):
    """Options of a binary frame with the user's description.

    Attributes:
        mapping: Path of a TOML file, like docs/codecs/binary_frame.toml.
    """

    mapping: str = ""

    def __post_init__(self) -> None:
        if not self.mapping:
            raise ConfigError(
                "binary_frame needs mapping=FILE.toml, as docs/codecs/binary_frame.toml"
            )


class DescribedFrame(SerialCodec):
    """Codec of frames of fixed length, optionally with counter, clock, status and checksum.

    Args:
        rate_hz: rate at which the device sends or is polled, Hz; 0 for that of the description.
    """

    cannot_detect = (
        "changed values without a checksum; frames that never came or came twice without a "
        "counter or a clock"
    )

    def __init__(self, mapping: FrameMapping, where: str, rate_hz: float = 0.0) -> None:
        if rate_hz:
            mapping = msgspec.structs.replace(mapping, rate_hz=rate_hz)
        self.frame = frame = FrameLayout(mapping, where)
        super().__init__(frame.spec)
        self.baud, self.parity = mapping.baud, mapping.parity  # type: ignore[misc]
        self.usb = mapping.usb  # type: ignore[misc]
        self.count_bits = frame.count.bits if frame.count else None
        if mapping.time is not None and frame.time is not None:
            self.tick_ns, self.tick_bits = 1e3 * mapping.time.tick_us, frame.time.bits
        self._invalid = self._invalid_bit = 0
        if mapping.status is not None:
            self.status_bits = frame.meanings  # type: ignore[misc]
            self.harmless_bits = frozenset(mapping.status.harmless)  # type: ignore[misc]
            self._invalid = sum(1 << bit for bit in mapping.status.invalid)
            self._invalid_bit = sum(1 << bit for bit in mapping.status.invalid[:1])
        self._steps = {
            command: tuple(
                Step(
                    as_bytes(m.send, f"{where}: {command}"),
                    as_bytes(m.expect, f"{where}: {command}") if m.expect else None,
                    m.wait_s, m.pause_s, f"the {command} command {textwrap.shorten(m.send, 40)}",
                )
                for m in messages
            )
            for command, messages in (
                (Command.STOP, mapping.stop), (Command.START, mapping.start),
            )
        }  # fmt: skip
        poll = as_bytes(mapping.poll, f"{where}: poll")
        self._steps[Command.POLL] = (Step(poll),) if poll else ()
        self.polls = bool(poll)
        self.streaming = not self.polls and not mapping.start
        self._finder: FrameFinder | EndFinder | StrideFinder
        if frame.sync:
            self._finder = FrameFinder(
                frame.sync, mapping.length, frame.intact, frame.between, self.stats,
                head=frame.usually,
            )  # fmt: skip
        elif len(frame.ends) >= DISTINCT:
            self._finder = EndFinder(frame.ends, mapping.length, self.stats)
        else:
            self._finder = StrideFinder(frame.ends, mapping.length, frame.possible, self.stats)
        self._host_bytes = b""

    @property
    def lock_confidence(self) -> float:
        """Confidence in where frames begin, 0 to 1; 1 with a distinct sync or ending."""
        return self._finder.confidence if isinstance(self._finder, StrideFinder) else 1.0

    @property
    def complaint(self) -> str:  # type: ignore[override]
        frame, mapping = self.frame, self.frame.mapping
        if self.stats.intact:
            return ""
        if not frame.sync:
            return f"nothing ends with {mapping.ends} every {mapping.length} bytes"
        if not frame.begun:
            return f"nothing begins with {mapping.sync}"
        if frame.ended_otherwise == frame.begun:
            ends = f"ends with {mapping.ends} at byte {mapping.length}"
            return f"{frame.begun} frames began, and none {ends}"
        name = mapping.checksum.name if mapping.checksum else ""
        return f"{frame.begun} frames began, and of none {name} is the checksum that it has"

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        found, damaged, arrived = self._find(packet, t_ns)
        if not found:
            return None
        frame, n, length = self.frame, len(found), self.frame.mapping.length
        data = b"".join(found)
        values = np.empty((n, frame.spec.shape[0] * frame.spec.shape[1]))
        valid = np.ones((n, frame.spec.shape[0]), np.bool_)
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged value may be anything
            for block in frame.blocks:
                raw = block.numbers.read(data, n, length).astype(np.float64)
                if len(block.cells):
                    values[:, block.cells] = raw * block.gain + block.bias
                block.judge(raw, valid)
            loads = values.astype(np.float32).reshape(n, *frame.spec.shape)
        count, ticks, status = (
            None if one is None else one.read(data, n, length)[:, 0].astype(np.int64)
            for one in (frame.count, frame.time, frame.status)
        )
        valid &= np.isfinite(loads).all(axis=2)
        if status is not None:
            valid &= (status & self._invalid == 0)[:, None]
        return Samples(
            loads, valid, np.array(arrived, np.int64), np.array(damaged, np.int64), count, ticks,
            status,
        )  # fmt: skip

    def _find(self, packet: bytes, t_ns: int) -> Found:
        if isinstance(self._finder, FrameFinder):
            found, damaged = self._finder.find(packet)
            return found, damaged, [t_ns] * len(found)
        return self._finder.find(packet, t_ns)

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        return self._steps[command]

    def forget(self) -> None:
        self._finder.forget()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        known = chunk.valid & np.isfinite(chunk.values).all(axis=2)
        values = np.where(chunk.valid[..., None], chunk.values, np.nan).astype(np.float64)
        if self._invalid_bit:  # the status marks invalid values
            values = np.nan_to_num(values)
        flat = values.reshape(len(chunk), -1)
        ticks = np.rint(chunk.t_ns / (self.tick_ns or 1.0))
        return [
            self._encode_one(flat[k], bool(known[k].all()), int(chunk.seq[k]), int(ticks[k]))
            for k in range(len(chunk))
        ]

    def _encode_one(self, values: NDArray[np.float64], good: bool, count: int, ticks: int) -> bytes:
        frame = self.frame
        data = bytearray(frame.mapping.length)
        data[: len(frame.sync)] = frame.sync
        data[len(data) - len(frame.ends) :] = frame.ends
        for block in frame.blocks:
            block.write(data, values)
        status = 0 if good else self._invalid_bit
        for number, place in ((count, frame.count), (ticks, frame.time), (status, frame.status)):
            if place is not None:
                place.write(data, np.array([number % (1 << place.bits)]))
        return frame.seal(data)

    def respond(self, packet: bytes) -> bytes:
        answer = b""
        longest = max((len(s.send) for steps in self._steps.values() for s in steps), default=1)
        for k in range(len(packet)):
            self._host_bytes = (self._host_bytes + packet[k : k + 1])[-longest:]
            answer += self._answer_command()
        return answer

    def _answer_command(self) -> bytes:
        for command, steps in self._steps.items():
            for step in steps:
                if step.send and self._host_bytes.endswith(step.send):
                    self._host_bytes = b""
                    self._apply_command(command, step)
                    return step.expect if isinstance(step.expect, bytes) else b""
        return b""

    def _apply_command(self, command: Command, step: Step[Any]) -> None:
        if command == Command.POLL:
            self.polled += 1
        elif command == Command.STOP:
            self.streaming = False
        elif step is self._steps[command][-1]:
            self.streaming = not self.polls


class BinaryFrame(DescribedFrame):
    """Codec of a frame that the user describes, ``mapping=FILE.toml``."""

    Options = BinaryFrameOptions

    def __init__(self, options: BinaryFrameOptions) -> None:
        mapping = read_mapping(options.mapping, FrameMapping)
        super().__init__(mapping, options.mapping, options.rate_hz)


def shipped_frame(name: str) -> FrameMapping:
    """Read the shipped description of a device's frame from the folder `FRAMES`."""
    return read_mapping(str(FRAMES / f"{name}.toml"), FrameMapping)


@cache
def frame_codec(name: str) -> type[DescribedFrame]:
    """Return a codec class made from the device's description in the folder `FRAMES`."""

    class Described(DescribedFrame):
        Options = FrameOptions

        def __init__(self, options: FrameOptions) -> None:
            super().__init__(shipped_frame(name), name, options.rate_hz)

    Described.__name__ = Described.__qualname__ = name
    frame = shipped_frame(name)
    unseen = [] if frame.checksum else ["changed values"]
    if not frame.count:
        clock = ", but for steps of its clock" if frame.time else ""
        unseen.append(f"frames that never came or came twice{clock}")
    else:
        bits = int(frame.count.type.removeprefix("uint"))
        unseen.append(f"{2**bits:,} samples lost in succession")
    Described.cannot_detect = "; ".join(unseen)
    about, _, _ = (FRAMES / f"{name}.toml").read_text("utf-8").partition("\n\n")
    Described.__doc__ = about.replace("# ", "").replace("#\n", "\n")
    return Described
