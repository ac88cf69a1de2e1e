"""The manifest of a sweep set: its array, period, categories, and the split of its objects.

sets/default24/
    manifest.json      what the set is: array, period, categories, split by object, recipe
    mug-17.npz         every sweep of one object
    skipped.json       objects that could not be made, and why
    SHA256SUMS         of all these, once the set is finished: `sha256sum -c` reads it too
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core.errors import ConfigError, RecordingError, name_some
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import ArraySpec, Timing
from tactile_rt.core.stream.sensor_spec import ChannelLimits, SensorSpec, channel_limits
from tactile_rt.sets.sensor_faults import SensorFaults

SET_VERSION = 2
RECORDED_VERSION = 3  # of recordings: a reader of version 2 alone would add their noise again
READABLE = (SET_VERSION, RECORDED_VERSION)
MANIFEST, SKIPPED = "manifest.json", "skipped.json"
CONTACTS = "contacts"  # in an object's file, and in the recipe that asks for them
FAULTS = "faults"  # in the recipe, see `sensor_faults`
RECORDINGS = "recordings"  # in the recipe of a set that is made of them
UNLABELLED = "unlabelled"  # the category of touches without a label
SPLITS = ("train", "validation", "test")
# Further splits, of categories that are labelled -1: training never sees the first, and may learn
# from the second what to refuse.
WITHHELD, OUTLIERS = "withheld", "outliers"
# Sweeps of training objects that no training learns from, where the recipe holds some out.
NEW_SWEEPS = "new-sweeps"


@dataclass(frozen=True)
class SweepManifest:
    """The description of a sweep set.

    Attributes:
        period_ns: The sample period of the stored arrays, ns.
        lead: The number of samples at the start of every sweep before the object can touch.
        categories: The names of the classes; a label is an index into them.
        split: The object names of each split, each ``category-index`` unless `category_of` has it.
        recipe: What made the set (profile, seed, sweeps per object ...), for provenance.
        withheld: The categories of the splits "withheld" and "outliers".
        category_of: The category of each object whose name does not give it.
        kind_of: The kind of objects that have one within their category: box, within block.
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
    kind_of: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    settings: dict[str, float | str] = field(default_factory=dict)
    sensor: SensorSpec | None = None

    @property
    def faults(self) -> SensorFaults:
        """The sensor faults that training draws.

        Raises:
            RecordingError: the recipe's faults are invalid.
        """
        try:
            return msgspec.convert(self.recipe.get(FAULTS, {}), SensorFaults)
        except (msgspec.ValidationError, ConfigError) as error:
            raise RecordingError(f"{MANIFEST} is damaged: {error}") from None

    @property
    def source(self) -> str:
        """The source of the objects according to the recipe; "" if it has none."""
        objects = self.recipe.get("objects")
        return str(objects.get("from", "")) if isinstance(objects, dict) else ""

    @property
    def recorded(self) -> bool:
        """True if its sweeps were recorded, with their sensor's noise, rather than simulated."""
        return RECORDINGS in self.recipe

    @property
    def frame(self) -> tuple[int, int, int]:
        """Channels, rows and columns of a network's input in a step."""
        rows, columns = self.spec.grid_shape
        return Timing.of(self.period_ns).substeps * len(self.spec.channels), rows, columns

    @property
    def limits(self) -> ChannelLimits:
        """Noise, detector floor, clip and scale of each channel."""
        return channel_limits(self.spec, self.sensor, self.period_ns)

    @property
    def kinds(self) -> dict[str, tuple[str, ...]]:
        """The kinds of each category that its training objects have."""
        found: dict[str, set[str]] = {}
        for name in self.split["train"]:
            if kind := self.kind_of.get(name):
                found.setdefault(self.category(name), set()).add(kind)
        return {c: tuple(sorted(found[c])) for c in self.categories if c in found}

    def names(self, splits: Sequence[str] = ()) -> list[str]:
        """List the object names of these splits, or of all.

        Raises:
            ConfigError: no such split.
        """
        for split in splits:
            if split not in self.split:
                raise ConfigError(f"no split {split!r}: there are {name_some(self.split)}")
        return [name for split in dict.fromkeys(splits or self.split) for name in self.split[split]]

    def category(self, name: str) -> str:
        """Return the category of an object.

        Raises:
            RecordingError: the set does not name its category.
        """
        category = self.category_of.get(name) or name.rpartition("-")[0]
        if category not in self.categories and category not in self.withheld:
            raise RecordingError(f"{MANIFEST} is damaged: {name} is of no category it names")
        return category

    def label(self, name: str) -> int:
        """Return the label of an object: -1 if its category is withheld from training."""
        category = self.category(name)
        return self.categories.index(category) if category in self.categories else -1

    def write(self, folder: Path) -> None:
        """Write into a folder, or check that the folder already holds this set.

        Raises:
            ConfigError: the folder holds another set, or other files.
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
            # Compared as JSON, which has no tuples: this recipe may have some.
            here = msgspec.json.decode(text)
            there = msgspec.json.decode(msgspec.json.encode(SweepManifest.read(folder)))
            differing = _compare_recipes(here, there)
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
            RecordingError: it is missing, damaged, or of another version.
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


def object_path(folder: Path, name: str) -> Path:
    """Return the path of the file of one object's sweeps."""
    return folder / f"{name}.npz"


def has_object(folder: Path, name: str) -> bool:
    """Return whether the file of an object's sweeps, written whole or not at all, exists."""
    return object_path(folder, name).exists()


def _compare_recipes(here: dict[str, Any], there: dict[str, Any], prefix: str = "") -> list[str]:
    """List the keys that differ, those of nested tables by their full name."""
    found = []
    for key in dict.fromkeys([*here, *there]):
        mine, theirs = here.get(key), there.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict) and key not in ("spec", "split"):
            found += _compare_recipes(mine, theirs, f"{prefix}{key}.")
        elif mine != theirs:
            found.append(f"{prefix}{key}")
    return found
