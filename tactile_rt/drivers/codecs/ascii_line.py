"""Any board that prints numbers, a line per sample; a file says which column is what.

Numbers stand between spaces, tabs, commas or semicolons in any mixture; lines end with a carriage
return, a line feed or both. The first line after joining is not believed, for it may have lost its
beginning; banners and headers are known by their words.
"""

import re
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.ascii_mapping import (
    LineMapping,
    array_of,
    parse_column,
    read_mapping,
)
from tactile_rt.stream import Chunk, ConfigError

__all__ = ["AsciiLine", "AsciiLineOptions"]

TICK_NS: Final = {"s": 1e3, "ms": 1e6, "us": 1e3, "ns": 1.0}
NEVER_WRAPS: Final = 62  # bits, for a time in seconds
EXACT: Final = 2.0**53  # whole numbers up to here are exact

_SPACES: Final = bytes.maketrans(b",;\t", b"   ")
_LABEL: Final = re.compile(rb"[A-Za-z_]\w*[ ]*[:=]")


@dataclass(frozen=True)
class AsciiLineOptions:
    """Options of a board that prints numbers: either a file or the columns.

    Attributes:
        mapping: Path of a TOML file, like docs/codecs/ascii_line.toml.
        columns: The columns between commas, e.g. ``time:ms,A0.fx*0.5:mN,A0.fy*0.5:mN,-``; how they
            are written is told in `ascii_mapping`.
        labels: Whether numbers have names before them, ``x:1.5 y=2``.
        rate_hz: Rate at which the board prints, Hz; 0 stands for the rate in the file, else 100 Hz.
        start: Text to send so that the board begins (in a URL ``%0A`` is a line feed).
        stop: Text to send so that the board ends.
        poll: Text to send for each sample; without one the board prints by itself.
    """

    mapping: str = ""
    columns: str = ""
    labels: bool = False
    rate_hz: float = 0.0
    start: str = ""
    stop: str = ""
    poll: str = ""

    def __post_init__(self) -> None:
        if bool(self.mapping) == bool(self.columns):
            raise ConfigError(
                "ascii_line has to know its columns: give either mapping=FILE.toml or "
                "columns=A0.fx,A0.fy"
            )
        if not 0 <= self.rate_hz < np.inf:
            raise ConfigError(f"rate_hz must be positive, not {self.rate_hz}")


class AsciiLine(SerialCodec):
    """Numbers printed in lines: capacitive skins, lab whiskers, sketches for a serial plotter.

    Args:
        options: The columns, and how the board is started and stopped.

    Raises:
        ConfigError: the file or a column is wrong.
    """

    Options = AsciiLineOptions
    baud = 115200
    cannot_detect = (
        "there is no checksum: a changed digit is a changed value; without a count column lost and "
        "repeated lines leave no trace; the first line after each connection is not used"
    )

    def __init__(self, options: AsciiLineOptions) -> None:
        where = options.mapping or "columns"
        if options.mapping:
            mapping = read_mapping(options.mapping)
        else:
            mapping = LineMapping(columns=tuple(w.strip() for w in options.columns.split(",")))
        if options.rate_hz:
            mapping = msgspec.structs.replace(mapping, rate_hz=options.rate_hz)
        prefix = f"{where}: columns" if options.mapping else where
        columns = tuple(
            parse_column(word, f"{prefix}[{i}]") for i, word in enumerate(mapping.columns)
        )
        spec = array_of(mapping, columns, where)
        super().__init__(spec)
        self._width = len(columns)
        at = {(c.element, c.channel): i for i, c in enumerate(columns)}
        self._order = [at[e, c] for e in spec.elements for c in spec.channels]
        self._scale = np.array([columns[i].scale for i in self._order])
        self._offset = np.array([columns[i].offset for i in self._order])
        self._count = self._time = -1
        self._per_tick = 1.0  # numbers on the wire
        for i, c in enumerate(columns):
            if c.kind == "count":
                self._count, self.count_bits = i, c.bits
            elif c.kind in TICK_NS:
                self._time, self.tick_ns = i, TICK_NS[c.kind]
                self.tick_bits = c.bits
                if c.kind == "s":
                    self.tick_bits, self._per_tick = NEVER_WRAPS, 1e-6 / c.scale
        self._labels = options.labels or mapping.labels
        self._start = (options.start or mapping.start).encode()
        self._stop = (options.stop or mapping.stop).encode()
        self._poll = (options.poll or mapping.poll).encode()
        self.polls = bool(self._poll)
        self.streaming = not self._start and not self.polls
        self._longest = 256 + 64 * self._width
        self._data, self._heard = bytearray(), b""
        self._joined = self._overlong = self._printed = False
        self._damaged = 0

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        self._data += packet
        *lines, self._data = self._data.replace(b"\r", b"\n").split(b"\n")
        rows: list[list[float]] = []
        damaged: list[int] = []
        for line in lines:
            row = self._row(line)
            if row is not None:
                rows.append(row)
                damaged.append(self._damaged)
                self._damaged = 0
        if len(self._data) > self._longest:
            self.stats.skipped += len(self._data)
            self._overlong = True
            self._data.clear()
        self.stats.intact += len(rows)
        return self._samples(np.array(rows), damaged, t_ns) if rows else None

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        send = {Command.START: self._start, Command.STOP: self._stop, Command.POLL: self._poll}[
            command
        ]
        return (Step(send),) if send else ()

    def forget(self) -> None:
        self._data.clear()
        self._joined = self._overlong = False
        self._damaged = 0

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        values = np.where(chunk.valid[..., None], chunk.values, np.nan).astype(np.float64)
        numbers = (values.reshape(len(chunk), -1) - self._offset) / self._scale
        packets = []
        for seq, t_ns, row in zip(
            chunk.seq.tolist(), chunk.t_ns.tolist(), numbers.tolist(), strict=True
        ):
            words = ["0"] * self._width
            for at, number in zip(self._order, row, strict=True):
                words[at] = f"{number:.9g}"
            if self.count_bits is not None:
                words[self._count] = str(seq % (1 << self.count_bits))
            if self.tick_ns is not None:
                ticks = t_ns // int(self.tick_ns) % (1 << self.tick_bits)
                decimal = self.tick_bits == NEVER_WRAPS
                words[self._time] = f"{ticks * self._per_tick:.9f}" if decimal else str(ticks)
            # one who joins does not believe what stands before the first line end
            begin = b"" if self._printed else b"\r\n"
            self._printed = True
            packets.append(begin + ",".join(words).encode() + b"\r\n")
        return packets

    def respond(self, packet: bytes) -> bytes:
        words = [w for w in (self._start, self._stop, self._poll) if w]
        heard = self._heard + packet
        while found := [(heard.find(w), w) for w in words if w in heard]:
            at, word = min(found)
            heard = heard[at + len(word) :]
            if word == self._poll:
                self.polled += 1
            else:
                self.streaming = word == self._start and not self.polls
        self._heard = heard[-max(map(len, words), default=1) :]
        return b""

    # lines

    def _row(self, line: bytearray) -> list[float] | None:
        """The numbers of a line that is a sample, else None, counted as what it is."""
        joined, self._joined = self._joined, True
        overlong, self._overlong = self._overlong or len(line) > self._longest, False
        if not joined or overlong:
            self.stats.skipped += len(line)
            if joined:
                self._refuse()
            return None
        if self._labels:
            line = bytearray(_LABEL.sub(b" ", line))
        words = line.translate(_SPACES).split()
        row = [x for x in map(_number, words) if x is not None]
        if len(row) == len(words) == self._width and self._counts(row):
            return row
        if 2 * len(row) < len(words):  # mostly words: not meant as a sample
            self.stats.skipped += len(line)
        elif words:
            self._refuse()
        return None

    def _counts(self, row: list[float]) -> bool:
        """Whether what counts is a whole number, and the time a time."""
        count = row[self._count] if self.count_bits is not None else 0.0
        ticks = row[self._time] / self._per_tick if self.tick_ns is not None else 0.0
        return abs(ticks) < EXACT and abs(count) < EXACT and count.is_integer()

    def _refuse(self) -> None:
        self.stats.corrupt += 1
        self._damaged += 1

    def _samples(self, wire: NDArray[np.float64], damaged: list[int], t_ns: int) -> Samples:
        assert self.spec is not None
        with np.errstate(over="ignore", invalid="ignore"):
            values = (wire[:, self._order] * self._scale + self._offset).astype(np.float32)
        values = values.reshape(len(wire), *self.spec.shape)
        count = ticks = None
        if self.count_bits is not None:
            count = wire[:, self._count].astype(np.int64) % (1 << self.count_bits)
        if self.tick_ns is not None:
            ticks = np.rint(wire[:, self._time] / self._per_tick).astype(np.int64)
            ticks %= 1 << self.tick_bits
        return Samples(
            values,
            np.isfinite(values).all(axis=2),
            np.full(len(wire), t_ns, np.int64),
            np.array(damaged, np.int64),
            count,
            ticks,
        )


def _number(word: bytearray) -> float | None:
    """What is printed; NaN for what a board prints in place of one, None for a word."""
    try:
        return None if b"_" in word else float(word)
    except ValueError:
        return float("nan") if word == b"ovf" else None  # Arduino's for what is over 4e9
