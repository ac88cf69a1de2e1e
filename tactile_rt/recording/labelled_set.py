"""Sweep sets made of labelled touches of recordings, split by object.

touches with labels -> objects -> train, validation, test -> folder
"""

import hashlib
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import replace_folder
from tactile_rt.core.packages import VERSION
from tactile_rt.recording.labelling import LabelledTouch, LabelledTouches
from tactile_rt.recording.touches import REST
from tactile_rt.sets.manifest import RECORDED_VERSION, RECORDINGS, SPLITS, UNLABELLED, SweepManifest
from tactile_rt.sets.objects import write_object

SHARES = (0.7, 0.15, 0.15)  # shares of each category's objects, by split
ENOUGH = 3  # recordings of a label from which each counts as an object: one for each split
DIGITS = 6  # of a recording's checksum, in the names of its objects
STEM = 100  # bytes of a recording's name, in the names of its objects


def write_set(
    folder: Path,
    touches: LabelledTouches,
    shares: Sequence[float] = SHARES,
    seed: int = 0,
    options: str = "",
    finish: Callable[[Path], None] = lambda folder: None,
) -> SweepManifest:
    """Write a sweep set of labelled touches, whole or not at all.

    Args:
        folder: the set to write; an existing one is replaced.
        shares: shares of each category's objects for training, validation and test.

    Raises:
        ConfigError: no touch can be used, or the shares are invalid.
    """
    check_shares(shares)
    if not touches.used:
        why = "; ".join(touches.left_out) or "no recording holds one"
        raise ConfigError(f"no touch can be used: {why}")
    objects = _group_by_object(touches)
    categories = sorted({used[0].interval.label for used in objects.values()})
    category_of = {name: used[0].interval.label for name, used in objects.items()}
    manifest = SweepManifest(
        spec=touches.spec,
        sensor=touches.sensor,
        period_ns=touches.period_ns,
        lead=REST,
        categories=tuple(categories),
        split=_split_objects(category_of, shares, seed),
        category_of=category_of,
        recipe={
            "name": folder.name,
            "objects": {"from": RECORDINGS},
            RECORDINGS: {str(one): digest for one, digest in touches.sums.items()},
            "options": options,
            "seed": seed,
        },
        versions={"tactile_rt": VERSION, "numpy": np.__version__},
        version=RECORDED_VERSION,
    )
    with replace_folder(folder) as made:
        manifest.write(made)
        for name, used in objects.items():
            about: dict[str, Any] = {
                "recording": np.array([u.recording.name for u in used]),
                "onset_s": np.array([u.onset_s for u in used]),
            }
            write_object(made, name, np.stack([u.touch.values for u in used]), about)
        finish(made)
    return manifest


def check_shares(shares: Sequence[float]) -> None:
    """Raise a ConfigError unless the shares are valid, one per split, with some for training."""
    whole = len(shares) == len(SPLITS) and all(s >= 0 for s in shares) and sum(shares) < inf
    if not whole or not shares[0]:
        raise ConfigError(
            "--shares must be TRAIN,VALIDATION,TEST, as 0.7,0.15,0.15: all 0 or more, TRAIN above 0"
        )


def _group_by_object(touches: LabelledTouches) -> dict[str, list[LabelledTouch]]:
    """Group the touches by the name of their object.

    The labels may name the object. If not, each recording counts as an object if a label has
    `ENOUGH` recordings; else each touch counts as one, and a line of `left_out` warns of it.
    """
    recordings: defaultdict[str, set[Path]] = defaultdict(set)
    for used in touches.used:
        recordings[used.interval.label].add(used.recording)
    objects: defaultdict[str, list[LabelledTouch]] = defaultdict(list)
    alone: Counter[str] = Counter()
    for used in touches.used:
        label, thing = used.interval.thing
        if not thing:
            stem = os.fsencode(used.recording.stem)[:STEM].decode(errors="ignore")
            thing = f"{stem}-{touches.sums[used.recording][:DIGITS]}"
            if label == UNLABELLED or len(recordings[label]) < ENOUGH:
                alone[label] += 1
                thing += f"-{used.onset_s:.3f}"
        objects[f"{label}@{thing}"].append(used)
    for label, n in alone.items():
        if label != UNLABELLED:
            touches.left_out.append(
                f"touches of {label}, each taken for an object of its own: {n}; an accuracy says "
                f"nothing of other things: fill in the column object, or record {ENOUGH} files"
            )
    return dict(objects)


def _split_objects(
    category_of: Mapping[str, str], shares: Sequence[float], seed: int
) -> dict[str, tuple[str, ...]]:
    """Assign objects to splits by a hash of their names; each category keeps training objects."""
    sides: dict[str, list[str]] = {split: [] for split in SPLITS}
    for category in sorted(set(category_of.values())):
        names = sorted(
            (name for name, of in category_of.items() if of == category),
            key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest(),
        )
        held = [max(1, round(len(names) * s / sum(shares))) if s else 0 for s in shares[1:]]
        while sum(held) >= len(names):  # with few objects validation goes before test
            held[1 if held[1] >= held[0] else 0] -= 1
        ends = np.cumsum([len(names) - sum(held), *held]).tolist()
        for split, begin, end in zip(SPLITS, [0, *ends], ends, strict=False):
            sides[split] += names[begin:end]
    return {split: tuple(names) for split, names in sides.items()}
