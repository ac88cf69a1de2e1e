"""Storage of calibrations: one TOML file per device, which people can read and edit.

    $XDG_CONFIG_HOME/tactile_rt/calibration/DEVICE.toml     (~/.config if that is not set)

A file is written whole or not at all. It has a version; a file of another version is refused.
"""

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path

import msgspec

from tactile_rt.calibration.device_calibration import Calibration, Mirror, check_device
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.settings import SettingNode, convert, nearest, read_toml

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


class _File(msgspec.Struct, forbid_unknown_fields=True):
    version: int
    device: str
    raw: _Raw
    output: _Output = msgspec.field(default_factory=_Output)
    history: tuple[str, ...] = ()
    gain: tuple[float, ...] = ()
    tare: dict[str, Row] = {}
    noise: dict[str, Row] = {}
    changes: float = 0.0
    matrices: dict[str, tuple[Row, ...]] = msgspec.field(name="matrix", default_factory=dict)
    mapping: dict[str, str] = {}
    mirror: Mirror | None = None


def calibration_path(device: str) -> Path:
    """Return the default path of a device's calibration."""
    check_device(device)
    return _find_folder() / f"{device}.toml"


def load_calibration(which: str | Path) -> Calibration:
    """Read the calibration of a device by its id, or from a file.

    Args:
        which: a path if it ends in ``.toml`` or contains a folder; else a device's id.
    """
    named = str(which)
    path = Path(which)
    if not (isinstance(which, Path) or path.suffix == ".toml" or os.sep in named):
        path = calibration_path(named)
        if not path.is_file():
            known = sorted(p.stem for p in _find_folder().glob("[!.]*.toml"))
            raise ConfigError(
                f"no calibration of device {named!r} in {_find_folder()}; {nearest(named, known)}"
            )
    return _parse_calibration(read_toml(path))


def save_calibration(calibration: Calibration, path: Path | None = None) -> Path:
    """Write a calibration to its default path, or to a given file; return the path.

    Raises:
        ConfigError: the folder of `path` does not exist.
    """
    if path is None:
        path = calibration_path(calibration.device)
        path.parent.mkdir(parents=True, exist_ok=True)
    elif not path.parent.is_dir():
        raise ConfigError(f"no folder {path.parent} to write {path.name} in")
    text = _format_file(calibration).encode()
    write_whole(path, lambda file: file.write(text))
    return path


def _find_folder() -> Path:
    configured = os.environ.get("XDG_CONFIG_HOME", "")
    # The XDG specification requires that relative paths are ignored.
    try:
        home = Path(configured) if os.path.isabs(configured) else Path.home() / ".config"
    except RuntimeError:  # neither HOME is set nor a line in /etc/passwd exists
        raise ConfigError(
            "this user has no home to keep calibrations in: set XDG_CONFIG_HOME, or name a file"
        ) from None
    return home / "tactile_rt" / "calibration"


def _parse_calibration(nodes: SettingNode) -> Calibration:
    version = nodes.value.get("version")
    if version is None or version.value != VERSION:
        found = None if version is None else version.plain()
        raise ConfigError(
            f"{nodes.where}: is a calibration of version {found!r}; this release reads {VERSION}"
        )
    file: _File = convert(nodes, _File)
    raw, out = msgspec.structs.asdict(file.raw), file.output
    parts = ("history", "gain", "tare", "noise", "changes", "matrices", "mapping", "mirror")
    rest = {name: getattr(file, name) for name in parts}
    try:
        return Calibration(
            file.device, **raw, output_channels=out.channels, output_units=out.units, **rest
        )
    except ConfigError as error:  # the parts do not fit together
        raise ConfigError(f"{nodes.where}: {error}") from None


def _format_file(c: Calibration) -> str:
    outputs = list(zip(*c.output, strict=True))
    lines = [
        f"# Calibration of the tactile sensor {c.device}, for tactile-rt.",
        "# Of every element: output = matrix @ (raw - tare); then mapped, then mirrored.",
        f"version = {VERSION}",
        f"device = {_dump(c.device)}",
        f"changes = {_dump(c.changes)}  # share of readings that differ from the one before, tared",
        "history = [",
        *(f"  {_dump(line)}," for line in c.history),
        "]",
        "",
        "[raw]  # what the device sends; a unit of 1 are counts",
        f"elements = {_dump(c.elements)}",
        f"channels = {_dump(c.channels)}",
        f"units = {_dump(c.units)}",
        "",
        "[output]  # what programs get; what is left out is as in [raw]",
    ]
    if c.output_channels:
        lines.append(f"channels = {_dump(c.output_channels)}")
    if c.output_units:
        lines.append(f"units = {_dump(c.output_units)}")
    if c.mapping:
        lines += ["", "[mapping]  # output element = raw element, in the order of the output"]
        lines += [f"{_quote_key(new)} = {_dump(old)}" for new, old in c.mapping.items()]
    for what, rows, meaning in (
        ("tare", c.tare, "raw reading at no load"),
        ("noise", c.noise, "standard deviation of the raw reading at no load"),
    ):
        if rows:
            lines += ["", f"[{what}]  # {meaning}: {_join(c.channels)}"]
            lines += [f"{_quote_key(element)} = {_dump(row)}" for element, row in rows.items()]
    if c.matrices:
        lines += ["", "[matrix]  # a row per output channel: output unit per raw unit"]
    for element, matrix in c.matrices.items():
        lines += [f"{_quote_key(element)} = [  # columns: {_join(c.channels)}"]
        lines += [
            f"  {_dump(row)},  # {_join(of)}" for of, row in zip(outputs, matrix, strict=True)
        ]
        lines += ["]"]
    if c.mirror:
        lines += [
            "",
            "[mirror]  # reflect the mount frame's axis, flip the element frame's",
            f"axis = {_dump(c.mirror.axis)}",
            f"element_axis = {_dump(c.mirror.element_axis)}",
        ]
        if c.mirror.signs:
            lines += ["[mirror.signs]  # of channels whose name and unit do not show it"]
            lines += [f"{_quote_key(channel)} = {sign}" for channel, sign in c.mirror.signs.items()]
    if c.gain:
        gain = f"gain = {_dump(c.gain)}  # of elements without a matrix: {_join(c.channels)}"
        lines.insert(lines.index("history = ["), gain)
    return "\n".join(lines) + "\n"


def _dump(value: object) -> str:
    # JSON's strings, numbers and lists are valid TOML, except for one control character that JSON
    # does not escape. Numbers are the shortest text that reads back as the same.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _join(names: Iterable[str]) -> str:
    # for a comment: a name that a device sends may contain a line break
    return ", ".join(_dump(name)[1:-1] for name in names)


def _quote_key(name: str) -> str:
    return name if BARE.fullmatch(name) else _dump(name)
