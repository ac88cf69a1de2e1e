"""What a sweep set is: its array, period, categories, and which objects are on which side of it.

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
# Sweeps of training objects that no training learns from, where the recipe holds some out.
NEW_SWEEPS = "new-sweeps"


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
        kind_of: The kind of objects that have one within their category: box, where that is block.
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
    def frame(self) -> tuple[int, int, int]:
        """Channels, rows and columns of what a network sees of the array in a step."""
        rows, columns = self.spec.grid_shape
        return Timing.of(self.period_ns).substeps * len(self.spec.channels), rows, columns

    @property
    def limits(self) -> ChannelLimits:
        """What a network may believe of the channels."""
        return channel_limits(self.spec, self.sensor, self.period_ns)

    @property
    def kinds(self) -> dict[str, tuple[str, ...]]:
        """The kinds of each category, as far as there are objects to learn from."""
        found: dict[str, set[str]] = {}
        for name in self.split["train"]:
            if kind := self.kind_of.get(name):
                found.setdefault(self.category(name), set()).add(kind)
        return {c: tuple(sorted(found[c])) for c in self.categories if c in found}

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


def object_path(folder: Path, name: str) -> Path:
    """The file of one object's sweeps."""
    return folder / f"{name}.npz"


def has_object(folder: Path, name: str) -> bool:
    """Return True if an object's sweeps are there, which are written whole."""
    return object_path(folder, name).exists()


def _compare_recipes(here: dict[str, Any], there: dict[str, Any], prefix: str = "") -> list[str]:
    """List the keys that differ, those of tables by their full name."""
    found = []
    for key in dict.fromkeys([*here, *there]):
        mine, theirs = here.get(key), there.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict) and key not in ("spec", "split"):
            found += _compare_recipes(mine, theirs, f"{prefix}{key}.")
        elif mine != theirs:
            found.append(f"{prefix}{key}")
    return found
