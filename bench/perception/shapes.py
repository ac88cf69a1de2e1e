"""realtouch 2: of what shape is a real thing, also one whose maker's things were never touched?

A method is tested on held-out objects, upright and leaning; on kinds within `other` that it learnt
nothing of; and, learnt again for each fold of makers, on all things of the makers held out.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import isnan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.perception.data import SHAPES_FILE, Data, load
from bench.perception.folds import FOLDS, KINDS, MAKER
from bench.perception.methods import Method, baselines, of_kinds, onnx_model
from bench.perception.scores import Figures, score
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import Disturbance
from tactile_rt.models.evaluation.coverage import Coverage, measure_coverage
from tactile_rt.models.evaluation.records import Record

Floats = NDArray[np.float32]
OBJECTS, LEANING, NEVER = "held-out objects", "the same, leaning", "kinds never met"
SEVEN_OBJECTS, MAKERS = "held-out objects of seven shapes", "held-out makers, mean of folds"
SEVEN = ("block", "panel", "ball", "bottle", "bowl", "disc", "chair")
FLOORS = {  # of the shipped model, in percent, by test: one sweep, four
    OBJECTS: (58.0, 66.0),
    SEVEN_OBJECTS: (70.0, 75.0),
    MAKERS: (48.0, 54.0),
}
CALIBRATION = 6.0  # percent at most


@dataclass
class ShapeResults:
    """All that was measured.

    Attributes:
        data: What it was measured on.
        scores: By test and method.
        folds: By fold and method: on held-out objects of the other makers, and on the held-out
            makers.
        coverage: Of model files, by name and test.
    """

    data: Data
    scores: dict[str, dict[Method, Figures]] = field(default_factory=dict)
    folds: dict[str, dict[str, tuple[Figures, Figures]]] = field(default_factory=dict)
    coverage: dict[str, dict[str, Coverage]] = field(default_factory=dict)


def measure(
    quick: bool,
    runs: Path,
    models: tuple[Path, ...] = (),
    folds: Path | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> ShapeResults:
    """Measure model files and baselines.

    Args:
        quick: train no network.
        runs: folder where networks are trained.
        models: model files; one that does not know the shapes is left out.
        folds: folder of a model file for each fold, `NAME.onnx`, each trained without that fold.
        progress: told of what is measured next.
    """
    data = load(SHAPES_FILE)
    files = {path.stem: path for path in models}
    known = [one for one in map(onnx_model, models) if set(data.kinds) <= set(one.kinds)]
    methods = [*baselines(data, None, None if quick else runs), *known]
    results = ShapeResults(data)
    tests = {OBJECTS: data.sets["test"], LEANING: data.wide["test"], NEVER: data.sets[KINDS]}
    for method in methods:
        progress(f"{method.name}, taught by {method.taught}")
        method = restricted(method, data.kinds)
        for name, test in tests.items():
            results.scores.setdefault(name, {})[method] = score(method, test)
        seven = of_kinds(tests[OBJECTS], SEVEN)
        found = score(restricted(method, SEVEN), seven)
        results.scores.setdefault(SEVEN_OBJECTS, {})[method] = found
    for one in known:
        path = files[one.name]
        on = ((OBJECTS, tests[OBJECTS]), (LEANING, tests[LEANING]))
        covered = {name: measure_coverage(path, test) for name, test in on}
        results.coverage[one.name] = {n: c for n, c in covered.items() if c is not None}
    for fold, makers in FOLDS.items():
        progress(f"without {fold}")
        for method in _taught_without(data, fold, makers, quick, runs, folds):
            part = data.without_makers(makers)
            mine = restricted(method, data.kinds)
            both = score(mine, part.sets["test"]), score(mine, part.sets[MAKER])
            results.folds.setdefault(fold, {})[f"{method.name}, {method.taught}"] = both
    return results


def _taught_without(
    data: Data, fold: str, makers: tuple[str, ...], quick: bool, runs: Path, folds: Path | None
) -> Iterator[Method]:
    yield from baselines(data.without_makers(makers), None, None if quick else runs)
    if folds is not None:
        yield replace(onnx_model(folds / f"{fold}.onnx"), name="network")


def restricted(method: Method, kinds: tuple[str, ...]) -> Method:
    """The method that knows that things are of these kinds alone."""
    at = [method.kinds.index(kind) for kind in kinds]

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
        found = method.posteriors(sweeps, disturbance)[:, at]
        return found / np.maximum(found.sum(axis=1, keepdims=True), np.float32(1e-12))

    return replace(method, kinds=kinds, posteriors=posteriors)


def records_of(results: ShapeResults, shipped: str) -> list[Record]:
    """The figures as records; those of the shipped model have bars."""
    found = []
    for test, scores in results.scores.items():
        for method, one in scores.items():
            bars = FLOORS.get(test, ()) if method.name == shipped else ()
            values = {
                "shape, one sweep": (one.top1, bars and f">= {bars[0]:g}"),
                "shape, four sweeps": (one.four, bars and f">= {bars[1]:g}"),
                "mean over shapes, one sweep": (one.macro, ""),
                "calibration error": (one.calibration, f"<= {CALIBRATION:g}"
                                      if bars and test == OBJECTS else ""),
            }  # fmt: skip
            found += [
                Record(
                    f"perception.{method.name}, {figure}", 100 * value.value, "%", bar or "",
                    f"{test}; taught by {method.taught}; {len(method.kinds)} shapes",
                    f"95 % interval {100 * value.low:.0f} to {100 * value.high:.0f}, by object",
                )
                for figure, (value, bar) in values.items()
                if not isnan(value.value)
            ]  # fmt: skip
    return found + _records_of_makers(results)


def _records_of_makers(results: ShapeResults) -> list[Record]:
    folds = list(results.folds.values())
    found = []
    for name in folds[0] if folds else ():
        bars = FLOORS[MAKERS] if name.startswith("network") else ()
        for number, figure in enumerate(("one", "four")):
            shares = [(f[name][1].top1, f[name][1].four)[number].value for f in folds]
            each = ", ".join(
                f"{n} {100 * s:.0f}" for n, s in zip(results.folds, shares, strict=True)
            )
            found.append(
                Record(
                    f"perception.{name}, shape, {figure} sweep{'s' * number}",
                    100 * float(np.nanmean(shares)), "%", (bars and f">= {bars[number]:g}") or "",
                    MAKERS, each,
                )
            )  # fmt: skip
    return found
