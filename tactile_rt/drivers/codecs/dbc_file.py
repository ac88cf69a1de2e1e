"""Where in a device's CAN frames its samples are: a DBC file, and a mapping that names signals.

`Signal` reads a number out of a frame's data, `FramePart` knows a frame by its multiplexers, and
`DbcMapping` says how a sample is put together of both. `read_mapping` makes one from a mapping like
``docs/codecs/can_dbc.toml``; cantools reads the DBC file that it names.
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

LARGEST: Final = 1e30  # reading that an integer of a frame may stand for
FLOATS: Final = {16: ">e", 32: ">f", 64: ">d"}

Cell = tuple[int, int]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Signal:
    """Where a number is in a frame's data.

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
        """The number as it is in the data, before the DBC file's factor and offset."""
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
        """What it can hold that is nearest to this value; NaN is 0."""
        if not math.isfinite(value):
            value = 0.0
        if self.real:
            return value
        low, high = (0, 1 << self.length) if not self.signed else (-1 << self.length - 1, 0)
        high = high or 1 << self.length - 1
        return min(max(round(value), low), high - 1)


@dataclass(frozen=True)
class FramePart:
    """A frame that every sample has: a message, with these values of its multiplexers.

    Attributes:
        length: Length of the message's data, bytes.
        when: The multiplexers in the message, and the values of each that make a frame this part.
    """

    id: int
    extended: bool
    length: int
    when: tuple[tuple[Signal, frozenset[int]], ...]
    message: Any

    def matches(self, data: bytes) -> bool:
        """Whether the multiplexers in the data have these values."""
        return all(signal.read(data) in values for signal, values in self.when)


@dataclass(frozen=True)
class DbcMapping:
    """How a sample is put together.

    Attributes:
        parts: The frames of a sample, in the order in which the device sends them.
        cells: The signal of each of (element * channel) values, and the parts that each is in.
        gain: Scale of each value, (element, channel), SI units per raw count.
        bias: Value of a raw 0, (element, channel), SI.
        counter: The signal that counts samples, and the parts that have it; None if there is none.
            The same holds for `time` and `status`.
        tick_ns: Length of a tick of `time`, ns; None if the device sends no time.
        commands: What the host sends and when: (command, frame, identifier of the answer).
        names: Identifiers of all messages of the DBC file, and whether they have 29 bits.
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
            text = content.decode("cp1252")  # as cantools takes them to be
            check_dbc(str(self.dbc), text)
            database: Any = cantools.database.load_string(text, "dbc")
        except (DatabaseError, ValueError, LookupError, TypeError, RecursionError) as error:
            why = "".join(c if c.isprintable() else " " for c in str(error)[:1000])
            why = " ".join(why.split())[:200]
            raise ConfigError(f"{self.dbc}: is not a DBC file that cantools reads: {why}") from None
        self.messages: dict[str, Any] = {m.name: m for m in database.messages}
        # (message, multiplexers' values) of each signal that is used
        self.used: dict[tuple[str, str], tuple[tuple[str, frozenset[int]], ...]] = {}

    def mapping(self) -> DbcMapping:
        file, path = self.file, self.path
        spec = self._spec()
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
                signal, found = self._find(
                    f"{where}, channel {channel.name}", element.signals[channel.name]
                )
                signals.append(found)
                gain.append(signal.scale * channel.scale)
                bias.append(signal.offset * channel.scale + channel.offset)
                largest = abs(gain[-1]) * 2.0 ** (0 if found.real else found.length) + abs(bias[-1])
                if not largest < LARGEST:
                    raise ConfigError(
                        f"{where}, channel {channel.name}: by the factor and offset of signal "
                        f"{found.name} its readings go up to {largest:.3g}, as no sensor's do"
                    )
        singles = [
            self._integer(what, getattr(file, what)) for what in ("counter", "time", "status")
        ]
        parts = self._parts()
        counter, time, status = (None if s is None else (s, self._in(s, parts)) for s in singles)
        return DbcMapping(
            spec,
            parts,
            tuple((s, self._in(s, parts)) for s in signals),
            np.array(gain).reshape(spec.shape),
            np.array(bias).reshape(spec.shape),
            counter,
            time,
            status,
            file.time.tick_us * 1e3 if file.time else None,
            file.status.invalid if file.status else 0,
            tuple(self._command(i, c) for i, c in enumerate(file.command, 1)),
            {m.name: (m.frame_id, m.is_extended_frame) for m in self.messages.values()},
        )

    def _spec(self) -> ArraySpec:
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

    def _message(self, where: str, name: str) -> Any:
        if name not in self.messages:
            hint = nearest(name, [known[:40] for known in self.messages])
            raise ConfigError(f"{where}: no message {name[:40]!r} in {self.dbc}; {hint}")
        return self.messages[name]

    def _find(self, where: str, name: str) -> tuple[Any, Signal]:
        """cantools' signal, and ours, of ``Message.Signal``."""
        of, dot, signal_name = name.partition(".")
        if not dot:
            owners = [m.name for m in self.messages.values() for s in m.signals if s.name == name]
            hint = f" (did you mean {owners[0]}.{name}?)" if owners else ""
            raise ConfigError(f"{where}: {name!r} must be written Message.Signal{hint}")
        message = self._message(where, of)
        known = {s.name: s for s in message.signals}
        if signal_name not in known:
            hint = nearest(signal_name, [n[:40] for n in known])
            raise ConfigError(
                f"{where}: no signal {signal_name!r} in message {of[:40]} of {self.dbc}; {hint}"
            )
        signal = known[signal_name]
        chain: list[tuple[str, frozenset[int]]] = []
        outer = signal
        while outer.multiplexer_signal:
            if len(chain) == DEEPEST:
                raise ConfigError(f"{self.dbc}: {name} is within {DEEPEST} multiplexers, or itself")
            chain.append((outer.multiplexer_signal, frozenset(outer.multiplexer_ids)))
            outer = known[outer.multiplexer_signal]
        self.used[of, signal_name] = tuple(chain)
        return signal, _signal(message, signal)

    def _integer(self, what: str, wanted: _Signal | None) -> Signal | None:
        if wanted is None:
            return None
        _, signal = self._find(f"{self.path}, {what}", wanted.signal)
        if signal.real:
            raise ConfigError(f"{self.path}, {what}: {wanted.signal} must be of whole numbers")
        return signal

    def _parts(self) -> tuple[FramePart, ...]:
        chains = {(of, frozenset(chain)) for (of, _), chain in self.used.items()}
        # what every frame of a message has belongs to each of its multiplexed parts
        last = [c for c in chains if not any(c[0] == o[0] and c[1] < o[1] for o in chains)]
        order, messages = self.file.order, {of for of, _ in last}
        for name in order:
            self._message(f"{self.path}, order", name)
        if order and (left := sorted(messages - set(order))):
            raise ConfigError(f"{self.path}, order: {left[0]} is missing; name every message used")
        parts = []
        for of, chain in last:
            message = self.messages[of]
            known = {s.name: s for s in message.signals}
            when = tuple(
                sorted(
                    ((_signal(message, known[m]), values) for m, values in chain),
                    key=lambda w: w[0].name,
                )
            )
            extended = bool(message.is_extended_frame)
            part = FramePart(message.frame_id, extended, message.length, when, message)
            rank = order.index(of) if order else message.frame_id
            parts.append((rank, sorted(min(v) for _, v in when), part))
        return tuple(part for *_, part in sorted(parts, key=lambda p: p[:2]))

    def _in(self, signal: Signal, parts: Sequence[FramePart]) -> tuple[int, ...]:
        needs = self.used[signal.message, signal.name]
        return tuple(
            i
            for i, part in enumerate(parts)
            if part.message.name == signal.message
            and {(m, v) for m, v in needs} <= {(s.name, v) for s, v in part.when}
        )

    def _command(self, number: int, command: _Command) -> tuple[str, CanFrame, int | None]:
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


def _signal(message: Any, signal: Any) -> Signal:
    big = signal.byte_order == "big_endian"
    # a DBC file counts bits from the lowest of each byte, in either order
    start = signal.start // 8 * 8 + 7 - signal.start % 8 if big else signal.start
    return Signal(
        message.name, signal.name, start, signal.length, big, signal.is_signed, signal.is_float
    )
