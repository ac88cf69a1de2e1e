"""Logs of a serial line or CAN bus, read as packets of bytes or frames.

    log = read_log(Path("can.log"))       # candump, asc, blf, ...; bytes, hex
    for packet, t_ns in log.packets(): ...  # t_ns is None where the log has no times

The first bytes of a file determine its form, not its name; gzip is unpacked. Logs may be cut short
or contain foreign lines: all that is readable is read, and `notes` list the rest.
"""

import gzip
import logging
import zlib
from codecs import getincrementaldecoder
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from io import BufferedReader, RawIOBase, TextIOWrapper
from itertools import islice, pairwise, tee, zip_longest
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from tactile_rt.core.errors import ConfigError, describe_error, name_some
from tactile_rt.core.files import open_regular
from tactile_rt.core.stream import NS_PER_S
from tactile_rt.drivers import log_lines
from tactile_rt.drivers.links import convert_message

CAN_FORMS: Final = ("candump", "slcan", "gvret", "asc", "blf", "trc", "csv", "db")
BINARY: Final = ("blf", "db")
FORMS: Final = ("raw", "hex", "terminal", *CAN_FORMS)
HEAD: Final = 16_384  # bytes by which the form is recognised
MOSTLY: Final = 0.8  # of the first lines must have the form
BLF: Final = b"LOGG"
SQLITE: Final = b"SQLite format 3\0"  # of python-can's logger, .db; bags of ROS 2 are .db3
GZIP: Final = b"\x1f\x8b"
# Files that are neither a log nor text, by their first bytes, and how to convert them.
OTHERS: Final = {
    b"\x93NUMPY": "an array of NumPy: write it as a table, as numpy.savetxt does",
    b"PK\x03\x04": "a zip archive, as .npz and .xlsx are: write a table of it as text",
    b"\x89HDF\r\n": "an HDF5 file: write a table of it as text",
    b"MATLAB 5.0": "a file of MATLAB: write a table of it, as writematrix does",
    b"PAR1": "a Parquet file: write a table of it, as DataFrame.to_csv does",
    b"MDF     ": "a measurement file (MDF): asammdf writes its groups as CSV",
    b"UnFinMF ": "a measurement file (MDF) that was not finished: asammdf writes it as CSV",
    b"\xd4\xc3\xb2\xa1": "a capture of packets (pcap): tshark writes a bus's frames as text",
    b"\n\r\r\n": "a capture of packets (pcapng): tshark writes a bus's frames as text",
}
CSV_HEADER: Final = "timestamp,arbitration_id,extended,remote,error,dlc,data"
SAVVYCAN_HEADER: Final = "time stamp,id,extended,"
DAY_NS: Final = 86_400 * NS_PER_S
FALLING: Final = 0.2  # of the times in candump -td, at least, are less than the previous one

LINES: Final[dict[str, Callable[[str], log_lines.Found]]] = {
    "candump": log_lines.parse_candump, "slcan": log_lines.parse_slcan,
    "terminal": log_lines.parse_heard, "hex": log_lines.parse_hex, "gvret": log_lines.parse_gvret,
    "csv": log_lines.read_csv_line,
}  # fmt: skip
Read = tuple[str, Any, int | None]  # bus, packet (empty for an error frame), time in ns


class Occurrences:
    """Counter of one kind of problem in a log, with the first place and cause."""

    def __init__(self, what: str) -> None:
        self.what, self.n, self.first, self.why = what, 0, 0, ""

    def add(self, number: int, why: str = "") -> None:
        """Count one more problem, at the line, frame or packet of this number."""
        if not self.n:
            self.first, self.why = number, why
        self.n += 1

    def __str__(self) -> str:
        return f"{self.n} ({self.what} {self.first}{f': {self.why:.60}' * bool(self.why)})"


class LineLog:
    """A log of a serial line or a CAN bus.

    Args:
        bus: Name of the bus whose frames to read from a log of several; empty for all.

    Attributes:
        piece: Size of a packet in bytes, where the log does not delimit packets.
        notes: Sentences on what could not be read; complete once all packets are read.
        buses: Number of packets of each bus, by its name; complete once all packets are read.
        names: Identifier, and whether it has 29 bits, of each known message name.
        total: Number of bytes, lines or frames in the file; complete once all packets are read.
        frames: Number of entries that were read as frames, or as lines from a device.
    """

    def __init__(self, path: Path, form: str, bus: str = "") -> None:
        self.path, self.form, self._bus = path, form, bus
        self.wire = "can" if form in CAN_FORMS else "serial"
        self.piece = 256
        self.notes: list[str] = []
        self.buses: Counter[str] = Counter()
        self.names: Mapping[str, tuple[int, bool]] = {}
        self.total = self.frames = 0
        self.back = Occurrences("packet")  # whose time is before the previous one

    def packets(self) -> Iterator[tuple[Any, int | None]]:
        """Yield (bytes or list of CAN frames, time in ns or None); times never decrease."""
        self.notes.clear()
        self.buses.clear()
        self.total = self.frames = 0
        latest, self.back = -(1 << 62), Occurrences("frame" if self.wire == "can" else "packet")
        number = errors = 0
        read = self._read_raw if self.form == "raw" else self._read_text
        with open_log_file(self.path) as file:
            reads = (self._read_binary if self.form in BINARY else read)(file)
            for bus, packet, t_ns in _count_days(reads) if self.form == "terminal" else reads:
                self.frames += 1
                if not packet:
                    errors += 1
                    continue
                self.buses[bus] += 1
                if self._bus and bus != self._bus:
                    continue
                number += 1
                if t_ns is not None:
                    if t_ns < latest:
                        self.back.add(number)
                    t_ns = latest = max(t_ns, latest)
                yield packet, t_ns
            if getattr(file.raw, "broken", False):
                self.notes.append("it is cut short or damaged: what unpacks of it was read")
        self.notes += [f"{errors} error frames"] if errors else []
        if self._bus and self._bus not in self.buses:
            known = ", ".join(sorted(self.buses)) or "none"
            self.notes.append(f"no frames are of bus {self._bus}; there are those of {known}")
        elif len(self.buses) > 1:
            named = ", ".join(f"{bus or 'none'} ({n})" for bus, n in sorted(self.buses.items()))
            taken = f"those of {self._bus} are taken" if self._bus else "--bus takes those of one"
            self.notes.append(f"frames of several buses: {named}; {taken}")
        if self.back.n:
            self.notes.append(
                f"{self.back.n} times go back ({self.back.what} {self.back.first} is the first); "
                "these packets have the time before"
            )

    def _read_raw(self, file: BufferedReader) -> Iterator[Read]:
        """Yield the file's bytes; UTF-16 text that is mostly ASCII is converted to UTF-8."""
        head, decode = _read_head(self.path), getincrementaldecoder("utf-16")("replace").decode
        text = head.decode("utf-16", "replace") if _guess_encoding(head) == "utf-16" else ""
        plain = sum(c.isascii() and (c.isprintable() or c.isspace()) for c in text)
        while piece := file.read(self.piece):
            if data := decode(piece).encode() if plain > MOSTLY * len(text) else piece:
                self.total += len(data)
                yield "", data, None

    def _read_text(self, file: BufferedReader) -> Iterator[Read]:
        """Yield the packets in lines of text, and note lines of another form."""
        asc, trc = log_lines.AscLines(self.names), log_lines.TrcLines()
        parse = {"asc": asc.read, "trc": trc.read, **LINES}[self.form]
        odd, number, now = Occurrences("line"), 0, 0
        differences = self.form == "candump" and _has_time_differences(self.path)
        with TextIOWrapper(file, _guess_encoding(_read_head(self.path)), "replace") as lines:
            for number, line in enumerate(lines, 1):
                if not line.strip():
                    continue
                self.total += 1
                found, why = _try_parse(parse, line.rstrip("\r\n"))
                if found is None:
                    odd.add(number, why)
                    continue
                bus, packet, t_ns = found
                if packet is None:
                    continue
                if differences:
                    t_ns = now = now + (t_ns or 0)
                yield bus, packet, t_ns
        if asc.odd_date:
            self.notes.append(f"its date, {asc.odd_date:.40}, is not read: times count from 0")
        if asc.unknown:
            why = (
                "not in the DBC file" if self.names else "codec=can-dbc knows those of its DBC file"
            )
            self.notes.append(
                f"identifiers are names here ({name_some(list(asc.unknown))}), not read in "
                f"{asc.unknown.total()} frames: {why}"
            )
        if trc.version not in log_lines.TRC_COLUMNS:
            self.notes.append(
                f"version {trc.version[:20]!r} of a .trc is not read: there are "
                f"{', '.join(log_lines.TRC_COLUMNS)}"
            )
        if asc.begun:  # it was most often cut within its last line
            self.notes.append(f"it ends before its end: {self.frames} frames were read")
        if odd.n and not (asc.begun and odd.n == 1 and odd.first == number):
            a = "an" if self.form == "asc" else "a"
            what = "frame" if self.form in ("asc", "csv", "trc") else "line"
            self.notes.append(f"passed over, no {what} of {a} {self.form} log: {odd}")

    def _read_binary(self, file: BufferedReader) -> Iterator[Read]:
        """Yield the messages that python-can reads, up to the first damage."""
        from can.io import BLFReader, SqliteReader

        warned = logging.getLogger("can.io.blf")
        warned.addFilter(self._note_warning)
        try:
            made: Any = SqliteReader(self.path) if self.form == "db" else BLFReader(file)
            made.stop = lambda: None  # keep `file` open: its position is needed below
            for message in made:
                bus = "" if message.channel is None else str(message.channel)
                packet = [] if message.is_error_frame else [convert_message(message)]
                yield bus, packet, round(NS_PER_S * message.timestamp)
            if self.form == "blf":
                self.total = made.object_count
                n, short = self.frames, file.seekable() and file.tell() < made.file_size
                if (short or made._tail.strip(b"\0")) and not self.notes:
                    of = f" of {made.object_count}" if n < made.object_count else ""
                    self.notes.append(f"it ends before its end: {n} frames{of} were read")
        except OSError:
            raise
        except Exception as error:  # python-can raises any exception at a cut or damaged file
            why = describe_error(error)
            self.notes.append(f"it is cut short or damaged after {self.frames} frames ({why:.80})")
        finally:
            warned.removeFilter(self._note_warning)
            self.total = max(self.total, self.frames)

    def _note_warning(self, record: logging.LogRecord) -> bool:
        """Note a warning of python-can; return False, so that the terminal does not show it."""
        note = " ".join(record.getMessage().split())
        self.notes += [note] if note not in self.notes else []
        return False


def read_log(path: Path, form: str = "", bus: str = "") -> LineLog:
    """Return the log in a file, as raw bytes if its form is unknown.

    Args:
        form: one of `FORMS`; empty to recognise it by the first bytes.
    """
    if form and form not in FORMS:
        raise ConfigError(f"no form {form!r} of a log: there are {', '.join(FORMS)}")
    if not path.exists():
        raise ConfigError(f"no file {path}")
    return LineLog(path, form or _guess_form(path), bus)


def open_log_file(path: Path) -> BufferedReader:
    """Open a log file for reading; unpack gzip, up to the first damage.

    Raises:
        ConfigError: it is of a known type that is neither a log nor a table.
        OSError: it cannot be read, or is a pipe or device.
    """
    file = open_regular(path)
    begins = file.read(max(map(len, OTHERS)))
    for magic, what in OTHERS.items():
        if begins.startswith(magic):
            file.close()
            raise ConfigError(f"{path} is {what}")
    packed = begins.startswith(GZIP)
    file.seek(0)
    return BufferedReader(_GzipReader(file)) if packed else cast(BufferedReader, file)


class _GzipReader(RawIOBase):
    """A gzip file that ends where it is damaged; `broken` is then True."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._unpacked, self.broken = file, gzip.GzipFile(fileobj=file), False

    def readable(self) -> bool:
        return True

    def readinto(self, room: Any) -> int:
        try:
            data = self._unpacked.read1(len(room))
        except (EOFError, gzip.BadGzipFile, zlib.error):
            self.broken = True
            return 0
        room[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()


def _read_head(path: Path) -> bytes:
    with open_log_file(path) as file:
        return file.read(HEAD)


def _guess_encoding(head: bytes) -> str:
    return "utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"


def _split_lines(head: bytes) -> list[str]:
    lines = [x for x in head.decode(_guess_encoding(head), "replace").splitlines() if x.strip()]
    return lines[:-1] if len(head) == HEAD else lines  # the last line is cut


def _count_days(reads: Iterator[Read]) -> Iterator[Read]:
    """Add days to times after midnight. A single wrong time becomes the last less 1 ns."""
    now, (reads, ahead) = 0, tee(reads)
    for read, after in zip_longest(reads, islice(ahead, 1, None)):
        t_ns, then = (  # add days to a time that is more than half a day earlier
            t + DAY_NS * max(0, -((t - now + DAY_NS // 2) // DAY_NS))
            for t in (read[2] or 0, (after or read)[2] or 0)
        )
        wrong = 0 < now <= then < t_ns - DAY_NS // 24
        now = now if wrong else t_ns
        yield *read[:2], now - wrong


def _try_parse(parse: Callable[[str], log_lines.Found], line: str) -> tuple[log_lines.Found, str]:
    """Parse a line; return (result, reason for a failure)."""
    try:
        return parse(line), ""
    except (ValueError, LookupError) as error:
        return None, str(error)


def _count_frames(parse: Callable[[str], log_lines.Found], lines: list[str]) -> int:
    return sum(x is not None and x[1] is not None for x in (_try_parse(parse, y)[0] for y in lines))


def _has_time_differences(path: Path) -> bool:
    """Return whether candump's times are differences (-td): they start at 0 and vary."""
    found = [
        _try_parse(log_lines.parse_candump, line)[0] for line in _split_lines(_read_head(path))
    ]
    times = [line[2] for line in found if line is not None and line[2] is not None]
    if len(times) < 3 or times[0]:
        return False
    falling = sum(b < a for a, b in pairwise(times[1:]))
    return falling > FALLING * len(times) or (times[1] > 0 and len(set(times[1:])) == 1)


def _guess_form(path: Path) -> str:
    head = _read_head(path)
    if head.startswith(BLF):
        return "blf"
    if head.startswith(SQLITE):
        return "db"
    lines = _split_lines(head)
    if not lines:
        return "raw"
    most = max(1, MOSTLY * len(lines))
    entries = [x for x in lines if not x.startswith(";")]
    if any(x.startswith(";$FILEVERSION") for x in lines) or (
        entries != lines
        and _count_frames(log_lines.TrcLines().read, entries) >= max(1, MOSTLY * len(entries))
    ):
        return "trc"
    if lines[0].startswith(CSV_HEADER):
        return "csv"
    if lines[0].lower().startswith(SAVVYCAN_HEADER):
        return "gvret"
    asc = log_lines.AscLines({})
    begins = {x.split()[0].lower() for x in lines[:6]}
    if begins >= {"date", "base"} or _count_frames(asc.read, lines) + asc.unknown.total() >= most:
        return "asc"
    for form in ("candump", "slcan", "terminal"):
        if _count_frames(LINES[form], lines) >= most:
            return form
    # A table of two-digit numbers looks hexadecimal, too: only letters prove that it is bytes.
    hexes = [
        x for x in (_try_parse(log_lines.parse_hex, line)[0] for line in lines) if x is not None
    ]
    data = b"".join(x[1] for x in hexes)
    letters = sum(b & 15 > 9 or b > 0x9F for b in data)
    right = len(hexes) >= most and len(data) >= 16 and letters > len(data) / 16
    return "hex" if right else "raw"
