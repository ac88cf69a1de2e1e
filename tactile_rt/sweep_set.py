"""Streams at rest: a sweep set is a folder of arrays for training and evaluation.

    sets/default24/
        manifest.json      what the set is: array, period, categories, split by object, recipe
        mug-17.npz         every sweep of one object
        skipped.json       objects that could not be made, and why
        SHA256SUMS         of all these, once the set is finished: `sha256sum -c` reads it too

One file per object, written whole or not at all, so that no half-written one is ever read, and so
that a split can never put one object on two sides. The archive's own checksums tell a damaged
file at every reading.
"""

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, RecordingError, name_some
from tactile_rt.core.files import write_whole
from tactile_rt.core.sensor_spec import ChannelLimits, SensorSpec, channel_limits
from tactile_rt.core.stream import ArraySpec
from tactile_rt.sensor_faults import SensorFaults

__all__ = [
    "OUTLIERS",
    "RECORDED_VERSION",
    "RECORDINGS",
    "SPLITS",
    "UNLABELLED",
    "WITHHELD",
    "SweepManifest",
    "Sweeps",
    "has_object",
    "join_manifests",
    "object_path",
    "read_object",
    "read_skipped",
    "read_sweeps",
    "split_by_object",
    "write_object",
    "write_skipped",
]

SET_VERSION = 2
RECORDED_VERSION = 3  # of recordings: who does not know them would add their noise again
READABLE = (SET_VERSION, RECORDED_VERSION)
MANIFEST, SKIPPED = "manifest.json", "skipped.json"
CONTACTS = "contacts"  # in an object's file, and in the recipe that asks for them
FAULTS = "faults"  # in the recipe, see `sensor_faults`
RECORDINGS = "recordings"  # in the recipe of a set that is made of them
UNLABELLED = "unlabelled"  # the category of touches of which nobody said what was touched
SPLITS = ("train", "validation", "test")
# Further splits, of categories that are labelled -1: training never sees the first, and may learn
# from the second what to refuse.
WITHHELD, OUTLIERS = "withheld", "outliers"


@dataclass(frozen=True)
class SweepManifest:
    """What a sweep set is.

    Attributes:
        period_ns: The sample period of the stored arrays, ns.
        lead: The number of samples at the start of every sweep before the object can touch.
        categories: The names of the classes; a label is an index into them.
        split: The object names of each split, each ``category-index`` unless `category_of` has it.
        recipe: What made the set (profile, seed, sweeps per object ...), for provenance.
        withheld: The categories of the splits "withheld" and "outliers".
        category_of: The category of objects whose name does not tell it.
        versions: The versions of what made the set (mujoco, numpy, ...).
        sensor: The description of the array's sensor; None: it has none, and the values are base
            loads.
        version: The version of the set's format: 2 of simulated sweeps, 3 of recorded ones.
    """

    spec: ArraySpec
    period_ns: int
    lead: int
    categories: tuple[str, ...]
    split: dict[str, tuple[str, ...]]
    recipe: dict[str, Any] = field(default_factory=dict)
    version: int = SET_VERSION
    withheld: tuple[str, ...] = ()
    category_of: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    settings: dict[str, float | str] = field(default_factory=dict)
    sensor: SensorSpec | None = None

    @property
    def faults(self) -> SensorFaults:
        """What training draws to be wrong with the sensor.

        Raises:
            RecordingError: the recipe says it in a way that cannot be.
        """
        try:
            return msgspec.convert(self.recipe.get(FAULTS, {}), SensorFaults)
        except (msgspec.ValidationError, ConfigError) as error:
            raise RecordingError(f"{MANIFEST} is damaged: {error}") from None

    @property
    def source(self) -> str:
        """Where the objects come from, as its recipe says it; "" if it does not."""
        objects = self.recipe.get("objects")
        return str(objects.get("from", "")) if isinstance(objects, dict) else ""

    @property
    def recorded(self) -> bool:
        """Whether its sweeps were recorded, with the noise of their sensor, not simulated."""
        return RECORDINGS in self.recipe

    @property
    def limits(self) -> ChannelLimits:
        """What a network may believe of the channels."""
        return channel_limits(self.spec, self.sensor, self.period_ns)

    def names(self, splits: Sequence[str] = ()) -> list[str]:
        """Object names of these splits, or of all.

        Raises:
            ConfigError: no such split.
        """
        for split in splits:
            if split not in self.split:
                raise ConfigError(f"no split {split!r}: there are {name_some(self.split)}")
        return [name for split in dict.fromkeys(splits or self.split) for name in self.split[split]]

    def category(self, name: str) -> str:
        """The category of an object.

        Raises:
            RecordingError: it is of none that the set names.
        """
        category = self.category_of.get(name) or name.rpartition("-")[0]
        if category not in self.categories and category not in self.withheld:
            raise RecordingError(f"{MANIFEST} is damaged: {name} is of no category it names")
        return category

    def label(self, name: str) -> int:
        """The label of an object: -1 if its category is withheld from training."""
        category = self.category(name)
        return self.categories.index(category) if category in self.categories else -1

    def write(self, folder: Path) -> None:
        """Write into a folder, or check that the set already there is this very one.

        Raises:
            ConfigError: the folder holds another set, or things that are none.
        """
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / MANIFEST
        if not path.exists() and not any(has_object(folder, name) for name in self.names()):
            others = [other.name for other in folder.iterdir() if other.name[0] != "."]
            if others:
                raise ConfigError(
                    f"{folder} holds {min(others)!r} and no sweep set: choose a new or an empty "
                    "folder"
                )
        text = msgspec.json.encode(self)
        if path.exists():
            # Compared as JSON, which knows no tuples: a recipe may have been written with some.
            here = msgspec.json.decode(text)
            there = msgspec.json.decode(msgspec.json.encode(SweepManifest.read(folder)))
            differing = _differing(here, there)
            if differing:
                raise ConfigError(
                    f"{folder} holds another sweep set (other {name_some(differing)}): "
                    "choose another folder, or repeat the options that began it"
                )
            return
        write_whole(path, lambda file: file.write(msgspec.json.format(text, indent=1)))

    @classmethod
    def read(cls, folder: Path) -> "SweepManifest":
        """Read a set's manifest.

        Raises:
            RecordingError: there is none, it is damaged, or of another version.
        """
        path = folder / MANIFEST
        try:
            raw = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
            if raw.get("version") not in READABLE:
                raise RecordingError(
                    f"{path} is of version {raw.get('version')!r}; this release reads "
                    f"{READABLE[0]} and {READABLE[-1]}"
                )
            return msgspec.convert(raw, cls)
        except OSError:
            raise RecordingError(
                f"{folder} is not a sweep set: no {MANIFEST} (make one with `tactile-rt sweep` or "
                "`tactile-rt label`)"
            ) from None
        except (msgspec.MsgspecError, UnicodeDecodeError, ConfigError) as error:
            raise RecordingError(f"{path} is damaged: {error}") from None


def join_manifests(manifests: Sequence[SweepManifest]) -> SweepManifest:
    """Sets of one array as one, which is the first with the categories and objects of the others.

    Raises:
        ConfigError: sets of another array or sensor, or of another period.
    """
    first = manifests[0]
    for other in manifests[1:]:
        differing = first.spec.differences(other.spec, ("name", "rate_hz"))
        if first.period_ns != other.period_ns:
            periods = (f"{m.period_ns * 1e-6:g} ms" for m in (first, other))
            differing = [*differing, f"the period of their samples, {' and '.join(periods)}"]
        if first.sensor != other.sensor:
            differing = [*differing, "the sensor: its noise, range or rate"]
        if differing:
            names = " and ".join(str(m.recipe.get("name", "?")) for m in (first, other))
            raise ConfigError(f"the sweep sets {names} cannot be joined: {differing[0]}")
    split: dict[str, dict[str, None]] = {}  # dictionaries, as sets that keep their order
    for one in manifests:
        for side, names_there in one.split.items():
            split.setdefault(side, {}).update(dict.fromkeys(names_there))
    return replace(
        first,
        lead=max(one.lead for one in manifests),
        categories=tuple(dict.fromkeys(c for one in manifests for c in one.categories)),
        withheld=tuple(dict.fromkeys(c for one in manifests for c in one.withheld)),
        split={side: tuple(names) for side, names in split.items()},
        category_of={name: kind for m in manifests for name, kind in m.category_of.items()},
    )


def _differing(here: dict[str, Any], there: dict[str, Any], prefix: str = "") -> list[str]:
    """Which keys differ, those of tables by their full name."""
    found = []
    for key in dict.fromkeys([*here, *there]):
        mine, theirs = here.get(key), there.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict) and key not in ("spec", "split"):
            found += _differing(mine, theirs, f"{prefix}{key}.")
        elif mine != theirs:
            found.append(f"{prefix}{key}")
    return found


@dataclass(frozen=True)
class Sweeps:
    """Sweeps in memory.

    Attributes:
        values: The (sweep, sample, element, channel) float32 loads, SI, on the set's period.
        labels: The (sweep,) int64 index into the manifest's categories; -1: of none of them.
        objects: The (sweep,) names of the objects; sweeps of one object share the name.
        contacts: The (sweep, sample, element) float32 arc length (m) from the whisker's base to
            where it touches, NaN where it does not; None: the set was made without.
        recorded: The (sweep,) bool whether it was recorded, so that its sensor's noise is in it;
            None: all were simulated, without any.
    """

    values: NDArray[np.float32]
    labels: NDArray[np.int64]
    objects: NDArray[np.str_]
    contacts: NDArray[np.float32] | None = None
    recorded: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, at: slice | NDArray[Any]) -> "Sweeps":
        """Some of the sweeps."""
        there = ((f.name, getattr(self, f.name)) for f in fields(self))
        taken: dict[str, Any] = {name: v if v is None else v[at] for name, v in there}
        return Sweeps(**taken)


def object_path(folder: Path, name: str) -> Path:
    """The file of one object's sweeps."""
    return folder / f"{name}.npz"


def has_object(folder: Path, name: str) -> bool:
    """Whether an object's sweeps have been written (whole, by construction)."""
    return object_path(folder, name).exists()


def write_object(
    folder: Path,
    name: str,
    values: NDArray[np.float32],
    parameters: dict[str, NDArray[Any]],
    contacts: NDArray[np.float32] | None = None,
) -> None:
    """Write all sweeps of one object, whole or not at all.

    Args:
        name: ``category-index``.
        values: (sweep, sample, element, channel) SI.
        parameters: (sweep,) arrays that describe each sweep, stored beside the values.
        contacts: (sweep, sample, element), see `Sweeps`; None stores none.
    """
    arrays: dict[str, Any] = {"values": values.astype(np.float32), **parameters}
    if contacts is not None:
        arrays[CONTACTS] = contacts.astype(np.float32)
    write_whole(object_path(folder, name), lambda file: np.savez(file, **arrays))


def read_sweeps(folder: Path, split: str) -> Sweeps:
    """Read all sweeps of one split; objects that were skipped are not among them.

    Raises:
        RecordingError: no such set, an object is missing (the run that makes it was interrupted)
            or damaged.
        ConfigError: no such split.
    """
    manifest = SweepManifest.read(folder)
    names = _names_of(folder, manifest, split)
    labels = [manifest.label(name) for name in names]
    missing = [name for name in names if not has_object(folder, name)]
    if missing:
        raise RecordingError(
            f"{folder} is unfinished: {len(missing)} of {len(names)} objects of {split!r} are "
            f"missing ({missing[0]} ...); run the same `tactile-rt sweep` again to finish it"
        )
    shapes = [_stored_shape(object_path(folder, name), manifest.spec.shape) for name in names]
    samples = shapes[0][1]
    for name, shape in zip(names, shapes, strict=True):
        if shape[1] != samples:
            raise RecordingError(
                f"{object_path(folder, name)} holds sweeps of {shape[1]} samples, "
                f"not {samples} as {names[0]}"
            )
    counts = [shape[0] for shape in shapes]
    # Filled in place: a large set fits into memory once, not twice.
    values = np.empty((sum(counts), *shapes[0][1:]), dtype=np.float32)
    contacts = (
        np.empty(values.shape[:3], dtype=np.float32) if manifest.recipe.get(CONTACTS) else None
    )
    at = 0
    for name, count in zip(names, counts, strict=True):
        path = object_path(folder, name)
        values[at : at + count] = _read_arrays(path, "values")["values"]
        if contacts is not None:
            stored = _read_arrays(path, CONTACTS)[CONTACTS]
            if stored.shape != contacts[at : at + count].shape:
                raise _damaged(path, ValueError(f"contacts {stored.shape} beside other values"))
            contacts[at : at + count] = stored
        at += count
    return Sweeps(
        values,
        np.repeat(np.array(labels), counts),
        np.repeat(names, counts),
        contacts,
        np.full(len(values), True) if manifest.recorded else None,
    )


def read_object(folder: Path, name: str) -> tuple[NDArray[np.float32], dict[str, NDArray[Any]]]:
    """All sweeps of one object.

    Returns:
        (sweep, sample, element, channel) values, SI, and the (sweep,) arrays that describe each.
        Contacts, if any, are `read_sweeps`'s to read.

    Raises:
        RecordingError: the file is damaged.
    """
    path = object_path(folder, name)
    arrays = _read_arrays(path)
    arrays.pop(CONTACTS, None)
    if "values" not in arrays:
        raise _damaged(path, KeyError("no values"))
    return arrays.pop("values"), arrays


def _names_of(folder: Path, manifest: SweepManifest, split: str) -> list[str]:
    if split not in manifest.split:
        raise ConfigError(f"no split {split!r} in {folder}: it has {name_some(manifest.split)}")
    skipped = read_skipped(folder)
    names = [name for name in manifest.split[split] if name not in skipped]
    if not names:
        raise RecordingError(f"{folder}: {split!r} has no objects")
    return names


def _stored_shape(path: Path, shape: tuple[int, int]) -> tuple[int, ...]:
    """The shape of an object's values, without reading them."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open("values.npy") as member:
            version = np.lib.format.read_magic(member)
            read = {(1, 0): np.lib.format.read_array_header_1_0}[version]
            stored, _, dtype = read(member)
        if dtype != np.float32:
            raise ValueError(f"values of type {dtype}")
    except MemoryError:
        raise
    except Exception as error:
        raise _damaged(path, error) from None
    if len(stored) != 4 or stored[2:] != shape:
        raise RecordingError(f"{path} holds {stored}, not (sweep, sample, *{shape})")
    return tuple(stored)


def _read_arrays(path: Path, *keys: str) -> dict[str, NDArray[Any]]:
    try:
        # Opened here because numpy leaves its own file open when it is damaged.
        with path.open("rb") as file, np.load(file) as arrays:
            return {key: arrays[key] for key in keys or arrays.files}
    except MemoryError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    return RecordingError(f"{path} is damaged ({reason}): delete it and sweep again")


def read_skipped(folder: Path) -> dict[str, str]:
    """Objects that could not be made, and why; none if the set does not list any.

    Raises:
        RecordingError: the list is damaged.
    """
    path = folder / SKIPPED
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, str])
    except FileNotFoundError:
        return {}
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} is damaged: {error}") from None


def write_skipped(folder: Path, skipped: dict[str, str]) -> None:
    """Replace the list of objects that could not be made."""
    text = msgspec.json.format(msgspec.json.encode(dict(sorted(skipped.items()))), indent=1)
    write_whole(folder / SKIPPED, lambda file: file.write(text))


def split_by_object(
    categories: Sequence[str], objects: int, validation: int, test: int
) -> dict[str, tuple[str, ...]]:
    """Split `objects` instances of every category by object: the last ones are the test."""
    first = {"train": 0, "validation": objects - test - validation, "test": objects - test}
    stop = {"train": first["validation"], "validation": first["test"], "test": objects}
    return {
        # Index first, so that an unfinished set has its objects spread over the categories.
        split: tuple(f"{c}-{i}" for i in range(first[split], stop[split]) for c in categories)
        for split in SPLITS
    }
