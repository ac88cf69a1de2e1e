"""A binary frame as its mapping file describes it: checked, and ready to be read and written."""

import binascii
import re
import zlib
from collections.abc import Callable
from itertools import product
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codecs.ascii_mapping import UNITS, Column, array_of
from tactile_rt.drivers.codecs.frame_mapping import FrameCounter, FrameMapping
from tactile_rt.drivers.codecs.framing import crc16_modbus, crc16_x25, crc16_xmodem
from tactile_rt.stream import ArraySpec, ConfigError

__all__ = ["CHECKSUMS", "Block", "FrameLayout", "Numbers", "as_bytes"]

# Name: width in bytes, and what it is of the bytes that it covers.
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
    """Where numbers of one type are in a frame.

    Args:
        at, step: offset of the first, and from one to the next.
        n: how many.
        kind: their type.
        order: their byte order.
    """

    def __init__(self, at: int, n: int, kind: str, order: str, step: int = 0) -> None:
        self.bits = int("".join(filter(str.isdigit, kind)))
        self.width = self.bits // 8
        self.at, self.n, self.step = at, n, step or self.width
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
        """Offsets of all bytes that they take."""
        return {self.at + k * self.step + b for k in range(self.n) for b in range(self.width)}

    def read(self, frames: bytes, count: int, length: int) -> NDArray[Any]:
        """(count, n) of so many frames."""
        if not self._odd:
            return np.ndarray((count, self.n), self._dtype, frames, self.at, (length, self.step))
        parts = np.ndarray((count, self.n, 3), np.uint8, frames, self.at, (length, self.step, 1))
        parts = parts if self._little else parts[..., ::-1]
        found: NDArray[Any] = parts.astype(np.int64) @ (1, 1 << 8, 1 << 16)
        return np.where(found >> 23, found - (1 << 24), found) if self._signed else found

    def write(self, frame: bytearray, values: NDArray[Any]) -> None:
        """Put these, clipped to what the type can tell, into a frame."""
        numbers = np.clip(np.nan_to_num(values), self.low, self.high)
        if self.whole:
            numbers = np.rint(numbers)
        for k, number in enumerate(numbers.tolist()):
            at = self.at + k * self.step
            if self.whole:
                order: Literal["little", "big"] = "little" if self._little else "big"
                raw = (int(number) & ((1 << self.bits) - 1)).to_bytes(self.width, order)
            else:
                raw = np.array(number, self._dtype).tobytes()
            frame[at : at + self.width] = raw


class Block:
    """Measured numbers, with where they go and what they stand for."""

    def __init__(self, numbers: Numbers, gain: Row, bias: Row, cells: list[int]) -> None:
        self.numbers, self.gain, self.bias, self.cells = numbers, gain, bias, np.array(cells)


class FrameLayout:
    """A mapping, checked, as a codec wants it.

    Args:
        mapping: contents of the file.
        path: of the file, for what is raised.

    Raises:
        ConfigError: the frame cannot be so; names file and key.

    Attributes:
        mapping: The contents of the file.
        spec: What the samples are.
        sync, ends: The bytes with which a frame begins and ends.
        between: A pattern of what else comes between frames.
        blocks: The numbers that are measured.
        count, time, status: The place of each of these; None without it.
        meanings: What the bits of the status mean, by their number.
        check_at, check_first: Offsets of the checksum, and of the first byte that it covers.
    """

    def __init__(self, mapping: FrameMapping, path: str) -> None:
        self.mapping = mapping
        patterns = [_pattern(text, f"{path}: between") for text in mapping.between]
        answers = [m.expect for m in (*mapping.start, *mapping.stop) if m.expect]
        patterns += [re.escape(as_bytes(text, f"{path}: expect")) for text in answers]
        self.between = re.compile(b"|".join(patterns) or rb"(?!)", re.DOTALL)
        self.sync = _bytes(mapping.sync, f"{path}: sync")
        self.ends = _bytes(mapping.ends, f"{path}: ends") if mapping.ends else b""
        if not self.sync:
            raise ConfigError(f"{path}: sync must be at least one byte")
        taken: dict[int, str] = {}
        length = mapping.length

        def take(offsets: set[int], what: str) -> None:
            for at in sorted(offsets):
                if not 0 <= at < length:
                    raise ConfigError(f"{path}: {what} reaches byte {at}; a frame has {length}")
                if at in taken:
                    raise ConfigError(f"{path}: byte {at} is of {taken[at]} and of {what}")
                taken[at] = what

        def place(one: FrameCounter, what: str) -> Numbers:
            found = Numbers(one.at, 1, one.type, one.order or mapping.order)
            take(found.covered, what)
            return found

        take(set(range(len(self.sync))), "sync")
        take(set(range(length - len(self.ends), length)), "ends")
        self._check(path, take)
        self.count = place(mapping.count, "count") if mapping.count else None
        self.time = place(mapping.time, "time") if mapping.time else None
        self.status = place(mapping.status, "status") if mapping.status else None
        self.meanings: dict[int, str] = {}
        for bit, meaning in (mapping.status.bits if mapping.status else {}).items():
            if not (bit.isdecimal() and self.status and int(bit) < self.status.bits):
                raise ConfigError(f"{path}: status.bits: {bit!r} is no bit of it")
            self.meanings[int(bit)] = meaning
        self.spec, self.blocks = self._measured(path, take)

    def _check(self, path: str, take: Callable[[set[int], str], None]) -> None:
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

    def _measured(
        self, path: str, take: Callable[[set[int], str], None]
    ) -> tuple[ArraySpec, list[Block]]:
        found: list[tuple[Numbers, Row, Row, list[Column]]] = []
        for k, values in enumerate(self.mapping.values):
            where = f"values[{k}]"
            names = values.elements
            elements = tuple(f"T{i}" for i in range(names)) if isinstance(names, int) else names
            pairs = list(product(elements, values.channels))
            if values.by == "channel":
                pairs = [(e, c) for c, e in product(values.channels, elements)]
            if values.unit and values.unit not in UNITS:
                raise ConfigError(
                    f"{path}: {where}: unknown unit {values.unit!r}; there are {', '.join(UNITS)}"
                )
            scales = values.scale if isinstance(values.scale, tuple) else (values.scale,)
            if len(scales) == 1:
                scales *= len(values.channels)
            if len(scales) != len(values.channels):
                raise ConfigError(f"{path}: {where}: scale: one for all channels, or one for each")
            if not (all(scales) and np.isfinite((*scales, values.offset)).all()):
                raise ConfigError(f"{path}: {where}: scale must be numbers other than 0")
            by_channel = dict(zip(values.channels, scales, strict=True))
            columns = [Column.measured(e, c, values.unit, by_channel[c]) for e, c in pairs]
            unit = np.array([Column.measured(e, c, values.unit).scale for e, c in pairs])
            gain = np.array([column.scale for column in columns])
            order = values.order or self.mapping.order
            numbers = Numbers(values.at, len(pairs), values.type, order, values.step)
            take(numbers.covered, where)
            found.append((numbers, gain, values.offset * unit + columns[0].offset, columns))
        spec = array_of(self.mapping, tuple(c for *_, cs in found for c in cs), path)
        cell = {(e, c): i for i, (e, c) in enumerate(product(spec.elements, spec.channels))}
        return spec, [
            Block(numbers, gain, bias, [cell[c.element, c.channel] for c in columns])
            for numbers, gain, bias, columns in found
        ]

    def intact(self, frame: bytes) -> bool:
        """Whether a frame that begins right ends right, and its checksum is its own."""
        if not frame.endswith(self.ends):
            return False
        return not self.check_width or frame[self.check_at :][: self.check_width] == self._sum_of(
            frame
        )

    def seal(self, frame: bytearray) -> bytes:
        """The frame with its checksum."""
        if self.check_width:
            frame[self.check_at : self.check_at + self.check_width] = self._sum_of(bytes(frame))
        return bytes(frame)

    def _sum_of(self, frame: bytes) -> bytes:
        covered = frame[self.check_first : self.check_at]
        return self._sum(covered).to_bytes(self.check_width, self._check_order)


def as_bytes(text: str, where: str) -> bytes:
    """What a message says: hexadecimal, or ``text:`` and characters."""
    if text.startswith("text:"):
        return text.removeprefix("text:").encode()
    return _bytes(text, where)


def _pattern(text: str, where: str) -> bytes:
    words = text.replace("..", " .. ").split()
    return b"".join(b"." if w == ".." else re.escape(_bytes(w, where)) for w in words)


def _bytes(text: str, where: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError:
        raise ConfigError(f"{where}: write bytes in hexadecimal, AA 07, not {text!r}") from None
