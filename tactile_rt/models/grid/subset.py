"""Some sweeps of every object, as a sweep set of its own that all cells share."""

from dataclasses import replace
from pathlib import Path

from tactile_rt.models.grid.plan import SweepCounts
from tactile_rt.sweep_set import (
    SET_VERSION,
    SPLITS,
    SweepManifest,
    has_object,
    read_object,
    read_skipped,
    write_object,
    write_skipped,
)

__all__ = ["write_subset"]


def write_subset(source: Path, folder: Path, sweeps: SweepCounts) -> None:
    """Write, or go on writing, the first sweeps of every object of a set.

    Args:
        source: a sweep set.
        folder: where the smaller one goes.
        sweeps: how many of each object, by split.

    Raises:
        RecordingError: the source cannot be read.
        ConfigError: the folder holds another set.
    """
    manifest = SweepManifest.read(source)
    taken = {split: getattr(sweeps, split) for split in SPLITS}
    recipe = {key: value for key, value in manifest.recipe.items() if key != "contacts"}
    smaller = replace(
        manifest,
        split={split: manifest.split[split] for split in SPLITS},
        recipe={**recipe, "taken": taken, "from": str(source)},
        version=SET_VERSION,
    )
    smaller.write(folder)
    skipped = read_skipped(source)
    if skipped:
        write_skipped(folder, {k: v for k, v in skipped.items() if k in smaller.names()})
    for split, count in taken.items():
        for name in smaller.split[split]:
            if name in skipped or has_object(folder, name):
                continue
            values, parameters = read_object(source, name)
            few = slice(count or None)
            write_object(folder, name, values[few], {k: v[few] for k, v in parameters.items()})
