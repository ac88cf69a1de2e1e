"""Calibrations at rest: one TOML file per device, which people read and mend.

    $XDG_CONFIG_HOME/tactile_rt/calibration/DEVICE.toml     (~/.config if that is not set)

A file is written whole or not at all. It carries a version; one of another version is refused.
"""

import json
import os
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.calibration.correction import Calibration, check_device, nearest
from tactile_rt.calibration.mirroring import Mirror
from tactile_rt.files import write_whole
from tactile_rt.stream import ConfigError

__all__ = ["calibration_path", "load_calibration", "save_calibration"]

Row = tuple[float, ...]

VERSION = 1
BARE = re.compile(r"[A-Za-z0-9_-]+")


class _Raw(msgspec.Struct, forbid_unknown_fields=True):
    elements: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]


class _Output(msgspec.Struct, forbid_unknown_fields=True):
    channels: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


class _Mirror(msgspec.Struct, forbid_unknown_fields=True):
    axis: str = "x"
    element_axis: str = "z"
    signs: dict[str, int] = {}


class _File(msgspec.Struct, forbid_unknown_fields=True):
    version: int
    device: str
    raw: _Raw
    output: _Output = msgspec.field(default_factory=_Output)
    history: tuple[str, ...] = ()
    gain: tuple[float, ...] = ()
    tare: dict[str, Any] = {}  # rows by element: see `_rows`
    noise: dict[str, Any] = {}
    matrix: dict[str, Any] = {}
    mapping: dict[str, str] = {}
    mirror: _Mirror | None = None


KEYS = {"": _File, "$.raw": _Raw, "$.output": _Output, "$.mirror": _Mirror}


def calibration_path(device: str) -> Path:
    """Where the calibration of a device is kept unless one says otherwise.

    Raises:
        ConfigError: no id that could name a file.
    """
    check_device(device)
    return _folder() / f"{device}.toml"


def load_calibration(which: str | Path) -> Calibration:
    """Read the calibration of a device by its id, or from a file.

    Args:
        which: a path if it ends in ``.toml`` or has a folder in it; else a device's id.

    Raises:
        ConfigError: there is none, or what is wrong with it: file, key, sizes.
    """
    named = str(which)
    path = Path(which)
    if not (isinstance(which, Path) or path.suffix == ".toml" or os.sep in named):
        path = calibration_path(named)
        if not path.is_file():
            there = sorted(p.stem for p in _folder().glob("[!.]*.toml"))
            raise ConfigError(
                f"no calibration of device {named!r} in {_folder()}; {nearest(named, there)}"
            )
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; save it as UTF-8") from None
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        return _parsed(text)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def save_calibration(calibration: Calibration, path: Path | None = None) -> Path:
    """Write it where `load_calibration` finds it, or to a file of your own.

    Returns:
        The file.

    Raises:
        ConfigError: the folder of `path` is not there.
        OSError: it cannot be written.
    """
    if path is None:
        path = calibration_path(calibration.device)
        path.parent.mkdir(parents=True, exist_ok=True)
    elif not path.parent.is_dir():
        raise ConfigError(f"no folder {path.parent} to write {path.name} in")
    text = _written(calibration).encode()
    write_whole(path, lambda file: file.write(text))
    return path


def _folder() -> Path:
    configured = os.environ.get("XDG_CONFIG_HOME", "")
    # The specification has relative paths ignored.
    home = Path(configured) if os.path.isabs(configured) else Path.home() / ".config"
    return home / "tactile_rt" / "calibration"


def _parsed(text: str) -> Calibration:
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"is not TOML: {error}") from None
    if raw.get("version") != VERSION:
        raise ConfigError(
            f"is a calibration of version {raw.get('version')!r}; this release reads {VERSION}"
        )
    try:
        file = msgspec.convert(raw, _File)
    except msgspec.ValidationError as error:
        raise ConfigError(_explained(str(error))) from None
    return Calibration(
        device=file.device,
        elements=file.raw.elements,
        channels=file.raw.channels,
        units=file.raw.units,
        output_channels=file.output.channels,
        output_units=file.output.units,
        gain=file.gain,
        tare=_rows("tare", file.tare, Row),
        noise=_rows("noise", file.noise, Row),
        matrices=_rows("matrix", file.matrix, tuple[Row, ...]),
        mapping=file.mapping,
        mirror=Mirror(**msgspec.structs.asdict(file.mirror)) if file.mirror else None,
        history=file.history,
    )


def _rows(what: str, table: dict[str, Any], kind: Any) -> dict[str, Any]:
    """The entries of a table, each converted alone so that a message can name it."""
    made = {}
    for element, value in table.items():
        try:
            made[element] = msgspec.convert(value, kind)
        except msgspec.ValidationError as error:
            key = f"{what}.{element}"
            where, _, at = str(error).partition(" - at `$")
            raise ConfigError(f"{key}{at.strip('`')}: {where}") from None
    return made


def _explained(message: str) -> str:
    """A message of msgspec in the words of the file."""
    what, _, where = message.partition(" - at ")
    key = where.strip("`")
    if unknown := re.search(r"unknown field `(.*?)`", what):
        names = KEYS[key].__struct_fields__
        table = key.removeprefix("$.") + "." if key else ""
        return f"no key {table}{unknown[1]}; {nearest(unknown[1], names)}"
    if missing := re.search(r"required field `(.*?)`", what):
        table = key.removeprefix("$.") + "." if key else ""
        return f"{table}{missing[1]} is missing"
    return f"{key.removeprefix('$.')}: {what}" if key else what


def _written(c: Calibration) -> str:
    channels, units = c.output
    lines = [
        f"# Calibration of the tactile sensor {c.device}, for tactile-rt.",
        "# Of every element: output = matrix @ (raw - tare); then mapped, then mirrored.",
        f"version = {VERSION}",
        f"device = {_text(c.device)}",
        "history = [",
        *(f"  {_text(line)}," for line in c.history),
        "]",
        "",
        "[raw]  # what the device sends; a unit of 1 are counts",
        f"elements = {_texts(c.elements)}",
        f"channels = {_texts(c.channels)}",
        f"units = {_texts(c.units)}",
        "",
        "[output]  # what programs get; what is left out is as in [raw]",
    ]
    if c.output_channels:
        lines.append(f"channels = {_texts(c.output_channels)}")
    if c.output_units:
        lines.append(f"units = {_texts(c.output_units)}")
    if c.mapping:
        lines += ["", "[mapping]  # output element = raw element, in the order of the output"]
        lines += [f"{_key(new)} = {_text(old)}" for new, old in c.mapping.items()]
    for what, rows, meaning in (
        ("tare", c.tare, "raw reading at no load"),
        ("noise", c.noise, "standard deviation of the raw reading at no load"),
    ):
        if rows:
            lines += ["", f"[{what}]  # {meaning}: {_listed(c.channels)}"]
            lines += [f"{_key(element)} = {_numbers(row)}" for element, row in rows.items()]
    if c.matrices:
        lines += ["", "[matrix]  # a row per output channel: output unit per raw unit"]
    for element, matrix in c.matrices.items():
        rows_of = zip(channels, units, matrix, strict=True)
        lines += [
            f"{_key(element)} = [  # columns: {_listed(c.channels)}",
            *(f"  {_numbers(row)},  # {_listed((name, unit))}" for name, unit, row in rows_of),
            "]",
        ]
    if c.mirror:
        lines += [
            "",
            "[mirror]  # reflect the mount frame's axis, flip the element frame's",
            f"axis = {_text(c.mirror.axis)}",
            f"element_axis = {_text(c.mirror.element_axis)}",
        ]
        if c.mirror.signs:
            lines += ["[mirror.signs]  # of channels whose name and unit do not tell"]
            lines += [f"{_key(channel)} = {sign}" for channel, sign in c.mirror.signs.items()]
    if c.gain:
        gain = f"gain = {_numbers(c.gain)}  # of elements without a matrix: {_listed(c.channels)}"
        lines.insert(lines.index("history = ["), gain)
    return "\n".join(lines) + "\n"


def _text(value: str) -> str:
    # JSON's strings are TOML's, but for the one control character that JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _texts(values: Iterable[str]) -> str:
    return f"[{', '.join(map(_text, values))}]"


def _listed(names: Iterable[str]) -> str:
    # for a comment: a device that describes itself may have a line's end in a name
    return ", ".join(_text(name)[1:-1] for name in names)


def _key(name: str) -> str:
    return name if BARE.fullmatch(name) else _text(name)


def _numbers(values: Iterable[float]) -> str:
    # repr is the shortest text that reads back as the same number
    return f"[{', '.join(repr(float(v)) for v in values)}]"
