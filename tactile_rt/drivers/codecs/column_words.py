"""Lists of column words, with short forms for groups of columns.

time:s,A0.fx,A0.fy                        three columns
T{0..15}.pressure                         sixteen: T0.pressure, T1.pressure, ...
(M{0..4}.bx:uT,M{0..4}.by:uT)             ten: M0.bx, M0.by, M1.bx, M1.by, ...
p{0..35}_x=T{0..35}.fx:N                  by names; the ranges of a group advance together
c{00..15}=T{0..15}.raw                    c00, c01, ...
-{1..9}                                   nine ignored columns
"Force, x"=A0.fx                          a name that contains a comma
"""

import re
from collections.abc import Iterator, Sequence
from typing import Final

from tactile_rt.core.errors import ConfigError

MOST: Final = 100_000  # columns of a line
_RANGE: Final = re.compile(r"\{(\d{1,6})\.\.(\d{1,6})\}")
_NUMBER: Final = re.compile(r"\d{1,6}")
_NOTHING: Final = re.compile(r"-\d+")


def expand_columns(text: str, where: str = "columns") -> tuple[str, ...]:
    """Expand a list of columns into one word for each column.

    Raises:
        ConfigError: a quote or parenthesis is not closed, ranges of a group differ in length, or
            the columns are too many.
    """
    found: list[str] = []
    for item in _split(text, where):
        words = [item]
        if item.startswith("(") and item.endswith(")") and "{" in item:
            words = list(_split(item[1:-1], where))
        ranges = [(int(a), int(b)) for word in words for a, b in _RANGE.findall(word)]
        lengths = {abs(b - a) + 1 for a, b in ranges} or {1}
        if len(lengths) > 1:
            each = ", ".join(map(str, sorted(lengths)))
            raise ConfigError(f"{where}: the ranges in {item!r} are of different lengths: {each}")
        (n,) = lengths
        if len(found) + n * len(words) > MOST:
            raise ConfigError(f"{where}: more than {MOST} columns")
        for k in range(n):
            found += [_NOTHING.sub("-", _expand(word, k)) if word[:1] == "-" else _expand(word, k)
                      for word in words]  # fmt: skip
    return tuple(found)


def compress_columns(words: Sequence[str]) -> str:
    """Join words to one text for `expand_columns`; words that count up become ranges."""
    quoted = [_quote(word) for word in words]
    parts: list[str] = []
    at = 0
    while at < len(quoted):
        n = 1
        while at + n < len(quoted) and _counts_up(quoted[at], quoted[at + n], n):
            n += 1
        text = _write_range(quoted[at], quoted[at + n - 1], n)
        if expand_columns(text) != tuple(words[at : at + n]):  # for example numbers of one width
            text, n = quoted[at], 1
        parts.append(text)
        at += n
    return ",".join(parts)


def _split(text: str, where: str) -> Iterator[str]:
    """Split a text at commas, except in quotes and in parentheses that contain a range."""
    item, quoted, depth = "", False, 0
    for at, c in enumerate(text):
        if c == '"':
            quoted = not quoted
        elif not quoted and c == "(" and not item.strip() and "{" in text[at:]:
            depth += 1
        elif not quoted and c == ")" and depth:
            depth -= 1
        if c == "," and not quoted and not depth:
            yield _unquote(item)
            item = ""
        else:
            item += c
    if quoted or depth:
        raise ConfigError(f"{where}: {'a quote' if quoted else 'a parenthesis'} is not closed")
    yield _unquote(item)


def _unquote(item: str) -> str:
    item = item.strip()
    return item if item.startswith("(") else item.replace('"', "")


def _quote(word: str) -> str:
    name, named, column = word.rpartition("=")
    return f'"{name}"={column}' if named and ("," in name or name[:1] == "(") else word


def _expand(word: str, k: int) -> str:
    """Replace each range in a word by its k-th number, counted from 0."""

    def number(found: re.Match[str]) -> str:
        first, last = int(found[1]), int(found[2])
        width = len(found[1]) if found[1][0] == "0" else 0
        return f"{first + k if last >= first else first - k:0{width}d}"

    return _RANGE.sub(number, word)


def _counts_up(first: str, other: str, n: int) -> bool:
    """Return whether the other word differs only in numbers that are n larger."""
    steps = {
        int(b) - int(a)
        for a, b in zip(_NUMBER.findall(first), _NUMBER.findall(other), strict=False)
    }
    return _NUMBER.split(first) == _NUMBER.split(other) and n in steps and steps <= {0, n}


def _write_range(first: str, last: str, n: int) -> str:
    """Return the first word, with ranges for numbers that differ in the last word."""
    if n == 1:
        return first
    ends = iter(_NUMBER.findall(last))

    def number(found: re.Match[str]) -> str:
        end = next(ends)
        return found[0] if end == found[0] else f"{{{found[0]}..{end}}}"

    return _NUMBER.sub(number, first)
