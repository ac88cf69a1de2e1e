"""A table of a configuration as a struct; what is wrong with it in a user's words.

msgspec finds the mistakes; here they get file, line, key and the nearest valid name.
"""

import difflib
import re
import typing
from collections.abc import Sequence
from datetime import date, time
from typing import Any

import msgspec

from tactile_rt.daemon.config import Config
from tactile_rt.daemon.config_nodes import TomlNode, named
from tactile_rt.stream import ConfigError

__all__ = ["convert_table", "is_list", "is_text", "nearest", "refusal"]

UNITS = {"_s": "seconds", "_ms": "milliseconds", "_mb": "megabytes", "_hz": "hertz"}
ALIKE = (  # units that one may take for another
    ("s", "ms", "us", "ns", "sec", "seconds", "min", "minutes", "h", "hours"),
    ("mb", "b", "kb", "gb", "mib", "gib", "bytes"),
)
WORDS = {  # of msgspec, in a user's words
    "float": "a number", "int": "a whole number", "bool": "true or false", "str": "text",
    "object": "a table", "array": "a list",
}  # fmt: skip


def convert_table(root: TomlNode, node: TomlNode, path: list[str | int], kind: Any) -> Any:
    """A table as a struct.

    Args:
        root: the whole tree, for where things are.
        node: the table.
        path: of it in the tree.
        kind: msgspec.Struct class.

    Raises:
        ConfigError: unknown key, or a value of the wrong type or range.
    """
    _check_keys(root, node, path, kind)
    try:
        return msgspec.convert(node.plain(), kind)
    except msgspec.ValidationError as error:
        message, _, at = str(error).partition(" - at `")
        steps = _steps(at.rstrip("`"))
        raise refusal(root, [*path, *steps], _said(message, node, steps, kind)) from None
    except (ConfigError, ValueError, OverflowError, RecursionError) as error:
        raise refusal(root, path, str(error)) from None


def nearest(name: str, known: Sequence[str]) -> str:
    """``did you mean X?``, or what there is."""
    near = difflib.get_close_matches(name.lower(), known, 1, 0.5)
    if near:
        return f"did you mean {near[0]}?"
    return f"there is {', '.join(known)}" if known else "there is none"


def _check_keys(root: TomlNode, node: TomlNode, path: list[str | int], kind: Any) -> None:
    """Unknown keys first: a misspelt key is the commonest mistake."""
    if not isinstance(node.value, dict):
        return
    fields = {f.encode_name: f.type for f in msgspec.structs.fields(kind)}
    for key, below in node.value.items():
        here = [*path, key]
        if key not in fields:
            owner = named(path) or "the file"
            hint = (path and _table_hint(key)) or _hint(key, list(fields))
            raise ConfigError(f"{below.where}: {owner} has no key {key!r}; {hint}")
        inner, several = _inner(fields[key])
        if inner is None:
            continue
        if several and not isinstance(below.value, list):
            raise ConfigError(
                f"{below.where}: there may be several of {named(here)}: write [[{key}]]"
            )
        if not several and isinstance(below.value, list):
            raise ConfigError(f"{below.where}: there is but one: write [{named(here)}]")
        for i, item in enumerate(below.value if several else [below]):
            at = [*here, i] if several else here
            if not isinstance(item.value, dict):
                raise ConfigError(
                    f"{item.where}: {named(at)} is a table of keys, not {item.value!r:.60}"
                )
            _check_keys(root, item, at, inner)


def _hint(key: str, known: list[str]) -> str:
    """The nearest key; one that differs in its unit alone is told with the unit."""
    for alike in ALIKE:
        found = re.search(rf"_({'|'.join(alike)})$", key.lower())
        if not found:
            continue
        for suffix in alike:
            name = f"{key.lower()[: found.start()]}_{suffix}"
            if name in known and f"_{suffix}" in UNITS:
                return f"did you mean {name}, in {UNITS[f'_{suffix}']}?"
    return nearest(key, known)


def _table_hint(key: str) -> str:
    """Where a table of the file belongs that stands in another one; empty: it is no such table."""
    kinds = {f.encode_name: f.type for f in msgspec.structs.fields(Config)}
    inner, several = _inner(kinds.get(key))
    if inner is None:
        return ""
    return f"it is a table of the file: write {f'[[{key}]]' if several else f'[{key}]'}"


def _inner(kind: Any) -> tuple[Any, bool]:
    """The struct that a key's value is, or is a list of; None: neither."""
    for part in (kind, *typing.get_args(kind)):
        if isinstance(part, type) and issubclass(part, msgspec.Struct):
            return part, typing.get_origin(kind) is tuple
    return None, False


def _kind_at(path: Sequence[str | int]) -> tuple[Any, bool]:
    """The type of what stands at a path of a configuration, and whether it is a list of tables."""
    kind: Any = Config
    for step in path:
        if isinstance(step, int):
            continue
        inner = kind if isinstance(kind, type) else _inner(kind)[0]
        if inner is None or not issubclass(inner, msgspec.Struct):
            return None, False
        kind = {f.encode_name: f.type for f in msgspec.structs.fields(inner)}.get(step)
        if kind is None:
            return None, False
        found, several = _inner(kind)
        if found is not None:
            if step == path[-1]:
                return found, several
            kind = found
    return kind, False


def is_list(path: Sequence[str | int]) -> bool:
    """Whether there is a list of tables at a path of a configuration."""
    return _kind_at(path)[1]


def is_text(path: Sequence[str | int]) -> bool:
    """Whether there is text at a path of a configuration."""
    kind = _kind_at(path)[0]
    if typing.get_origin(kind) is typing.Annotated:
        kind = typing.get_args(kind)[0]
    return kind is str or (
        typing.get_origin(kind) is typing.Literal and isinstance(typing.get_args(kind)[0], str)
    )


def _steps(at: str) -> list[str | int]:
    """``$.source[0].url`` as a path."""
    found = re.findall(r"\.([^.\[]+)|\[(\d+)\]", at.removeprefix("$"))
    return [name if name else int(number) for name, number in found]


def _said(message: str, node: TomlNode, steps: list[str | int], kind: Any) -> str:
    """What msgspec says, in a user's words."""
    missing = re.search(r"missing required field `(\w+)`", message)
    if missing:
        return f"needs a key {missing[1]!r}"
    value = node.at(steps).plain()
    leaf = _leaf(kind, steps)
    if typing.get_origin(leaf) is typing.Literal:
        choices = [str(c) for c in typing.get_args(leaf)]
        near = difflib.get_close_matches(str(value).lower(), choices, 1, 0.5)
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{_shown(value)} is not one of {', '.join(choices)}{hint}"
    if "matching regex" in message:
        return f"{_shown(value)} is no name: letters, digits, - and _, 64 at most"
    if "of length" in message:
        return "must not be empty" if value in ("", [], {}) else "is too long"
    if not message.startswith("Expected "):
        return message.replace("`", "'")
    message = message.partition(", got ")[0].replace("`", "").replace("Expected", "expected")
    message = re.sub("|".join(WORDS), lambda word: WORDS[word[0]], message)
    message += f", got {_shown(value)}"
    key = str(steps[-1]) if steps else ""
    unit = next((unit for end, unit in UNITS.items() if key.endswith(end)), "")
    return message + (f" (in {unit})" if unit else "")


def _shown(value: Any) -> str:
    if isinstance(value, date | time):
        return value.isoformat()
    return f"{value!r:.60}"


def _leaf(kind: Any, steps: list[str | int]) -> Any:
    for step in steps:
        if isinstance(step, int):
            continue
        if not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            return None
        kind = {f.encode_name: f.type for f in msgspec.structs.fields(kind)}.get(step)
        kind = _inner(kind)[0] or kind
    return kind


def refusal(root: TomlNode, path: list[str | int], why: str) -> ConfigError:
    """The error of what stands at a path."""
    node = root.at(path)
    where = node.where if node.line or node.file != root.file else root.file
    name = named(path)
    return ConfigError(f"{where}: {name}: {why}" if name else f"{where}: {why}")
