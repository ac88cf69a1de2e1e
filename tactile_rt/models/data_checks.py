"""What would spoil a training run, found before it starts."""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tactile_rt.core.errors import ConfigError, RecordingError, SpecMismatch
from tactile_rt.core.stream import ArraySpec
from tactile_rt.models.datasets import SweepSet, frame_of
from tactile_rt.models.ead_config import EADConfig
from tactile_rt.sets.manifest import SweepManifest, check_labelled, join_manifests, object_path

__all__ = [
    "check_array",
    "check_sets",
    "probed_on",
    "trained_on",
]


def check_array(checkpoint: Path, saved: Mapping[str, Any], manifest: SweepManifest) -> None:
    """A set that a checkpoint is to be used on is of the array that it was made for, and its
    samples are so far apart that steps are of as many.
    """
    spec = ArraySpec.from_json(saved["spec"])
    if differences := spec.differences(manifest.spec, ("name", "rate_hz")):
        raise SpecMismatch(f"{checkpoint} was made for another array: {differences[0]}")
    channels = len(spec.channels)
    taken, given = EADConfig(**saved["network"]).frame[0], frame_of(manifest)[0]
    if taken != given:
        raise SpecMismatch(
            f"{checkpoint} takes steps of {taken // channels} samples, and of the set, with one "
            f"every {manifest.period_ns / 1e6:g} ms, a step has {given // channels}: name a set of "
            "the sample period that it was trained at"
        )


def trained_on(
    checkpoint: Path, saved: Mapping[str, Any], data: Sequence[Path] = ()
) -> tuple[Path, ...]:
    """The sweep sets that a checkpoint was trained on: where they lie now.

    Args:
        data: the sets; default: where they lay when it was trained on.

    Raises:
        RecordingError: one is not there, or no sweep set.
        SpecMismatch: one is of another array, or they hold other categories.
    """
    config = saved["config"]
    folders = tuple(data) or tuple(map(Path, (config["data"], *config.get("also", ()))))
    for folder in folders:
        if not data and not folder.exists():
            raise RecordingError(
                f"{folder}, a sweep set that {checkpoint} was trained on, is not here: name it by "
                "--data"
            )
    manifest = join_manifests([SweepManifest.read(folder) for folder in folders])
    check_array(checkpoint, saved, manifest)
    held = list(manifest.categories)
    classes = saved["network"]["classes"] - len(saved["refusals"])
    if saved["categories"] != held or len(held) != classes:
        other = (
            ", ".join(sorted({*saved["categories"]} ^ {*held})[:3]) or "the same in another order"
        )
        there = " and ".join(map(str, folders))
        raise SpecMismatch(
            f"{checkpoint} tells other categories apart than {there} holds ({other}): name what "
            "it was trained on by --data"
        )
    return folders


def probed_on(
    checkpoint: Path, saved: Mapping[str, Any], folder: Path, data: str = ""
) -> tuple[Path, SweepManifest]:
    """The sweep set that a checkpoint is probed on.

    Args:
        data: the set; empty: the first of those that it was trained on.

    Raises:
        RecordingError: it is not there, or no sweep set.
        SpecMismatch: it is of another array.
        ConfigError: it has no labels; or the folder is that of a trained network, which the probe
            would take the place of.
    """
    best = folder / "best.pt"
    if (folder / "config.json").exists() or (best.exists() and best.samefile(checkpoint)):
        raise ConfigError(
            f"{folder} holds a training run, whose best.pt the probe would replace: choose another "
            "folder"
        )
    path = Path(data or saved["config"]["data"])
    manifest = SweepManifest.read(path)
    check_array(checkpoint, saved, manifest)
    check_labelled(path, manifest)
    return path, manifest


def check_sets(folder: Path, sets: Sequence[SweepSet]) -> None:
    """The sweeps themselves: finite, long enough, and none on two sides.

    Raises:
        RecordingError: otherwise; the message names the object.
    """
    seen: dict[bytes, tuple[str, int]] = {}
    for number, data in enumerate(sets):
        sweeps = data.sweeps
        if sweeps.values.shape[1] < data.timing.samples:
            raise RecordingError(
                f"{folder}: sweeps of {sweeps.values.shape[1]} samples are shorter than a window "
                f"of {data.timing.samples}"
            )
        first = {str(name): int(at) for at, name in reversed(list(enumerate(sweeps.objects)))}
        for k, sweep in enumerate(sweeps.values):
            if not np.isfinite(sweep).all():
                name = str(sweeps.objects[k])
                raise RecordingError(
                    f"{object_path(folder, name)}: sweep {k - first[name]} holds values that are "
                    "not finite: delete the file and sweep again"
                )
        for name, at in first.items():
            if not np.ptp(sweeps.values[at], axis=0).any():
                continue  # a miss is like any other miss, also above a magnet
            key = hashlib.blake2b(sweeps.values[at].tobytes()).digest()
            twin, where = seen.setdefault(key, (name, number))
            if where != number:
                raise RecordingError(
                    f"{folder}: {name} is {twin} by another name, on another side of the split: an "
                    "accuracy on it would mean nothing; make the set anew"
                )
