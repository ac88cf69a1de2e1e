"""Codec of any CAN sensor, configured by its maker's DBC file and a mapping file.

``docs/codecs/can_dbc.toml`` is an example with all fields explained.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import CanCodec, CanFrame, Command, SampleBatch, Samples, Step
from tactile_rt.drivers.codecs.dbc_file import FramePart, Signal, read_mapping
from tactile_rt.drivers.codecs.framing import Rounds


@dataclass(frozen=True)
class CanDbcOptions:
    """Options of a CAN sensor described by a DBC file.

    Attributes:
        mapping: TOML file, see ``docs/codecs/can_dbc.toml``.
    """

    mapping: str = ""

    def __post_init__(self) -> None:
        if not self.mapping:
            raise ConfigError("can-dbc needs mapping=FILE.toml: see docs/codecs/can_dbc.toml")


class CanDbc(CanCodec):
    """Codec of samples sent in one CAN message, several messages, or a multiplexed one.

    A sample ends with its last frame, or at the first frame of the next sample: a frame out of
    order, or one whose counter differs. Elements with a missing signal are invalid;
    a sample without its counter, time or status is not delivered.
    """

    Options = CanDbcOptions
    cannot_detect = "a lost sample, where the mapping names no counter"

    def __init__(self, options: CanDbcOptions) -> None:
        self._map = read_mapping(Path(options.mapping))
        super().__init__(self._map.spec)
        self.tick_ns = self._map.tick_ns
        self.names = self._map.names  # of messages, since some logs have them for identifiers
        if self._map.counter:
            self.count_bits = self._map.counter[0].length
        if self._map.time:
            self.tick_bits = self._map.time[0].length
        self.polls = any(when == Command.POLL for when, *_ in self._map.commands)
        self.streaming = not any(when == Command.START for when, *_ in self._map.commands)
        self._parts: dict[tuple[int, bool], list[tuple[int, FramePart]]] = {}
        for index, part in enumerate(self._map.parts):
            self._parts.setdefault((part.id, part.extended), []).append((index, part))
        self._rounds: Rounds[bytes] = Rounds(len(self._map.parts))
        self._count: float | None = None  # counter of the unfinished round

    def forget(self) -> None:
        self._rounds.forget()
        self._count = None

    def feed(self, packet: Sequence[CanFrame], t_ns: int) -> Samples | None:
        batch, stats, ids = SampleBatch(), self.stats, self._parts
        for identifier, data, extended, _, remote in packet:
            parts = ids.get((identifier, extended))
            if parts is None or remote:
                stats.skipped += 1
                continue
            if len(data) < parts[0][1].length:
                stats.corrupt += 1
                continue
            stats.intact += 1
            data = data[: parts[0][1].length]
            for index, part in parts:
                if part.matches(data):
                    self._add_part(batch, index, data)
                    break
        return batch.take(self._map.spec.shape, t_ns)

    def _add_part(self, batch: SampleBatch, index: int, data: bytes) -> None:
        ended: list[list[bytes | None]] = []
        counter = self._map.counter
        if counter and index in counter[1]:
            count = counter[0].read(data)
            if self._count is not None and count != self._count:
                ended = self._rounds.end()
            self._count = count
        for parts in ended + self._rounds.add(index, data):
            self._add_sample(batch, parts)

    def _add_sample(self, batch: SampleBatch, parts: list[bytes | None]) -> None:
        mapping = self._map
        self.stats.incomplete += None in parts
        numbers = [_read_cell(cell, parts) for cell in mapping.cells]
        whole = [
            _read_cell(single, parts) if single else 0
            for single in (mapping.counter, mapping.time, mapping.status)
        ]
        if None in whole:
            return
        raw = np.array(numbers, np.float64).reshape(mapping.spec.shape)  # None becomes NaN
        count, ticks, status = (int(x or 0) for x in whole)
        came = np.asarray(np.isfinite(raw).all(axis=1))
        values = np.where(came[:, None], raw * mapping.gain + mapping.bias, 0.0)
        with np.errstate(over="ignore"):  # an overflow becomes infinite, and so invalid
            batch.values.append(values.astype(np.float32))
        batch.valid.append(came if not status & mapping.invalid else np.zeros_like(came))
        for single, number, numbers_so_far in (
            (mapping.counter, count, batch.count),
            (mapping.time, ticks, batch.ticks),
            (mapping.status, status, batch.status),
        ):
            if single:
                numbers_so_far.append(number & (1 << single[0].length) - 1)

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        return tuple(
            Step((frame,), answer, what=f"the {when} command {frame.id:#x}")
            for when, frame, answer in self._map.commands
            if when == command
        )

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        mapping = self._map
        values = np.nan_to_num(chunk.values.astype(np.float64))
        raw = ((values - mapping.bias) / mapping.gain).reshape(len(chunk), -1)
        tick_ns = mapping.tick_ns or 1.0
        packets: list[Sequence[CanFrame]] = []
        for seq, t_ns, numbers in zip(
            chunk.seq.tolist(), chunk.t_ns.tolist(), raw.tolist(), strict=True
        ):
            fields = [
                (signal, inside, signal.nearest(number))
                for (signal, inside), number in zip(mapping.cells, numbers, strict=True)
            ]
            for single, number in (
                (mapping.counter, seq),
                (mapping.time, int(t_ns // tick_ns)),
            ):
                if single:
                    fields.append((*single, _wrap(single[0], number)))
            packets.append([_encode_part(i, p, fields) for i, p in enumerate(mapping.parts)])
        return packets

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        answers = []
        for frame in packet:
            for when, command, answer in self._map.commands:
                if frame[:3] != command[:3]:
                    continue
                if when == Command.POLL:
                    self.polled += 1
                else:
                    self.streaming = when == Command.START
                if answer is not None:
                    answers.append(CanFrame(answer, extended=answer > 0x7FF))
        return answers


def _read_cell(cell: tuple[Signal, tuple[int, ...]], parts: list[bytes | None]) -> float | None:
    """Return a signal's raw number from the first part that carries it; None without any."""
    signal, inside = cell
    for index in inside:
        data = parts[index]
        if data is not None:
            return signal.read(data)
    return None


def _wrap(signal: Signal, number: int) -> int:
    number &= (1 << signal.length) - 1
    return (
        number - (1 << signal.length) if signal.signed and number >> signal.length - 1 else number
    )


def _encode_part(
    index: int, part: FramePart, fields: list[tuple[Signal, tuple[int, ...], float]]
) -> CanFrame:
    numbers: dict[str, float] = {s.name: 0 for s in part.message.signals}
    numbers.update((signal.name, min(values)) for signal, values in part.when)
    numbers.update((signal.name, x) for signal, inside, x in fields if index in inside)
    data = part.message.encode(numbers, scaling=False, padding=False, strict=False)
    return CanFrame(part.id, bytes(data), part.extended, fd=part.length > 8)
