"""Conversion of a tree of settings to a typed struct, with errors in a user's words.

Goals: every error is one line with the place, the key, the value that was found and what is
allowed; a correct tree costs one call of msgspec; no wording of msgspec's reaches a user.

Plan: keys are checked first, as a misspelt key is the most frequent mistake, which msgspec would
only call unknown. Then msgspec converts the whole tree. Only if it refuses, the branches are
converted one by one to find the smallest branch that is refused by itself: its path is the place of
the error, its type defines what is allowed. This works for all that msgspec converts, including
tables under arbitrary keys and the structs' own checks, for which msgspec gives no path.
"""

import dataclasses
import difflib
import itertools
import math
import re
import types
import typing
from collections.abc import Iterable, Iterator, Sequence
from datetime import date, time
from typing import Annotated, Any, Literal

import msgspec

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.settings.tree import SettingNode, format_path

UNITS = {"_s": "seconds", "_ms": "milliseconds", "_mb": "megabytes", "_hz": "hertz"}
ALIKE = (  # units that a user may confuse
    ("s", "ms", "us", "ns", "sec", "seconds", "min", "minutes", "h", "hours"),
    ("mb", "b", "kb", "gb", "mib", "gib", "bytes"),
)
WORDS = {  # a user's words for msgspec's
    "float": "a number", "int": "a whole number", "bool": "true or false", "str": "text",
    "object": "a table", "array": "a list", "null": "nothing",
}  # fmt: skip
SEVERAL = {float: "numbers", int: "whole numbers", str: "texts", bool: "true or false"}
LISTED = 66  # characters of names that a message lists
_CONVERSION_ERRORS = (ConfigError, ValueError, OverflowError, RecursionError)  # msgspec: ValueError


def convert(
    root: SettingNode,
    kind: Any,
    path: Sequence[str | int] = (),
    *,
    top: Any = None,
    lax: bool = False,
) -> Any:
    """Convert the part of a settings tree at a path to the type `kind`.

    Args:
        top: the type of the whole tree, to recognize a table of the file that is nested wrongly;
            by default `kind` if the path is empty.
        lax: whether the values are text as written, so that ``"5"`` is a number.

    Raises:
        ConfigError: an unknown key, a value of the wrong type or range, or one that a struct's own
            check refuses; one line with place, key, what was found and what is allowed.
    """
    node, here = root.at(path), list(path)
    _check_keys(node, here, kind, top if path else kind)
    if lax:
        _check_finite(root, node, here, kind)
    try:
        return msgspec.convert(node.plain(), kind, strict=not lax)
    except _CONVERSION_ERRORS as error:
        steps, leaf, cause = _find_smallest_error(node, kind, lax) or ([], kind, error)
        whole = [*here, *steps]
        raise refusal(root, whole, _explain(cause, root.at(whole), leaf, whole)) from None


def refusal(root: SettingNode, path: Sequence[str | int], why: str) -> ConfigError:
    """Make the error about a value, from its file and line, its key, and `why`."""
    node, name = root.at(path), format_path(path)
    where = node.where if node.line or node.file != root.file else root.where
    return ConfigError(f"{where}: {name}: {why}" if name else f"{where}: {why}")


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ``did you mean X?`` for an unknown name, or a list of known names."""
    names = list(known)
    plain = {n.casefold(): n for n in names}
    near = difflib.get_close_matches(name.casefold(), plain, 1, 0.6)
    if near:
        return f"did you mean {plain[near[0]]}?"
    verb = "is" if len(names) == 1 else "are"
    ends = itertools.accumulate(len(name) + 2 for name in names)
    fitting = sum(end <= LISTED for end in ends)
    return f"there {verb} {name_some(names, max(3, fitting)) or 'none'}"


def no_such(what: str, name: str, known: Iterable[str]) -> str:
    """Return an error message: ``no recipe 'defualt'; did you mean default?``"""
    return f"no {what} {name!r}; {nearest(name, known)}"


def hint(key: str, known: Sequence[str]) -> str:
    """Suggest the known key nearest to `key`, with its unit if only the units differ."""
    for alike in ALIKE:
        found = re.search(rf"_({'|'.join(alike)})$", key.lower())
        if not found:
            continue
        for suffix in alike:
            name = f"{key.lower()[: found.start()]}_{suffix}"
            if name in known and f"_{suffix}" in UNITS:
                return f"did you mean {name}, in {UNITS[f'_{suffix}']}?"
    return nearest(key, known)


# types


def types_of(kind: Any) -> dict[str, Any]:
    """Return the types of a struct's or dataclass's keys, by their names in files."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return {f.encode_name: f.type for f in msgspec.structs.fields(kind)}
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind, include_extras=True)
        return {f.name: hints[f.name] for f in dataclasses.fields(kind) if f.init}
    return {}


def is_list(kind: Any, path: Sequence[str | int]) -> bool:
    """Return whether the type `kind` has a list of tables at a path."""
    return _find_struct(_find_kind(kind, path))[1]


def is_text(kind: Any, path: Sequence[str | int]) -> bool:
    """Return whether the type `kind` has text at a path."""
    found = _strip_type(_find_kind(kind, path))
    return found is str or (
        typing.get_origin(found) is Literal and isinstance(typing.get_args(found)[0], str)
    )


def _find_kind(kind: Any, path: Sequence[str | int]) -> Any:
    for step in path:
        if isinstance(step, int):
            continue
        inner = _find_struct(kind)[0]
        kind = types_of(inner).get(step) if inner is not None else None
    return kind


def _is_table(kind: Any) -> bool:
    return isinstance(kind, type) and (
        issubclass(kind, msgspec.Struct) or dataclasses.is_dataclass(kind)
    )


def _find_struct(kind: Any) -> tuple[Any, bool]:
    """Return a type's struct or None, and whether the type is a list of structs."""
    bare = _strip_type(kind)
    if _is_table(bare):
        return bare, False
    if typing.get_origin(bare) in (tuple, list):
        items = typing.get_args(bare)
        if items and _is_table(item := _strip_type(items[0])) and items[1:] in ((), (Ellipsis,)):
            return item, True
    return None, False


def _strip_type(kind: Any, value: Any = None) -> Any:
    """Strip annotations and None from a type; choose from a union by the value."""
    while True:
        origin = typing.get_origin(kind)
        if origin is Annotated:
            kind = typing.get_args(kind)[0]
        elif origin in (typing.Union, types.UnionType):
            choices = [c for c in typing.get_args(kind) if c is not types.NoneType]
            if len(choices) > 1:
                choices = [c for c in choices if _is_same_sort(_strip_type(c), value)]
            if len(choices) != 1:
                return kind
            (kind,) = choices
        else:
            return kind


def _is_same_sort(kind: Any, value: Any) -> bool:
    """Return whether a type and a value are both tables, both lists, or neither."""
    origin = typing.get_origin(kind)
    if isinstance(value, dict):
        return _is_table(kind) or origin is dict
    return (origin in (tuple, list)) == isinstance(value, list) and not _is_table(kind)


def _walk_values(node: SettingNode, kind: Any) -> Iterator[tuple[str | int, SettingNode, Any]]:
    """Yield (key or index, node, type) of each value in a table or list."""
    bare = _strip_type(kind, node.value)
    origin, arguments = typing.get_origin(bare), typing.get_args(bare)
    if isinstance(node.value, dict):
        fields = types_of(bare) if _is_table(bare) else {}
        for key, below in node.value.items():
            if key in fields:
                yield key, below, fields[key]
            elif origin is dict:
                yield key, below, arguments[1]
    elif isinstance(node.value, list) and origin in (tuple, list) and arguments:
        several = origin is list or arguments[1:] == (Ellipsis,)
        if several or len(arguments) == len(node.value):
            for i, below in enumerate(node.value):
                yield i, below, arguments[0 if several else i]


# errors


def _check_keys(node: SettingNode, path: list[str | int], kind: Any, top: Any) -> None:
    """Refuse unknown keys, values in place of tables, and [name] confused with [[name]]."""
    bare = _strip_type(kind, node.value)
    if _is_table(bare) and not isinstance(node.value, dict):
        name = format_path(path) or "the file"
        raise ConfigError(
            f"{node.where}: {name} is a table of keys, not {format_value(node.plain())}"
        )
    fields = types_of(bare) if _is_table(bare) else {}
    for key, below in node.value.items() if fields or _is_table(bare) else ():
        if key not in fields:
            owner = format_path(path) or "the file"
            advice = (path and _table_hint(key, top)) or hint(key, list(fields))
            raise ConfigError(f"{below.where}: {owner} has no key {key!r}; {advice}")
        inner, several = _find_struct(fields[key])
        if inner is not None and several and not isinstance(below.value, list):
            name = format_path([*path, key])
            raise ConfigError(f"{below.where}: there may be several of {name}: write [[{key}]]")
        if inner is not None and not several and isinstance(below.value, list):
            name = format_path([*path, key])
            raise ConfigError(f"{below.where}: only one is allowed: write [{name}]")
    for step, below, inner in _walk_values(node, kind):
        _check_keys(below, [*path, step], inner, top)


def _table_hint(key: str, top: Any) -> str:
    """Return a hint where a wrongly nested table belongs, or empty text for other keys."""
    inner, several = _find_struct(types_of(top).get(key)) if top is not None else (None, False)
    if inner is None:
        return ""
    return f"it is a table of the file: write {f'[[{key}]]' if several else f'[{key}]'}"


def _check_finite(root: SettingNode, node: SettingNode, path: list[str | int], kind: Any) -> None:
    """Refuse text such as nan or inf for a number. `parse_toml` refuses it in TOML."""
    for step, below, inner in _walk_values(node, kind):
        _check_finite(root, below, [*path, step], inner)
    if _strip_type(kind, node.value) is float and isinstance(node.value, str):
        try:
            number = float(node.value)
        except ValueError:
            return  # the conversion reports it with what is allowed
        if not math.isfinite(number):
            raise refusal(root, path, f"{number} is not a finite number")


def _find_smallest_error(
    node: SettingNode, kind: Any, lax: bool
) -> tuple[list[str | int], Any, Exception] | None:
    """Return (path, type, error) of the smallest branch that cannot be converted, or None."""
    for step, below, inner in _walk_values(node, kind):
        found = _find_smallest_error(below, inner, lax)
        if found is not None:
            return [step, *found[0]], found[1], found[2]
    try:
        msgspec.convert(node.plain(), kind, strict=not lax)
    except _CONVERSION_ERRORS as error:
        return [], kind, error
    return None


def _explain(error: Exception, node: SettingNode, kind: Any, path: Sequence[str | int]) -> str:
    """Translate msgspec's error on a branch into a message for the user."""
    message = str(error)
    if not isinstance(error, msgspec.ValidationError):
        return message
    message = message.partition(" - at `")[0]
    missing = re.search(r"missing required field `(.+)`", message)
    if missing:
        return f"needs a key {missing[1]!r}"
    value = node.plain()
    bare = _strip_type(kind, value)
    if typing.get_origin(bare) is Literal:
        choices = [str(c) for c in typing.get_args(bare)]
        near = difflib.get_close_matches(str(value).lower(), choices, 1, 0.6)
        ask = f"; did you mean {near[0]}?" if near else ""
        return f"{format_value(value)} is not one of {', '.join(choices)}{ask}"
    if "matching regex" in message:
        return f"{format_value(value)} is no {_describe_text(kind)}"
    if message.startswith("Expected `array`") and (expected := _describe_list(bare)):
        return f"expected {expected}, got {format_value(value)}"
    if "of length" in message:
        return "must not be empty" if value in ("", [], {}) else "is too long"
    if not message.startswith("Expected "):
        return message.replace("`", "'")
    message = message.partition(", got ")[0].replace(" | null", "").replace(" | ", " or ")
    message = message.replace("`", "").replace("Expected", "expected")
    message = re.sub(rf"\b({'|'.join(WORDS)})\b", lambda word: WORDS[word[0]], message)
    key = str(path[-1]) if path else ""
    unit = next((unit for end, unit in UNITS.items() if key.endswith(end)), "")
    return f"{message}, got {format_value(value)}" + (f" (in {unit})" if unit else "")


def _describe_text(kind: Any) -> str:
    """Return the description of a text type that has a pattern."""
    for note in typing.get_args(kind)[1:] if typing.get_origin(kind) is Annotated else ():
        if isinstance(note, msgspec.Meta) and note.description:
            return note.description
    return "such text"


def _describe_list(kind: Any) -> str:
    """Return ``a list of 3 numbers`` for a list of fixed length, else empty text."""
    items = typing.get_args(kind)
    if typing.get_origin(kind) is not tuple or items[1:] == (Ellipsis,):
        return ""
    alike = SEVERAL.get(items[0], "values") if len(set(items)) == 1 else "values"
    return f"a list of {len(items)} {alike}"


def format_value(value: Any) -> str:
    """Format a value for a message: at most 60 characters, without line breaks."""
    if isinstance(value, date | time):
        return value.isoformat()
    return f"{value!r:.60}"
