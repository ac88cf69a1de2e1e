"""Any sensor that sends frames of one length over a serial line, described in a TOML file."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.frame_layout import FrameLayout, as_bytes
from tactile_rt.drivers.codecs.frame_mapping import read_frame_mapping
from tactile_rt.drivers.codecs.framing import FrameFinder
from tactile_rt.stream import Chunk, ConfigError

__all__ = ["BinaryFrame", "BinaryFrameOptions"]


@dataclass(frozen=True)
class BinaryFrameOptions:
    """Options of a described binary frame.

    Attributes:
        mapping: Path of a TOML file, like docs/codecs/binary_frame.toml.
    """

    mapping: str = ""

    def __post_init__(self) -> None:
        if not self.mapping:
            raise ConfigError(
                "binary_frame has to know the frame: give mapping=FILE.toml, as "
                "docs/codecs/binary_frame.toml"
            )


class BinaryFrame(SerialCodec):
    """Frames with a beginning and a length; counter, clock, status and checksum if they have one.

    Attributes:
        frame: The frame as it was described.
    """

    Options = BinaryFrameOptions
    cannot_detect = (
        "What the frame has nothing for: without a checksum changed values, without a counter or "
        "clock frames that never came or came twice."
    )

    def __init__(self, options: BinaryFrameOptions) -> None:
        mapping, where = read_frame_mapping(options.mapping), options.mapping
        self.frame = frame = FrameLayout(mapping, where)
        super().__init__(frame.spec)
        self.baud, self.parity = mapping.baud, mapping.parity  # type: ignore[misc]
        self.count_bits = frame.count.bits if frame.count else None
        if mapping.time is not None and frame.time is not None:
            self.tick_ns, self.tick_bits = 1e3 * mapping.time.tick_us, frame.time.bits
        self._invalid = 0
        if mapping.status is not None:
            self.status_bits = frame.meanings  # type: ignore[misc]
            self._invalid = sum(1 << bit for bit in mapping.status.invalid)
        self._steps = {
            command: tuple(
                Step(
                    as_bytes(m.send, f"{where}: {command}"),
                    as_bytes(m.expect, f"{where}: {command}") if m.expect else None,
                    m.wait_s, m.pause_s, f"the {command} command {m.send}",
                )
                for m in messages
            )
            for command, messages in (
                (Command.START, mapping.start), (Command.STOP, mapping.stop),
            )
        }  # fmt: skip
        poll = as_bytes(mapping.poll, f"{where}: poll")
        self._steps[Command.POLL] = (Step(poll),) if poll else ()
        self.polls = bool(poll)
        self.streaming = not self.polls and not mapping.start
        self._finder = FrameFinder(
            frame.sync, mapping.length, frame.intact, frame.between, self.stats
        )
        self._heard = b""

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        found, damaged = self._finder.find(packet)
        if not found:
            return None
        frame, n, length = self.frame, len(found), self.frame.mapping.length
        data = b"".join(found)
        values = np.empty((n, frame.spec.shape[0] * frame.spec.shape[1]))
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged value may be any
            for block in frame.blocks:
                raw = block.numbers.read(data, n, length)
                values[:, block.cells] = raw.astype(np.float64) * block.gain + block.bias
            loads = values.astype(np.float32).reshape(n, *frame.spec.shape)
        count, ticks, status = (
            None if one is None else one.read(data, n, length)[:, 0].astype(np.int64)
            for one in (frame.count, frame.time, frame.status)
        )
        valid = np.asarray(np.isfinite(loads).all(axis=2))
        if status is not None:
            valid &= (status & self._invalid == 0)[:, None]
        arrived = np.full(n, t_ns, np.int64)
        return Samples(loads, valid, arrived, np.array(damaged, np.int64), count, ticks, status)

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        return self._steps[command]

    def forget(self) -> None:
        self._finder.forget()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        flat = chunk.values.astype(np.float64).reshape(len(chunk), -1)
        ticks = np.rint(chunk.t_ns / (self.tick_ns or 1.0))
        return [self._encoded(flat[k], int(chunk.seq[k]), int(ticks[k])) for k in range(len(chunk))]

    def _encoded(self, values: NDArray[np.float64], count: int, ticks: int) -> bytes:
        frame = self.frame
        made = bytearray(frame.mapping.length)
        made[: len(frame.sync)] = frame.sync
        made[len(made) - len(frame.ends) :] = frame.ends
        for block in frame.blocks:
            block.numbers.write(made, (values[block.cells] - block.bias) / block.gain)
        for number, place in ((count, frame.count), (ticks, frame.time)):
            if place is not None:
                place.write(made, np.array([number % (1 << place.bits)]))
        return frame.seal(made)

    def respond(self, packet: bytes) -> bytes:
        answer = b""
        longest = max((len(s.send) for steps in self._steps.values() for s in steps), default=1)
        for k in range(len(packet)):
            self._heard = (self._heard + packet[k : k + 1])[-longest:]
            answer += self._hear()
        return answer

    def _hear(self) -> bytes:
        for command, steps in self._steps.items():
            for step in steps:
                if step.send and self._heard.endswith(step.send):
                    self._heard = b""
                    self._obey(command, step)
                    return step.expect if isinstance(step.expect, bytes) else b""
        return b""

    def _obey(self, command: Command, step: Step[Any]) -> None:
        if command == Command.POLL:
            self.polled += 1
        elif command == Command.STOP:
            self.streaming = False
        elif step is self._steps[command][-1]:
            self.streaming = not self.polls
