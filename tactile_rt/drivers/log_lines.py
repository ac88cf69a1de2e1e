"""Parsers of the lines of text logs.

Logs of candump, SavvyCAN, slcan adapters, Vector, PEAK, python-can, terminals, and hex dumps. Each
parser returns None for a line of another form, and raises a ValueError for a damaged one.
"""

import base64
import re
from collections import Counter
from collections.abc import Mapping
from decimal import Decimal
from typing import Any, Final

from tactile_rt.core.stream import NS_PER_S
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.codecs.ascii_text import in_seconds
from tactile_rt.drivers.slcan import SlcanDecoder

_CANDUMP: Final = re.compile(
    r"\s*(?:\((?P<t>[^)]*)\)\s*)?(?P<bus>[A-Za-z]\w*)\s+(?:[TR]X\s+\S+\s+\S+\s+)?"
    r"(?:(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"(?:#(?P<fd>#[0-9A-Fa-f])?(?P<rtr>[Rr]\d?)?(?P<hex>(?:[0-9A-Fa-f]{2}\.?)*)(?:\s+[TR])?"
    r"|\s+\[(?P<n>\d+)\](?P<spaced>(?:\s+[0-9A-Fa-f]{2})*|\s+remote request)(?:\s+'.*')?)"
    r"|(?P<error>[0-9A-Fa-f]{8}\s+\[\d+\].*ERRORFRAME.*))\s*"
)
_GVRET: Final = re.compile(  # as saved by SavvyCAN
    r"(?P<us>\d+),(?P<id>[0-9A-Fa-f]{3,8}),(?P<extended>true|false),(?:[RT]x,)?(?P<bus>\d+),"
    r"(?P<n>\d+)(?P<hex>(?:,[0-9A-Fa-f]{2})*),*\s*"
)
_SLCAN: Final = re.compile(r"(?:[tr][0-7][0-9A-Fa-f]{2}|[TR][01][0-9A-Fa-f]{7}|[dDbB])[0-9A-Fa-f]+")
_TERMINAL: Final = re.compile(  # the Arduino IDE; CoolTerm, Tera Term and the like
    r"(?P<arduino>\d\d?:\d\d?:\d\d?\.\d+(?: ?[AaPp][Mm])?) -> (?P<a>.*)"
    r"|\[(?P<t>(?:\d{4}-\d\d-\d\d[ T])?\d\d?:\d\d?:\d\d?[.,]\d+)\]:? ?(?P<b>.*)"
)
# xxd, hexdump -C, and hexadecimal bytes, optionally after a time
_XXD: Final = re.compile(
    r"[0-9a-fA-F]{7,16}:? +(?P<hex>(?:[0-9a-fA-F]{2,8} {1,2})*[0-9a-fA-F]{2,8})(?:  .*| \|.*)?"
)
_HEX: Final = re.compile(
    r"\s*(?:\[?(?P<t>\d+\.\d+)\]?(?:\s*s)?[\s,:;]+)?"
    r"(?P<hex>(?:0x)?[0-9a-fA-F]{2}(?:[\s,]+(?:0x)?[0-9a-fA-F]{2})*|(?:[0-9a-fA-F]{2}){8,})\s*,?\s*"
)
_ERROR, _STANDARD, _EXTENDED = 1 << 29, 0x7FF, 0x1FFFFFFF
_FD_BYTES: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)  # by data length code
# Columns of each version of .trc, by the letters of its line ;$COLUMNS.
TRC_COLUMNS: Final = {
    "1.0": "NOILD", "1.1": "NOdILD", "1.2": "NOBdILD", "1.3": "NOBdIRLD", "2.0": "NOTIdlD",
    "2.1": "NOTBIdRLD",
}  # fmt: skip
_TRC_STATUS: Final = {"Warng", "Error", "ST", "EC", "ER", "EV"}  # bus status, not frames
_TRC_FD: Final = {"FD", "FB", "FE", "BI"}

# Bus, packet, time in ns. The packet is empty for an error frame, None for a line without a frame.
Found = tuple[str, Any, int | None] | None
BESIDE: Final = ("", None, None)


def parse_candump(line: str) -> Found:
    """Parse a line that candump printed or logged."""
    found = _CANDUMP.fullmatch(line)
    if found is None:
        return None
    if found["error"]:
        return found["bus"], [], None
    t_ns = _parse_time(found["t"]) if found["t"] else None
    number = int(found["id"], 16)
    extended = len(found["id"]) == 8
    if extended and number & _ERROR:
        return found["bus"], [], None
    remote = found["rtr"] is not None or (found["spaced"] or "").strip() == "remote request"
    text = "" if remote else found["hex"] or found["spaced"] or ""
    data = bytes.fromhex(text.replace(".", ""))
    n, fd = int(found["n"] or len(data)), found["fd"] is not None
    return _to_frame(found["bus"], t_ns, number & _EXTENDED, extended, data, n, fd, remote)


def parse_gvret(line: str) -> Found:
    """Parse a line of a GVRET file, as saved by SavvyCAN."""
    if line.lower().startswith("time stamp,"):
        return BESIDE
    found = _GVRET.fullmatch(line)
    if found is None:
        return None
    data, t_ns = bytes.fromhex(found["hex"].replace(",", "")), 1000 * int(found["us"])
    extended = found["extended"] == "true"
    return _to_frame(found["bus"], t_ns, int(found["id"], 16), extended, data, int(found["n"]))


def read_csv_line(line: str) -> Found:
    """Parse a line of a CSV table written by python-can."""
    if line.startswith("timestamp,"):
        return BESIDE
    t, number, extended, remote, error, n, text = line.split(",")
    if error == "1":
        return "", [], None
    t_ns, data = round(float(t) * NS_PER_S), base64.b64decode(text)
    return _to_frame("", t_ns, int(number, 16), extended == "1", data, int(n), remote=remote == "1")


class AscLines:
    """Parser of the lines of an .asc log, in which names may replace identifiers.

    Args:
        names: Identifier, and whether it has 29 bits, of each known message name.

    Attributes:
        unknown: Number of frames of each unknown message name.
        begun: Whether a trigger block is open.
        odd_date: First date that could not be parsed; empty if none.
    """

    def __init__(self, names: Mapping[str, tuple[int, bool]]) -> None:
        self.unknown: Counter[str] = Counter()
        self.begun, self.odd_date = False, ""
        self._names, self._base, self._relative = names, 16, False
        self._began_ns = self._now_ns = 0

    def read(self, line: str) -> Found:
        """Parse the next line of the log."""
        words = line.split()
        first = words[0].lower()
        if re.fullmatch(r"\d+[.,]\d+", first):
            since = round(float(first.replace(",", ".")) * NS_PER_S)
            self._now_ns = since + self._now_ns * self._relative
            return self._read_event(words[1:])
        if first in ("date", "begin"):
            if first == "begin":
                self.begun, self._now_ns = True, 0
            self._read_date(words[2 if first == "begin" else 1 :])
        elif first == "base":
            self._base = 10 if words[1:2] == ["dec"] else 16
            self._relative = "relative" in line.lower()
        elif first == "end":
            self.begun = False
        elif first not in ("internal", "no", "previous", "next") and not first.startswith("//"):
            return None
        return BESIDE

    def _read_date(self, words: list[str]) -> None:
        from can.io import ASCReader

        try:
            began_s = ASCReader._datetime_to_timestamp(" ".join(words[1:]))
            self._began_ns = 1000 * round(1e6 * began_s)
        except ValueError:
            self.odd_date = self.odd_date or " ".join(words)

    def _read_event(self, words: list[str]) -> Found:
        """Parse the words of a line after its time."""
        fd = words[:1] == ["CANFD"]
        bus, text, way, *rest = [*words[fd:], "", "", ""]
        if fd:
            text, way = way, text
        if not bus.isdecimal():
            return BESIDE if bus else None
        if text.lower() == "errorframe":
            return f"{int(bus) - 1}", [], None
        if way == "TxRq" or ":" in (text[-1:], way[-1:]):  # e.g. statistics
            return BESIDE
        if way not in ("Rx", "Tx"):
            return None
        if fd:  # an optional name, then two flags and the data length code
            rest = ["d", *rest[3 + (not rest[0].isdigit()) :], "", ""]
        identifier = self._find_identifier(text)
        if identifier is None:
            return BESIDE
        remote, n = rest[0].lower() == "r", 0
        if not remote:
            n = int(rest[1]) if fd else min(8, int(rest[1], self._base))
        digits = rest[2 : 2 + n]
        data = _read_hex_bytes(" ".join(digits)) if self._base == 16 else bytes(map(int, digits))
        t_ns = self._began_ns + self._now_ns
        return _to_frame(f"{int(bus) - 1}", t_ns, *identifier, data, n, fd, remote)

    def _find_identifier(self, text: str) -> tuple[int, bool] | None:
        """Return (identifier, whether it has 29 bits) of a number or name; None if unknown."""
        digits = text.rstrip("xX")
        extended = digits != text
        try:
            number = int(digits, self._base)
        except ValueError:
            number = -1
        if text in self._names and not 0 <= number <= (_EXTENDED if extended else _STANDARD):
            return self._names[text]
        if number >= 0:
            return number, extended
        self.unknown[text] += 1
        return None


class TrcLines:
    """Parser of the lines of a .trc log, whose header defines its version and columns.

    Attributes:
        version: Version of the format.
    """

    def __init__(self) -> None:
        self.version = "1.0"
        self._columns, self._began_ns = TRC_COLUMNS["1.0"], 0

    def read(self, line: str) -> Found:
        """Parse the next line; in an unknown version, no line counts as a frame."""
        if line.startswith(";"):
            key, _, value = line.strip().partition("=")
            if key == ";$FILEVERSION":
                self.version, self._columns = value, TRC_COLUMNS.get(value, "")
            elif key == ";$COLUMNS" and self._columns:
                self._columns = value.replace(",", "")
            elif key == ";$STARTTIME":  # days from 30 December 1899
                self._began_ns = round((float(value) - 25_569) * 86_400 * NS_PER_S)
            return BESIDE
        names = self._columns
        cells = dict(zip(names, line.split(maxsplit=len(names) - 1), strict=False))
        status = cells.get("T") or cells.get("d")
        if not names or status in _TRC_STATUS or cells.get("I") == "FFFFFFFF":
            return BESIDE
        old = self.version < "2"
        if len(cells) < len(names) - 1 or (old and not cells["N"].endswith(")")):
            return None
        if status not in ((None, "Rx", "Tx") if old else (*_TRC_FD, "DT", "RR")):
            return None
        text, fd = cells.get("D", ""), status in _TRC_FD
        remote = status == "RR" or text.startswith("RTR")
        n = int(cells["l"]) if "l" in cells else int(cells["L"])
        if "L" in cells:
            n = _FD_BYTES[n] if fd else min(8, n)
        return _to_frame(
            cells.get("B", "1"), self._began_ns + round(1e6 * float(cells["O"])),
            int(cells["I"], 16), len(cells["I"]) > 4, _read_hex_bytes("" if remote else text), n,
            fd, remote,
        )  # fmt: skip


def parse_slcan(line: str) -> Found:
    """Parse a line that an slcan adapter sent."""
    if _SLCAN.fullmatch(line) is None:
        return None
    frames = SlcanDecoder().feed(line.encode("ascii") + b"\r")
    return ("", frames, None) if frames else None


def parse_heard(line: str) -> Found:
    """Parse a line that a terminal program logged with its time of arrival."""
    found = _TERMINAL.fullmatch(line)
    if found is None:
        return None
    t_ns = _parse_time((found["arduino"] or found["t"]).replace(",", "."))
    text = found["a"] if found["b"] is None else found["b"]
    return None if t_ns is None else ("", f"{text}\n".encode(), t_ns)


def parse_hex(line: str) -> Found:
    """Parse a line of hexadecimal bytes, such as xxd or hexdump prints."""
    found = _HEX.fullmatch(line) or _XXD.fullmatch(line)
    if found is None:
        return None
    t_ns = _parse_time(found["t"]) if "t" in found.re.groupindex and found["t"] else None
    return "", bytes.fromhex(found["hex"].replace("0x", "").replace(",", " ")), t_ns


def _read_hex_bytes(text: str) -> bytes:
    """Convert pairs of hexadecimal digits to bytes; raise a ValueError at anything else."""
    if not re.fullmatch(r"(?:\s*[0-9A-Fa-f]{2})*\s*", text):
        raise ValueError("its bytes are damaged")
    return bytes.fromhex(text)


def _to_frame(
    bus: str,
    t_ns: int | None,
    number: int,
    extended: bool,
    data: bytes,
    n: int,
    fd: bool = False,
    remote: bool = False,
) -> Found:
    """Return a frame; raise a ValueError unless it has n bytes and a valid identifier."""
    if number > (_EXTENDED if extended else _STANDARD):
        raise ValueError("no such identifier")
    if n > _FD_BYTES[-1] or (len(data) != n and not remote):
        raise ValueError(f"{len(data)} of {n} bytes")
    return bus, [CanFrame(number, data, extended, fd or n > 8, remote)], t_ns


def _parse_time(text: str) -> int | None:
    """Convert a time in seconds, or a date, to ns; None if it is neither."""
    plain = text.strip()
    if "-" in plain or ":" in plain:
        plain = in_seconds(plain)
    exact = re.fullmatch(r"\d+(?:\.\d*)?", plain)
    return int(Decimal(plain) * NS_PER_S) if exact else None
