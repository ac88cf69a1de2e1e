"""Layout of samples in a device's CAN frames, from a DBC file and a mapping of its signals.

`Signal` reads a number from a frame's data, `FramePart` recognises a frame by its multiplexers, and
`DbcMapping` defines how a sample is assembled from both. `read_mapping` makes one from a mapping
like ``docs/codecs/can_dbc.toml``; cantools reads the DBC file named there.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import open_regular
from tactile_rt.core.packages import require_extra
from tactile_rt.core.settings import convert, nearest, no_such, read_toml
from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.codecs.dbc_limits import DEEPEST, MOST_BYTES, check_dbc

LARGEST: Final = 1e30  # largest reading that an integer in a frame may represent
FLOATS: Final = {16: ">e", 32: ">f", 64: ">d"}

Cell = tuple[int, int]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Signal:
    """Position and type of a number in the data of a CAN frame.

    Attributes:
        start: The signal's lowest bit, counted from the lowest bit of byte 0; if `big`, the highest
            bit, counted from the highest of byte 0.
        length: Width of the signal, in bits.
    """

    message: str
    name: str
    start: int
    length: int
    big: bool
    signed: bool
    real: bool

    def read(self, data: bytes) -> float:
        """Return the raw number, before the DBC file's factor and offset are applied."""
        if self.big:
            raw = int.from_bytes(data, "big") >> (8 * len(data) - self.start - self.length)
        else:
            raw = int.from_bytes(data, "little") >> self.start
        raw &= (1 << self.length) - 1
        if self.real:
            number: float = struct.unpack(FLOATS[self.length], raw.to_bytes(self.length // 8))[0]
            return number
        if self.signed and raw >> (self.length - 1):
            raw -= 1 << self.length
        return raw

    def nearest(self, value: float) -> float:
        """Return the nearest number that the signal can hold; 0 for NaN and infinity."""
        if not math.isfinite(value):
            value = 0.0
        if self.real:
            return value
        low, high = (0, 1 << self.length) if not self.signed else (-1 << self.length - 1, 0)
        high = high or 1 << self.length - 1
        return min(max(round(value), low), high - 1)


@dataclass(frozen=True)
class FramePart:
    """Part of a sample: a CAN message, selected by the values of its multiplexers.

    Attributes:
        length: Length of the message's data, bytes.
        when: The multiplexers in the message, and the values of each that identify this part.
    """

    id: int
    extended: bool
    length: int
    when: tuple[tuple[Signal, frozenset[int]], ...]
    message: Any

    def matches(self, data: bytes) -> bool:
        """Return whether the multiplexers in a frame's data have the values of this part."""
        return all(signal.read(data) in values for signal, values in self.when)


@dataclass(frozen=True)
class DbcMapping:
    """Layout of a sample in CAN frames, and the commands of its device.

    Attributes:
        parts: The frames of a sample, in the order in which the device sends them.
        cells: The signal of each of (element * channel) values, and the parts that contain it.
        gain: Scale of each value, (element, channel), SI units per raw count.
        bias: Value of a raw 0, (element, channel), SI.
        counter: The signal that counts samples, and the parts that contain it; None without one.
            The same holds for `time` and `status`.
        tick_ns: Length of a tick of `time`, ns; None if the device sends no time.
        commands: (command, frame to send, identifier of the answer) of each command.
        names: Identifier of each message of the DBC file, and whether it has 29 bits.
    """

    spec: ArraySpec
    parts: tuple[FramePart, ...]
    cells: tuple[tuple[Signal, tuple[int, ...]], ...]
    gain: NDArray[np.float64]
    bias: NDArray[np.float64]
    counter: tuple[Signal, tuple[int, ...]] | None
    time: tuple[Signal, tuple[int, ...]] | None
    status: tuple[Signal, tuple[int, ...]] | None
    tick_ns: float | None
    invalid: int
    commands: tuple[tuple[str, CanFrame, int | None], ...]
    names: dict[str, tuple[int, bool]]


class _Channel(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    unit: str
    scale: float = 1.0
    offset: float = 0.0


class _Element(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    grid: Cell
    signals: dict[str, str]
    position_m: Point = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


class _Signal(msgspec.Struct, forbid_unknown_fields=True):
    signal: str


class _Time(_Signal):
    tick_us: Annotated[float, msgspec.Meta(gt=0)]


class _Status(_Signal):
    invalid: int = 0


class _Command(msgspec.Struct, forbid_unknown_fields=True):
    when: Literal["start", "stop", "poll"]
    id: Annotated[int, msgspec.Meta(ge=0, le=0x1FFFFFFF)]
    data: str = ""
    extended: bool = False
    answer: int | None = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    dbc: str
    name: str
    rate_hz: float
    channel: Annotated[list[_Channel], msgspec.Meta(min_length=1)]
    element: Annotated[list[_Element], msgspec.Meta(min_length=1)]
    frame: str = "mount"
    order: list[str] = []
    counter: _Signal | None = None
    time: _Time | None = None
    status: _Status | None = None
    command: list[_Command] = []


def read_mapping(path: Path) -> DbcMapping:
    """Read a mapping and the DBC file that it names."""
    file: _File = convert(read_toml(path), _File)
    return _Reader(path, file).mapping()


class _Reader:
    def __init__(self, path: Path, file: _File) -> None:
        with require_extra("codec can-dbc needs", "dbc"):
            import cantools
            from cantools.database.errors import Error as DatabaseError
        self.path, self.file = path, file
        self.dbc = path.parent / file.dbc
        try:
            with open_regular(self.dbc) as dbc:
                content = dbc.read(MOST_BYTES + 1)
        except OSError as error:
            raise ConfigError(f"{path}, dbc: {self.dbc}: {error.strerror or error}") from None
        if len(content) > MOST_BYTES:
            raise ConfigError(
                f"{self.dbc}: larger than {MOST_BYTES >> 20} MiB; keep the messages of the sensor"
            )
        try:
            text = content.decode("cp1252")  # the encoding that cantools assumes
            check_dbc(str(self.dbc), text)
            database: Any = cantools.database.load_string(text, "dbc")
        except (DatabaseError, ValueError, LookupError, TypeError, RecursionError) as error:
            why = "".join(c if c.isprintable() else " " for c in str(error)[:1000])
            why = " ".join(why.split())[:200]
            raise ConfigError(f"{self.dbc}: is not a DBC file that cantools reads: {why}") from None
        self.messages: dict[str, Any] = {m.name: m for m in database.messages}
        # (multiplexer, its values) for each (message, signal) used, innermost first
        self.used: dict[tuple[str, str], tuple[tuple[str, frozenset[int]], ...]] = {}

    def mapping(self) -> DbcMapping:
        file, path = self.file, self.path
        spec = self._make_spec()
        names = [c.name for c in file.channel]
        signals, gain, bias = [], [], []
        for element in file.element:
            where = f"{path}, element {element.name}"
            for name in element.signals:
                if name not in names:
                    raise ConfigError(f"{where}: {no_such('channel', name, names)}")
            for channel in file.channel:
                if channel.name not in element.signals:
                    raise ConfigError(f"{where}: no signal for channel {channel.name}; add one")
                if not (math.isfinite(channel.scale) and channel.scale):
                    raise ConfigError(f"{path}, channel {channel.name}: scale must not be 0")
                signal, found = self._find_signal(
                    f"{where}, channel {channel.name}", element.signals[channel.name]
                )
                signals.append(found)
                gain.append(signal.scale * channel.scale)
                bias.append(signal.offset * channel.scale + channel.offset)
                largest = abs(gain[-1]) * 2.0 ** (0 if found.real else found.length) + abs(bias[-1])
                if not largest < LARGEST:
                    raise ConfigError(
                        f"{where}, channel {channel.name}: factor and offset of signal "
                        f"{found.name} give readings up to {largest:.3g}, more than any sensor's"
                    )
        roles = [
            self._find_integer(what, getattr(file, what)) for what in ("counter", "time", "status")
        ]
        parts = self._make_parts()
        counter, time, status = (None if s is None else (s, self._locate(s, parts)) for s in roles)
        return DbcMapping(
            spec,
            parts,
            tuple((s, self._locate(s, parts)) for s in signals),
            np.array(gain).reshape(spec.shape),
            np.array(bias).reshape(spec.shape),
            counter,
            time,
            status,
            file.time.tick_us * 1e3 if file.time else None,
            file.status.invalid if file.status else 0,
            tuple(self._make_command(i, c) for i, c in enumerate(file.command, 1)),
            {m.name: (m.frame_id, m.is_extended_frame) for m in self.messages.values()},
        )

    def _make_spec(self) -> ArraySpec:
        elements, channels = self.file.element, self.file.channel
        try:
            return ArraySpec(
                name=self.file.name,
                elements=tuple(e.name for e in elements),
                grid=tuple(e.grid for e in elements),
                positions=tuple(e.position_m for e in elements),
                orientations=tuple(e.orientation for e in elements),
                channels=tuple(c.name for c in channels),
                units=tuple(c.unit for c in channels),
                rate_hz=self.file.rate_hz,
                frame=self.file.frame,
            )
        except ConfigError as error:
            raise ConfigError(f"{self.path}: {error}") from None

    def _get_message(self, where: str, name: str) -> Any:
        if name not in self.messages:
            hint = nearest(name, [known[:40] for known in self.messages])
            raise ConfigError(f"{where}: no message {name[:40]!r} in {self.dbc}; {hint}")
        return self.messages[name]

    def _find_signal(self, where: str, name: str) -> tuple[Any, Signal]:
        """Find a signal by its name ``Message.Signal``; return it as cantools' object and ours."""
        owner, dot, signal_name = name.partition(".")
        if not dot:
            owners = [m.name for m in self.messages.values() for s in m.signals if s.name == name]
            hint = f" (did you mean {owners[0]}.{name}?)" if owners else ""
            raise ConfigError(f"{where}: {name!r} must be written Message.Signal{hint}")
        message = self._get_message(where, owner)
        known = {s.name: s for s in message.signals}
        if signal_name not in known:
            hint = nearest(signal_name, [n[:40] for n in known])
            raise ConfigError(
                f"{where}: no signal {signal_name!r} in message {owner[:40]} of {self.dbc}; {hint}"
            )
        signal = known[signal_name]
        chain: list[tuple[str, frozenset[int]]] = []
        outer = signal
        while outer.multiplexer_signal:
            if len(chain) == DEEPEST:
                raise ConfigError(f"{self.dbc}: {name} is nested in {DEEPEST} multiplexers or more")
            chain.append((outer.multiplexer_signal, frozenset(outer.multiplexer_ids)))
            outer = known[outer.multiplexer_signal]
        self.used[owner, signal_name] = tuple(chain)
        return signal, _convert_signal(message, signal)

    def _find_integer(self, what: str, entry: _Signal | None) -> Signal | None:
        if entry is None:
            return None
        _, signal = self._find_signal(f"{self.path}, {what}", entry.signal)
        if signal.real:
            raise ConfigError(f"{self.path}, {what}: {entry.signal} must have whole numbers")
        return signal

    def _make_parts(self) -> tuple[FramePart, ...]:
        chains = {(owner, frozenset(chain)) for (owner, _), chain in self.used.items()}
        # signals in every frame of a message belong to each of its multiplexed parts
        last = [c for c in chains if not any(c[0] == o[0] and c[1] < o[1] for o in chains)]
        order, messages = self.file.order, {owner for owner, _ in last}
        for name in order:
            self._get_message(f"{self.path}, order", name)
        if order and (left := sorted(messages - set(order))):
            raise ConfigError(f"{self.path}, order: {left[0]} is missing; name every message used")
        parts = []
        for owner, chain in last:
            message = self.messages[owner]
            known = {s.name: s for s in message.signals}
            when = tuple(
                sorted(
                    ((_convert_signal(message, known[m]), values) for m, values in chain),
                    key=lambda w: w[0].name,
                )
            )
            extended = bool(message.is_extended_frame)
            part = FramePart(message.frame_id, extended, message.length, when, message)
            rank = order.index(owner) if order else message.frame_id
            parts.append((rank, sorted(min(v) for _, v in when), part))
        return tuple(part for *_, part in sorted(parts, key=lambda p: p[:2]))

    def _locate(self, signal: Signal, parts: Sequence[FramePart]) -> tuple[int, ...]:
        needs = self.used[signal.message, signal.name]
        return tuple(
            i
            for i, part in enumerate(parts)
            if part.message.name == signal.message
            and {(m, v) for m, v in needs} <= {(s.name, v) for s, v in part.when}
        )

    def _make_command(self, number: int, command: _Command) -> tuple[str, CanFrame, int | None]:
        where = f"{self.path}, command {number}"
        try:
            data = bytes.fromhex(command.data)
        except ValueError:
            raise ConfigError(f"{where}: data {command.data!r} must be hexadecimal") from None
        if command.id > 0x7FF and not command.extended:
            raise ConfigError(f"{where}: id {command.id:#x} has over 11 bits: add extended = true")
        if len(data) > 64:
            raise ConfigError(f"{where}: a CAN frame has at most 64 bytes, not {len(data)}")
        frame = CanFrame(command.id, data, command.extended, fd=len(data) > 8)
        return command.when, frame, command.answer


def _convert_signal(message: Any, signal: Any) -> Signal:
    big = signal.byte_order == "big_endian"
    # a DBC file counts bits from the lowest of each byte, in either order
    start = signal.start // 8 * 8 + 7 - signal.start % 8 if big else signal.start
    return Signal(
        message.name, signal.name, start, signal.length, big, signal.is_signed, signal.is_float
    )
