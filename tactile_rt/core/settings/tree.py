"""Settings as a tree in which every value has the file and line that it came from.

`tomllib` gives values but not their lines, so `find_lines` parses a valid document a second time,
statement by statement.
"""

import os
import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_rt.core.errors import ConfigError

LARGEST = 1 << 26  # bytes of a file that a person or a program writes
# Strings and comments, in which brackets and line ends have no meaning; brackets and line ends.
TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?"""(?!")|"(?:\\.|[^"\\])*"'
    r"|'''.*?'''(?!')|'[^']*'|#[^\n]*|[][{}\n]",
    re.DOTALL,
)
INT64 = 2**63


@dataclass
class SettingNode:
    """Node of a settings tree: a value, and the file and line it came from.

    Attributes:
        value: The value; for a table a dict of nodes, for a list a list of nodes.
        file: The file as the user named it, ``--set ...``, or the URL that has the option.
        line: The line of the file, counted from 1; 0 if the value is not from a file.
        folder: The folder to which paths in the file are relative.
    """

    value: Any
    file: str
    line: int
    folder: Path

    @property
    def where(self) -> str:
        """File and line for a message, ``FILE:LINE``."""
        return f"{self.file}:{self.line}" if self.line else self.file

    def plain(self) -> Any:
        """Return the value with plain dicts and lists instead of nodes."""
        if isinstance(self.value, dict):
            return {key: node.plain() for key, node in self.value.items()}
        if isinstance(self.value, list):
            return [node.plain() for node in self.value]
        return self.value

    def at(self, path: Sequence[str | int]) -> "SettingNode":
        """Return the node at a path, or the last existing node on the way."""
        node = self
        for step in path:
            try:
                node = node.value[step]
            except (KeyError, IndexError, TypeError):
                break
        return node

    def walk(self, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
        """Yield (path, node) of this node and of all nodes below it."""
        yield path, self
        if isinstance(self.value, dict):
            for key, node in self.value.items():
                yield from node.walk((*path, key))
        elif isinstance(self.value, list):
            for i, node in enumerate(self.value):
                yield from node.walk((*path, i))


def format_path(path: Sequence[str | int]) -> str:
    """Format a path for a message: ``source[0].url``."""
    return "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in path).lstrip(".")


def make_node(value: Any, file: str, line: int, folder: Path) -> SettingNode:
    """Make a settings tree of a plain value. All nodes get the same file and line."""
    return _build(value, (), {(): line}, file, folder, line)


def read_text(path: Path, largest: int = LARGEST) -> str:
    """Read a UTF-8 text file; drop its byte order mark.

    Args:
        largest: largest size of the file, bytes.

    Raises:
        ConfigError: missing, not readable, too large, or not UTF-8; names file and line.
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
    if data.startswith(b"\x89MCAP"):
        raise ConfigError(f"{path} is a recording, no text: --source takes it as replay:{path}")
    if len(data) > largest:
        raise ConfigError(f"{path}: larger than {largest >> 20} MB: too large for such a file")
    try:
        return data.decode().removeprefix("\ufeff")  # some editors write this mark first
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ConfigError(f"{path}:{line}: not UTF-8 text") from None


def read_toml(path: Path, largest: int = LARGEST) -> SettingNode:
    """Read a TOML file into a settings tree."""
    folder = Path(os.path.abspath(path)).parent
    return parse_toml(read_text(path, largest), str(path), folder)


def parse_toml(text: str, where: str, folder: Path = Path()) -> SettingNode:
    """Parse a TOML document into a settings tree.

    Args:
        folder: the folder to which paths in the document are relative.

    Raises:
        ConfigError: not TOML, or a number that is not finite or exceeds 64 bits; names the line.
    """
    try:
        parsed = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(_describe_syntax_error(where, str(error), text)) from None
    except (RecursionError, ValueError):  # deeply nested lists; a number of 10,000 digits
        raise ConfigError(f"{where}: nested too deeply, or a number too long") from None
    return _build(parsed, (), find_lines(text), where, folder, 0)


def plain_value(written: str) -> Any:
    """Parse a TOML value. Return other text unchanged, so that it needs no quotes."""
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
    where = f"{node.where}: {format_path(path)}" if path else node.where
    if isinstance(value, float) and (value != value or value in (float("inf"), -float("inf"))):
        raise ConfigError(f"{where}: {value} is not a finite number")
    if isinstance(value, int) and not -INT64 <= value < INT64:
        raise ConfigError(f"{where}: more than 64 bits")
    return node


def _describe_syntax_error(path: str, message: str, text: str) -> str:
    found = re.search(r" \(at line (\d+), column (\d+)\)$", message)
    if found:
        return f"{path}:{found[1]}: not TOML: {message[: found.start()]} (column {found[2]})"
    if message.endswith(" (at end of document)"):
        return f"{path}:{text.count(chr(10)) + 1}: not TOML: {message.removesuffix(')')[:-20]}"
    return f"{path}: not TOML: {message}"


# lines of keys


def find_lines(text: str) -> dict[tuple[str | int, ...], int]:
    """Return the line of each key and header of a valid TOML document, by path.

    Values inside brackets get the line of their key.
    """
    text += "\n"
    lines: dict[tuple[str | int, ...], int] = {}
    counts: dict[tuple[str | int, ...], int] = {}
    table: tuple[str | int, ...] = ()
    begin, depth, next_line = 0, 0, 1
    for token in TOKEN.finditer(text):
        depth += (token[0] in "[{") - (token[0] in "]}")
        if token[0] != "\n" or depth:
            continue
        statement, line = text[begin : token.end()], next_line
        begin, next_line = token.end(), line + statement.count("\n")
        keys, below = list[str](), tomllib.loads(statement)
        while isinstance(below, dict) and len(below) == 1:
            ((key, below),) = below.items()
            keys.append(key)
        if statement.lstrip().startswith("["):
            table = ()
            for key in keys:
                table = (*table, counts[table]) if table in counts else table
                table = (*table, key)
            if isinstance(below, list):  # [[table in a list]]
                counts[table] = counts.get(table, -1) + 1
                lines.setdefault(table, line)
                table = (*table, counts[table])
            lines.setdefault(table, line)
        else:
            for n in range(1, len(keys) + 1):
                lines.setdefault((*table, *keys[:n]), line)
    return lines
