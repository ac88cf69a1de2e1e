"""Lines of a CAN log for a reader of python-can, one message for each line that is a frame.

What python-can misreads is mended before it comes there: times that are differences are added up,
names stand for identifiers, a header ends where frames begin, and what is no frame is left out. A
frame of which no message came, or another than the line tells, is counted.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, Final, TextIO

from tactile_rt.core.errors import name_some

__all__ = ["TRC_1_0", "CanLines", "Occurrences", "find_asc_frame", "has_names"]

TRC_VERSIONS: Final = ("1.0", "1.1", "1.2", "1.3", "2.0", "2.1")
NAMES_HELP: Final = "codec=can-dbc knows those of its DBC file"
TRC_1_0: Final = re.compile(r"\s*\d+\)\s+\d+(?:\.\d+)?\s+[0-9A-Fa-f]{4,8}\s+\d(?:\s.*)?")
_TRC_STATUS: Final = re.compile(  # of the bus: no frame
    r"\s*\d+\)?\s+[\d.]+\s+(?:(?:\d+\s+)?(?:Warng|Error|ST|EC|ER|EV)\b|FFFFFFFF\s)"
)
_ASC_TIME: Final = re.compile(r"\s*(\d+)(?:[.,](\d+))?\s+")
_ASC_FRAME: Final = re.compile(
    r"(?P<bus>\d+\s+)(?P<id>ErrorFrame\b|\S+(?=\s+[RT]x\s|\s+(?!TxRq)\S+\s+[dr]\s))", re.IGNORECASE
)
_ASC_FD: Final = re.compile(r"(?P<bus>CANFD\s+\d+\s+(?!TxRq)\S+\s+)(?P<id>\S+)", re.IGNORECASE)
_ASC_DATE: Final = re.compile(r"\s*(date|begin\s+triggerblock)\b\s*(.*)", re.IGNORECASE)
_ASC_NUMBER: Final = {10: re.compile(r"\d+[xX]?"), 16: re.compile(r"[0-9A-Fa-f]+[xX]?")}
_CUT: Final = re.compile(r".*\s[0-9A-Fa-f]{2} [0-9A-Fa-f]")  # in the middle of a byte


class Occurrences:
    """How many there are of something, and which is the first."""

    def __init__(self, what: str) -> None:
        self.what, self.n, self.first, self.why = what, 0, 0, ""

    def add(self, number: int, why: str = "") -> None:
        """Count the one of this number."""
        if not self.n:
            self.first, self.why = number, why
        self.n += 1

    def __str__(self) -> str:
        return f"{self.n} ({self.what} {self.first}{f': {self.why:.60}' * bool(self.why)})"


def find_asc_frame(line: str) -> str:
    """Find the identifier of a frame in a line of an .asc log; else empty."""
    time = _ASC_TIME.match(line)
    frame = None if time is None else _match_frame(line, time.end())
    return "" if frame is None else frame["id"]


def has_names(lines: Iterable[str]) -> bool:
    """Return whether identifiers are names in these lines of an .asc log."""
    found = filter(None, map(find_asc_frame, lines))
    return any(not _ASC_NUMBER[16].fullmatch(x) and x.lower() != "errorframe" for x in found)


def _match_frame(line: str, at: int) -> "re.Match[str] | None":
    return _ASC_FRAME.match(line, at) or _ASC_FD.match(line, at)


class CanLines:
    """Lines as python-can reads them rightly; it iterates and closes them as a file.

    Args:
        names: Identifiers, and whether they have 29 bits, of the messages whose names are known.
        symbolic: Whether a word that is a name and hexadecimal is a name.

    Attributes:
        number: Number of the line that came last.
        filled: The number of lines that are not blank.
        lost: Frames of which no message came.
        notes: What is odd about the file as a whole, a sentence each.
    """

    def __init__(
        self, lines: TextIO, form: str, names: Mapping[str, tuple[int, bool]], symbolic: bool
    ) -> None:
        self._file, self._lines = lines, iter(lines)
        self._form, self._names, self._symbolic = form, names, symbolic
        self._prepare = {"asc": self._asc, "csv": self._csv, "trc": self._trc}[form]
        self.number = self.filled = self._pending = 0
        self.lost = Occurrences("line")
        self.notes: list[str] = []
        self.version = ""  # of a .trc
        self.begun = False  # a trigger block, which has not ended
        self._first: list[str] = []  # to hand over before any other
        self._header, self._base, self._apart, self._now = True, 16, False, 0
        self._unknown: Counter[str] = Counter()  # names that stand for identifiers

    def __iter__(self) -> "CanLines":
        return self

    def __next__(self) -> str:
        if self._first:
            return self._first.pop()
        self.settle()
        while True:
            line = next(self._lines)
            self.number += 1
            if not line.strip():
                continue
            self.filled += 1
            ready: str = self._prepare(line)
            if (
                self._pending
                and not line.endswith("\n")
                and self._base == 16
                and _CUT.fullmatch(line)
            ):
                self.settle("cut in a byte")
            elif ready:
                return ready

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def settle(self, why: str = "") -> bool:
        """Count the newest frame as lost if no message came of it, and return whether."""
        pending, self._pending = self._pending, 0
        if pending:
            self.lost.add(pending, why)
        return pending > 0

    def resume(self) -> None:
        """Let a reader begin once more, after a line that it could not read."""
        self._first += {"asc": ["internal events logged\n"], "csv": ["\n"]}.get(self._form, [])

    def accept(self, message: Any) -> bool:
        """Return whether a message is as its line tells; else it counts as lost."""
        from can.util import dlc2len

        told = dlc2len(message.dlc) if self._form == "trc" else message.dlc
        told = told if message.is_fd else min(8, told)
        if not (message.is_remote_frame or message.is_error_frame) and len(message.data) < told:
            self.settle(f"{len(message.data)} of {told} bytes")
            return False
        if message.arbitration_id > (0x1FFFFFFF if message.is_extended_id else 0x7FF):
            self.settle("no such identifier")
            return False
        self._pending = 0
        return True

    def finish(self) -> None:
        """Count what came last, and note what is odd about the whole."""
        self.settle()
        if self._unknown:
            names, n = list(self._unknown), sum(self._unknown.values())
            self.notes.append(
                f"identifiers are names here ({name_some(names)}), not read in {n} frames: "
                f"{'not in the DBC file' if self._names else NAMES_HELP}"
            )

    def _csv(self, line: str) -> str:
        if line.startswith("timestamp,"):
            return line if self.number == 1 else ""
        self._pending = self.number
        return line

    def _trc(self, line: str) -> str:
        if line.startswith(";"):
            if line.startswith(";$FILEVERSION="):
                self.version = line.partition("=")[2].strip()
                if self.version not in TRC_VERSIONS:
                    self.notes.append(
                        f"version {self.version[:20]!r} of a .trc is not read: there are "
                        f"{', '.join(TRC_VERSIONS)}"
                    )
                    self._lines = iter(())
                return line.replace("1.2", "1.3")
            return line
        if _TRC_STATUS.match(line):
            return ""
        self._pending = self.number
        if self.version == "1.2":  # as 1.3, but for a column that is reserved
            line = re.sub(r"((?:\S+\s+){5})", r"\1- ", line, count=1)
        return line

    def _asc(self, line: str) -> str:
        begins = line.split(None, 2)[0].lower()
        if date := _ASC_DATE.match(line):
            block, text = date[1][0] in "bB", date[2].strip()
            if block:
                self.begun, self._now = True, 0
            if not _is_date(text):
                if text and not self.notes:
                    self.notes.append(f"its date, {text:.40}, is not read: times count from 0")
                return ""
            return self._open_frames(line) if block else line
        if line.strip().lower().startswith("end triggerblock"):
            self.begun = False
        elif begins == "base" and self._header:
            self._base = 10 if line.split()[1:2] == ["dec"] else 16
            self._apart = "relative" in line.lower().split()
            return line
        time = _ASC_TIME.match(line)
        if time is None:
            return ""
        if self._apart:
            self._now += int(time[1]) * 10**9 + int(f"{time[2] or 0:0<9.9}")
        frame = _match_frame(line, time.end())
        if frame is None:
            return ""
        name = frame["id"]
        if name.lower() != "errorframe":
            known = self._names.get(name)
            number = _ASC_NUMBER[self._base].fullmatch(name) is not None
            if known is not None and (self._symbolic or not number):
                name = f"{known[0]:{'X' if self._base == 16 else 'd'}}{'x' * known[1]}"
            elif not number:
                self._unknown[name] += 1
                return ""
        self._pending = self.number
        seconds = (
            f"{self._now // 10**9}.{self._now % 10**9:09d}"
            if self._apart
            else f"{time[1]}.{time[2] or 0}"
        )
        return self._open_frames(f"{seconds} {frame['bus']}{name}{line[frame.end() :]}")

    def _open_frames(self, line: str) -> str:
        """End the header before the first line that is not of it."""
        if not self._header:
            return line
        self._header, self._first = False, [line]
        return "internal events logged\n"


def _is_date(text: str) -> bool:
    """Return whether python-can reads this date."""
    from can.io import ASCReader

    try:
        ASCReader._datetime_to_timestamp(text.split(None, 1)[1])
    except (ValueError, IndexError):
        return False
    return text.split(None, 1)[0].isalpha()
