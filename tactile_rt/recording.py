"""Streams at rest: a sweep set is a folder of arrays for training and evaluation.

    sets/mouse12/
        manifest.json      what the set is: array, period, categories, split by object, recipe
        mug-17.npz         every sweep of one object

One file per object, written whole or not at all, so that an interrupted run loses only the object
it was at, and so that a split can never put one object on two sides.
"""

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.stream import ArraySpec, ConfigError, RecordingError

__all__ = [
    "SPLITS",
    "SweepManifest",
    "Sweeps",
    "has_object",
    "read_sweeps",
    "split_by_object",
    "write_object",
]

SET_VERSION = 1
MANIFEST = "manifest.json"
SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class SweepManifest:
    """What a sweep set is.

    Attributes:
        spec: the array.
        period_ns: sample period of the stored arrays, ns.
        lead: samples at the start of every sweep before the object can touch.
        categories: class names; a label is an index into them.
        split: object names per split, each name ``category-index``.
        recipe: what made the set (profile, seed, sweeps per object ...), for provenance.
    """

    spec: ArraySpec
    period_ns: int
    lead: int
    categories: tuple[str, ...]
    split: dict[str, tuple[str, ...]]
    recipe: dict[str, Any] = field(default_factory=dict)
    version: int = SET_VERSION

    def write(self, folder: Path) -> None:
        """Write into a folder, or check that the set already there is this very one.

        Raises:
            ConfigError: the folder holds another set.
        """
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / MANIFEST
        text = msgspec.json.encode(self)
        if path.exists():
            # Compared as JSON, which knows no tuples: a recipe may have been written with some.
            here = msgspec.json.decode(text)
            there = msgspec.json.decode(msgspec.json.encode(SweepManifest.read(folder)))
            differing = [name for name in here if there[name] != here[name]]
            if differing:
                raise ConfigError(
                    f"{folder} holds another sweep set (other {', '.join(differing)}): "
                    "choose another folder, or repeat the options that began it"
                )
            return
        _write_whole(path, lambda file: file.write(msgspec.json.format(text, indent=1)))

    @classmethod
    def read(cls, folder: Path) -> "SweepManifest":
        """Read a set's manifest.

        Raises:
            RecordingError: there is none, it is damaged, or of another version.
        """
        path = folder / MANIFEST
        try:
            raw = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
            if raw.get("version") != SET_VERSION:
                raise RecordingError(
                    f"{path} is of version {raw.get('version')!r}; this release reads {SET_VERSION}"
                )
            return msgspec.convert(raw, cls)
        except OSError:
            raise RecordingError(
                f"{folder} is not a sweep set: no {MANIFEST} (make one with `tactile-rt sweep`)"
            ) from None
        except (msgspec.MsgspecError, UnicodeDecodeError, ConfigError) as error:
            raise RecordingError(f"{path} is damaged: {error}") from None


@dataclass(frozen=True)
class Sweeps:
    """Sweeps in memory.

    Attributes:
        values: (sweep, sample, element, channel) float32, SI, on the set's period.
        labels: (sweep,) int64 index into the manifest's categories.
        objects: (sweep,) str object name; sweeps of one object share it.
    """

    values: NDArray[np.float32]
    labels: NDArray[np.int64]
    objects: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.labels)


def _object_path(folder: Path, name: str) -> Path:
    return folder / f"{name}.npz"


def has_object(folder: Path, name: str) -> bool:
    """Whether an object's sweeps have been written (whole, by construction)."""
    return _object_path(folder, name).exists()


def write_object(
    folder: Path, name: str, values: NDArray[np.float32], parameters: dict[str, NDArray[Any]]
) -> None:
    """Write all sweeps of one object, whole or not at all.

    Args:
        folder: the set.
        name: ``category-index``.
        values: (sweep, sample, element, channel) SI.
        parameters: (sweep,) arrays that describe each sweep, stored beside the values.
    """
    arrays: dict[str, Any] = {"values": values.astype(np.float32), **parameters}
    _write_whole(_object_path(folder, name), lambda file: np.savez(file, **arrays))


def read_sweeps(folder: Path, split: str) -> Sweeps:
    """Read all sweeps of one split.

    Raises:
        RecordingError: no such set, an object is missing (the run that makes it was interrupted)
            or damaged.
        ConfigError: no such split.
    """
    manifest = SweepManifest.read(folder)
    if split not in manifest.split:
        raise ConfigError(f"no split {split!r} in {folder}: it has {', '.join(manifest.split)}")
    names = manifest.split[split]
    if not names:
        raise RecordingError(f"{folder}: {split!r} has no objects")
    labels = [_label(folder, name, manifest.categories) for name in names]
    missing = [name for name in names if not has_object(folder, name)]
    if missing:
        raise RecordingError(
            f"{folder} is unfinished: {len(missing)} of {len(names)} objects of {split!r} are "
            f"missing ({missing[0]} ...); run the same `tactile-rt sweep` again to finish it"
        )
    values = [_read_values(_object_path(folder, name), manifest.spec.shape) for name in names]
    samples = values[0].shape[1]
    for name, sweeps in zip(names, values, strict=True):
        if sweeps.shape[1] != samples:
            raise RecordingError(
                f"{_object_path(folder, name)} holds sweeps of {sweeps.shape[1]} samples, "
                f"not {samples} as {names[0]}"
            )
    counts = [len(v) for v in values]
    return Sweeps(
        np.concatenate(values), np.repeat(np.array(labels), counts), np.repeat(names, counts)
    )


def _label(folder: Path, name: str, categories: tuple[str, ...]) -> int:
    category = name.rpartition("-")[0]
    if category not in categories:
        raise RecordingError(f"{folder / MANIFEST} is damaged: {name} is of no category it names")
    return categories.index(category)


def _read_values(path: Path, shape: tuple[int, int]) -> NDArray[np.float32]:
    try:
        # Opened here because numpy leaves its own file open when it is damaged.
        with path.open("rb") as file, np.load(file) as arrays:
            values: NDArray[np.float32] = arrays["values"]
    except MemoryError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        reason = str(error) or type(error).__name__
        raise RecordingError(f"{path} is damaged ({reason}): delete it and sweep again") from None
    if values.ndim != 4 or values.shape[2:] != shape:
        raise RecordingError(f"{path} holds {values.shape}, not (sweep, sample, *{shape})")
    return values


def _write_whole(path: Path, write: Any) -> None:
    """Let `write(file)` fill a file that appears under its name only when complete."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            write(file)
        os.chmod(name, 0o644)  # a temporary file is its owner's alone; a set is for others too
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise


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
