"""Results of a grid: accuracies with intervals, comparisons of cells, and tables."""

from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.models.evaluation.measures import Interval, Names, accuracy
from tactile_rt.models.grid.outcomes import (
    Outcome,
    Tested,
    Training,
    read_outcome,
    read_tested,
    shows_nothing,
)
from tactile_rt.models.grid.plan import RANDOM, SVM, Candidate, Grid


@dataclass(frozen=True)
class Row:
    """The results of a cell over its seeds, and those of its untrained network.

    Attributes:
        network, learning: Names of the network and of its training; empty for the SVM.
        top1, top5, noisy: Accuracies on the test sweeps, 0 to 1; `noisy` is top-1 at the rated
            noise. None if not measured.
        known: Top-1 on new sweeps of the training objects; None if the set holds out no sweeps.
        random: The top-1 accuracy of a linear probe on the untrained network, 0 to 1.
        seconds: The mean CPU time of a seed's training, s; 0 if not known for any seed.
        flat: True if the last training of `growth` gained less than the grid's `gain`.
        tuned: True if the trials could rank the learning rates.
    """

    name: str
    network: str
    learning: str
    seeds: int
    top1: Interval | None = None
    top5: Interval | None = None
    noisy: Interval | None = None
    random: Interval | None = None
    parameters: int = 0
    seconds: float = 0.0
    share: float = 1.0
    chosen: Training | None = None
    growth: tuple[Training, ...] = ()
    flat: bool = False
    failed: str = ""
    known: Interval | None = None
    tuned: bool = True


@dataclass(frozen=True)
class Answer:
    """One comparison: the difference in top-1, `better` minus `than`, on the same test sweeps."""

    question: str
    better: str
    than: str
    difference: Interval

    @property
    def verdict(self) -> str:
        """Answer in words: "yes", "no", or "cannot tell" if the interval includes 0."""
        if self.difference.low > 0:
            return "yes"
        return "no" if self.difference.high < 0 else "cannot tell"


@dataclass(frozen=True)
class GridResults:
    """All results of a grid so far: a row per cell, and answers to questions."""

    rows: tuple[Row, ...]
    answers: tuple[Answer, ...]
    objects: int
    sweeps: int
    classes: int


def gather(grid: Grid, folder: Path) -> GridResults:
    """Compute the results of a grid from the outcomes in its folder so far."""
    found: dict[str, list[Outcome]] = {}
    for task in grid.tasks():
        outcome = read_outcome(grid, folder, task)
        if outcome is not None:
            found.setdefault(task.name, []).append(outcome)
    if not found:
        raise ConfigError(f"{folder} has no outcome yet: run the grid first")
    tested = read_tested(folder)
    objects = tested.names(tested.objects)
    for outcome in (one for several in found.values() for one in several):
        if outcome.top1 and len(outcome.top1) != len(objects):
            raise ConfigError(
                f"{folder}: {outcome.name!r}, seed {outcome.seed}, was tested on "
                f"{len(outcome.top1)} sweeps, of which there are {len(objects)}: delete its outcome"
            )
    cells = {SVM: None, **{cell.name: cell for cell in grid.cells}}
    rows = [_make_row(grid, n, cell, found, tested) for n, cell in cells.items() if n in found]
    answers = [
        Answer(question.text, pair.better, pair.than, difference)
        for question in grid.questions
        for pair in question.pairs
        if (difference := _compare_seeds(found.get(pair.better), found.get(pair.than), objects))
    ]
    kinds = len(set(objects.tolist()))
    return GridResults(tuple(rows), tuple(answers), kinds, len(objects), tested.classes)


def _make_row(
    grid: Grid, name: str, cell: Candidate | None, found: dict[str, list[Outcome]], tested: Tested
) -> Row:
    def estimate(these: list[Outcome], which: str) -> Interval | None:
        right = [one.right(which) for one in these if getattr(one, which)]
        objects = tested.names(tested.known if which == "known" else tested.objects)
        return accuracy(np.stack(right), objects) if right else None

    outcomes, random = found[name], found.get(f"{RANDOM} {cell.network}", []) if cell else []
    first = outcomes[0]
    scores = [point.score for point in first.growth]
    return Row(
        name,
        cell.network if cell else "",
        cell.learning if cell else "",
        sum(not one.failed for one in outcomes),
        estimate(outcomes, "top1"),
        estimate(outcomes, "top5"),
        estimate(outcomes, "noisy"),
        estimate(random, "top1"),
        first.parameters,
        float(np.mean([one.seconds for one in outcomes if one.seconds] or [0.0])),
        cell.share if cell else 1.0,
        first.chosen,
        first.growth,
        len(scores) > 1 and scores[-1] < scores[-2] + grid.growth.gain,
        "; ".join(sorted({one.failed for one in outcomes if one.failed})),
        estimate(outcomes, "known"),
        not (first.trials and shows_nothing(first.trials, 1 / tested.classes)),
    )


def _compare_seeds(
    better: list[Outcome] | None, than: list[Outcome] | None, objects: Names
) -> Interval | None:
    """Return the top-1 difference over common seeds; the SVM's one result counts for all."""
    mine = {one.seed: one.right() for one in better or () if one.top1}
    theirs = {one.seed: one.right() for one in than or () if one.top1}
    seeds = sorted(set(mine) & set(theirs))
    if than and than[0].name == SVM and theirs:
        seeds, theirs = sorted(mine), dict.fromkeys(mine, theirs[0])
    if not seeds:
        return None
    return accuracy(np.stack([mine[s].astype(np.float64) - theirs[s] for s in seeds]), objects)


def table(results: GridResults) -> str:
    """Format results as Markdown: a table of cells, then a table of comparisons."""
    lines = [
        f"Top-1 on {results.objects} objects that no network trained on ({results.sweeps} sweeps, "
        f"{results.classes} categories, chance {100 / results.classes:.1f} %); in brackets 95 %, "
        "by object and seed. Untrained: a linear probe on the network as it was initialised. "
        "Updates: those of the training that was scored; with + where twice as many would have "
        "been too many to try, so that its end is not known.",
        "",
        "| network | learning | parameters | rate, warm-up | updates | top-1 (%) | untrained (%) "
        "| top-5 (%) | at rated noise (%) | new sweeps of known objects (%) | seeds | CPU s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results.rows:
        at = row.chosen
        cells = [
            row.network or "RBF SVM",
            row.learning or "on the same windows",
            f"{row.parameters:,}" if row.parameters else "",
            f"{at.learning_rate:g}, {at.warmup:g}{'' if row.tuned else ' (not tuned)'}"
            if at
            else "",
            _format_updates(row),
            _format_percent(row.top1) if row.top1 else "failed" if row.failed else "",
            *(_format_percent(one) for one in (row.random, row.top5, row.noisy, row.known)),
            str(row.seeds),
            f"{row.seconds:.0f}" if row.seconds else "",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    failed = [row for row in results.rows if row.failed]
    lines += ["", *(f"`{row.name}`: {row.failed}" for row in failed)] if failed else []
    if results.answers:
        lines += ["", "| question | compared | points | |", "|---|---|---|---|"]
    asked = ""
    for answer in results.answers:
        d = answer.difference
        lines.append(
            f"| {answer.question if answer.question != asked else ''} "
            f"| {answer.better} - {answer.than} "
            f"| {100 * d.value:+.1f} [{100 * d.low:+.1f}, {100 * d.high:+.1f}] "
            f"| {answer.verdict} |"
        )
        asked = answer.question
    return "\n".join(lines) + "\n"


def _format_updates(row: Row) -> str:
    if row.chosen is None:
        return ""
    return f"{row.chosen.updates:,}{'' if row.flat else ' +'}" if row.chosen.updates else "recipe"


def _format_percent(one: Interval | None) -> str:
    if one is None:
        return ""
    return f"{100 * one.value:.1f} [{100 * one.low:.1f}, {100 * one.high:.1f}]"


def write_results(results: GridResults, folder: Path) -> None:
    """Write results into a grid's folder: `results.json`, and tables as `results.md`."""
    text = msgspec.json.format(msgspec.json.encode(results), indent=1)
    write_whole(folder / "results.json", lambda file: file.write(text))
    write_whole(folder / "results.md", lambda file: file.write(table(results).encode()))
