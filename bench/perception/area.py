"""Benchmark area `perception`: real things that no model here has touched.

Quick: the shipped model and what learns from the real sweeps in a minute, from the data in the
checkout alone. Whole: also what learns from generated objects, and networks.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import isnan
from pathlib import Path

from bench.perception.data import NAME, SOURCE, Data, load
from bench.perception.generator import UPRIGHT, Condition, false_touches, measured, rows
from bench.perception.methods import (
    GENERATED,
    Method,
    baselines,
    digest_of,
    of_kinds,
    onnx_model,
)
from bench.perception.scores import Figures, accuracy_by_source, robustness, score
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.models.datasets import SweepSet, joined
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation.coverage import Coverage, measure_coverage, named_faults
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.models.evaluation.records import Record
from tactile_rt.models.evaluation.robustness import conditions
from tactile_rt.sets.manifest import SPLITS, WITHHELD
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import DEFAULT_RECIPE, read_recipe

FOLDER = Path("data") / NAME
OBJECTS, ELSEWHERE, WIDE = "held-out objects", "held-out source", "both, in the wide world"
SHARED, SHARED_WIDE = "kinds that are also generated", "these kinds, in the wide world"
ALL = "all real objects of these kinds"


@dataclass
class BenchmarkResults:
    """All that was measured.

    Attributes:
        data: What it was measured on.
        scores: By test and method (name, taught).
        by_source: Top-1 on the held-out objects and the held-out source together, by source.
        robust: Top-1 on the held-out objects by condition.
        generator: Top-1 on generated objects by what is changed, of those that know them.
        coverage: The coverage and the refusals of each model file, by its name and test.
        faults: The share of loads that no touch makes that each model file refuses, by their name.
        false_touches: Touches a minute found while the head is shaken and nothing is near, without
            and with the rated noise; None: not measured.
        digest: SHA-256 over the sweeps of generated objects, empty if they were not used.
    """

    data: Data
    scores: dict[str, dict[Method, Figures]]
    by_source: dict[Method, dict[str, Interval]]
    robust: dict[Method, dict[str, Interval]]
    generator: dict[Method, dict[str, Interval]]
    coverage: dict[str, dict[str, Coverage]] = field(default_factory=dict)
    faults: dict[str, dict[str, Interval]] = field(default_factory=dict)
    false_touches: tuple[float, float] | None = None
    digest: str = ""


def run(quick: bool) -> list[Record]:
    """Measure the shipped model and the baselines."""
    return records_of(measure(quick, FOLDER))


def measure(
    quick: bool,
    folder: Path,
    models: tuple[Path, ...] = (),
    progress: Callable[[str], None] = lambda line: None,
) -> BenchmarkResults:
    """Measure the shipped model, others, and the baselines.

    Args:
        quick: leave out what needs sweeps of generated objects, or trains a network.
        folder: of both.
        models: further model files.
        progress: told of what is measured next.
    """
    shipped = shipped_model()
    files = [onnx_model(path) for path in (shipped, *models)]  # first: one may not be there
    data, generated, digest = load(), None, ""
    recipe, there = read_recipe(DEFAULT_RECIPE), folder / DEFAULT_RECIPE
    if not quick:
        for name in make_sweeps(recipe, there, splits=SPLITS[:2]):
            progress(name)
        generated = SweepSet.read(there, "train"), SweepSet.read(there, "validation")
        digest = digest_of(*generated)
    held_out = _together([data.sets["test"], data.sets[SOURCE]])
    generated_kinds = recipe.objects.categories
    wide = _together([data.wide["test"], data.wide[SOURCE]])
    tests = {
        OBJECTS: data.sets["test"],
        ELSEWHERE: data.sets[SOURCE],
        WIDE: wide,
        SHARED: of_kinds(held_out, generated_kinds),
        SHARED_WIDE: of_kinds(wide, generated_kinds),
        ALL: of_kinds(
            _together([data.sets[split] for split in (*SPLITS, SOURCE)]), generated_kinds
        ),
    }
    methods = [*baselines(data, generated, None if quick else folder / "runs"), *files]
    changed = {} if quick else rows(folder, progress)
    results = BenchmarkResults(data, {test: {} for test in tests}, {}, {}, {}, digest=digest)
    for method in methods:
        progress(f"{method.name}, taught by {method.taught}")
        of = [SHARED, SHARED_WIDE]
        if set(data.kinds) <= set(method.kinds):
            of = [OBJECTS, ELSEWHERE, WIDE, *of]
        if method.taught == GENERATED:  # real objects that it has not seen are all there are
            of.append(ALL)
        unknown = data.sets[WITHHELD]
        strange = method.score_known(unknown), unknown.sweeps.objects
        for test in of:  # unknown things stand: they are no match for known ones that do not
            against = None if test in (WIDE, SHARED_WIDE) else strange
            results.scores[test][method] = score(method, tests[test], against)
        on = tests[of[0]]
        results.robust[method] = {} if quick else robustness(method, on, conditions(on))
        if changed and (found := measured(method, changed)):
            results.generator[method] = found
        results.by_source[method] = accuracy_by_source(
            method, held_out if of[0] == OBJECTS else tests[SHARED], data
        )
    if not quick:
        results.false_touches = false_touches(folder, 0.0), false_touches(folder, 1.0)
    for path in (shipped, *models):
        progress(f"{path.stem}: its coverage and refusals")
        _measure_refusals(results, path, tests, data, changed)
    return results


def _measure_refusals(
    results: BenchmarkResults,
    path: Path,
    tests: dict[str, SweepSet],
    data: Data,
    changed: dict[str, list[Condition]],
) -> None:
    """Measure the coverage and the refusals of a model file."""
    on: dict[str, tuple[SweepSet, Disturbance]] = {
        OBJECTS: (tests[OBJECTS], CLEAN),
        f"{OBJECTS}, rated noise": (tests[OBJECTS], Disturbance(noise=1)),
        ELSEWHERE: (tests[ELSEWHERE], CLEAN),
        "unknown kinds": (data.sets[WITHHELD], CLEAN),
    }
    plain = changed[UPRIGHT][0][0] if changed else None
    if plain:
        for noise, name in ((0, "generated"), (1, "rated noise"), (2, "twice that")):
            said = name if not noise else f"generated, {name}"
            on[said] = plain, Disturbance(noise=noise)
    kinds = load_model(path)[1].classes
    found = {}
    for name, (test, disturbance) in on.items():
        known = of_kinds(test, kinds)  # there are none among the unknown
        found[name] = measure_coverage(path, known if len(known.sweeps) else test, disturbance)
    told = {name: one for name, one in found.items() if one is not None}
    if told:
        results.coverage[path.stem] = told
        results.faults[path.stem] = dict(named_faults(path, plain or tests[OBJECTS]))


def records_of(results: BenchmarkResults) -> list[Record]:
    """The figures that matter most as records; `page` has all of them."""
    found = []
    for test, scores in results.scores.items():
        for method, one in scores.items():
            figures = {
                "top-1": one.top1,
                "four sweeps fused": one.four,
                "calibration error": one.calibration,
                "open set (AUROC)": one.auroc,
            }
            found += [
                Record(
                    f"perception.{method.name}, {figure}",
                    100 * value.value,
                    "%",
                    "",
                    f"{test}; taught by {method.taught}; {len(method.kinds)} kinds",
                    f"95 % interval {100 * value.low:.0f} to {100 * value.high:.0f}, by object",
                )
                for figure, value in figures.items()
                if not isnan(value.value)
            ]
    return found


def _together(sets: list[SweepSet]) -> SweepSet:
    """Splits of one set as one."""
    return joined([of_kinds(one, one.manifest.categories) for one in sets])
