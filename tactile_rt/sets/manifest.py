"""The manifest of a sweep set: its array, period, categories, and the split of its objects.

sets/default24/
    manifest.json      the description: array, period, categories, split by object, recipe
    mug-17.npz         all sweeps of one object
    skipped.json       objects that could not be made, and why
    SHA256SUMS         checksums of these files once the set is finished, for `sha256sum -c`
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
RECORDED_VERSION = 3  # of recorded sweeps: a reader of version 2 would add noise to their own
READABLE = (SET_VERSION, RECORDED_VERSION)
MANIFEST, SKIPPED = "manifest.json", "skipped.json"
CONTACTS = "contacts"  # key in an object's file, and in a recipe that requests contacts
FAULTS = "faults"  # key in the recipe, see `sensor_faults`
RECORDINGS = "recordings"  # key in the recipe of a set that is cut out of recordings
UNLABELLED = "unlabelled"  # the category of touches without a label
SPLITS = ("train", "validation", "test")
# Further splits, of categories with label -1: training never reads the withheld ones, and may learn
# to refuse the outliers.
WITHHELD, OUTLIERS = "withheld", "outliers"
# The split of the sweeps of training objects that the recipe holds out from training.
NEW_SWEEPS = "new-sweeps"


@dataclass(frozen=True)
class SweepManifest:
    """The description of a sweep set, stored as its `manifest.json`.

    Attributes:
        period_ns: The sample period of the stored arrays, ns.
        lead: The number of samples at the start of every sweep before the object can touch.
        categories: The names of the classes; a label is an index into this list.
        split: The object names of each split: ``category-index``, or any name in `category_of`.
        recipe: The options that the set was made with (profile, seed, sweeps per object ...).
        withheld: The categories of the splits "withheld" and "outliers".
        category_of: The category of each object whose name is not ``category-index``.
        kind_of: The kind, such as box within block, of each object that has a kind.
        versions: The versions of the software that made the set (mujoco, numpy, ...).
        sensor: The description of the array's sensor; None: no sensor model, and the values are
            loads at the elements' bases.
        version: The version of the set's format: 2 for simulated sweeps, 3 for recorded sweeps.
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
        """Amounts of the sensor faults that training draws, from the recipe.

        Raises:
            RecordingError: the recipe's faults are invalid.
        """
        try:
            return msgspec.convert(self.recipe.get(FAULTS, {}), SensorFaults)
        except (msgspec.ValidationError, ConfigError) as error:
            raise RecordingError(f"{MANIFEST} is damaged: {error}") from None

    @property
    def source(self) -> str:
        """Source of the objects according to the recipe; "" if the recipe names no source."""
        objects = self.recipe.get("objects")
        return str(objects.get("from", "")) if isinstance(objects, dict) else ""

    @property
    def recorded(self) -> bool:
        """True if the sweeps were recorded, and so contain sensor noise, rather than simulated."""
        return RECORDINGS in self.recipe

    @property
    def frame(self) -> tuple[int, int, int]:
        """Channels, rows and columns of a network's input frame in one step."""
        rows, columns = self.spec.grid_shape
        return Timing.of(self.period_ns).substeps * len(self.spec.channels), rows, columns

    @property
    def limits(self) -> ChannelLimits:
        """Noise, detector floor, clip and scale of each channel."""
        return channel_limits(self.spec, self.sensor, self.period_ns)

    @property
    def kinds(self) -> dict[str, tuple[str, ...]]:
        """Kinds of the training objects, by category; categories without kinds are left out."""
        found: dict[str, set[str]] = {}
        for name in self.split["train"]:
            if kind := self.kind_of.get(name):
                found.setdefault(self.category(name), set()).add(kind)
        return {c: tuple(sorted(found[c])) for c in self.categories if c in found}

    def names(self, splits: Sequence[str] = ()) -> list[str]:
        """List the object names of the given splits; without splits, of all.

        Raises:
            ConfigError: the set has no such split.
        """
        for split in splits:
            if split not in self.split:
                raise ConfigError(f"no split {split!r}: there are {name_some(self.split)}")
        return [name for split in dict.fromkeys(splits or self.split) for name in self.split[split]]

    def category(self, name: str) -> str:
        """Return the category of an object.

        Raises:
            RecordingError: the manifest does not list the object's category.
        """
        category = self.category_of.get(name) or name.rpartition("-")[0]
        if category not in self.categories and category not in self.withheld:
            raise RecordingError(f"{MANIFEST} is damaged: {name} has a category that is not listed")
        return category

    def label(self, name: str) -> int:
        """Return an object's label: the index of its category, -1 if not in `categories`."""
        category = self.category(name)
        return self.categories.index(category) if category in self.categories else -1

    def write(self, folder: Path) -> None:
        """Write the manifest into a folder, or check that the folder already holds this set.

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
            # Compared as decoded JSON, which has no tuples: this recipe may contain tuples.
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
        """Read the manifest of the sweep set in a folder.

        Raises:
            RecordingError: the manifest is missing, damaged, or of an unknown version.
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
    """Return the path of the file that stores one object's sweeps."""
    return folder / f"{name}.npz"


def has_object(folder: Path, name: str) -> bool:
    """Return whether a set has an object's file, which is complete if it exists."""
    return object_path(folder, name).exists()


def _compare_recipes(here: dict[str, Any], there: dict[str, Any], prefix: str = "") -> list[str]:
    """List the keys whose values differ between two manifests, such as "recipe.seed"."""
    found = []
    for key in dict.fromkeys([*here, *there]):
        mine, theirs = here.get(key), there.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict) and key not in ("spec", "split"):
            found += _compare_recipes(mine, theirs, f"{prefix}{key}.")
        elif mine != theirs:
            found.append(f"{prefix}{key}")
    return found
