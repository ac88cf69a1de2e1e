"""The page of the benchmark, `docs/reference/realtouch.md`, and its figures, `realtouch.json`."""

import json
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from bench.perception.area import ELSEWHERE, OBJECTS, SHARED, SHARED_WIDE, WIDE, BenchmarkResults
from bench.perception.data import NAME, SOURCE, VERSION, Data
from bench.perception.methods import Method
from bench.perception.scores import Figures
from tactile_rt.models.evaluation.coverage import Coverage
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.sets.manifest import OUTLIERS, WITHHELD
from tactile_rt.sim_backend.datasets.recipe_files import DEFAULT_RECIPE

PAGE = Path("docs/reference/realtouch.md")
BESIDE = "SVM, real"  # shown beside the model files where it knows the kinds
SPLITS = {
    "train": "learning",
    "validation": "choosing settings",
    "test": "testing on objects of a known kind and source",
    SOURCE: "testing on a source that no other split has anything of",
    OUTLIERS: "learning what is unknown, if a method does",
    WITHHELD: "testing what a method makes of unknown kinds",
}
TESTS = (OBJECTS, ELSEWHERE, WIDE, SHARED, SHARED_WIDE)
CARD = """\
---
# Of a data card, as Hugging Face reads it.
pretty_name: {name}, what whiskers feel of real things
license: apache-2.0 # of the loads; those of the meshes that were swept are below
task_categories: [other]
tags: [tactile, whisker, time-series, robotics, simulation]
size_categories: ["1K<n<10K"] # sweeps
source_datasets: [original]
annotations_creators: [expert-generated]
---

# {name}: real objects by touch

*Written by `python -m bench.perception`; do not edit.*

A benchmark for classifiers of touch. Meshes of real objects, made by other people for other
purposes, are swept past the simulated mouse's 30 whiskers, and a method says of what kind each
object is. The loads at the whiskers are the data; a method may learn from anything but the test
splits. Objects stand upright, are 40 mm large, turned in any way about the vertical, and pass at 28
to 40 mm/s, at heights of -8 to 4 mm, 5.5 to 8 mm away.

## Run it

```bash
tactile-rt bench perception --quick           # from the checkout alone, in a minute or two
python -m bench.perception                    # everything, and this page: 90 minutes on two cores
python -m bench.perception --model MINE.onnx  # a model of your own beside it
```

For another kind of model, `bench.perception.data.load()` gives loads in N and N m, labels and
objects, by split. `python -m bench.perception.make FOLDER` makes the data again from the meshes.
"""
RESULTS = """\
## Results

In percent, with 95 % intervals of a bootstrap over objects. `mouse44` is the [shipped
model](mouse44.md). Each method chose its settings on the validation split of what it was taught.
All figures, also by source and for every method, are in [realtouch.json](realtouch.json).

Top-1 accuracy, one sweep:

- *{objects}*: of kinds that the method was taught, from sources of which it touched other objects.
- *{elsewhere}*: the same kinds, all from a source of which no method has touched anything.
- *{wide}*: the objects of these two tests, 25 to 60 mm large, smooth or rough, leaning by up to 30
  degrees, from other directions, at 20 to 60 mm/s, past a head shaken with up to 0.5 g. No real
  object was taught in this world.
- *{shared}*: of these two tests, only kinds that generated objects have, too, so that methods
  taught on generated objects alone can be compared; and *{shared_wide}*.
"""
ACCOUNT = """\
More on the held-out objects. *Two*, *four*: posteriors of so many sweeps of an object, fused.
*Surest 50 %*: top-1 on the half of the sweeps with the largest posterior. *ECE*: expected
calibration error, 15 bins. *AUROC*: how well the largest posterior tells known kinds from unknown
ones; 50 is chance.
"""
REFUSALS = """\
### Refusals and prediction sets

A model file may answer `unknown`, or that something is wrong with the loads, and may have
prediction sets. *Coverage* is the share of touches with the true kind in the set at every step;
*set* is the mean number of kinds in it at the last step.
"""


def write_page(results: BenchmarkResults, path: Path) -> None:
    """Write the page, and its figures beside it."""
    found = figures(results)
    path.with_suffix(".json").write_text(json.dumps(found, indent=1) + "\n", "utf-8")
    path.write_text(made(found, results.data), "utf-8")


def figures(results: BenchmarkResults) -> dict[str, Any]:
    """All figures in percent, rounded; an interval is (value, low, high)."""

    def by_method(found: dict[Method, dict[str, Interval]]) -> dict[str, Any]:
        return {_name(m): {k: _percent(v) for k, v in row.items()} for m, row in found.items()}

    return {
        "scores": {
            test: [_scores(method, one) for method, one in scores.items()]
            for test, scores in results.scores.items()
        },
        "by_source": by_method(results.by_source),
        "robust": by_method(results.robust),
        "generator": by_method(results.generator),
        "false_touches": results.false_touches,
        "coverage": {
            name: {test: _coverage(one) for test, one in tests.items()}
            for name, tests in results.coverage.items()
        },
        "faults": {
            name: {fault: _percent(v) for fault, v in row.items()}
            for name, row in results.faults.items()
        },
        "digest": results.digest,
    }


def _name(method: Method) -> str:
    return f"{method.name}, {method.taught}"


def _percent(one: Interval) -> list[float] | None:
    if one.value != one.value:
        return None
    return [round(100 * one.value, 1), round(100 * one.low), round(100 * one.high)]


def _scores(method: Method, s: Figures) -> dict[str, Any]:
    values = {"top-1": s.top1, "top-5": s.top5, "mean over kinds": s.macro, "two": s.two}
    values |= {"four": s.four, "ECE": s.calibration, "AUROC": s.auroc}
    values |= {f"surest {c} %": one for c, one in s.at.items()}
    said = {k: _percent(v) for k, v in values.items()}
    return {"method": _name(method), "kinds": len(method.kinds), **said}


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
    tests = {t: {one["method"]: one for one in found["scores"].get(t, ())} for t in TESTS}
    methods = dict.fromkeys(m for scores in tests.values() for m in scores)
    account = ("two", "four", "surest 50 %", "ECE", "AUROC")
    models = [m for m in found["robust"] if m.partition(",")[0] in found["coverage"]]
    about = {"objects": OBJECTS, "elsewhere": ELSEWHERE, "wide": WIDE}
    lines = [
        CARD.format(name=f"{NAME} {VERSION}"),
        RESULTS.format(**about, shared=SHARED, shared_wide=SHARED_WIDE),
        *_table(TESTS, {m: [tests[t].get(m, {}).get("top-1") for t in TESTS] for m in methods}),
        ACCOUNT,
        *_table(account, {m: [one.get(k) for k in account] for m, one in tests[OBJECTS].items()}),
        "### With a faulty sensor\n",
        f"Top-1 on the {OBJECTS}; no method was told of the fault.\n",
        *_columns(found["robust"], [*models, BESIDE]),
    ]
    if found["generator"]:
        lines += [
            "### Generated objects, one condition changed at a time\n",
            "Top-1 on 96 generated objects of 24 kinds that no method has seen, 3 sweeps each "
            "(`bench/perception/generator.py`). `mouse44` learnt from objects made the same way.\n",
            *_columns(found["generator"], models),
            f"Methods taught on `generated` learnt from the recipe `{DEFAULT_RECIPE}`, whose loads "
            f"have the SHA-256 `{found['digest']}`.\n",
        ]
    if found["false_touches"]:
        silent, noisy = found["false_touches"]
        lines += [
            f"With the head shaken with 0.5 g and nothing near, {silent:.1f} touches a minute are "
            f"found, and {noisy:.1f} with the rated noise.\n"
        ]
    if found["coverage"]:
        rows = {f"{m}, {t}": p for m, of in found["coverage"].items() for t, p in of.items()}
        lines += [
            REFUSALS,
            *_table(next(iter(rows.values())), {name: p.values() for name, p in rows.items()}),
            "Loads that no touch makes, refused and named as such:\n",
            *_columns(found["faults"], list(found["faults"])),
        ]
    return "\n".join([*lines, *_contents(data)])


def _table(columns: Iterable[str], rows: dict[str, Iterable[Any]], of: str = "") -> list[str]:
    head = [of, *columns]
    said = (f"| {name} | {' | '.join(map(_said, cells))} |" for name, cells in rows.items())
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *said, ""]


def _columns(found: dict[str, dict[str, Any]], names: list[str]) -> list[str]:
    """A column for each of the methods, a row for each condition."""
    shown = {n: found[n] for n in names if n in found}
    rows = next(iter(shown.values()))
    return _table(shown, {row: [one.get(row) for one in shown.values()] for row in rows})


def _said(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"{value[0]:.1f} ({value[1]:.0f}-{value[2]:.0f})"
    return "-" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _contents(data: Data) -> list[str]:
    origins = data.origins.values()

    def row(split: str) -> list[Any]:
        mine = [o.category for o in origins if o.split == split]
        wide = len(data.wide[split].sweeps) if split in data.wide else None
        return [SPLITS[split], len({*mine}), len(mine), len(data.sets[split].sweeps), wide]

    def named(split: str) -> str:
        return ", ".join(
            sorted({o.category.replace("_", " ") for o in origins if o.split == split})
        )

    sources = sorted(Counter((o.source, o.licence) for o in origins).items())
    columns = ("for", "kinds", "objects", "sweeps", "in the wide world")
    return [
        "## The data\n",
        f"`bench/perception/data/{NAME}-{VERSION}.xz`, SHA-256 `{data.digest}`: made by the "
        "recipes `bench/perception/recipes/real27.toml` and `real27-source.toml` from the list "
        "`tactile_rt/sim_backend/objects/lists/real.csv`, which has every mesh's address and hash."
        "\n",
        *_table(columns, {f"`{split}`": row(split) for split in SPLITS}, "split"),
        "Variants, mirror images and copies of one object, in whatever source, are in one split.\n",
        f"- Known: {named('train')}.",
        f"- Unknown, to learn from: {named(OUTLIERS)}.",
        f"- Unknown, to test with: {named(WITHHELD)}.\n",
        *_table(("licence", "objects"), {name: [of, n] for (name, of), n in sources}, "source"),
    ]
