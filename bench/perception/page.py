"""The page of the benchmark, `docs/reference/realtouch.md`: what is measured, on what, and every
figure.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from bench.perception.area import (
    ALL,
    ELSEWHERE,
    OBJECTS,
    SHARED,
    SHARED_WIDE,
    WIDE,
    BenchmarkResults,
)
from bench.perception.data import NAME, SOURCE, VERSION, Data
from bench.perception.methods import Method
from bench.perception.scores import COVERAGES, Figures
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.sets.manifest import OUTLIERS, WITHHELD
from tactile_rt.sim_backend.datasets.recipe_files import DEFAULT_RECIPE

__all__ = ["PAGE", "write_page"]

PAGE = Path("docs/reference/realtouch.md")
CONSTANT = ("chance", "most frequent kind")
ABOUT = {
    OBJECTS: "Objects that no method has touched, of the kinds that it was taught, from sources of "
    "which it has touched other objects.",
    ELSEWHERE: "The same kinds as somebody else makes them: every object of one source, of which "
    "no method has touched anything.",
    WIDE: "The objects of these two tests once more: 25 to 60 mm large, smooth or rough, leaning "
    "by up to 30 degrees about both axes, from directions 30 degrees to either side, at 20 to 60 "
    "mm/s, past a head that is shaken with up to 0.5 g. No real object has been learnt from in "
    "this world.",
    SHARED: "The held-out objects and the held-out source, only of the kinds that generated "
    "objects have, too: here those who have learnt from generated objects alone can be compared. "
    "Each still decides among all the kinds that it knows.",
    SHARED_WIDE: "The same objects in the wide world, which is the world of the generated ones.",
    ALL: "For those that have learnt from generated objects alone, all real objects of these kinds "
    "are new: more of them, and narrower intervals.",
}
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
"""
INTRODUCTION = """\
Whiskers are swept past real things, models that other people made for other purposes, and a method
says what each is. What it has learnt from is its own affair, but for the splits. The loads of the
simulated mouse's 30 whiskers are the data. The things stand as they do, 40 mm large, turned in any
way about the vertical, and pass at 28 to 40 mm/s at heights of -8 to 4 mm, 5.5 to 8 mm away.
"""
FIGURES = """\
## Figures

In percent, with 95 % intervals of a bootstrap over objects. *Two* and *four*: posteriors of so many
sweeps of an object, fused. *ECE*: expected calibration error, 15 bins; less is better. *AUROC*: how
well the largest posterior tells known kinds from the withheld ones; 50 is chance. Every method has
chosen its own settings on the validation split of what it learnt from: the SVM its penalty, the GRU
its rate of learning, and all that learn here their temperature.
"""
RUN_IT = """\
## Run it

```bash
tactile-rt bench perception --quick           # from the checkout alone, in a minute or two
python -m bench.perception                    # everything, and this page: 90 minutes on two cores
python -m bench.perception --model MINE.onnx  # a model of your own beside it
```

Whoever has another kind of model reads the data with `bench.perception.data.load()`: loads in N and
N m, labels and objects, by split. `python -m bench.perception.make FOLDER` makes the data anew,
from the objects on.
"""


def write_page(results: BenchmarkResults, path: Path) -> None:
    """Write it."""
    data = results.data
    lines = [
        CARD.format(name=f"{NAME} {VERSION}"),
        f"# {NAME} {VERSION}: what is this, by touch?",
        "",
        "*This page is written by `python -m bench.perception`; do not edit it.*",
        "",
        INTRODUCTION,
        RUN_IT,
        *_contents(data),
        FIGURES,
    ]
    for test, scores in results.scores.items():
        if scores:
            lines += [f"### {test[0].upper()}{test[1:]}", "", ABOUT[test], ""]
            lines += [*_scores(scores), "", *_coverage(scores), ""]
    lines += [
        "### By source",
        "",
        "Top-1 on the held-out objects and the held-out source (of those who know only some kinds: "
        "of these).",
        "",
        *_table(results.by_source, _sources(results), lambda name: name.rpartition("/")[2]),
        "",
        "### When something is wrong with the sensor",
        "",
        f"Top-1 on the {OBJECTS} (of those who know only some kinds: on the {SHARED}). Nobody has "
        "been told.",
        "",
        *_table(results.robust, list(next(iter(results.robust.values()))), str),
        "",
    ]
    if results.generator:
        lines += [
            "### Generated objects when one thing is not as in the first row",
            "",
            "Top-1 on 96 plain generated objects of 24 kinds that no method has seen, 3 sweeps "
            "each (`bench/perception/generator.py`), of those methods that know these kinds. "
            "What ships has learnt from such objects, too, the others from those of any plan in "
            "the wide world.",
            "",
            *_table(results.generator, list(next(iter(results.generator.values()))), str),
            "",
            *_false_touches(results),
            f"Those that have learnt from generated objects have learnt from the recipe "
            f"`{DEFAULT_RECIPE}`, whose loads have the SHA-256 `{results.digest}`.",
            "",
        ]
    if results.coverage:
        lines += [*_list_coverage(results), ""]
    path.write_text("\n".join(lines), encoding="utf-8")


def _false_touches(results: BenchmarkResults) -> list[str]:
    if results.false_touches is None:
        return []
    silent, noisy = results.false_touches
    return [
        f"While the head is shaken with 0.5 g and nothing is near, {silent:.1f} touches a minute "
        f"are found, and {noisy:.1f} with the rated noise.",
        "",
    ]


def _list_coverage(results: BenchmarkResults) -> list[str]:
    """List the coverage of the models, and which loads they refuse."""
    lines = [
        "### Refusals and prediction sets",
        "",
        "A model file may refuse to name a kind, because the object is of none that it knows or "
        "because no touch makes such loads; and it may tell the coverage of its prediction sets: "
        "of how many touches they hold the true kind at every step. *Set*: the mean number of "
        "kinds in it at the last step.",
        "",
        "| model | test | nominal coverage | coverage | set | called unknown "
        "| refused for the loads |",
        "|---" * 7 + "|",
    ]
    for name, tests in results.coverage.items():
        for test, p in tests.items():
            nominal = "-" if p.nominal != p.nominal else f"{100 * p.nominal:g}"
            size = "-" if p.size.value != p.size.value else f"{p.size.value:.1f}"
            cells = (nominal, _said(p.covered), size, _said(p.unknown), _said(p.faulty))
            lines.append(f"| {name} | {test} | {' | '.join(cells)} |")
    lines += [
        "",
        "Loads that no touch makes, refused for what is wrong with them:",
        "",
        "| | " + " | ".join(results.faults) + " |",
        "|---" * (1 + len(results.faults)) + "|",
    ]
    for fault in next(iter(results.faults.values())):
        cells = [_said(found[fault]) for found in results.faults.values()]
        lines.append(f"| {fault} | {' | '.join(cells)} |")
    return lines


def _contents(data: Data) -> list[str]:
    origins = data.origins.values()

    def row(split: str, what: str) -> str:
        mine = [o for o in origins if o.split == split]
        kinds = sorted({o.category for o in mine})
        return (
            f"| `{split}` | {what} | {len(kinds)} | {len(mine)} | {len(data.sets[split].sweeps)} | "
            f"{len(data.wide[split].sweeps) if split in data.wide else '-'} |"
        )

    def named(split: str) -> str:
        return ", ".join(
            sorted({o.category.replace("_", " ") for o in origins if o.split == split})
        )

    sources = Counter((o.source, o.licence) for o in origins)
    return [
        "## The data",
        "",
        f"`bench/perception/data/{NAME}-{VERSION}.xz`, SHA-256 `{data.digest}`: made by the "
        "recipes `bench/perception/recipes/real27.toml` and `real27-source.toml` from the list "
        "`tactile_rt/sim_backend/objects/lists/real.csv`, which has every mesh's address and hash.",
        "",
        "| split | for | kinds | objects | sweeps | in the wide world |",
        "|---|---|---|---|---|---|",
        row("train", "learning"),
        row("validation", "choosing settings"),
        row("test", "testing on objects of a known kind and source"),
        row(SOURCE, "testing on a source that no other split has anything of"),
        row(OUTLIERS, "learning what is unknown, if a method does"),
        row(WITHHELD, "testing what a method makes of unknown kinds"),
        "",
        "Objects that are variants, mirror images or copies of one another, in whatever source, "
        "are on one side.",
        "",
        f"- Known: {named('train')}.",
        f"- Unknown, to learn from: {named(OUTLIERS)}.",
        f"- Unknown, to test with: {named(WITHHELD)}.",
        "",
        "| source | licence | objects |",
        "|---|---|---|",
        *(f"| {name} | {licence} | {n} |" for (name, licence), n in sorted(sources.items())),
        "",
    ]


def _said(value: Interval) -> str:
    if value.value != value.value:
        return "-"
    return f"{100 * value.value:.1f} ({100 * value.low:.0f}-{100 * value.high:.0f})"


def _name(method: Method) -> str:
    return f"{method.name} | {method.taught}"


def _scores(scores: dict[Method, Figures]) -> list[str]:
    figures = ("top-1", "top-5", "mean over kinds", "two", "four", "ECE", "AUROC")
    rows = [f"| method | taught by | kinds | {' | '.join(figures)} |", "|---" * 10 + "|"]
    for method, s in scores.items():
        values = (s.top1, s.top5, s.macro, s.two, s.four, s.calibration, s.auroc)
        said = " | ".join(_said(value) for value in values)
        rows.append(f"| {_name(method)} | {len(method.kinds)} | {said} |")
    return rows


def _coverage(scores: dict[Method, Figures]) -> list[str]:
    ends = " | ".join(f"surest {c} %" for c in COVERAGES)
    rows = [f"| method | taught by | {ends} |", "|---" * (2 + len(COVERAGES)) + "|"]
    for method, s in scores.items():
        if method.name not in CONSTANT:  # which is as sure of one sweep as of another
            rows.append(f"| {_name(method)} | {' | '.join(_said(s.at[c]) for c in COVERAGES)} |")
    return rows


def _sources(results: BenchmarkResults) -> list[str]:
    return sorted({name for found in results.by_source.values() for name in found})


def _table(
    found: dict[Method, dict[str, Interval]], columns: Sequence[str], called: Callable[[str], str]
) -> list[str]:
    """A row for each of the columns, a column for each method: these names are the longer."""
    methods = [m for m in found if m.name not in CONSTANT]
    rows = [
        "| | " + " | ".join(f"{m.name}, {m.taught}" for m in methods) + " |",
        "|---" * (1 + len(methods)) + "|",
    ]
    for name in columns:
        cells = (_said(found[m][name]) if name in found[m] else "-" for m in methods)
        rows.append(f"| {called(name)} | {' | '.join(cells)} |")
    return rows
