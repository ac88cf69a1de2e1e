"""One line of a log of text: what candump, SavvyCAN, slcan adapters, terminals and dumps in
hexadecimal print."""

import re
from typing import Any, Final

from tactile_rt.core.stream import NS_PER_S
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.codecs.ascii_text import in_seconds
from tactile_rt.drivers.slcan import SlcanDecoder

__all__ = ["Found", "of_candump", "of_gvret", "of_heard", "of_hex", "of_slcan"]

_CANDUMP: Final = re.compile(
    r"\s*(?:\((?P<t>[^)]*)\)\s*)?(?P<bus>[A-Za-z]\w*)\s+(?:[TR]X\s+\S+\s+\S+\s+)?"
    r"(?:(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"(?:#(?P<fd>#[0-9A-Fa-f])?(?P<rtr>[Rr]\d?)?(?P<hex>(?:[0-9A-Fa-f]{2}\.?)*)(?:\s+[TR])?"
    r"|\s+\[(?P<n>\d+)\](?P<spaced>(?:\s+[0-9A-Fa-f]{2})*|\s+remote request)(?:\s+'.*')?)"
    r"|(?P<error>[0-9A-Fa-f]{8}\s+\[\d+\].*ERRORFRAME.*))\s*"
)
_GVRET: Final = re.compile(  # what SavvyCAN saves
    r"(?P<us>\d+),(?P<id>[0-9A-Fa-f]{3,8}),(?P<extended>true|false),(?:[RT]x,)?(?P<bus>\d+),"
    r"(?P<n>\d+)(?P<hex>(?:,[0-9A-Fa-f]{2})*),*\s*"
)
_SLCAN: Final = re.compile(r"(?:[tr][0-7][0-9A-Fa-f]{2}|[TR][01][0-9A-Fa-f]{7}|[dDbB])[0-9A-Fa-f]+")
_HEARD: Final = re.compile(  # the Arduino IDE; CoolTerm, Tera Term and the like
    r"(?P<arduino>\d\d?:\d\d?:\d\d?\.\d+(?: ?[AaPp][Mm])?) -> (?P<a>.*)"
    r"|\[(?P<t>(?:\d{4}-\d\d-\d\d[ T])?\d\d?:\d\d?:\d\d?[.,]\d+)\]:? ?(?P<b>.*)"
)
# xxd, hexdump -C, and bytes in hex with or without a time before them
_XXD: Final = re.compile(
    r"[0-9a-fA-F]{7,16}:? +(?P<hex>(?:[0-9a-fA-F]{2,8} {1,2})*[0-9a-fA-F]{2,8})(?:  .*| \|.*)?"
)
_HEX: Final = re.compile(
    r"\s*(?:\[?(?P<t>\d+\.\d+)\]?(?:\s*s)?[\s,:;]+)?"
    r"(?P<hex>(?:0x)?[0-9a-fA-F]{2}(?:[\s,]+(?:0x)?[0-9a-fA-F]{2})*|(?:[0-9a-fA-F]{2}){8,})\s*,?\s*"
)
_ERROR, _EXTENDED = 1 << 29, 0x1FFFFFFF

Found = tuple[str, Any, int | None] | None  # bus, packet (None: an error frame), when, ns


def of_candump(line: str) -> Found:
    """A line of candump, as it prints or logs."""
    found = _CANDUMP.fullmatch(line)
    if found is None:
        return None
    if found["error"]:
        return found["bus"], None, None
    t_ns = _time(found["t"]) if found["t"] else None
    number = int(found["id"], 16)
    extended = len(found["id"]) == 8
    if extended and number & _ERROR:
        return found["bus"], None, None
    fd = found["fd"] is not None
    remote = found["rtr"] is not None or (found["spaced"] or "").strip() == "remote request"
    text = "" if remote else found["hex"] or found["spaced"] or ""
    data = bytes.fromhex(text.replace(".", ""))
    if len(data) > 64 or (found["n"] and not remote and int(found["n"]) != len(data)):
        return None
    fd = fd or len(data) > 8
    return found["bus"], [CanFrame(number & _EXTENDED, data, extended, fd, remote)], t_ns


def of_gvret(line: str) -> Found:
    """A line of what SavvyCAN saves (GVRET)."""
    found = _GVRET.fullmatch(line)
    if found is None:
        return None
    data, number = bytes.fromhex(found["hex"].replace(",", "")), int(found["id"], 16)
    extended = found["extended"] == "true"
    if (
        len(data) != int(found["n"])
        or len(data) > 64
        or number > (_EXTENDED if extended else 0x7FF)
    ):
        return None
    frame = CanFrame(number, data, extended, len(data) > 8)
    return found["bus"], [frame], _time(found["us"], NS_PER_S // 1_000_000)


def of_slcan(line: str) -> Found:
    """A line of what an slcan adapter sends."""
    if _SLCAN.fullmatch(line) is None:
        return None
    frames = SlcanDecoder().feed(line.encode("ascii") + b"\r")
    return ("", frames, None) if frames else None


def of_heard(line: str) -> Found:
    """A line of text with the time at which a terminal got it."""
    found = _HEARD.fullmatch(line)
    if found is None:
        return None
    t_ns = _time((found["arduino"] or found["t"]).replace(",", "."))
    text = found["a"] if found["b"] is None else found["b"]
    return None if t_ns is None else ("", f"{text}\n".encode(), t_ns)


def of_hex(line: str) -> Found:
    """A line of bytes in hexadecimal."""
    found = _HEX.fullmatch(line) or _XXD.fullmatch(line)
    if found is None:
        return None
    t_ns = _time(found["t"]) if "t" in found.re.groupindex and found["t"] else None
    try:
        return "", bytes.fromhex(found["hex"].replace("0x", "").replace(",", " ")), t_ns
    except ValueError:
        return None


def _time(text: str, unit_ns: int = NS_PER_S) -> int | None:
    """A time in ns: whole and parts exactly, or a date."""
    plain = text.strip()
    if "-" in plain or ":" in plain:
        plain = in_seconds(plain)
    whole, _, part = plain.partition(".")
    if not (whole.isdecimal() and (part.isdecimal() or not part)):
        return None
    scale: int = 10 ** len(part)
    return int(whole) * unit_ns + int(part or 0) * unit_ns // scale
