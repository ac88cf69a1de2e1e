"""What somebody kept of a line: bytes, hexadecimal text, or a log of a CAN bus, as packets again.

    log = read_log(Path("can.log"))       # candump, asc, blf, ...; bytes, hex
    for packet, t_ns in log.packets(): ...  # t_ns is None where the log has no times

Which form a file has is told by how it begins, whatever its name; gzip is unpacked. Logs end
anywhere and hold lines that are none: what can be read is, and `notes` say what could not.
"""

import gzip
import logging
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from io import BufferedReader, RawIOBase, TextIOWrapper
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import open_regular
from tactile_rt.core.stream import NS_PER_S
from tactile_rt.drivers.can_lines import TRC_1_0, CanLines, Occurrences, find_asc_frame, has_names
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.log_lines import Found, of_candump, of_gvret, of_heard, of_hex, of_slcan

__all__ = ["CAN_FORMS", "FORMS", "LineLog", "open_log_file", "read_log"]

SERIAL_FORMS: Final = ("raw", "hex", "terminal")
OF_PYTHON_CAN: Final = ("asc", "blf", "trc", "csv", "db")
CAN_FORMS: Final = ("candump", "slcan", "gvret", *OF_PYTHON_CAN)
FORMS: Final = (*SERIAL_FORMS, *CAN_FORMS)
PIECE: Final = 256
HEAD: Final = 16_384  # bytes that tell the form
MOSTLY: Final = 0.8  # of the lines at the beginning are of the form
BLF: Final = b"LOGG"
SQLITE: Final = b"SQLite format 3\0"  # of python-can's logger, .db; bags of ROS 2 are .db3
GZIP: Final = b"\x1f\x8b"
# What is neither a log nor a text, by its first bytes, and how it becomes one.
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
FALLING: Final = 0.2  # of the times of candump -td are less than the one before

LINES: Final[dict[str, Callable[[str], Found]]] = {
    "candump": of_candump, "slcan": of_slcan,
    "terminal": of_heard, "hex": of_hex, "gvret": of_gvret,
}  # fmt: skip
Timed = tuple[Any, int | None]  # a packet, and when it came, ns

LogFile = BufferedReader


class LineLog:
    """A log of a serial line or a CAN bus.

    Args:
        bus: Name of the bus whose frames to take, of a log of several; empty for all.

    Attributes:
        piece: Bytes of a packet where the log says nothing of packets.
        notes: What could not be read, a sentence each; complete once all packets were read.
        buses: Number of packets of each bus, by its name; complete once all packets were read.
        names: Identifiers, and whether they have 29 bits, of the messages whose names are known.
        total: The number of bytes, lines or frames that the file holds; complete as the notes.
        frames: How many of them were read as frames, or as lines that a device sent.
    """

    def __init__(self, path: Path, form: str, bus: str = "") -> None:
        self.path, self.form, self._bus = path, form, bus
        self.wire = "can" if form in CAN_FORMS else "serial"
        self.piece = PIECE
        self.notes: list[str] = []
        self.buses: Counter[str] = Counter()
        self.names: Mapping[str, tuple[int, bool]] = {}
        self.total = self.frames = 0
        self.back = Occurrences("packet")  # times that go back

    def packets(self) -> Iterator[Timed]:
        """The packets, bytes or a CAN frame each, and when each came, ns; None where the log does
        not say. Times never go back.
        """
        self.notes.clear()
        self.buses.clear()
        self.total = self.frames = 0
        latest, self.back = -(1 << 62), Occurrences("frame" if self.wire == "can" else "packet")
        with open_log_file(self.path) as file:
            for number, (packet, t_ns) in enumerate(self._read(file), 1):
                if t_ns is not None:
                    if t_ns < latest:
                        self.back.add(number)
                        t_ns = latest
                    latest = t_ns
                yield packet, t_ns
        if self.back.n:
            self.notes.append(
                f"{self.back.n} times go back ({self.back.what} {self.back.first} is the first); "
                "these packets have the time before"
            )

    def _read(self, file: "LogFile") -> Iterator[Timed]:
        if self.form == "raw":
            while piece := file.read(self.piece):
                self.total += len(piece)
                yield piece, None
        elif self.form in OF_PYTHON_CAN:
            yield from self._logged(file)
        else:
            yield from self._text(file)
        if getattr(file.raw, "broken", False):
            self.notes.append("it is cut short or damaged: what unpacks of it was read")

    def _text(self, file: LogFile) -> Iterator[Timed]:
        parse, errors, buses = LINES[self.form], 0, self.buses
        others, blank, number = Occurrences("line"), 0, 0
        apart, now = self.form == "candump" and _times_are_apart(self.path), 0
        with TextIOWrapper(file, "utf-8-sig", "replace") as lines:
            for number, line in enumerate(lines, 1):
                found = parse(line.rstrip("\r\n"))
                if found is None:
                    if not line.strip() or (number == 1 and self.form == "gvret"):
                        blank += 1  # as good as: the names of columns
                    else:
                        others.add(number)
                    continue
                bus, packet, t_ns = found
                if packet is None:
                    errors += 1
                    continue
                if self.form == "terminal" and t_ns is not None:  # on after midnight
                    now = t_ns = t_ns + DAY_NS * max(0, -((t_ns - now + DAY_NS // 4) // DAY_NS))
                if apart:
                    t_ns = now = now + (t_ns or 0)
                buses[bus] += 1
                if not self._bus or bus == self._bus:
                    yield packet, t_ns
        self.total, self.frames = number - blank, number - blank - others.n
        self._tell(others, "line", errors)

    def _logged(self, file: LogFile) -> Iterator[Timed]:
        """Read what python-can does: what it passes over in silence, a note says."""
        warned = _Warnings()
        logging.getLogger("can").addHandler(warned)  # it tells us, not the terminal
        errors, buses, n = 0, self.buses, 0
        lines: CanLines | None = None
        if self.form in ("asc", "csv", "trc"):
            text, named = TextIOWrapper(file, "utf-8-sig", "replace"), False
            if self.form == "asc":
                named = has_names(_lines(_head(self.path)))
            lines = CanLines(text, self.form, self.names, named)
        try:
            made = self._reader(file, lines)
            for message in self._read_messages(made, lines):
                n += 1
                bus = "" if message.channel is None else str(message.channel)
                if message.is_error_frame:
                    errors += 1
                    continue
                buses[bus] += 1
                if not self._bus or bus == self._bus:
                    yield [
                        CanFrame(
                            message.arbitration_id, bytes(message.data), message.is_extended_id,
                            message.is_fd, message.is_remote_frame,
                        )
                    ], round(NS_PER_S * message.timestamp)  # fmt: skip
        finally:
            logging.getLogger("can").removeHandler(warned)
            if lines is not None:
                lines.close()
        others = Occurrences("line")
        self.total, self.frames = n, n
        if lines is not None:
            lines.finish()
            others, self.total = lines.lost, lines.filled
            self.notes += lines.notes
            if lines.begun:  # in its last line, most often
                last = others.n == 1 and others.first == lines.number
                others = Occurrences("line") if last else others
                self.notes.append(f"it ends before its end: {n} frames were read")
        elif self.form == "blf" and made is not None:
            self.total = max(n, made.object_count)
            self._check_end(file, made, n)
        self.notes += warned.notes[:3] if self.form != "trc" else []  # whose lines are counted
        self._tell(others, "frame", errors)

    def _reader(self, file: LogFile, lines: CanLines | None) -> Any:
        """Make python-can's reader; None where the file does not even begin as it should."""
        from can.io import ASCReader, BLFReader, CSVReader, SqliteReader, TRCReader

        if lines is not None:
            kinds = {"asc": ASCReader, "csv": CSVReader, "trc": TRCReader}
            return kinds[self.form](lines, relative_timestamp=False)
        if self.form == "db":
            return SqliteReader(self.path)
        try:
            made: Any = BLFReader(file)
        except (struct.error, ValueError) as error:
            self.notes.append(f"it is cut short or damaged after 0 frames ({error!s:.80})")
            return None
        made.stop = lambda: None  # `file` is looked at once more
        return made

    def _read_messages(self, made: Any, lines: CanLines | None) -> Iterator[Any]:
        """Read messages, and go on after lines that python-can cannot read."""
        n = 0
        while True:
            at = lines.number if lines else 0
            try:
                for message in made or ():
                    n += 1
                    if lines is None or lines.accept(message):
                        yield message
                return
            except (OSError, GeneratorExit):
                raise
            except Exception as error:  # python-can raises anything on what is cut or damaged
                why = " ".join(str(error).split()) or type(error).__name__
                if lines is None or lines.number == at:
                    self.notes.append(f"it is cut short or damaged after {n} frames ({why:.80})")
                    return
                if not lines.settle(why):
                    self.notes.append(f"line {lines.number} of its header is not read ({why:.60})")
                lines.resume()

    def _check_end(self, file: LogFile, made: Any, n: int) -> None:
        """Note that a .blf is shorter than its header says, or ends within an object."""
        short = file.seekable() and file.tell() < made.file_size  # one that is cut is noted
        if (short or made._tail.strip(b"\0")) and not self.notes:
            of = f" of {made.object_count}" if n < made.object_count else ""
            self.notes.append(f"it ends before its end: {n} frames{of} were read")

    def _tell(self, others: Occurrences, what: str, errors: int) -> None:
        buses = self.buses
        if others.n:
            a = "an" if self.form == "asc" else "a"
            self.notes.append(f"passed over, no {what} of {a} {self.form} log: {others}")
        if errors:
            self.notes.append(f"{errors} error frames")
        if self._bus and self._bus not in buses:
            known = ", ".join(sorted(buses)) or "none"
            self.notes.append(f"no frames are of bus {self._bus}; there are those of {known}")
        elif len(buses) > 1:
            named = ", ".join(f"{bus or 'none'} ({n})" for bus, n in sorted(buses.items()))
            taken = f"those of {self._bus} are taken" if self._bus else "--bus takes those of one"
            self.notes.append(f"frames of several buses: {named}; {taken}")


def read_log(path: Path, form: str = "", bus: str = "") -> LineLog:
    """A log of a line; raw bytes where it is no other.

    Args:
        form: one of `FORMS`; empty: as it begins.
    """
    if form and form not in FORMS:
        raise ConfigError(f"no form {form!r} of a log: there are {', '.join(FORMS)}")
    if not path.exists():
        raise ConfigError(f"no file {path}")
    return LineLog(path, form or _form(path), bus)


def open_log_file(path: Path) -> BufferedReader:
    """A file to read, unpacked if it is of gzip; what is cut short or damaged ends where it does.

    Raises:
        ConfigError: it is known to be no log and no table.
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
    return BufferedReader(_Unpacked(file)) if packed else cast(BufferedReader, file)


class _Unpacked(RawIOBase):
    """A gzip file, which ends where it is damaged: `broken` says that it does."""

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


class _Warnings(logging.Handler):
    """What python-can passes over with a warning, once each."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.notes: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        note = " ".join(record.getMessage().split())
        if note not in self.notes:
            self.notes.append(note)


def _head(path: Path) -> bytes:
    with open_log_file(path) as file:
        return file.read(HEAD)


def _lines(head: bytes) -> list[str]:
    lines = [x for x in head.decode("utf-8-sig", "replace").splitlines() if x.strip()]
    return lines[:-1] if len(head) == HEAD else lines  # the last one was cut


def _times_are_apart(path: Path) -> bool:
    """Whether the times of candump are differences (-td): from 0 on, up and down."""
    found = [of_candump(line) for line in _lines(_head(path))]
    times = [one[2] for one in found if one is not None and one[2] is not None]
    if len(times) < 3 or times[0]:
        return False
    falling = sum(b < a for a, b in pairwise(times[1:]))
    return falling > FALLING * len(times) or (times[1] > 0 and len(set(times[1:])) == 1)


def _form(path: Path) -> str:
    head = _head(path)
    if head.startswith(BLF):
        return "blf"
    if head.startswith(SQLITE):
        return "db"
    if b"\0" in head:
        return "raw"
    lines = _lines(head)
    if not lines:
        return "raw"
    entries = [x for x in lines if not x.startswith(";")]
    if any(x.startswith(";$FILEVERSION") for x in lines) or (
        entries != lines and sum(map(bool, map(TRC_1_0.fullmatch, entries))) > MOSTLY * len(entries)
    ):
        return "trc"
    if lines[0].startswith(CSV_HEADER):
        return "csv"
    if lines[0].lower().startswith(SAVVYCAN_HEADER):
        return "gvret"
    begins = {x.split()[0].lower() for x in lines[:6]}
    if begins >= {"date", "base"} or sum(map(bool, map(find_asc_frame, lines))) >= MOSTLY * len(
        lines
    ):
        return "asc"
    for form in ("candump", "slcan", "terminal"):
        if sum(LINES[form](x) is not None for x in lines) >= MOSTLY * len(lines):
            return form
    # A table of numbers of two digits is hexadecimal, too: only letters tell that it is bytes.
    hexes = [of_hex(x) for x in lines]
    right = sum(x is not None for x in hexes) >= MOSTLY * len(lines)
    data = b"".join(found[1] or b"" for found in hexes if found is not None)
    letters = sum(b & 15 > 9 or b > 0x9F for b in data)
    return "hex" if right and len(data) >= 16 and letters > len(data) / 16 else "raw"
