"""What would spoil a training run, found before it starts."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tactile_rt.models.datasets import STEPS, SUBSTEPS, SweepSet
from tactile_rt.recording import WITHHELD, SweepManifest, object_path
from tactile_rt.stream import RecordingError

__all__ = ["check_sets", "check_split"]


def check_split(folder: Path, manifest: SweepManifest) -> None:
    """No object on two sides of the split, every trained object of a category that is trained.

    Raises:
        RecordingError: otherwise.
    """
    side: dict[str, str] = {}
    for split, names in manifest.split.items():
        for name in names:
            if name in side:
                where = "twice in" if side[name] == split else f"in {side[name]!r} and in"
                raise RecordingError(
                    f"{folder}: the object {name} is {where} {split!r} of the split: an accuracy "
                    "on it would mean nothing; make the set anew"
                )
            side[name] = split
            if split != WITHHELD and manifest.label(name) < 0:
                raise RecordingError(
                    f"{folder}: {name} of {split!r} is of the withheld category "
                    f"{manifest.category(name)!r}, which has no label to train on"
                )


def check_sets(folder: Path, sets: Sequence[SweepSet]) -> None:
    """The sweeps themselves: finite, long enough, labelled, and none on two sides.

    Args:
        folder: the sweep set's.
        sets: its splits, as they were read.

    Raises:
        RecordingError: otherwise; the message names the object.
    """
    seen: dict[bytes, tuple[str, int]] = {}
    for number, data in enumerate(sets):
        sweeps, classes = data.sweeps, len(data.manifest.categories)
        if sweeps.values.shape[1] < STEPS * SUBSTEPS:
            raise RecordingError(
                f"{folder}: sweeps of {sweeps.values.shape[1]} samples are shorter than a window "
                f"of {STEPS * SUBSTEPS}"
            )
        wrong = np.flatnonzero((sweeps.labels < 0) | (sweeps.labels >= classes))
        if len(wrong):
            raise RecordingError(
                f"{object_path(folder, sweeps.objects[wrong[0]])}: label "
                f"{sweeps.labels[wrong[0]]} is none of the {classes} categories"
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
            if not sweeps.values[at].any():
                continue  # a miss is like any other miss
            key = hashlib.blake2b(sweeps.values[at].tobytes()).digest()
            twin, where = seen.setdefault(key, (name, number))
            if where != number:
                raise RecordingError(
                    f"{folder}: {name} is {twin} by another name, on another side of the split: an "
                    "accuracy on it would mean nothing; make the set anew"
                )
