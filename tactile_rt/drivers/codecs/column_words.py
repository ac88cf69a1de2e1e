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

from tactile_rt.errors import ConfigError

__all__ = ["compress_columns", "expand_columns"]

MOST: Final = 100_000  # columns of a line
_RANGE: Final = re.compile(r"\{(\d{1,6})\.\.(\d{1,6})\}")
_NUMBER: Final = re.compile(r"\d{1,6}")
_NOTHING: Final = re.compile(r"-\d+")
_LONGEST_GROUP: Final = 12  # words that are looked for as a group


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
    """The shortest list that `expand_columns` makes these words of."""
    quoted = [_quoted(word) for word in words]
    shapes = [_NUMBER.split(word) for word in quoted]
    numbers = [[int(x) for x in _NUMBER.findall(word)] for word in quoted]
    parts: list[str] = []
    at = 0
    while at < len(words):
        size, times, steps = _longest_group(shapes, numbers, at)
        if times < 2:
            parts.append(quoted[at])
            at += 1
            continue
        group = [_ranged(quoted[at + i], steps[i], times) for i in range(size)]
        text = group[0] if size == 1 else f"({','.join(group)})"
        if expand_columns(text) == tuple(words[at : at + size * times]):
            parts.append(text)
            at += size * times
        else:  # numbers of one width for a part of them
            parts.append(quoted[at])
            at += 1
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


def _longest_group(
    shapes: Sequence[list[str]], numbers: Sequence[list[int]], at: int
) -> tuple[int, int, list[list[bool]]]:
    """How many words from here make a group, how often it comes, and which numbers go up."""
    best: tuple[int, int, list[list[bool]]] = (1, 1, [])
    for size in range(1, min(_LONGEST_GROUP, (len(shapes) - at) // 2) + 1):
        steps: list[list[bool]] = []
        for i in range(at, at + size):
            up = [b - a for a, b in zip(numbers[i], numbers[i + size], strict=False)]
            if shapes[i] != shapes[i + size] or not set(up) <= {0, 1} or 1 not in up:
                break
            steps.append([u == 1 for u in up])
        if len(steps) < size:
            continue
        times = 2
        while at + (times + 1) * size <= len(shapes) and all(
            shapes[at + i + times * size] == shapes[at + i]
            and numbers[at + i + times * size]
            == [n + times * up for n, up in zip(numbers[at + i], steps[i], strict=True)]
            for i in range(size)
        ):
            times += 1
        if size * times > best[0] * best[1]:
            best = size, times, steps
    return best


def _ranged(word: str, up: list[bool], times: int) -> str:
    """The word with a range for each number that goes up."""
    goes = iter(up)

    def number(found: re.Match[str]) -> str:
        n, width = int(found[0]), len(found[0])
        return f"{{{found[0]}..{n + times - 1:0{width}d}}}" if next(goes) else found[0]

    return _NUMBER.sub(number, word)
