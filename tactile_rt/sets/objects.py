"""The sweeps of a set's objects on disk: one file per object, written atomically.

So a reader never sees a partly written file, and a split cannot divide an object. The archive's
checksums reveal a damaged file whenever it is read.
"""

import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, RecordingError, name_some
from tactile_rt.core.files import refuse_lfs_pointer, write_whole
from tactile_rt.sets.manifest import (
    CONTACTS,
    NEW_SWEEPS,
    SKIPPED,
    SweepManifest,
    has_object,
    object_path,
)


@dataclass(frozen=True)
class Sweeps:
    """Sweeps in memory, with their labels and object names.

    Attributes:
        values: (sweep, sample, element, channel) float32 The loads, SI, at the set's period.
        labels: (sweep,) int64 The index of the category in the manifest; -1: not a category.
        objects: (sweep,) The names of the objects; sweeps of one object share the name.
        contacts: (sweep, sample, element) float32 The arc length (m) from the whisker's base to
            the contact, NaN without contact; None: the set stores no contacts.
        recorded: (sweep,) bool True if a sweep was recorded, and so contains sensor noise;
            None: all sweeps were simulated, without noise.
    """

    values: NDArray[np.float32]
    labels: NDArray[np.int64]
    objects: NDArray[np.str_]
    contacts: NDArray[np.float32] | None = None
    recorded: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, at: slice | NDArray[Any]) -> "Sweeps":
        """Return the sweeps at a slice or at indices."""
        there = ((f.name, getattr(self, f.name)) for f in fields(self))
        taken: dict[str, Any] = {name: v if v is None else v[at] for name, v in there}
        return Sweeps(**taken)


def write_object(
    folder: Path,
    name: str,
    values: NDArray[np.float32],
    parameters: dict[str, NDArray[Any]],
    contacts: NDArray[np.float32] | None = None,
) -> None:
    """Write all sweeps of one object to its file, atomically.

    Args:
        name: the object's name, ``category-index``.
        values: (sweep, sample, element, channel), SI.
        parameters: named arrays (sweep,) that describe the sweeps, stored with the values.
        contacts: (sweep, sample, element), see `Sweeps`; None: no contacts are stored.
    """
    arrays: dict[str, Any] = {"values": values.astype(np.float32), **parameters}
    if contacts is not None:
        arrays[CONTACTS] = contacts.astype(np.float32)
    write_whole(object_path(folder, name), lambda file: np.savez(file, **arrays))


def read_sweeps(folder: Path, split: str) -> Sweeps:
    """Read all sweeps of one split; skipped objects are left out.

    Raises:
        RecordingError: the set is missing, or an object is damaged or missing (the run that makes
            the set was interrupted).
        ConfigError: the set has no such split.
    """
    return read_split(folder, SweepManifest.read(folder), split)


def read_split(folder: Path, manifest: SweepManifest, split: str) -> Sweeps:
    """Read all sweeps of one split as `read_sweeps` does, given the set's manifest."""
    names = _list_objects(folder, manifest, "train" if split == NEW_SWEEPS else split)
    labels = [manifest.label(name) for name in names]
    missing = [name for name in names if not has_object(folder, name)]
    if missing:
        raise RecordingError(
            f"{folder} is unfinished: {len(missing)} of {len(names)} objects of {split!r} are "
            f"missing ({missing[0]} ...); run the same `tactile-rt sweep` again to finish it"
        )
    shapes = [_read_shape(object_path(folder, name), manifest.spec.shape) for name in names]
    samples = shapes[0][1]
    for name, shape in zip(names, shapes, strict=True):
        if shape[1] != samples:
            raise RecordingError(
                f"{object_path(folder, name)} holds sweeps of {shape[1]} samples, "
                f"not {samples} as {names[0]}"
            )
    taken = [
        _choose_sweeps(object_path(folder, name), manifest, split, shape[0])
        for name, shape in zip(names, shapes, strict=True)
    ]
    counts = [int(chosen.sum()) for chosen in taken]
    # Filled in place: a large set fits into memory once, not twice.
    values = np.empty((sum(counts), *shapes[0][1:]), dtype=np.float32)
    contacts = (
        np.empty(values.shape[:3], dtype=np.float32) if manifest.recipe.get(CONTACTS) else None
    )
    at = 0
    for name, count, chosen in zip(names, counts, taken, strict=True):
        path = object_path(folder, name)
        values[at : at + count] = read_arrays(path, "values")["values"][chosen]
        if contacts is not None:
            stored = read_arrays(path, CONTACTS).get(CONTACTS, contacts[:0])
            if stored.shape != (len(chosen), *contacts.shape[1:]):
                raise _damage_error(
                    path, ValueError(f"contacts {stored.shape} beside other values")
                )
            contacts[at : at + count] = stored[chosen]
        at += count
    return Sweeps(
        values,
        np.repeat(np.array(labels), counts),
        np.repeat(names, counts),
        contacts,
        np.full(len(values), True) if manifest.recorded else None,
    )


def holds_out_sweeps(manifest: SweepManifest) -> bool:
    """Return whether a set's recipe excludes sweeps of training objects from training."""
    recipe = manifest.recipe.get("sweeps", {})
    return bool(recipe.get("held_out_draws") or recipe.get("held_out"))


def _choose_sweeps(
    path: Path, manifest: SweepManifest, split: str, sweeps: int
) -> NDArray[np.bool_]:
    """Return a mask (sweep,) of the sweeps of an object that belong to a split.

    Of a training object either the draws from number `draws` on are held out, or `held_out` random
    sweeps, as the recipe says.
    """
    chosen = np.ones(sweeps, dtype=np.bool_)
    if split not in ("train", NEW_SWEEPS) or not holds_out_sweeps(manifest):
        if split == NEW_SWEEPS:
            raise ConfigError("the set's recipe holds out no sweeps of its training objects")
        return chosen
    recipe = manifest.recipe["sweeps"]
    if recipe.get("held_out_draws"):
        draws = read_arrays(path, "draw").get("draw", np.zeros(sweeps))
        held = np.asarray(draws >= recipe["draws"])
    else:
        rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
        held = rng.permutation(sweeps) < recipe["held_out"]
    return held if split == NEW_SWEEPS else ~held


def read_object(folder: Path, name: str) -> tuple[NDArray[np.float32], dict[str, NDArray[Any]]]:
    """Read all sweeps of one object, without contacts (`read_sweeps` reads these).

    Returns:
        Values (sweep, sample, element, channel), SI, and named arrays (sweep,) that describe the
        sweeps.

    Raises:
        RecordingError: the file is damaged.
    """
    path = object_path(folder, name)
    arrays = read_arrays(path)
    arrays.pop(CONTACTS, None)
    if "values" not in arrays:
        raise _damage_error(path, KeyError("no values"))
    return arrays.pop("values"), arrays


def _list_objects(folder: Path, manifest: SweepManifest, split: str) -> list[str]:
    if split not in manifest.split:
        raise ConfigError(f"no split {split!r} in {folder}: it has {name_some(manifest.split)}")
    skipped = read_skipped(folder)
    names = [name for name in manifest.split[split] if name not in skipped]
    if not names:
        raise RecordingError(f"{folder}: {split!r} has no objects")
    return names


def _read_shape(path: Path, shape: tuple[int, int]) -> tuple[int, ...]:
    """Read the shape of an object's values without loading the values, and check it."""
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
        raise _damage_error(path, error) from None
    if len(stored) != 4 or stored[2:] != shape:
        raise RecordingError(f"{path} holds {stored}, not (sweep, sample, *{shape})")
    return tuple(stored)


def read_arrays(path: Path, *keys: str) -> dict[str, NDArray[Any]]:
    """Read the named arrays from an object's file, or all without names; skip missing names."""
    refuse_lfs_pointer(path)
    try:
        # Opened here because numpy leaves its own file open when it is damaged.
        with path.open("rb") as file, np.load(file) as arrays:
            return {key: arrays[key] for key in arrays.files if not keys or key in keys}
    except MemoryError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        raise _damage_error(path, error) from None


def _damage_error(path: Path, error: Exception) -> RecordingError:
    reason = str(error) or type(error).__name__
    return RecordingError(f"{path} is damaged ({reason}): delete it and sweep again")


def read_skipped(folder: Path) -> dict[str, str]:
    """Read the list of objects that could not be made: cause by name, or empty.

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
    """Write the list of objects that could not be made: cause by name."""
    text = msgspec.json.format(msgspec.json.encode(dict(sorted(skipped.items()))), indent=1)
    write_whole(folder / SKIPPED, lambda file: file.write(text))
