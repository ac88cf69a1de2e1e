"""What was written, as a tree in which every value knows the file and the line that it came from.

`tomllib` tells values but not where they stand, so the lines are found beside it: `find_lines`
reads the text a second time, line by line. It looks at no values, only at headers, keys, and
whether a line ends within a string or within brackets; the document is known to be valid by then.
"""

import os
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_rt.errors import ConfigError

__all__ = [
    "SettingNode",
    "find_lines",
    "make_node",
    "named",
    "parse_toml",
    "plain_value",
    "read_text",
    "read_toml",
]

LARGEST = 1 << 26  # bytes of a file that people write, or have a program write for them
BARE = re.compile(r"[A-Za-z0-9_-]+")
INT64 = 2**63


@dataclass
class SettingNode:
    """A value, and where it was written.

    Attributes:
        value: The value; of a table a dict of nodes, of a list a list of nodes.
        file: The file as the user named it, ``--set ...``, or the URL whose options these are.
        line: The line of the file, counted from 1; 0 where there are no lines.
        folder: The folder that relative paths in the file are meant from.
    """

    value: Any
    file: str
    line: int
    folder: Path

    @property
    def where(self) -> str:
        """For a message."""
        return f"{self.file}:{self.line}" if self.line else self.file

    def plain(self) -> Any:
        """Without the nodes."""
        if isinstance(self.value, dict):
            return {key: node.plain() for key, node in self.value.items()}
        if isinstance(self.value, list):
            return [node.plain() for node in self.value]
        return self.value

    def at(self, path: Sequence[str | int]) -> "SettingNode":
        """The node at a path, or the last one there is on the way."""
        node = self
        for step in path:
            try:
                node = node.value[step]
            except (KeyError, IndexError, TypeError):
                break
        return node

    def walk(self, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
        """(path, node) of this and all below."""
        yield path, self
        if isinstance(self.value, dict):
            for key, node in self.value.items():
                yield from node.walk((*path, key))
        elif isinstance(self.value, list):
            for i, node in enumerate(self.value):
                yield from node.walk((*path, i))


def named(path: Sequence[str | int]) -> str:
    """A path as in a message: ``source[0].url``."""
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def make_node(value: Any, file: str, line: int, folder: Path) -> SettingNode:
    """Nodes of a plain value, all of one line."""
    return _build(value, (), {(): line}, file, folder, line)


def read_text(path: Path, largest: int = LARGEST) -> str:
    """The text of a file that a user names, without a byte order mark.

    Args:
        path: of the file.
        largest: number of bytes that it may have.

    Raises:
        ConfigError: not there, not readable, too large, or not UTF-8; names file and line.
    """
    try:
        with path.open("rb") as file:
            data = file.read(largest + 1)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # a zero byte in the name
        raise ConfigError(f"{str(path)!r}: cannot be read: {error}") from None
    if len(data) > largest:
        raise ConfigError(f"{path}: larger than {largest >> 20} MB: not such a file")
    try:
        return data.decode().removeprefix("\ufeff")  # which some editors write before the text
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ConfigError(f"{path}:{line}: not UTF-8 text") from None


def read_toml(path: Path, largest: int = LARGEST) -> SettingNode:
    """Read a TOML file.

    Args:
        path: of the file.
        largest: number of bytes that it may have.

    Raises:
        ConfigError: as `read_text` and `parse_toml`.
    """
    folder = Path(os.path.abspath(path)).parent
    return parse_toml(read_text(path, largest), str(path), folder)


def parse_toml(text: str, where: str, folder: Path = Path()) -> SettingNode:
    """A TOML document as a tree.

    Args:
        text: the document.
        where: it comes from, for messages.
        folder: what relative paths in it are meant from.

    Raises:
        ConfigError: not TOML, or a number that no key can mean; names the line.
    """
    try:
        parsed = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(_syntax(where, str(error), text)) from None
    except (RecursionError, ValueError):  # lists in lists in lists; a number of 10,000 digits
        raise ConfigError(f"{where}: nested too deeply, or a number too long") from None
    return _build(parsed, (), find_lines(text), where, folder, 0)


def plain_value(written: str) -> Any:
    """A TOML value, or else text, so that it need not be quoted twice."""
    try:
        return tomllib.loads(f"value = {written}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError, ValueError):
        return written


def _build(
    value: Any,
    path: tuple[str | int, ...],
    lines: dict[tuple[str | int, ...], int],
    file: str,
    folder: Path,
    line: int,
) -> SettingNode:
    line = lines.get(path, line)
    made: Any = value
    if isinstance(value, dict):
        made = {k: _build(v, (*path, k), lines, file, folder, line) for k, v in value.items()}
    elif isinstance(value, list):
        made = [_build(v, (*path, i), lines, file, folder, line) for i, v in enumerate(value)]
    node = SettingNode(made, file, line, folder)
    where = f"{node.where}: {named(path)}" if path else node.where
    if isinstance(value, float) and (value != value or value in (float("inf"), -float("inf"))):
        raise ConfigError(f"{where}: {value} is no quantity")
    if isinstance(value, int) and not -INT64 <= value < INT64:
        raise ConfigError(f"{where}: more than 64 bits")
    return node


def _syntax(path: str, message: str, text: str) -> str:
    found = re.search(r" \(at line (\d+), column (\d+)\)$", message)
    if found:
        return f"{path}:{found[1]}: not TOML: {message[: found.start()]} (column {found[2]})"
    if message.endswith(" (at end of document)"):
        return f"{path}:{text.count(chr(10)) + 1}: not TOML: {message.removesuffix(')')[:-20]}"
    return f"{path}: not TOML: {message}"


# where a key stands


def find_lines(text: str) -> dict[tuple[str | int, ...], int]:
    """Line of every key and header of a valid TOML document, by path; values in brackets have the
    line of the key before them."""
    lines: dict[tuple[str | int, ...], int] = {}
    counts: dict[tuple[str | int, ...], int] = {}
    table: tuple[str | int, ...] = ()
    state = _Within()
    for number, line in enumerate(text.split("\n"), 1):
        if state.open:
            state.scan(line)
            continue
        bare = line.strip()
        if not bare or bare.startswith("#"):
            continue
        if bare.startswith("["):
            several = bare.startswith("[[")
            keys, _ = _keys(bare[2 if several else 1 :])
            table = _resolve((), keys[:-1], counts)
            table = (*table, keys[-1]) if keys else table
            if several:
                counts[table] = counts.get(table, -1) + 1
                lines.setdefault(table, number)
                table = (*table, counts[table])
            elif table in counts:
                table = (*table, counts[table])
            lines.setdefault(table, number)
            continue
        keys, rest = _keys(bare)
        for n in range(1, len(keys) + 1):
            lines.setdefault((*table, *keys[:n]), number)
        state.scan(rest)
    return lines


def _resolve(
    path: tuple[str | int, ...], keys: list[str], counts: dict[tuple[str | int, ...], int]
) -> tuple[str | int, ...]:
    for key in keys:
        path = (*path, key)
        if path in counts:
            path = (*path, counts[path])
    return path


def _keys(text: str) -> tuple[list[str], str]:
    """A dotted key at the beginning of a text, and what follows it."""
    keys: list[str] = []
    while True:
        text = text.lstrip()
        if text[:1] in ('"', "'"):
            end = _string_end(text, 1, text[0])
            try:
                keys.append(str(tomllib.loads(f"k = {text[:end]}")["k"]))
            except tomllib.TOMLDecodeError:
                keys.append(text[1 : end - 1])
            text = text[end:]
        else:
            found = BARE.match(text)
            if not found:
                return keys, text
            keys.append(found[0])
            text = text[found.end() :]
        text = text.lstrip()
        if not text.startswith("."):
            return keys, text
        text = text[1:]


def _string_end(text: str, at: int, quote: str) -> int:
    """Where a string that began before `at` ends; the text's end if it does not."""
    while at < len(text):
        if quote[0] == '"' and text[at] == "\\":
            at += 2
        elif text.startswith(quote, at):
            return at + len(quote)
        else:
            at += 1
    return len(text) + 1


class _Within:
    """Whether a line ends within brackets or a string of several lines."""

    def __init__(self) -> None:
        self._depth, self._quote = 0, ""

    @property
    def open(self) -> bool:
        return bool(self._depth or self._quote)

    def scan(self, text: str) -> None:
        at = 0
        if self._quote:
            at = _string_end(text, 0, self._quote)
            if at > len(text):
                return
            self._quote = ""
        while at < len(text):
            c = text[at]
            if c == "#":
                return
            if c in "[{":
                self._depth += 1
            elif c in "]}":
                self._depth = max(0, self._depth - 1)
            elif c in "\"'":
                quote = 3 * c if text.startswith(3 * c, at) else c
                at = _string_end(text, at + len(quote), quote)
                if at > len(text) and len(quote) == 3:
                    self._quote = quote
                continue
            at += 1
