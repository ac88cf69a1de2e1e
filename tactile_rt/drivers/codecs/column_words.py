"""Columns in words: a list of them, in which a group stands for many.

time:s,A0.fx,A0.fy                        three columns
T{0..15}.pressure                         sixteen: T0.pressure, T1.pressure, ...
(M{0..4}.bx:uT,M{0..4}.by:uT)             ten: M0.bx, M0.by, M1.bx, M1.by, ...
p{0..35}_x=T{0..35}.fx:N                  by names; ranges of a group go in step
c{00..15}=T{0..15}.raw                    c00, c01, ...
-{1..9}                                   nine of no interest
"Force, x"=A0.fx                          a name that holds a comma
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
    """The columns of a list, one word each.

    Raises:
        ConfigError: a quote or parenthesis that is not closed, ranges of a group that are not of
            one length, or too many columns.
    """
    found: list[str] = []
    for item in _split(text, where):
        words = [item]
        if item.startswith("(") and item.endswith(")") and "{" in item:
            words = list(_split(item[1:-1], where))
        ranges = [(int(a), int(b)) for word in words for a, b in _RANGE.findall(word)]
        lengths = {abs(b - a) + 1 for a, b in ranges} or {1}
        if len(lengths) > 1:
            told = ", ".join(map(str, sorted(lengths)))
            raise ConfigError(f"{where}: the ranges in {item!r} are of different lengths: {told}")
        (n,) = lengths
        if len(found) + n * len(words) > MOST:
            raise ConfigError(f"{where}: more than {MOST} columns")
        for k in range(n):
            found += [_NOTHING.sub("-", _at(word, k)) if word[:1] == "-" else _at(word, k)
                      for word in words]  # fmt: skip
    return tuple(found)


def compress_columns(words: Sequence[str]) -> str:
    """Write words as a list for `expand_columns`, with a range for words that count up."""
    quoted = [_quoted(word) for word in words]
    parts: list[str] = []
    at = 0
    while at < len(quoted):
        n = 1
        while at + n < len(quoted) and _counts_up(quoted[at], quoted[at + n], n):
            n += 1
        text = _ranged(quoted[at], quoted[at + n - 1], n)
        if expand_columns(text) != tuple(words[at : at + n]):  # of numbers of one width, say
            text, n = quoted[at], 1
        parts.append(text)
        at += n
    return ",".join(parts)


def _split(text: str, where: str) -> Iterator[str]:
    """The items between commas, but for commas in quotes and parentheses that hold a range."""
    item, quoted, depth = "", False, 0
    for at, c in enumerate(text):
        if c == '"':
            quoted = not quoted
        elif not quoted and c == "(" and not item.strip() and "{" in text[at:]:
            depth += 1
        elif not quoted and c == ")" and depth:
            depth -= 1
        if c == "," and not quoted and not depth:
            yield _plain(item)
            item = ""
        else:
            item += c
    if quoted or depth:
        raise ConfigError(f"{where}: {'a quote' if quoted else 'a parenthesis'} is not closed")
    yield _plain(item)


def _plain(item: str) -> str:
    item = item.strip()
    return item if item.startswith("(") else item.replace('"', "")


def _quoted(word: str) -> str:
    name, named, column = word.rpartition("=")
    return f'"{name}"={column}' if named and ("," in name or name[:1] == "(") else word


def _at(word: str, k: int) -> str:
    """The k-th of the words that a range stands for."""

    def number(found: re.Match[str]) -> str:
        first, last = int(found[1]), int(found[2])
        width = len(found[1]) if found[1][0] == "0" else 0
        return f"{first + k if last >= first else first - k:0{width}d}"

    return _RANGE.sub(number, word)


def _counts_up(first: str, other: str, n: int) -> bool:
    """Return whether numbers of the other are n more, or the same."""
    steps = {
        int(b) - int(a)
        for a, b in zip(_NUMBER.findall(first), _NUMBER.findall(other), strict=False)
    }
    return _NUMBER.split(first) == _NUMBER.split(other) and n in steps and steps <= {0, n}


def _ranged(first: str, last: str, n: int) -> str:
    """Write the first word with a range for each number that differs in the last."""
    if n == 1:
        return first
    ends = iter(_NUMBER.findall(last))

    def number(found: re.Match[str]) -> str:
        end = next(ends)
        return found[0] if end == found[0] else f"{{{found[0]}..{end}}}"

    return _NUMBER.sub(number, first)
