"""Layout of a binary frame, made from its mapping file, to read and write frames."""

import binascii
import re
import zlib
from collections.abc import Callable
from itertools import product
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import nearest
from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codecs.ascii_mapping import UNITS, Column, array_of
from tactile_rt.drivers.codecs.frame_mapping import UNHEARD, FrameCounter, FrameMapping, Values
from tactile_rt.drivers.codecs.framing import crc16_modbus, crc16_x25, crc16_xmodem

# Name: (width in bytes, function of the bytes that it covers).
CHECKSUMS: Final[dict[str, tuple[int, Callable[[bytes], int]]]] = {
    "sum8": (1, lambda data: sum(data) & 0xFF),
    "negative_sum8": (1, lambda data: -sum(data) & 0xFF),
    "xor8": (1, lambda data: int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))),
    "sum16": (2, lambda data: sum(data) & 0xFFFF),
    "crc16_modbus": (2, crc16_modbus),
    "crc16_xmodem": (2, crc16_xmodem),
    "crc16_ccitt_false": (2, lambda data: binascii.crc_hqx(data, 0xFFFF)),
    "crc16_x25": (2, crc16_x25),
    "crc32": (4, zlib.crc32),
}

Row: TypeAlias = NDArray[np.float64]


class Numbers:
    """Positions in a frame of numbers of one type, in evenly spaced groups.

    Args:
        groups, n: number of groups, and of adjacent numbers in each.
        stride: bytes from one group to the next; 0 if groups are adjacent, too.
    """

    def __init__(
        self, at: int, kind: str, order: str, groups: int = 1, n: int = 1, stride: int = 0
    ) -> None:
        self.bits = int("".join(filter(str.isdigit, kind)))
        self.width = self.bits // 8
        self.at, self.shape, self.stride = at, (groups, n), stride or n * self.width
        self._odd = self.width == 3
        self._signed, self._little = kind.startswith("int"), order == "little"
        letter = kind[0]
        self._dtype = np.dtype(
            f"{'<' if self._little else '>'}{letter}{self.width}" if not self._odd else "u1"
        )
        if letter == "f":
            self.low, self.high = (
                -float(np.finfo(self._dtype).max),
                float(np.finfo(self._dtype).max),
            )
        else:
            half = 1 << (self.bits - 1)
            self.low, self.high = (-half, half - 1) if self._signed else (0, 2 * half - 1)
        self.whole = letter != "f"

    @property
    def covered(self) -> set[int]:
        """Offsets of all bytes that the numbers occupy in the frame."""
        return {at + b for at in self._list_offsets() for b in range(self.width)}

    def _list_offsets(self) -> list[int]:
        groups, n = self.shape
        return [self.at + g * self.stride + k * self.width for g in range(groups) for k in range(n)]

    def read(self, frames: bytes, count: int, length: int) -> NDArray[Any]:
        """Read the raw numbers of `count` frames of `length` bytes into (count, number)."""
        shape, strides = (count, *self.shape), (length, self.stride, self.width)
        if not self._odd:
            found = np.ndarray(shape, self._dtype, frames, self.at, strides)
            return found.reshape(count, -1)
        parts = np.ndarray((*shape, 3), np.uint8, frames, self.at, (*strides, 1))
        parts = parts if self._little else parts[..., ::-1]
        found = (parts.astype(np.int64) @ (1, 1 << 8, 1 << 16)).reshape(count, -1)
        return np.where(found >> 23, found - (1 << 24), found) if self._signed else found

    def write(self, frame: bytearray, values: NDArray[Any]) -> None:
        """Write values into a frame, clipped to the range of the type."""
        numbers = np.clip(values, self.low, self.high)
        if self.whole:
            numbers = np.rint(np.nan_to_num(numbers))
        for at, number in zip(self._list_offsets(), numbers.tolist(), strict=True):
            if self.whole:
                order: Literal["little", "big"] = "little" if self._little else "big"
                raw = (int(number) & ((1 << self.bits) - 1)).to_bytes(self.width, order)
            else:
                raw = np.array(number, self._dtype).tobytes()
            frame[at : at + self.width] = raw


class Block:
    """Measured numbers of a frame, with their scales and their indices in a sample."""

    def __init__(
        self, values: Values, numbers: Numbers, gain: Row, bias: Row, cells: list[int],
        elements: list[int],
    ) -> None:  # fmt: skip
        self.numbers, self.gain, self.bias = numbers, gain, bias
        self.cells = np.array(cells, np.intp)  # places in a sample; empty if not delivered
        self._values, self._elements = values, elements
        self._limited = bool(values.possible or values.valid or values.smallest)

    def possible(self, raw: Row) -> NDArray[np.bool_]:
        """Return whether the device can send each of these raw numbers."""
        values, size = self._values, np.abs(raw)
        can: NDArray[np.bool_] = (size >= values.smallest) | (size == 0)
        return can & _is_within(raw, values.possible)

    def judge(self, raw: Row, valid: NDArray[np.bool_]) -> None:
        """Set `valid`, (n, element), to False where a raw number is out of range."""
        if not self._limited:
            return
        good = self.possible(raw) & _is_within(raw, self._values.valid)
        for k, element in enumerate(self._elements):
            valid[:, element] &= good[:, k]

    def write(self, frame: bytearray, sample: Row) -> None:
        """Convert a sample in SI units to raw numbers, and write them into its frame."""
        if not len(self.cells):
            return
        wire = (sample[self.cells] - self.bias) / self.gain
        if self._values.possible:
            wire = np.clip(wire, *self._values.possible)
        self.numbers.write(frame, np.where(np.abs(wire) < self._values.smallest, 0.0, wire))


def _is_within(raw: Row, limits: tuple[float, float] | None) -> NDArray[np.bool_]:
    least, most = limits or (-np.inf, np.inf)
    within: NDArray[np.bool_] = (raw >= least) & (raw <= most)
    return within


class FrameLayout:
    """Checked layout of a frame, with which a codec reads and writes frames.

    Attributes:
        sync, ends: The bytes with which a frame begins and ends.
        count, time, status: The position of each in a frame; None without it.
        check_at, check_first: Offsets of the checksum, and of the first byte that it covers.
    """

    def __init__(self, mapping: FrameMapping, path: str) -> None:
        self.mapping = mapping
        patterns = [_compile_pattern(text, f"{path}: between") for text in mapping.between]
        answers = [m.expect for m in (*mapping.start, *mapping.stop) if m.expect]
        patterns += [re.escape(as_bytes(text, f"{path}: expect")) for text in answers]
        self.between = re.compile(b"|".join(patterns) or rb"(?!)", re.DOTALL)
        self.sync = _parse_hex(mapping.sync, f"{path}: sync")
        self.ends = _parse_hex(mapping.ends, f"{path}: ends") if mapping.ends else b""
        self.usually = _parse_hex(mapping.usually, f"{path}: usually")
        if not self.sync and not self.ends:
            raise ConfigError(f"{path}: needs sync: the bytes that begin or end each frame")
        if self.usually and not self.usually.startswith(self.sync):
            raise ConfigError(f"{path}: usually must begin with sync")
        taken: dict[int, str] = {}
        length = mapping.length

        def take(offsets: set[int], what: str) -> None:
            for at in sorted(offsets):
                if not 0 <= at < length:
                    raise ConfigError(f"{path}: {what} reaches byte {at}; a frame has {length}")
                if at in taken:
                    raise ConfigError(f"{path}: byte {at} belongs to both {taken[at]} and {what}")
                taken[at] = what

        def place(one: FrameCounter, what: str) -> Numbers:
            found = Numbers(one.at, one.type, one.order or mapping.order)
            take(found.covered, what)
            return found

        take(set(range(len(self.sync))), "sync")
        take(set(range(length - len(self.ends), length)), "ends")
        self._place_checksum(path, take)
        self.count = place(mapping.count, "count") if mapping.count else None
        self.time = place(mapping.time, "time") if mapping.time else None
        self.status = place(mapping.status, "status") if mapping.status else None
        self.meanings: dict[int, str] = {}
        for bit, meaning in (mapping.status.bits if mapping.status else {}).items():
            if not (bit.isdecimal() and self.status and int(bit) < self.status.bits):
                raise ConfigError(f"{path}: status.bits: {bit!r} is not a bit of status")
            self.meanings[int(bit)] = meaning
        self.spec, self.blocks = self._lay_out_values(path, take)
        self.begun = self.ended_otherwise = 0

    def _place_checksum(self, path: str, take: Callable[[set[int], str], None]) -> None:
        check = self.mapping.checksum
        self.check_at = self.check_first = self.check_width = 0
        if check is None:
            return
        if check.name not in CHECKSUMS:
            known = ", ".join(CHECKSUMS)
            raise ConfigError(f"{path}: checksum {check.name!r} is not known; there are {known}")
        self.check_width, self._sum = CHECKSUMS[check.name]
        last = self.mapping.length - len(self.ends) - self.check_width
        self.check_at, self.check_first = (check.at if check.at >= 0 else last), check.first
        if check.first >= self.check_at:
            raise ConfigError(f"{path}: checksum covers nothing from byte {check.first} on")
        take(set(range(self.check_at, self.check_at + self.check_width)), "checksum")
        self._check_order: Literal["little", "big"] = check.order or self.mapping.order

    def _lay_out_values(
        self, path: str, take: Callable[[set[int], str], None]
    ) -> tuple[ArraySpec, list[Block]]:
        found: list[tuple[Values, Numbers, Row, Row, list[Column]]] = []
        for k, values in enumerate(self.mapping.values):
            where = f"values[{k}]"
            elements = _name_elements(values.elements, f"{path}: {where}")
            pairs = list(product(elements, values.channels))
            if values.by == "channel":
                pairs = [(e, c) for c, e in product(values.channels, elements)]
            if values.unit and values.unit not in UNITS:
                raise ConfigError(
                    f"{path}: {where}: unknown unit {values.unit!r}; {nearest(values.unit, UNITS)}"
                )
            scales = values.scale if isinstance(values.scale, tuple) else (values.scale,)
            if len(scales) == 1:
                scales *= len(values.channels)
            if len(scales) != len(values.channels):
                raise ConfigError(f"{path}: {where}: scale must be one number, or one per channel")
            if not (all(scales) and np.isfinite((*scales, values.offset)).all()):
                raise ConfigError(f"{path}: {where}: scale must be numbers other than 0")
            by_channel = dict(zip(values.channels, scales, strict=True))
            columns = [Column.make_measured(e, c, values.unit, by_channel[c]) for e, c in pairs]
            unit = np.array([Column.make_measured(e, c, values.unit).scale for e, c in pairs])
            gain = np.array([column.scale for column in columns])
            order = values.order or self.mapping.order
            groups = len(elements) if values.by == "element" else len(values.channels)
            n = len(pairs) // groups
            numbers = Numbers(values.at, values.type, order, groups, n, values.stride)
            take(numbers.covered, where)
            bias = values.offset * unit + columns[0].offset
            found.append((values, numbers, gain, bias, columns))
        measured = tuple(c for *_, cs in found for c in cs if c.channel != UNHEARD)
        spec = array_of(self.mapping, measured, path)
        cell = {(e, c): i for i, (e, c) in enumerate(product(spec.elements, spec.channels))}
        blocks = []
        for k, (values, numbers, gain, bias, columns) in enumerate(found):
            delivered = UNHEARD not in values.channels
            cells = [cell[c.element, c.channel] for c in columns] if delivered else []
            for column in columns:
                if column.element not in spec.elements:
                    raise ConfigError(
                        f"{path}: values[{k}]: {column.element} has no measured column"
                    )
            rows = [spec.elements.index(c.element) for c in columns]
            blocks.append(Block(values, numbers, gain, bias, cells, rows))
        return spec, blocks

    def possible(self, frames: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return whether the device can have sent each frame, (n,), of (n, length) bytes."""
        n, data = len(frames), frames.tobytes()
        can = np.array([frame.tobytes().endswith(self.ends) for frame in frames], np.bool_)
        with np.errstate(invalid="ignore"):  # treat a signalling NaN as any NaN
            for block in self.blocks:
                raw = block.numbers.read(data, n, self.mapping.length).astype(np.float64)
                can &= block.possible(raw).all(axis=1)
        return can

    def intact(self, frame: bytes) -> bool:
        """Return whether a frame that begins with the sync has a right ending and checksum."""
        self.begun += 1
        if not frame.endswith(self.ends):
            self.ended_otherwise += 1
            return False
        if not self.check_width:
            return True
        return frame[self.check_at :][: self.check_width] == self._make_sum(frame)

    def seal(self, frame: bytearray) -> bytes:
        """Write the checksum into a frame; return the frame as bytes."""
        if self.check_width:
            frame[self.check_at : self.check_at + self.check_width] = self._make_sum(bytes(frame))
        return bytes(frame)

    def _make_sum(self, frame: bytes) -> bytes:
        covered = frame[self.check_first : self.check_at]
        return self._sum(covered).to_bytes(self.check_width, self._check_order)


def _name_elements(given: int | tuple[str | int, ...], where: str) -> tuple[str, ...]:
    if isinstance(given, int):
        return tuple(f"T{k}" for k in range(given))
    names = tuple(name for name in given if isinstance(name, str))
    if len(names) == len(given):
        return names
    rows, columns = (*given, 0)[:2] if len(given) == 2 and not names else (0, 0)
    if not (isinstance(rows, int) and isinstance(columns, int) and 1 <= rows <= 26):
        raise ConfigError(
            f"{where}: elements: names, or how many, or rows (26 at most) and columns"
        )
    if columns > 100:
        raise ConfigError(f"{where}: elements: a matrix has 100 columns at most, not {columns}")
    return tuple(f"{chr(ord('A') + r)}{c}" for r in range(rows) for c in range(columns))


def as_bytes(text: str, where: str) -> bytes:
    """Convert a message, written in hexadecimal or as ``text:...``, to bytes."""
    if text.startswith("text:"):
        return text.removeprefix("text:").encode()
    return _parse_hex(text, where)


def _compile_pattern(text: str, where: str) -> bytes:
    if text.startswith("text:"):
        return re.escape(as_bytes(text, where))
    words = text.replace("..", " .. ").split()
    return b"".join(b"." if w == ".." else re.escape(_parse_hex(w, where)) for w in words)


def _parse_hex(text: str, where: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ConfigError(f"{where}: write bytes in hexadecimal, AA 07, not {text!r}") from None
