"""Whisker arrays, loaded by name (species, robot, package) or from a CSV or TOML file.

Both kinds of file have the columns of ``data/mouse.csv`` and may add those of `whiskers.OPTIONAL`;
see ``docs/arrays/robot.toml`` and ``robot.csv`` for one array in both formats. In TOML::

    name = "robot"             # the file's name if left out
    mirror = true              # adds the left side
    gravity_m_s2 = [0.0, 0.0, -9.80665]    # in the world; if left out: whiskers have no weight
    [mount]                    # if left out: not rotated, the mean base point at the world's origin
    position_mm = [0.0, 0.0, 0.0]
    roll_pitch_yaw_rad = [0.0, 0.0, 0.0]
    [sensor]                   # if left out: the base loads at 1 kHz
    rate_hz = 100              # see `sensor_spec.SensorSpec`
    [[sensor.channel]]         # see `sensor_spec.ChannelSpec`
    name = "mz"
    ...
    [sensor.magnet]            # see `sensor_spec.MagnetSpec`
    [defaults]                 # of every whisker
    young_modulus_pa = 2.9e9
    [[whisker]]
    whisker = "A0"
    ...

or, for several animals in one world, ``[[animal]]`` tables with ``array = "rat-both"`` (a name
or a file) and a ``mount`` of their own.
"""

import csv
import difflib
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np

from tactile_rt.core import packages, settings
from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream.sensor_spec import ChannelSpec, MagnetSpec, SensorSpec
from tactile_rt.sim_backend.arrays.whisker_array import (
    MOUNT,
    Mount,
    Point,
    WhiskerArray,
    both_sides,
    centred_mount,
    mirror_whisker,
    place,
)
from tactile_rt.sim_backend.arrays.whiskers import OPTIONAL, REQUIRED, TURN, Whisker

# Options of the serial URL that reads each robot's array.
ROBOTS = MappingProxyType(
    {
        "hx711_whisker": "codec=hx711_whisker",
        "mlx_hex": "codec=mlx_hex",
        "rattechan": "codec=anyskin&magnetometers=3&temperature=false&rate_hz=300",
    }
)
SIDES = ("right", "left", "both")
ARRAY_FILES = (".csv", ".toml")
COLUMNS = (*REQUIRED, *OPTIONAL)
ORIGIN = (0.0, 0.0, 0.0)


def robot_text(name: str) -> str:
    """Return the text of a robot's array file (.toml); `name` is one of `ROBOTS`."""
    file = resources.files(__package__).joinpath("data", f"{name}.toml")
    return file.read_text(encoding="utf-8")


def mouse_whiskers() -> tuple[Whisker, ...]:
    """Return the 30 right-side mystacial whiskers of the mouse (Bresee et al. 2023)."""
    return _read_species("mouse.csv")


def rat_whiskers() -> tuple[Whisker, ...]:
    """Return the 30 right-side mystacial whiskers of the rat (Belli et al. 2017, 2018)."""
    return _read_species("rat.csv")


def _read_species(file: str) -> tuple[Whisker, ...]:
    text = resources.files(__package__).joinpath("data", file).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return tuple(Whisker.from_columns(row) for row in csv.DictReader(lines))


SPECIES: dict[str, Callable[[], tuple[Whisker, ...]]] = {
    "mouse": mouse_whiskers,
    "rat": rat_whiskers,
}


ANIMALS = (*SPECIES, *(f"{animal}-{side}" for animal in SPECIES for side in SIDES))


@cache
def species_array(name: str) -> WhiskerArray:
    """Return the whisker array of an animal: ``mouse``, ``rat``, ``mouse-left``, ``rat-both`` ...

    ``mouse`` is ``mouse-right``. A left side alone is mounted as the mirror image of the right
    side, whiskers reaching along world -x, so that a mirrored sweep gives mirrored loads. Both
    sides share one head, mounted as for the right side alone. The rat's pose in the published
    sweeps is unknown: its head has the mouse's rotation, and the two mean base points coincide.
    """
    animal, _, side = name.partition("-")
    if name not in ANIMALS:
        known = [*ANIMALS, *ROBOTS, *packages.added_names(packages.ARRAYS)]
        near = difflib.get_close_matches(name, known, 1)
        raise ConfigError(
            f"no simulated array {name!r}: "
            + (f"did you mean {near[0]}?" if near else f"there are {name_some(known, 8)}")
            + " (or give a .csv or .toml file)"
        )
    side = side or "right"
    whiskers = SPECIES[animal]()
    right = WhiskerArray(f"{animal}-right", whiskers, _mount_species(whiskers))
    if side == "left":
        left = tuple(mirror_whisker(w) for w in whiskers)
        return WhiskerArray(f"{animal}-left", left, right.mount.mirror())
    return right if side == "right" else both_sides(right, f"{animal}-both")


def _mount_species(whiskers: tuple[Whisker, ...]) -> Mount:
    mouse = mouse_whiskers()
    if whiskers == mouse:
        return MOUNT
    middle = MOUNT.position + MOUNT.rotation @ np.mean([w.base for w in mouse], axis=0)
    return centred_mount(whiskers, tuple(middle), MOUNT.roll_pitch_yaw)


class _Mount(msgspec.Struct, forbid_unknown_fields=True):
    position_mm: Point = ORIGIN
    roll_pitch_yaw_rad: Point = ORIGIN


class _Animal(msgspec.Struct, forbid_unknown_fields=True):
    array: str
    mount: _Mount | None = None


class _Sensor(msgspec.Struct, forbid_unknown_fields=True):
    channel: tuple[ChannelSpec, ...] = ()
    rate_hz: float = SensorSpec.rate_hz
    bandwidth_hz: float = SensorSpec.bandwidth_hz
    latency_ms: float = SensorSpec.latency_ms
    magnet: MagnetSpec | None = None
    matrix: dict[str, tuple[tuple[float, ...], ...]] = {}


class _File(msgspec.Struct, forbid_unknown_fields=True):
    name: str = ""
    mirror: bool = False
    gravity_m_s2: Point = ORIGIN
    mount: _Mount | None = None
    sensor: _Sensor | None = None
    defaults: dict[str, Any] = {}
    whisker: list[dict[str, Any]] = []
    animal: list[_Animal] = []


def load_array(name: str) -> WhiskerArray:
    """Load a single array by name or from a file.

    Args:
        name: an animal and side (see `species_array`), a robot (see `ROBOTS`), another package's
            array, or a path to a .csv or .toml file.
    """
    arrays = load_animals(name)
    if len(arrays) > 1:
        raise ConfigError(f"{name}: holds {len(arrays)} animals where one array is needed")
    return arrays[0]


def load_animals(name: str) -> tuple[WhiskerArray, ...]:
    """Load the arrays that share one world: a named array, or all of a file."""
    path = Path(name)
    if path.suffix.lower() in ARRAY_FILES:
        return read_animals(path)
    if name in ROBOTS:
        return read_animals(Path(f"{name}.toml"), robot_text(name))
    if name in ANIMALS:  # these need no search of installed packages
        return (species_array(name),)
    file = packages.import_addition(packages.ARRAYS, name)
    return (species_array(name),) if file is None else read_animals(Path(file))


def read_animals(path: Path, text: str | None = None) -> tuple[WhiskerArray, ...]:
    """Read one array, or those of several animals, from a .csv or .toml file.

    Args:
        text: content to parse instead of the .toml file's; if None, the file is read.
    """
    if path.suffix.lower() == ".csv":
        whiskers = _read_csv(path)
        return (WhiskerArray(path.stem, whiskers, centred_mount(whiskers)),)
    nodes = settings.read_toml(path) if text is None else settings.parse_toml(text, str(path))
    return _read_toml(path, nodes)


def _read_csv(path: Path) -> tuple[Whisker, ...]:
    table = settings.read_csv(path)
    settings.check_columns(table, COLUMNS, REQUIRED)
    whiskers = [(row.where, _make_whisker(row.where, row.plain())) for row in table.rows]
    return _check_distinct(path, whiskers)


def _read_toml(path: Path, nodes: settings.SettingNode) -> tuple[WhiskerArray, ...]:
    file: _File = settings.convert(nodes, _File)
    if bool(file.animal) == bool(file.whisker):
        raise ConfigError(f"{path}: needs [[whisker]] tables or [[animal]] tables, one of the two")
    if file.animal:
        if any(
            (file.name, file.mirror, any(file.gravity_m_s2), file.mount, file.sensor, file.defaults)
        ):
            raise ConfigError(
                f"{path}: beside [[animal]] tables no other keys are allowed; name, mirror, "
                f"gravity_m_s2, mount, sensor and defaults belong in the file of an array"
            )
        animals = [_load_animal(path, animal) for animal in file.animal]
        try:
            return place(animals)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
    if file.defaults:
        _check_columns(nodes, ["defaults"])
    whiskers = []
    for number, values in enumerate(file.whisker):
        at: list[str | int] = ["whisker", number]
        _check_columns(nodes, at)
        where = f"{nodes.at(at).where}: {settings.format_path(at)}"
        if isinstance(values.get("whisker"), str):
            where += f" ({values['whisker']})"
        whiskers.append((where, _make_whisker(where, file.defaults | values)))
    made = _check_distinct(path, whiskers)
    mount = _make_mount(path, file.mount) if file.mount else centred_mount(made)
    name = file.name or path.stem
    try:
        array = WhiskerArray(name, made, mount, _make_sensor(nodes, file.sensor), file.gravity_m_s2)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None
    return (both_sides(array, name) if file.mirror else array,)


def _load_animal(path: Path, animal: _Animal) -> WhiskerArray:
    name = animal.array
    if Path(name).suffix.lower() in ARRAY_FILES:
        if (path.parent / name).resolve() == path.resolve():
            raise ConfigError(f"{path}: [[animal]] array names this file itself; name another file")
        name = str(path.parent / name)
    array = load_array(name)
    return replace(array, mount=_make_mount(path, animal.mount)) if animal.mount else array


def _make_mount(path: Path, mount: _Mount) -> Mount:
    for angle in mount.roll_pitch_yaw_rad:
        if abs(angle) > TURN:
            raise ConfigError(
                f"{path}: mount.roll_pitch_yaw_rad must be within a turn, 6.28, not {angle:g}: "
                "mind the unit"
            )
    try:
        return Mount(mount.position_mm, mount.roll_pitch_yaw_rad)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def _make_sensor(nodes: settings.SettingNode, sensor: _Sensor | None) -> SensorSpec | None:
    if sensor is None:
        return None
    given = msgspec.structs.asdict(sensor)
    try:
        return SensorSpec(channels=given.pop("channel"), **given)
    except ConfigError as error:
        raise ConfigError(f"{nodes.at(['sensor']).where}: {error}") from None


def _make_whisker(where: str, values: Mapping[str, object]) -> Whisker:
    try:
        return Whisker.from_columns(values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _check_distinct(path: Path, whiskers: list[tuple[str, Whisker]]) -> tuple[Whisker, ...]:
    if not whiskers:
        raise ConfigError(f"{path}: has no whiskers; give at least one")
    first: dict[object, str] = {}
    for where, w in whiskers:
        cell = f"row {w.row + 1}, col {w.column}"
        for key in (f"whisker {w.name}", cell):
            if key in first:
                raise ConfigError(f"{where}: {key} is taken already ({first[key]}); change one")
            first[key] = f"line {where.removeprefix(f'{path}:')}"
    return tuple(w for _, w in whiskers)


def _check_columns(nodes: settings.SettingNode, path: list[str | int]) -> None:
    """Raise a `ConfigError` if a table has a key that is not a column."""
    for key, node in nodes.at(path).value.items():
        if key not in COLUMNS:
            where, hint = f"{node.where}: {settings.format_path(path)}", settings.hint(key, COLUMNS)
            raise ConfigError(f"{where} has no key {key!r}; {hint}")
