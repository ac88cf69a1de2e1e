"""Benchmark area `perception`: of what shape is a real thing that no model here has touched?

A method is tested on held-out objects, upright and leaning; on kinds within `other` that nobody
learns from; and, learnt again for each fold of makers, on all things of the makers held out. Quick:
the shipped model and what learns in a minute, from the data in the checkout alone. Whole: also
folds, networks, and what changes when the world or the sensor does.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from math import isnan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.perception.data import NAME, SHAPES_FILE, Data, load
from bench.perception.enrolment import measure_enrolment
from bench.perception.folds import FOLDS, KINDS, MAKER
from bench.perception.generator import UPRIGHT, false_touches, measured, rows
from bench.perception.geometry import Bounds, measure_bounds
from bench.perception.methods import Method, baselines, of_kinds, onnx_model
from bench.perception.scores import Figures, robustness, score
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.models.datasets import SweepSet, join_sets
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation.measured_coverage import (
    Coverage,
    measure_coverage,
    measure_names,
    named_faults,
)
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.models.evaluation.records import Record
from tactile_rt.models.evaluation.robustness import conditions

Floats = NDArray[np.float32]
FOLDER = Path("data") / NAME
OBJECTS, LEANING, NEVER = "held-out objects", "the same, leaning", "kinds never met"
SEVEN_OBJECTS, MAKERS = "held-out objects of seven shapes", "held-out makers, mean of folds"
BOTH = "held-out objects, upright or leaning"
SEVEN = ("block", "panel", "ball", "bottle", "bowl", "disc", "chair")
FLOORS = {  # of the shipped model, in percent, by test: one sweep, four
    OBJECTS: (58.0, 66.0),
    SEVEN_OBJECTS: (70.0, 75.0),
    MAKERS: (48.0, 54.0),
}
CALIBRATION = 6.0  # percent at most
ENROLMENT = {  # of the shipped model, in percent, by test
    OBJECTS: {
        "likeliest, 1 judged": 75.0,
        "strangers refused, 1 judged": 40.0,
        "AUROC, 1 judged": 82.0,
    },
    BOTH: {"likeliest, 2 judged": 83.0},
}
NETWORK = "shipped model"  # its likes, learnt without a fold


@dataclass
class BenchmarkResults:
    """All that was measured.

    Attributes:
        data: What it was measured on.
        scores: By test and method.
        folds: By fold and method: on held-out objects of the other makers, and on the held-out
            makers.
        robust: Top-1 on the held-out objects by condition.
        generator: Top-1 on generated objects by what is changed, of those that know their shapes.
        coverage: Of model files, by name and test.
        names: Coverage and size of the sets of names of model files, by name and class.
        faults: The share of loads that no touch makes that each model file refuses, by their name.
        bounds: What a whole surface, and a noise-free picture of a side, tell; None: not measured.
        enrolment: Of model files that enrol objects, by name and test, see `measure_enrolment`.
        false_touches: Touches a minute found while the head is shaken and nothing is near, without
            and with the rated noise; None: not measured.
    """

    data: Data
    scores: dict[str, dict[Method, Figures]] = field(default_factory=dict)
    folds: dict[str, dict[str, tuple[Figures, Figures]]] = field(default_factory=dict)
    robust: dict[Method, dict[str, Interval]] = field(default_factory=dict)
    generator: dict[Method, dict[str, Interval]] = field(default_factory=dict)
    coverage: dict[str, dict[str, Coverage]] = field(default_factory=dict)
    names: dict[str, dict[str, Interval]] = field(default_factory=dict)
    faults: dict[str, dict[str, Interval]] = field(default_factory=dict)
    enrolment: dict[str, dict[str, dict[str, Interval]]] = field(default_factory=dict)
    bounds: Bounds | None = None
    false_touches: tuple[float, float] | None = None


def run(quick: bool) -> list[Record]:
    """Measure the shipped model and the baselines."""
    return records_of(measure(quick, FOLDER))


def measure(
    quick: bool,
    folder: Path,
    models: tuple[Path, ...] = (),
    folds: Path | None = None,
    objects: Path | None = None,
    progress: Callable[[str], None] = lambda line: None,
) -> BenchmarkResults:
    """Measure the shipped model, others, and the baselines.

    Args:
        quick: leave out what needs sweeps of generated objects, learns for each fold, or trains a
            network.
        folder: of both.
        models: further model files; one that does not know the shapes is left out.
        folds: folder of a model file for each fold, `NAME.onnx`, trained without it.
        objects: folder of the objects that were swept, for the bounds.
        progress: told of what is measured next.
    """
    found = {path: onnx_model(path) for path in (shipped_model(), *models)}  # first: one may lack
    data, runs = load(SHAPES_FILE), None if quick else folder / "runs"
    for path in [path for path, one in found.items() if not set(data.kinds) <= set(one.kinds)]:
        progress(f"{path.stem} is left out: it does not know the shapes")
        del found[path]
    tests = {OBJECTS: data.sets["test"], LEANING: data.wide["test"], NEVER: data.sets[KINDS]}
    results = BenchmarkResults(data)
    changed = {} if quick else rows(folder, progress)
    for method in (*baselines(data, runs), *found.values()):
        progress(f"{method.name}, taught by {method.taught}")
        method = restrict(method, data.kinds)
        for name, test in tests.items():
            results.scores.setdefault(name, {})[method] = score(method, test)
        seven = of_kinds(tests[OBJECTS], SEVEN)
        of_seven = score(restrict(method, SEVEN), seven)
        results.scores.setdefault(SEVEN_OBJECTS, {})[method] = of_seven
        if not quick:
            results.robust[method] = robustness(method, seven, conditions(seven))
            results.generator[method] = measured(method, changed)
    plain = changed[UPRIGHT][0][0] if changed else tests[OBJECTS]
    for path, method in found.items():
        progress(f"{path.stem}: its coverage and refusals")
        labelled = {name: of_kinds(one, method.kinds) for name, one in tests.items()}
        on = {
            OBJECTS: (labelled[OBJECTS], CLEAN),
            f"{OBJECTS}, rated noise": (labelled[OBJECTS], Disturbance(noise=1)),
            LEANING: (labelled[LEANING], CLEAN),
            NEVER: (labelled[NEVER], CLEAN),
        }
        covered = {name: measure_coverage(path, *one) for name, one in on.items()}
        results.coverage[path.stem] = {n: c for n, c in covered.items() if c is not None}
        every = join_sets([tests[OBJECTS], tests[LEANING]])
        for name, test in {OBJECTS: tests[OBJECTS], BOTH: every}.items():
            if enrolled := measure_enrolment(path, test):
                results.enrolment.setdefault(path.stem, {})[name] = enrolled
        results.names[path.stem] = dict(measure_names(path, labelled[OBJECTS]))
        results.faults[path.stem] = dict(named_faults(path, plain))
    if not quick:
        for fold, makers in FOLDS.items():
            progress(f"without {fold}")
            part = data.without_makers(makers)
            for method in _learnt_without(part, fold, runs, folds):
                mine = restrict(method, data.kinds)
                both = score(mine, part.sets["test"]), score(mine, part.sets[MAKER])
                results.folds.setdefault(fold, {})[f"{method.name}, {method.taught}"] = both
        results.false_touches = false_touches(folder, 0.0), false_touches(folder, 1.0)
    if objects is not None:
        progress("bounds")
        results.bounds = measure_bounds(data, objects)
    return results


def _learnt_without(
    part: Data, fold: str, runs: Path | None, folds: Path | None
) -> Iterator[Method]:
    yield from baselines(part, runs)
    if folds is not None and (folds / f"{fold}.onnx").exists():
        yield replace(onnx_model(folds / f"{fold}.onnx"), name=NETWORK)


def restrict(method: Method, kinds: tuple[str, ...]) -> Method:
    """Return the method that knows that things are of these kinds alone."""
    at = [method.kinds.index(kind) for kind in kinds]

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
        found = method.posteriors(sweeps, disturbance)[:, at]
        return found / np.maximum(found.sum(axis=1, keepdims=True), np.float32(1e-12))

    return replace(method, kinds=kinds, posteriors=posteriors)


def records_of(results: BenchmarkResults) -> list[Record]:
    """The figures that matter most as records; those of the shipped model have bars."""
    found, shipped = [], shipped_model().stem
    for test, scores in results.scores.items():
        for method, one in scores.items():
            bars = FLOORS.get(test, ()) if method.name == shipped else ()
            least = [f">= {bar:g}" for bar in bars] or ["", ""]
            most = f"<= {CALIBRATION:g}" if bars and test == OBJECTS else ""
            values = {
                "shape, one sweep": (one.top1, least[0]),
                "shape, four sweeps": (one.four, least[1]),
                "mean over shapes, one sweep": (one.macro, ""),
                "calibration error": (one.calibration, most),
            }
            found += [
                Record(
                    f"perception.{method.name}, {test}: {figure}", 100 * value.value, "%", bar,
                    f"taught by {method.taught}; {len(method.kinds)} shapes",
                    f"95 % interval {100 * value.low:.0f} to {100 * value.high:.0f}, by object",
                )
                for figure, (value, bar) in values.items()
                if not isnan(value.value)
            ]  # fmt: skip
    return [*found, *_records_of_enrolment(results), *_records_of_makers(results)]


def _records_of_enrolment(results: BenchmarkResults) -> Iterator[Record]:
    for name, tests in results.enrolment.items():
        for test, figures in tests.items():
            bars = ENROLMENT[test] if name == shipped_model().stem else {}
            for figure, value in figures.items():
                yield Record(
                    f"perception.{name}, ten enrolled of {test}: {figure}", 100 * value.value, "%",
                    f">= {bars[figure]:g}" if figure in bars else "", "three touches each",
                    f"{100 * value.low:.0f} to {100 * value.high:.0f} in 95 of 100 draws",
                )  # fmt: skip


def _records_of_makers(results: BenchmarkResults) -> Iterator[Record]:
    folds = results.folds
    for name in next(iter(folds.values()), ()):
        bars = FLOORS[MAKERS] if name.startswith(NETWORK) else ()
        for number, figure in enumerate(("one sweep", "four sweeps")):
            shares = {
                fold: (of[name][1].top1, of[name][1].four)[number].value
                for fold, of in folds.items()
                if name in of
            }
            yield Record(
                f"perception.{name}, shape, {figure}",
                100 * float(np.nanmean(list(shares.values()))), "%",
                f">= {bars[number]:g}" if bars else "", MAKERS,
                ", ".join(f"{fold} {100 * share:.0f}" for fold, share in shares.items()),
            )  # fmt: skip
