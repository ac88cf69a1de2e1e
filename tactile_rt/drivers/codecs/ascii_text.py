"""Parser of numbers in lines of text, among words, units, brackets, dates and names.

one, two = fields("2024-05-10 09:48:16.222  (6.37, kg)")       by their places
Names({"x": 0, "Raw.6": 1}).find('{"x": 1.5, "Raw": [0, 1, ...]}')  by the names before them
"""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, Final

import msgspec

NAN: Final = float("nan")
# Words that boards print in place of a number; ovf is Arduino's for a number over 4e9.
MISSING: Final = frozenset(
    "ovf null none na n/a n.a. n.a nil (null) <null> <na> - -- --- ---- err error fail failed "
    "timeout undefined missing #n/a #na #value! #div/0! #num! #ref! #null! #name? -nan(ind) "
    "nan(ind) 1.#qnan 1.#ind -1.#ind 1.#inf -1.#inf".split()
)
NUMBER: Final = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_WITH_UNIT: Final = re.compile(rf"({NUMBER})[A-Za-z%°µμ\ufffd]+(?:/[A-Za-z]+[²2]?)?")
_HEX: Final = re.compile(r"[+-]?0[xX][0-9A-Fa-f]+")
_DATE: Final = re.compile(
    r"(?:(\d{4})[-/.](\d\d?)[-/.](\d\d?)|(\d\d?)\.(\d\d?)\.(\d{4}))"
    r"[T ]+(\d\d?):(\d\d?)(?::(\d\d?)(?:[.,](\d{1,9}))?)?(Z|[+-]\d\d:?\d\d)?(?![\d:])"
)
_CLOCK: Final = re.compile(
    r"(?<![\d:.-])(\d\d?):([0-5]?\d):([0-5]?\d|60)(?:[.,](\d{1,9}))?(?![\d:])"
)
_DAY: Final = re.compile(r"(?<![\d/.-])(\d\d?)([-/])(\d\d?)\2(\d{4}),?[T ]+(?=\d\d?:)")
_HALF_DAY: Final = re.compile(
    r"(?<![\d:.-])(1[0-2]|0?[1-9])(:\d\d?)(:\d\d?(?:[.,]\d{1,9})?)?\s*([AaPp])\.?[Mm]\b\.?"
)
_NAME: Final = re.compile(r"[A-Za-z_]\w*\s*[:=](?!=)")
_NAMES: Final = re.compile(r"[A-Za-z_]\w*(?:[ \t]+[A-Za-z_]\w*)*\s*[:=](?!=)")
_NOTHING: Final = re.compile(r"(?:^|(?<=[,;]))\s*(?=[,;])")  # between or before commas
_BRACKETS: Final = str.maketrans(dict.fromkeys("()[]{}<>\"'|", " "))
_SEPARATORS: Final = re.compile(r"[\s,;]+")
_ARROW: Final = re.compile(r"[-=]>")
_BETWEEN: Final = r"(?:\s*->\s*|[\"'\s:=\[(|>~]{1,8})"  # between a name and its number
_MORE_DIGITS: Final = re.compile(r",\d[\d.,]*")  # directly behind a number
_SIGNS: Final = frozenset("=:/~#*")


def is_text(line: str) -> bool:
    """Return whether at most an eighth of the characters are not printable."""
    return 8 * sum(not (c.isprintable() or c == "\t") or c == "\ufffd" for c in line) <= len(line)


def number(word: Any) -> float | None:
    """Convert a printed word to a number, NaN for `MISSING`; None for other words."""
    if isinstance(word, int | float):
        return float(word) if abs(word) < 1e300 else NAN
    if not isinstance(word, str):
        return NAN if word is None else None
    word = word.replace("\u2212", "-")  # the typographic minus sign
    try:
        return None if "_" in word else float(word)
    except ValueError:
        pass
    if word.lower() in MISSING:
        return NAN
    if _HEX.fullmatch(word):
        return float(int(word, 16))
    found = _WITH_UNIT.fullmatch(word)
    return float(found[1]) if found else None


def fields(line: str, words_are_names: bool = False) -> list[str]:
    """Split a line into words at spaces, commas, semicolons and brackets.

    A name before a number (``x:``, ``y =``) is left out, a date with a time is one word (in
    seconds), and an empty place between two commas is ``nan``.

    Args:
        words_are_names: whether a name may be several words, ``one reading: 5``.
    """
    text = (_NAMES if words_are_names else _NAME).sub(" ", _ARROW.sub(" ", in_seconds(line)))
    text = _NOTHING.sub("nan", text.rstrip().removesuffix(",").removesuffix(";"))
    words = _SEPARATORS.split(text.translate(_BRACKETS))
    return [w for w in words if w and w not in _SIGNS]


class Names:
    """Finder of numbers in a line of text, each by the name that precedes it.

    Args:
        names: column of each number, by its name; ``a.b`` for a number in an object of JSON,
            ``a.2`` for the third number after a name.

    Attributes:
        ambiguous: Text of the last line such as ``4,25``: a decimal comma, or two numbers? Else "".
    """

    ambiguous = ""

    def __init__(self, names: Mapping[str, int]) -> None:
        self._names = names
        bases = {base for base, index in map(_split_index, names) if index}
        self._single = {
            place for name, place in names.items() if _split_index(name)[0] not in bases
        }
        self._patterns = {place: _compile_name(name) for name, place in names.items()}
        known = "|".join(map(re.escape, names))
        then = rf"(?=[{{\"']*({known})[\"']?\s*[:=])"
        self._glued = re.compile(rf"(?<![\w.])({known}){_BETWEEN}(?>{NUMBER}){then}")

    def find(self, line: str) -> dict[int, float]:
        """Return the numbers of a line by column; NaN if a name precedes no number."""
        self.ambiguous = ""
        if line.lstrip()[:1] == "{":
            try:
                decoded = msgspec.json.decode(line)
            except (msgspec.DecodeError, UnicodeEncodeError):
                decoded = None  # Python's dictionaries look alike
            if isinstance(decoded, dict):
                return {
                    place: _to_number(value)
                    for name, place in self._names.items()
                    if (value := _get_value(decoded, name.split("."))) is not ABSENT
                }
        text, numbers = in_seconds(line), {}
        for place, pattern in self._patterns.items():
            if found := pattern.search(text):
                numbers[place] = _to_number(found[1])
                more = _MORE_DIGITS.match(text, found.end())
                if more and place in self._single and text[found.start(1) - 1] not in "[({":
                    self.ambiguous = found[1] + more[0]
        return numbers

    def cut_glued(self, line: str) -> str:
        """Return the rest of a line after a sample that breaks off; else empty."""
        for found in self._glued.finditer(line):
            one, other = (self._patterns[self._names[name]] for name in found.groups())
            rest = line[found.end() :]
            if other.search(line[: found.end()]) or one.search(rest):  # one of the names repeats
                return rest
        return ""


ABSENT: Final = object()


def _get_value(value: Any, path: list[str]) -> Any:
    """Return the value at a path of keys and indices in decoded JSON, or `ABSENT`."""
    if not path:
        return value
    if isinstance(value, list):
        at = int(path[0]) if path[0].isdecimal() else len(value)
        return _get_value(value[at], path[1:]) if at < len(value) else ABSENT
    if not isinstance(value, dict):
        return ABSENT
    for n in range(len(path), 0, -1):
        if (key := ".".join(path[:n])) in value:
            return _get_value(value[key], path[n:])
    return ABSENT


def _to_number(value: Any) -> float:
    if isinstance(value, str) and (dated := in_seconds(value)) != value:
        value = dated
    found = number(value)
    return NAN if found is None else found


def _split_index(name: str) -> tuple[str, str]:
    """Split ``a.2`` into ``a`` and ``2``; the index is empty if there is none."""
    base, _, index = name.rpartition(".")
    return (base, index) if base and index.isdecimal() else (name, "")


def _compile_name(name: str) -> re.Pattern[str]:
    base, index = _split_index(name)
    before = r"(?<![\w.])" if base[:1].isalnum() or base[:1] == "_" else ""
    value = r"[^\s,;:=\[\](){}|\"']+"
    return re.compile(
        before
        + re.escape(base)
        + _BETWEEN
        + rf"(?:{value}\s*[,;\s]\s*){{{int(index or 0)}}}({value})"
    )


def in_seconds(line: str, order: str = "") -> str:
    """Replace dates by seconds since 1970 (UTC by default), times of day since midnight.

    Args:
        order: order of 05/10/2024, ``mdy`` or ``dmy``; empty to infer it from a number over 12.
    """
    if ":" not in line:
        return line
    line = _HALF_DAY.sub(_count_hours, line) if "m" in line or "M" in line else line
    if "/" in line or "-" in line:
        line = _DAY.sub(lambda found: _put_year_first(found, order), line)
    return _CLOCK.sub(_convert_clock, _DATE.sub(_convert_date, line))


def _count_hours(found: re.Match[str]) -> str:
    hour = int(found[1]) % 12 + 12 * (found[4] in "pP")
    return f"{hour}{found[2]}{found[3] or ':00'}"


def _put_year_first(found: re.Match[str], order: str) -> str:
    first, second = int(found[1]), int(found[3])
    order = order or ("mdy" if second > 12 >= first else "dmy" if first > 12 else "")
    month, day = (first, second) if order == "mdy" else (second, first)
    return f"{found[4]}-{month:02}-{day:02} " if order else found[0]


def _convert_date(found: re.Match[str]) -> str:
    *whole, part, zone = found.groups()
    date = whole[:3] if whole[0] else whole[5:2:-1]
    try:
        year, month, day, hour, minute, second = map(int, (*date, *whole[6:8], whole[8] or 0))
        at = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return found[0]
    seconds = int(at.timestamp())
    if zone and zone != "Z":
        minutes = int(zone[1:3]) * 60 + int(zone[-2:])
        seconds -= 60 * (minutes if zone[0] == "+" else -minutes)
    return f"{seconds}.{part or 0}"


def _convert_clock(found: re.Match[str]) -> str:
    hours, minutes, seconds, part = found.groups()
    return f"{3600 * int(hours) + 60 * int(minutes) + int(seconds)}.{part or 0}"


def quote_line(line: str) -> str:
    """Return a line quoted and shortened for a message."""
    return repr(line if len(line) <= 70 else line[:67] + "...")
