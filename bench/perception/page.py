"""The page of the benchmark, `docs/reference/realtouch-2.md`, and its figures beside it."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bench.perception.area import (
    CALIBRATION,
    ENROLMENT,
    FLOORS,
    LEANING,
    MAKERS,
    NEVER,
    OBJECTS,
    SEVEN,
    SEVEN_OBJECTS,
    BenchmarkResults,
)
from bench.perception.data import NAME, SHAPES_FILE, Data
from bench.perception.folds import KINDS, TEST_KINDS
from bench.perception.methods import Method
from bench.perception.scores import Figures
from tactile_rt.models.evaluation.measured_coverage import NAMES_LEFT, Coverage
from tactile_rt.models.evaluation.measures import Interval

PAGE = Path("docs/reference/realtouch-2.md")
TESTS = (OBJECTS, LEANING, SEVEN_OBJECTS, NEVER)
BESIDE = "SVM, real"  # shown beside the model files
LISTED = 2134
SPLITS = {
    "train": "learning",
    "validation": "choosing settings",
    "test": "testing on objects that nobody touched",
    KINDS: "testing on kinds of `other` that nobody learnt from",
}
CARD = f"""\
---
# Of a data card, as Hugging Face reads it.
pretty_name: {NAME} 2, the shapes of real things by whiskers
license: apache-2.0 # of the loads; those of the meshes that were swept are below
task_categories: [other]
tags: [tactile, whisker, time-series, robotics, simulation]
size_categories: ["1K<n<10K"] # sweeps
source_datasets: [original]
annotations_creators: [expert-generated]
---

# {NAME} 2: shapes of real things by touch

*Written by `python -m bench.perception`; do not edit.*

A benchmark for classifiers of touch. Meshes of things, made by other people for other purposes, are
swept past the simulated mouse's 30 whiskers, and a method says of which of twelve
[shapes](shapes.md) each is, or that it is of another. What a thing is *for* (a box, a crate, a
cabinet) can hardly be felt: [realtouch 1](realtouch.md) asked for that. Objects are 40 mm large,
turned in any way about the vertical, and pass at 28 to 40 mm/s, at heights of -8 to 4 mm, 5.5 to 8
mm away; upright, or leaning by up to 30 degrees.

## Run it

```bash
tactile-rt bench perception --quick           # from the checkout alone, in minutes
python -m bench.perception                    # everything, and this page
python -m bench.perception --model MINE.onnx  # a model of your own that knows the shapes
```

For another kind of model, `load(SHAPES_FILE)` of `bench.perception.data` gives loads in N and N m,
labels and objects, by split; its `without_makers` holds out a fold. `python -m
bench.perception.make FOLDER --only realtouch-2` makes the data again from the meshes.

## Results

In percent, with 95 % intervals of a bootstrap over objects. Each method chose its settings on the
validation split of what it learnt from; nothing was chosen by the tests.

- *{OBJECTS}*: of makers of which other things were learnt, no near copy among them.
- *{SEVEN_OBJECTS}*: {", ".join(SEVEN)}, told apart from one another alone.
- *{NEVER}*: {", ".join(TEST_KINDS)}; right is `other`.

*Two*, *four*: posteriors of so many sweeps of an object, fused. *ECE*: expected calibration error,
15 bins. *Surest 50 %*: one sweep, the half with the largest posterior.
"""
REFUSALS = """\
## Prediction sets

*Coverage* is the share of touches with the true shape in the set at every step; *set* is the mean
number of shapes in it at the last step. A set of names holds kinds within the true shape.
"""
ENROLLING = """\
Ten held-out objects are enrolled by three sweeps each and judged by one or two others, at any yaw
and height; ten more are strangers; the mean of 200 draws, and what 95 of 100 draws have.
*Likeliest*: the right one of the ten; *named*: it, and not refused. The file refuses by a rule that
was to refuse 5 % of touches of enrolled objects, measured on objects for validation.
"""


def write_page(results: BenchmarkResults, path: Path) -> None:
    """Write the page, and its figures beside it."""
    found = figures(results)
    path.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    path.write_text(made(found, results.data), "utf-8")


def figures(results: BenchmarkResults) -> dict[str, Any]:
    """All figures in percent, rounded; an interval is (value, low, high)."""

    def by_method(found: Mapping[Method, Mapping[str, Interval]]) -> dict[str, Any]:
        return {_name(m): {k: _percent(v) for k, v in row.items()} for m, row in found.items()}

    def by_model(found: Mapping[str, Mapping[str, Interval]]) -> dict[str, Any]:
        return {name: {k: _percent(v) for k, v in row.items()} for name, row in found.items()}

    bounds = results.bounds
    return {
        "scores": {
            test: {_name(method): _scores(one) for method, one in scores.items()}
            for test, scores in results.scores.items()
        },
        "folds": {
            fold: {name: [_scores(one) for one in both] for name, both in of.items()}
            for fold, of in results.folds.items()
        },
        "robust": by_method(results.robust),
        "generator": by_method(results.generator),
        "coverage": {
            name: {test: _coverage(one) for test, one in tests.items()}
            for name, tests in results.coverage.items()
        },
        "names": {
            name: {k: _number(v) if k == NAMES_LEFT else _percent(v) for k, v in row.items()}
            for name, row in results.names.items()
        },
        "enrolment": {name: by_model(of) for name, of in results.enrolment.items()},
        "faults": by_model(results.faults),
        "false_touches": results.false_touches,
        "bounds": bounds and {k: _percent(v) for k, v in vars(bounds).items()},
    }


def _name(method: Method) -> str:
    return f"{method.name}, {method.taught}"


def _percent(one: Interval) -> list[float] | None:
    if one.value != one.value:
        return None
    return [round(100 * one.value, 1), round(100 * one.low), round(100 * one.high)]


def _number(one: Interval) -> list[float]:
    return [round(value, 1) for value in (one.value, one.low, one.high)]


def _scores(s: Figures) -> dict[str, Any]:
    values = {"one": s.top1, "two": s.two, "four": s.four, "mean over shapes": s.macro}
    values |= {"ECE": s.calibration}
    values |= {f"surest {c} %": one for c, one in s.at.items()}
    return {k: _percent(v) for k, v in values.items()}


def _coverage(one: Coverage) -> dict[str, Any]:
    return {
        "nominal": None if one.nominal != one.nominal else round(100 * one.nominal, 1),
        "coverage": _percent(one.covered),
        "set": None if one.size.value != one.size.value else round(one.size.value, 1),
        "called unknown": _percent(one.unknown),
        "refused for the loads": _percent(one.faulty),
    }


def made(found: dict[str, Any], data: Data) -> str:
    """Make the page of all figures."""
    lines = [CARD]
    columns = ("one", "two", "four", "mean over shapes", "ECE", "surest 50 %")
    for test in TESTS:
        scores = found["scores"].get(test, {})
        lines += [f"### {test.capitalize()}\n"]
        lines += _table(columns, {m: [one[c] for c in columns] for m, one in scores.items()})
        if test in FLOORS:
            one, four = FLOORS[test]
            most = f"; calibration error at most {CALIBRATION:g}" if test == OBJECTS else ""
            lines += [
                f"The shipped model must reach {one:g} by one sweep, {four:g} by four{most}.\n"
            ]
    if bounds := found["bounds"]:
        lines += [
            "Who knows the whole surface of all things learnt from and takes the nearest is right "
            f"in {_said(bounds['whole'])} of the held-out objects; a support vector machine that "
            f"sees a noise-free picture of how deep a side lies, in {_said(bounds['one'])}, and "
            f"with four of them in {_said(bounds['four'])}.\n"
        ]
    lines += _folds(found["folds"])
    if found["generator"]:
        shown = [m for m in found["robust"] if m.partition(",")[0] in found["coverage"]]
        lines += [
            "## With a faulty sensor\n",
            "One sweep of the held-out objects of seven shapes; no method was told of the fault.\n",
            *_columns(found["robust"], [*shown, BESIDE]),
            "## Generated objects, one condition changed at a time\n",
            "One sweep of 96 generated objects, 4 of each of 24 kinds, which no method has seen "
            "(`bench/perception/generator.py`); models learnt from objects made the same way.\n",
            *_columns(found["generator"], shown),
        ]
    if found["false_touches"]:
        silent, noisy = found["false_touches"]
        lines += [
            f"With the head shaken with 0.5 g and nothing near, {silent:.1f} touches a minute are "
            f"found, and {noisy:.1f} with the rated noise.\n"
        ]
    rows = {f"{m}, {t}": p for m, of in found["coverage"].items() for t, p in of.items()}
    if rows:
        lines += [
            REFUSALS,
            *_table(next(iter(rows.values())), {name: p.values() for name, p in rows.items()}),
            *_columns(found["names"], list(found["names"])),
            "Loads that no touch makes, refused and named as such:\n",
            *_columns(found["faults"], list(found["faults"])),
        ]
    for name, of in found["enrolment"].items():
        lines += [f"## Objects enrolled: {name}\n", ENROLLING, *_columns(of, list(of))]
        bars = [f"{f} {b:g} ({t})" for t, some in ENROLMENT.items() for f, b in some.items()]
        lines += [f"The shipped model must reach: {'; '.join(bars)}.\n"]
    return "\n".join([*lines, *_contents(data)])


def _folds(folds: dict[str, Any]) -> list[str]:
    """Learnt again without the things of each fold of makers."""
    if not folds:
        return []
    names = list(next(iter(folds.values())))
    rows = {}
    for name in names:
        for number, figure in (("one", "one sweep"), ("four", "four")):
            cells = [of.get(name, [{}, {}])[1].get(number) for of in folds.values()]
            there = [cell[0] for cell in cells if cell]
            mean = sum(there) / len(there) if there else None
            rows[f"{name}: {figure}"] = [*cells, mean and round(mean, 1)]
    one, four = FLOORS[MAKERS]
    return [
        "## Makers held out\n",
        "Learnt again without things of these makers, nor any like them, and tested on them.\n",
        *_table((*folds, "mean"), rows),
        f"The shipped model's likes must reach {one:g} and {four:g} in the mean.\n",
    ]


def _table(columns: Iterable[str], rows: dict[str, Iterable[Any]], of: str = "") -> list[str]:
    head = [of, *columns]
    said = (f"| {name} | {' | '.join(map(_said, cells))} |" for name, cells in rows.items())
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *said, ""]


def _columns(found: dict[str, dict[str, Any]], names: list[str]) -> list[str]:
    """A column for each of the methods, a row for each condition."""
    shown = {n: found[n] for n in names if found.get(n)}
    if not shown:
        return []
    rows = next(iter(shown.values()))
    return _table(shown, {row: [one.get(row) for one in shown.values()] for row in rows})


def _said(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"{value[0]:.1f} ({value[1]:.0f}-{value[2]:.0f})"
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _contents(data: Data) -> list[str]:
    origins = data.origins.values()

    def row(split: str) -> list[Any]:
        mine = sum(o.split == split for o in origins)
        leaning = len(data.wide[split].sweeps) if split in data.wide else None
        return [SPLITS[split], mine, len(data.sets[split].sweeps), leaning]

    shapes = Counter(o.category for o in origins)
    tested = Counter(o.category for o in origins if o.split == "test")
    sources = sorted(Counter((o.source, o.licence) for o in origins).items())
    return [
        "## The data\n",
        f"`bench/perception/data/{SHAPES_FILE.name}`, SHA-256 `{data.digest}`: made by the recipes "
        "`bench/perception/recipes/real2.toml` and `real2-leaning.toml` from the list "
        "`tactile_rt/sim_backend/objects/lists/real2.csv`, which has every mesh's address, hash, "
        "maker, kind and shape.\n",
        *_table(
            ("for", "objects", "sweeps", "leaning"), {f"`{s}`": row(s) for s in SPLITS}, "split"
        ),
        f"Of the {LISTED:,} objects of the list these {len(data.origins):,} were swept, those "
        "for testing first: figures of what learns from more will be higher.\n",
        "Variants, mirror images and copies of one object, of whatever source, are in one split.\n",
        *_table(
            ("objects", "of them tested"), {s: [n, tested[s]] for s, n in shapes.items()}, "shape"
        ),
        *_table(("licence", "objects"), {name: [of, n] for (name, of), n in sources}, "source"),
    ]
