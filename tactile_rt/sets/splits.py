"""Functions that split sweep sets by object, check splits, and join or merge manifests."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tactile_rt.core.errors import ConfigError, RecordingError, name_some
from tactile_rt.sets.manifest import OUTLIERS, SPLITS, UNLABELLED, WITHHELD, SweepManifest


def split_by_object(
    categories: Sequence[str], objects: int, validation: int, test: int
) -> dict[str, tuple[str, ...]]:
    """Split `objects` objects of every category into training, validation and test, in order."""
    first = {"train": 0, "validation": objects - test - validation, "test": objects - test}
    stop = {"train": first["validation"], "validation": first["test"], "test": objects}
    return {
        # Index first, so that an unfinished set has its objects spread over the categories.
        split: tuple(f"{c}-{i}" for i in range(first[split], stop[split]) for c in categories)
        for split in SPLITS
    }


def check_labelled(folder: Path, manifest: SweepManifest) -> None:
    """Check that a set has labels, for training that uses labels.

    Raises:
        ConfigError: the touches of the set are unlabelled.
    """
    if UNLABELLED in manifest.categories:
        raise ConfigError(
            f"{folder} holds touches without labels: learn from them by --recipe simclr, or say "
            "what was touched with `tactile-rt label`"
        )


def check_split(folder: Path, manifest: SweepManifest) -> None:
    """Check that splits share no object and objects to train or test on have labels."""
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
            if split not in (WITHHELD, OUTLIERS) and manifest.label(name) < 0:
                raise RecordingError(
                    f"{folder}: {name} of {split!r} is of the withheld category "
                    f"{manifest.category(name)!r}, which has no label to train on"
                )


def trained_objects(
    manifests: Sequence[SweepManifest], saved: Mapping[str, Any] | None = None
) -> dict[str, list[str]]:
    """List training objects by source: those of `manifests` and of an earlier checkpoint."""
    before = saved.get("trained_objects", {}) if saved else {}
    found = {source: dict.fromkeys(names) for source, names in before.items()}
    for one in manifests:
        names = (*one.split["train"], *one.split.get(OUTLIERS, ()))
        found.setdefault(one.source, {}).update(dict.fromkeys(names))
    return {source: list(names) for source, names in found.items()}


def join_manifests(manifests: Sequence[SweepManifest]) -> SweepManifest:
    """Join manifests of one array: return the first, with categories and objects of all.

    Raises:
        ConfigError: the sets differ in array, sensor or sample period.
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
        category_of={name: c for one in manifests for name, c in one.category_of.items()},
        kind_of={name: kind for one in manifests for name, kind in one.kind_of.items()},
    )


def merge_categories(
    manifest: SweepManifest, classes: Mapping[str, Sequence[str]]
) -> SweepManifest:
    """Merge categories into classes; an object's old category becomes its kind.

    Args:
        classes: the categories to merge into each class; any other category is not changed.

    Raises:
        ConfigError: the set lacks a category in `classes`, or a category is in two classes.
    """
    class_of: dict[str, str] = {}
    for one, categories in classes.items():
        for category in categories:
            if category not in manifest.categories:
                known = name_some(manifest.categories, 8)
                raise ConfigError(f"classes: no category {category!r}: there are {known}")
            if class_of.setdefault(category, one) != one:
                raise ConfigError(f"classes: {category!r} is both {class_of[category]} and {one}")
    if not class_of:
        return manifest
    labelled = [name for name in manifest.names() if manifest.label(name) >= 0]
    before = {name: manifest.category(name) for name in labelled}
    return replace(
        manifest,
        categories=tuple(dict.fromkeys(class_of.get(c, c) for c in manifest.categories)),
        category_of=manifest.category_of | {n: class_of.get(c, c) for n, c in before.items()},
        kind_of={n: c for n, c in before.items() if c in class_of} | manifest.kind_of,
    )


def read_manifests(
    folders: Sequence[Path], labelled: bool
) -> tuple[list[SweepManifest], SweepManifest]:
    """Read and check the manifests of sets to train on; return each, and all joined.

    Args:
        folders: folders of the sets.
        labelled: True if training uses the labels.

    Raises:
        ConfigError: the sets cannot be joined, or a set has no labels and `labelled` is True.
        RecordingError: a set is missing, is no sweep set, or has an invalid split.
    """
    manifests = [SweepManifest.read(folder) for folder in folders]
    whole = join_manifests(manifests)
    for folder, manifest in [*zip(folders, manifests, strict=True), (folders[0], whole)]:
        if labelled:
            check_labelled(folder, manifest)
        check_split(folder, manifest)
    return manifests, whole
