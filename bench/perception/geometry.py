"""Bounds of what touch can tell: from a whole surface, and from a noise-free picture of a side.

Both need the meshes. An object is 40 mm large and upright, as it is swept.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from bench.perception.data import Data
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.models.evaluation.svm import PENALTIES, fit
from tactile_rt.sim_backend.objects.object_sets import open_objects

Floats = NDArray[np.float64]
SIZE_MM, POINTS, DENSE = 40.0, 256, 20_000
YAWS, LIKELY = 24, 60  # turns tried; objects of like profile that are tried
ACROSS, ROWS, BAND_MM = 32, 10, 10.0  # of a picture: columns, rows, half its height
PICTURES = 4  # of every object, each from a side and at a height of its own
HEIGHTS_MM = (-8.0, 4.0)


@dataclass(frozen=True)
class Bounds:
    """Bounds of what can be told of held-out objects.

    Attributes:
        whole: By the nearest of all whole shapes learnt from.
        one, four: By so many noise-free pictures of a side.
    """

    whole: Interval
    one: Interval
    four: Interval


def measure_bounds(data: Data, folder: Path) -> Bounds:
    """Measure the bounds on the held-out objects, whose meshes are in a folder."""
    split = {
        side: {n: data.kinds.index(o.category) for n, o in data.origins.items() if o.split == side}
        for side in ("train", "validation", "test")
    }
    surfaces = read_surfaces(folder, [n for names in split.values() for n in names])
    pictures = score_pictures(surfaces, split["train"], split["validation"], split["test"])
    whole = score_whole_shapes(surfaces, split["train"], split["test"])
    return Bounds(whole, *pictures)


def read_surfaces(folder: Path, names: Sequence[str]) -> dict[str, Floats]:
    """Read (point, 3) points, mm, on the surface of each object of a folder, the first ones few."""
    objects = open_objects(folder)
    path_of = {path.replace("/", "-"): path for path in objects.origins}
    found = {}
    for name in names:
        pieces = trimesh.util.concatenate(objects.load(path_of.get(name, name)).pieces)
        points, _ = trimesh.sample.sample_surface(pieces, DENSE, seed=0)
        found[name] = SIZE_MM * np.asarray(points, dtype=np.float64)
    return found


def nearest_shape(surface: Floats, others: Sequence[Floats]) -> int:
    """Find which of other surfaces is most like one, turned about z and mirrored."""
    profile = _profile(surface)
    likely = np.argsort([np.abs(profile - _profile(other)).sum() for other in others])[:LIKELY]
    points = surface[:POINTS]
    turned = [points * (1, side, 1) @ _turn(yaw).T for yaw in _angles(YAWS) for side in (1, -1)]
    return int(min(likely, key=lambda k: min(_chamfer(t, others[k][:POINTS]) for t in turned)))


def take_picture(surface: Floats, yaw_deg: float, height_mm: float) -> Floats:
    """Take a picture of how deep a side lies, (row, column) mm; nothing there is `SIZE_MM`."""
    x, y, z = (surface @ _turn(np.radians(yaw_deg)).T).T
    column = ((x / SIZE_MM + 0.5) * ACROSS).astype(int).clip(0, ACROSS - 1)
    row = np.floor(((z - height_mm) / BAND_MM + 1) / 2 * ROWS).astype(int)
    seen = (row >= 0) & (row < ROWS)
    depth = np.full((ROWS, ACROSS), SIZE_MM)
    np.minimum.at(depth, (row[seen], column[seen]), y.max() - y[seen])
    return depth


def score_whole_shapes(
    surfaces: Mapping[str, Floats], learnt: Mapping[str, int], test: Mapping[str, int]
) -> Interval:
    """Share of test objects whose label is that of the nearest learnt shape."""
    names = list(learnt)
    others = [surfaces[name] for name in names]
    right = [
        learnt[names[nearest_shape(surfaces[name], others)]] == label
        for name, label in test.items()
    ]
    return measures.accuracy(np.array(right), np.array(list(test)))


def score_pictures(
    surfaces: Mapping[str, Floats],
    learnt: Mapping[str, int],
    validation: Mapping[str, int],
    test: Mapping[str, int],
) -> tuple[Interval, Interval]:
    """Accuracy of a support vector machine that sees one picture of a side, and four fused."""
    x, labels, _ = _pictures(surfaces, learnt)
    held, right, _ = _pictures(surfaces, validation)
    classes = int(labels.max()) + 1
    machines = [fit(x, labels, penalty) for penalty in PENALTIES]
    best = max(machines, key=lambda one: float((one(held) == right).mean()))
    seen, known, objects = _pictures(surfaces, test)
    posteriors = measures.softmax(best.margins(seen, classes)).astype(np.float32)
    hits = measures.hits(posteriors, known)
    return (
        measures.accuracy(hits, objects),
        measures.fused_accuracy(posteriors, known, objects, PICTURES),
    )


def _pictures(
    surfaces: Mapping[str, Floats], labels: Mapping[str, int]
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.str_]]:
    rng = np.random.default_rng(0)
    seen = [
        take_picture(surfaces[name], rng.uniform(0, 360), -rng.uniform(*HEIGHTS_MM)).ravel()
        for name in labels
        for _ in range(PICTURES)
    ]
    names = np.repeat(list(labels), PICTURES)
    return np.array(seen, np.float32), np.repeat(list(labels.values()), PICTURES), names


def _profile(surface: Floats) -> Floats:
    """(8, 8) shares of the points by height and distance from the vertical through the middle."""
    away = np.hypot(surface[:, 0], surface[:, 1])
    span = [[-SIZE_MM / 2, SIZE_MM / 2], [0, SIZE_MM / 2**0.5]]
    return np.histogram2d(surface[:, 2], away, bins=8, range=span)[0] / len(surface)


def _chamfer(one: Floats, other: Floats) -> float:
    """Mean distance from each set of points to the other, mm."""
    squares = (one**2).sum(1)[:, None] + (other**2).sum(1) - 2 * one @ other.T
    apart = np.sqrt(np.maximum(squares, 0))
    return float(apart.min(axis=0).mean() + apart.min(axis=1).mean())


def _angles(count: int) -> Floats:
    return np.arange(count) * 2 * np.pi / count


def _turn(angle: float) -> Floats:
    """(3, 3) rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
