"""Codec of any board that prints numbers, described by a file or a few words.

Numbers stand at their places in a line, between spaces, tabs, commas, semicolons and brackets; or
after their names, in one line, in several, or in JSON. Lines end with a carriage return, a line
feed or both. The first line after connecting is not used, since its beginning may be cut off (a
file is read as if a line end came first); banners and headers are recognised by their words.
"""

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.ascii_mapping import (
    Column,
    LineMapping,
    array_of,
    order_columns,
    parse_columns,
    read_mapping,
)
from tactile_rt.drivers.codecs.ascii_text import Names, fields, is_text, number, quote_line

TICK_NS: Final = {"s": 1e3, "iso": 1e3, "ms": 1e6, "us": 1e3, "ns": 1.0}
NEVER_WRAPS: Final = 62  # bits, for a time in seconds
EXACT: Final = 2.0**53  # up to which integers are exact in a float64
NAN: Final = float("nan")
NO_TEXT: Final = "what comes is not text: wrong baud rate?"
SCRAP: Final = 8  # characters, as binary data may have between two line ends by chance

_SPACES: Final = bytes.maketrans(b",;\t", b"   ")
_WORDS: Final = re.compile(r"[^:=]*[\w\0][^:=]*")  # without labels; no ruled line
_PLAIN: Final = re.compile(rb"[-+0-9.eE \t;,]*")


@dataclass(frozen=True)
class AsciiLineOptions:
    """Options of a board that prints numbers: either a file or the columns.

    Attributes:
        mapping: Path of a TOML file, like docs/codecs/ascii_line.toml.
        columns: The columns between commas, e.g. ``time:ms,A0.fx*0.5:mN,A0.fy*0.5:mN,-``;
            `ascii_mapping` describes their form.
        rate_hz: Rate at which the board prints, Hz; 0 stands for the rate in the file, else 100 Hz.
        start: Text that starts the board (in a URL ``%0A`` is a line feed).
        stop: Text that stops the board.
        poll: Text to send for each sample; empty if the board prints by itself.
    """

    mapping: str = ""
    columns: str = ""
    rate_hz: float = 0.0
    start: str = ""
    stop: str = ""
    poll: str = ""

    def __post_init__(self) -> None:
        if bool(self.mapping) == bool(self.columns):
            raise ConfigError("ascii_line needs either mapping=FILE.toml or columns=A0.fx,A0.fy")


def _has_digit(word: str) -> bool:
    return any(map(str.isdigit, word))


class AsciiLine(SerialCodec):
    """Codec of boards that print numbers: capacitive skins, lab whiskers, Arduino sketches.

    Attributes:
        line_end: Line end to assume before the first line of a file.
        claims_rate: Whether the user has given the board's rate.
        unfinished: Number of bytes received so far of an incomplete sample.
        passed: Number of lines after the first sample that are mostly words, and of samples whose
            beginning did not come.
    """

    Options = AsciiLineOptions
    baud = 115200
    line_end = b"\n"
    passed = unfinished = 0
    cannot_detect = (
        "changed digits (no checksum); lost and repeated lines without a count column; the first "
        "line after each connection is not used"
    )

    def __init__(self, options: AsciiLineOptions) -> None:
        where = options.mapping or "columns"
        mapping = LineMapping(columns=(options.columns,))
        if options.mapping:
            mapping = read_mapping(options.mapping, LineMapping)
        if options.rate_hz:
            mapping = msgspec.structs.replace(mapping, rate_hz=options.rate_hz)
        self.claims_rate = bool(options.mapping or options.rate_hz)
        columns = parse_columns(mapping.columns, f"{where}: columns" if options.mapping else where)
        spec = array_of(mapping, columns, where)
        super().__init__(spec)
        self._columns, self._width = columns, len(columns)
        self._order = order_columns(columns, spec)
        self._scale = np.array([columns[i].scale for i in self._order])
        self._offset = np.array([columns[i].offset for i in self._order])
        self._count = self._time = -1
        self._per_tick = 1.0  # units of the printed time
        for i, c in enumerate(columns):
            if c.kind == "count":
                self._count, self.count_bits = i, c.bits
            elif c.kind in TICK_NS:
                self._time, self.tick_ns = i, TICK_NS[c.kind]
                self.tick_bits = c.bits
                if c.kind in ("s", "iso"):
                    self.tick_bits, self._per_tick = NEVER_WRAPS, 1e-6 / c.scale
        self._names = _find_names(columns, where)
        self._start = (options.start or mapping.start).encode()
        self._stop = (options.stop or mapping.stop).encode()
        self._poll = (options.poll or mapping.poll).encode()
        self.polls = bool(self._poll)
        self.streaming = not self._start and not self.polls
        self._longest = 256 + 64 * self._width
        self._data, self._host_text = bytearray(), b""
        self._has_printed = False
        self.forget()

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        self._data += packet
        *lines, self._data = self._data.replace(b"\r", b"\n").split(b"\n")
        self._rows: list[list[float]] = []
        self._arrivals: list[tuple[int, int]] = []  # arrival of each, and damaged lines before
        for line in lines:
            self._read_line(line, t_ns)
        if len(self._data) > self._longest:
            self.stats.skipped += len(self._data)
            self._overlong = True
            without = f"{self._longest} bytes came without a line end"
            text = self._data.decode("utf-8", "replace")
            self.complaint = without if is_text(text) else NO_TEXT
            self._data.clear()
        self.unfinished = len(self._data) + (self._open_bytes if self._open else 0)
        self.stats.intact += len(self._rows)
        return self._make_samples() if self._rows else None

    def forget(self) -> None:
        self._data.clear()
        self._joined = self._overlong = False
        self._damaged = 0
        self._open: dict[int, float] = {}  # numbers so far of a sample in several lines
        self._has_beginning = False  # whether that sample has its beginning
        self._open_ns = self._open_bytes = 0

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        sent = {Command.START: self._start, Command.STOP: self._stop, Command.POLL: self._poll}
        return (Step(sent[command]),) if sent[command] else ()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        values = np.where(chunk.valid[..., None], chunk.values, np.nan).astype(np.float64)
        numbers = (values.reshape(len(chunk), -1) - self._offset) / self._scale
        packets = []
        rows = zip(chunk.seq.tolist(), chunk.t_ns.tolist(), numbers.tolist(), strict=True)
        for seq, t_ns, row in rows:
            words = ["0"] * self._width
            for at, value in zip(self._order, row, strict=True):
                words[at] = f"{value:.9g}"
            if self.count_bits is not None:
                words[self._count] = str(seq % (1 << self.count_bits))
            if self.tick_ns is not None:
                ticks = t_ns // int(self.tick_ns) % (1 << self.tick_bits)
                decimal = self.tick_bits == NEVER_WRAPS
                words[self._time] = f"{ticks * self._per_tick:.9f}" if decimal else str(ticks)
                if self._columns[self._time].kind == "iso":
                    words[self._time] = f"{datetime.fromtimestamp(1e-6 * ticks, UTC):%F %T.%f}"
            # a host that joins does not use the text before the first line end
            begin = b"" if self._has_printed else b"\r\n"
            self._has_printed = True
            packets.append(begin + self._format_line(words).encode() + b"\r\n")
        return packets

    def _format_line(self, words: list[str]) -> str:
        if self._names is None:
            return ",".join(words)
        tree: dict[str, Any] = {}
        for column, word in zip(self._columns, words, strict=True):
            *path, last = column.label.split(".")
            if path and last.isdecimal():
                row = tree.setdefault(".".join(path), [])
                row += [0.0] * (int(last) + 1 - len(row))
                row[int(last)] = float(word)
            elif column.kind != "-":
                here = tree
                for key in path:
                    here = here.setdefault(key, {})
                here[last] = word if column.kind == "iso" else float(word)
        return msgspec.json.encode(tree).decode()

    def respond(self, packet: bytes) -> bytes:
        words = [w for w in (self._start, self._stop, self._poll) if w]
        text = self._host_text + packet
        while found := [(text.find(w), w) for w in words if w in text]:
            at, word = min(found)
            text = text[at + len(word) :]
            if word == self._poll:
                self.polled += 1
            else:
                self.streaming = word == self._start and not self.polls
        self._host_text = text[-max(map(len, words), default=1) :]
        return b""

    # lines

    def _read_line(self, line: bytearray, t_ns: int) -> None:
        joined, self._joined = self._joined, True
        overlong, self._overlong = self._overlong or len(line) > self._longest, False
        if not joined or overlong:
            self.stats.skipped += len(line)
            if joined:
                self._count_damaged()
            return
        words = line.translate(_SPACES).split() if self._names is None else []
        if len(words) == self._width and _PLAIN.fullmatch(line) and b",," not in line:
            try:
                self._add_row([float(word) for word in words], t_ns)
                return
            except ValueError:  # for example 1-2
                pass
        text = line.decode("utf-8", "replace")
        if self._names is not None:
            self._collect_named(text, t_ns)
        elif (row := self._parse_row(text)) is not None:
            self._add_row(row, t_ns)
        else:
            self._explain_line(text)

    def _add_row(self, row: list[float], t_ns: int) -> None:
        """Add a row of numbers; if count or time is invalid, count it as damaged."""
        count = row[self._count] if self.count_bits is not None else 0.0
        ticks = row[self._time] / self._per_tick if self.tick_ns is not None else 0.0
        counts = abs(count) < EXACT and count.is_integer()
        if counts and abs(ticks) < EXACT:
            self._rows.append(row)
            self._arrivals.append((t_ns, self._damaged))
            self._damaged = 0
        else:
            at = self._time if counts else self._count
            self.complaint = f"column {at + 1} ({self._columns[at].kind}) is {row[at]:g}"
            self._count_damaged()

    def _parse_row(self, text: str) -> list[float] | None:
        """Return the numbers of a line, one per column; None if it is no sample."""
        for words_are_names in (False, True):
            words = fields(text, words_are_names)
            if text.rstrip().endswith((",", ";")) and len(words) == self._width - 1:
                words.append("nan")
            for some in (words, [w for w in words if _has_digit(w) or number(w)]):
                row = self._parse_words(some)
                if row is not None and 2 * len(row) >= len(words):
                    return row
        return None

    def _parse_words(self, words: list[str]) -> list[float] | None:
        """Convert words to one number per column, NaN if missing; None if no sample."""
        if len(words) != self._width:
            return None
        row, measured, missing = [], 0, 0
        for column, word in zip(self._columns, words, strict=True):
            value = number(word)
            if value is None and column.kind != "-":
                if column.kind != "value" or _has_digit(word):
                    return None
                missing += 1
            measured += column.kind == "value"
            row.append(NAN if value is None else value)
        return row if 2 * missing <= measured else None

    def _collect_named(self, text: str, t_ns: int) -> None:
        """Add a line's named numbers to the open sample. The sample ends when all have come, when a
        name repeats, or at the name of the first column, with which each sample begins."""
        assert self._names is not None
        while rest := self._names.cut_glued(text):
            self.complaint = f"line {quote_line(text)} breaks off in a number, and another begins"
            self._count_damaged()
            text = rest
        found = self._names.find(text)
        if not found:
            if _WORDS.fullmatch(text):
                self._explain_line(text)
            else:
                self.stats.skipped += len(text)
            if text.strip():
                names = ", ".join(repr(c.label) for c in self._columns)
                self.complaint = f"line {quote_line(text)} has none of {names}"
            return
        if self._names.ambiguous:
            either = f"{self._names.ambiguous} is a decimal comma or two numbers"
            self.complaint = f"{either}: line {quote_line(text)}"
            self._open = {}
            self._count_damaged()
            return
        if 0 in found or not found.keys().isdisjoint(self._open):
            if self._open and self._has_beginning:
                self._end_sample()
            elif self._open:
                self.stats.skipped += self._open_bytes
                self.passed += 1
            self._open, self._open_bytes, self._has_beginning = {}, 0, True
        self._open |= found
        self._open_bytes += len(text) + 1
        self._open_ns = t_ns
        if len(self._open) == self._width:
            self._end_sample()

    def _end_sample(self) -> None:
        came, self._open = self._open, {}
        if len(came) < self._width:
            absent = [c.label for i, c in enumerate(self._columns) if i not in came]
            self.complaint = f"{', '.join(map(repr, absent))} did not come"
        if 2 * len(came) >= self._width:
            self.stats.incomplete += len(came) < self._width
            self._add_row([came.get(i, NAN) for i in range(self._width)], self._open_ns)
        else:
            self._count_damaged()

    def _explain_line(self, text: str) -> None:
        """Count a line that is no sample as text or damaged; set `complaint` accordingly."""
        words = fields(text)
        numbers = [w for w in words if number(w) is not None and w.strip("-")]
        if words and (len(text) > SCRAP or self.complaint != NO_TEXT):
            self.complaint = self._describe_problem(text, words)
        if 2 * len(numbers) < len(words):  # mostly words: not intended as a sample
            self.stats.skipped += len(text)
            self.passed += bool(words and (self.stats.intact or self._rows))
        elif words:
            self._count_damaged()

    def _describe_problem(self, text: str, words: list[str]) -> str:
        if not is_text(text):
            return NO_TEXT
        line = f"line {quote_line(text.strip())}"
        for k, (column, word) in enumerate(zip(self._columns, words, strict=False)):
            if number(word) is None and column.kind != "-":
                name = f"{column.element}.{column.channel}" if column.element else column.kind
                return f"{line}: column {k + 1} ({name}) is {word!r}, no number"
        last = f"column {len(words)} is {words[-1]!r}"
        return f"{line} has {len(words)} columns, {self._width} are described; {last}"

    def _count_damaged(self) -> None:
        self.stats.corrupt += 1
        self._damaged += 1

    def _make_samples(self) -> Samples:
        assert self.spec is not None
        wire: NDArray[np.float64] = np.array(self._rows)
        arrived, damaged = np.array(self._arrivals, np.int64).T
        with np.errstate(over="ignore", invalid="ignore"):
            values = (wire[:, self._order] * self._scale + self._offset).astype(np.float32)
        values = values.reshape(len(wire), *self.spec.shape)
        count = ticks = None
        if self.count_bits is not None:
            count = wire[:, self._count].astype(np.int64) % (1 << self.count_bits)
        if self.tick_ns is not None:
            ticks = np.rint(wire[:, self._time] / self._per_tick).astype(np.int64)
            ticks %= 1 << self.tick_bits
        return Samples(values, np.isfinite(values).all(axis=2), arrived, damaged, count, ticks)


def _find_names(columns: tuple[Column, ...], where: str) -> Names | None:
    """Return a finder of numbers by their names; None if columns have no names."""
    labels = {c.label: i for i, c in enumerate(columns) if c.label}
    if not labels:
        return None
    if len(labels) != len(columns):
        given = [c.label for c in columns]
        why = [f"{name!r} appears twice" for name in labels if given.count(name) > 1]
        why.append("give all columns a name, NAME=COLUMN, or none")
        raise ConfigError(f"{where}: {why[0]}")
    return Names(labels)
