"""A sweep set that is quickly made, of an array like the mouse's, and needs no simulator."""

from pathlib import Path

import numpy as np

from tactile_rt.core.stream import ArraySpec
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import write_object
from tactile_rt.sets.splits import split_by_object

COLUMNS = (5, 5, 7, 7, 6)  # of rows A to E
LEAD, SAMPLES = 24, 136
CATEGORIES = ("ball", "cube", "cone")


def tiny_array(seed: int = 0) -> ArraySpec:
    """30 whiskers on a ragged 5 x 7 grid, each turned in its own way."""
    rng = np.random.default_rng(seed)
    grid = tuple((r, c) for r, n in enumerate(COLUMNS) for c in range(n))
    turns = rng.normal(size=(len(grid), 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return ArraySpec(
        name="tiny",
        elements=tuple(f"{'ABCDE'[r]}{c}" for r, c in grid),
        grid=grid,
        positions=tuple((4e-3, 1e-3 * c + 1e-4 * r, -1e-3 * r) for r, c in grid),
        orientations=tuple(tuple(map(float, q)) for q in turns),
        channels=("fx", "fy", "fz", "mx", "my", "mz"),
        units=("N", "N", "N", "N m", "N m", "N m"),
        rate_hz=1000.0,
        frame="head",
    )


def plate(rows: int, columns: int, channels: str = "fx fy fz mx my mz") -> ArraySpec:
    """Whiskers of a robot in rows on a plate, all upright."""
    cells = tuple((r, c) for r in range(rows) for c in range(columns))
    names = tuple(channels.split())
    return ArraySpec(
        name="plate",
        elements=tuple(f"{'ABCDE'[r]}{c}" for r, c in cells),
        grid=cells,
        positions=tuple((0.0, 0.01 * c, -0.01 * r) for r, c in cells),
        orientations=((1.0, 0.0, 0.0, 0.0),) * len(cells),
        channels=names,
        units=tuple({"f": "N", "m": "N m"}[name[0]] for name in names),
        rate_hz=1000.0,
        frame="plate",
    )


def write_tiny_set(
    folder: Path,
    objects: int = 6,
    sweeps: int = 1,
    spec: ArraySpec | None = None,
    period_ns: int = 9_000_000,
    contacts: bool = False,
    categories: tuple[str, ...] = CATEGORIES,
    outliers: int = 0,
    faults: dict[str, float] | None = None,
    kinds: tuple[str, ...] = (),
    held_out: int = 1,
) -> SweepManifest:
    """Objects of some categories, every sweep a touch that noise and a category's mean make.

    `kinds`: those of every category but the last, each of its objects one after another; their mean
    is another. `held_out`: objects of a category for validation, and for test.
    """
    spec, rng = spec or tiny_array(), np.random.default_rng(1)
    split = split_by_object(categories, objects, held_out, held_out)
    kind_of = {
        f"{c}-{i}": kinds[i % len(kinds)]
        for c in categories[:-1] if kinds for i in range(objects)
    }  # fmt: skip
    recipe = {"contacts": True} if contacts else {}
    recipe |= {"faults": faults} if faults else {}
    withheld = ("thing",) if outliers else ()
    if outliers:
        split["outliers"] = tuple(f"thing-{k}" for k in range(outliers))
    manifest = SweepManifest(
        spec, period_ns, LEAD, categories, split, recipe=recipe, withheld=withheld, kind_of=kind_of
    )
    manifest.write(folder)
    unit = np.array([{"N": 1e-4, "N m": 1e-6}[u] for u in spec.units])
    # the last is that of things of no category
    means = np.random.default_rng(2).normal(size=(len(categories) + 1, *spec.shape)) * unit
    apart = np.random.default_rng(3).normal(size=(len(kinds), *spec.shape)) * unit
    for name in manifest.names():
        mean = means[manifest.label(name)]
        if kind := kind_of.get(name):
            mean = mean + apart[kinds.index(kind)]
        values = mean + rng.normal(size=(sweeps, SAMPLES, *spec.shape)) * unit
        values[:, :LEAD] = 0
        where = np.full(values.shape[:3], np.nan, np.float32)
        where[:, LEAD:] = 0.01  # of the base, m
        write_object(folder, name, values.astype(np.float32), {}, where if contacts else None)
    return manifest
