"""The stages that make a project's model and its report card.

    sweeps -> training -> export -> evaluation -> report

Finished sweeps and training are not repeated; interrupted ones continue.
"""

import os
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, fields, replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from tactile_rt.core.errors import ConfigError
from tactile_rt.export.release import release
from tactile_rt.models.datasets import SweepSet, read_splits
from tactile_rt.models.evaluation.model_file import evaluate_model
from tactile_rt.models.evaluation.records import Record, write
from tactile_rt.models.training.config import Progress, TrainingConfig
from tactile_rt.models.training.loop import train
from tactile_rt.models.training.recipes import read_recipe
from tactile_rt.project.budget import Budget, apply_budget, budget_sweeps, read_budget, write_budget
from tactile_rt.project.folder import Project
from tactile_rt.project.report import write_report
from tactile_rt.sets.objects import read_skipped, write_skipped
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.datasets.dataset import (
    describe_set,
    finished_objects,
    make_sweeps,
    simulate_sweep,
)
from tactile_rt.sim_backend.datasets.inventory import Tally, tally, write_sums
from tactile_rt.sim_backend.datasets.recipe_objects import choose_objects
from tactile_rt.sim_backend.sweep import Sweep, centrelines
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.views.contact_sheet import write_contact_sheet
from tactile_rt.sim_backend.world import PROFILES

LEAST_MINUTES = 1.0
SWEPT_BY = 0.48  # of the given time: sweeping ends then, even if sweeps take longer than timed
TRAINED_BY = 0.87  # of the given time: the rest is for export, evaluation and report
PILOT = 24  # updates that are timed
MOST_EPOCHS = 60
FEWEST_UPDATES = 200
RECIPE = "small"  # training recipe
PREVIEW_S, PREVIEWED = 50.0, 12  # time limit of a preview; its sweeps of each kind

Splits = tuple[SweepSet, SweepSet]


@dataclass(frozen=True)
class MakeProgress:
    """Progress of a stage of `make`.

    Attributes:
        done, of: Finished amount and total amount of the stage called ``name``.
        left_s: Time left for all stages, s.
    """

    name: str
    done: int
    of: int
    left_s: float


class _OutOfTime(Exception):
    """Raised to end a training after an epoch; the best network is on disk."""


Tell = Callable[[MakeProgress], None]


def preview_sweeps(project: Project, picture: Path) -> dict[str, Tally]:
    """Simulate some sweeps per kind; return counts, and draw the first touches into `picture`."""
    recipe, end = project.recipe(), time.monotonic() + PREVIEW_S
    objects, animals = choose_objects(recipe.objects), load_animals(recipe.array)
    kinds: dict[str, list[str]] = {}
    for name in chain.from_iterable(objects.split.values()):
        kind = objects.category_of.get(name) or name.rpartition("-")[0]
        kinds.setdefault(kind, []).append(name)
    counts, touches = {kind: Counter[str]() for kind in kinds}, {}
    for number, kind in ((n, kind) for n in range(PREVIEWED) for kind in kinds):
        if number and time.monotonic() > end:
            break
        try:
            target = objects.load(kinds[kind][number % len(kinds[kind])])
        except ConfigError:  # a mesh that a sweep set leaves out, too
            continue
        found = simulate_sweep(recipe, target, number % len(recipe.sweeps)).parameters
        counts[kind].update(
            sweeps=1, misses=not found["touches"], unstable=found["unstable"] > 0,
            wedged=found["wedged"] > 0, saturated=found["saturated"] > 0,
        )  # fmt: skip
        if counts[kind]["sweeps"] == 1:
            sweep = Sweep(**{field.name: found[field.name] for field in fields(Sweep)})
            made = SweepSimulation(animals, target, sweep, PROFILES[recipe.profile], whole=True)
            touches[f"{kind}, {sweep.size_mm:.3g} mm"] = made.first_touch()
    if not touches:
        raise ConfigError("no object can be used: `tactile-rt objects check` says why")
    whiskers = [line for a in animals for line in centrelines(a.whiskers, a.mount)]
    write_contact_sheet(picture, touches, whiskers)
    return {kind: Tally(**count) for kind, count in counts.items()}


def make(project: Project, minutes: float, tell: Tell = lambda _: None) -> list[Record]:
    """Make a project's model within the given time, or continue an interrupted run.

    Args:
        minutes: for all stages, from now on. Less time gives a smaller set and a shorter training,
            and so a worse model.
    """
    if not minutes >= LEAST_MINUTES:
        raise ConfigError(f"--minutes must be at least {LEAST_MINUTES:g}, not {minutes:g}")
    project.line()  # reports a mistake in robot.toml before the work, not after
    end = time.monotonic() + 60 * minutes
    budget = read_budget(project)
    if budget is None:
        tell(MakeProgress("timing sweeps", 0, 1, 60 * minutes))
        budget = budget_sweeps(project, 60 * minutes)
        write_budget(project, budget)
    start = end - 60 * minutes
    sweeps = _sweep(project, budget, start + SWEPT_BY * 60 * minutes, end, tell)
    best = _train(project, budget, sweeps, start + TRAINED_BY * 60 * minutes, end, tell)
    tell(MakeProgress("exporting", 0, 1, end - time.monotonic()))
    project.write_spec()
    release(best, project.model, project.folder.resolve().name)
    tell(MakeProgress("evaluating", 0, 1, end - time.monotonic()))
    project.report.mkdir(exist_ok=True)
    records = evaluate_model(project.model, sweeps, svm=True, pictures=project.report)
    write(records, project.report / "figures.json")
    write_report(project, sweeps, records)
    return records


def _sweep(project: Project, budget: Budget, until: float, end: float, tell: Tell) -> Path:
    """Make the sweep set, or the part that time permits; return its folder."""
    folder = project.build / "sweeps"
    recipe = apply_budget(project.recipe(), budget)
    manifest = describe_set(recipe)
    left = manifest.names()
    total, finished = len(left), len(finished_objects(folder, left))
    # Splits grow in step, the test twice as fast. The smallest needs one object of each category.
    smallest = min(len(names) for names in manifest.split.values() if names)
    share = len(manifest.categories) / smallest
    fewest = share * (total + len(manifest.split["test"])) + (os.cpu_count() or 1)
    with closing(make_sweeps(recipe, folder)) as made:
        for done, name in enumerate(made, start=1):
            left.remove(name)
            if done > finished:
                tell(MakeProgress("sweeping", done, total, end - time.monotonic()))
            if done > max(finished, fewest) and time.monotonic() > until:
                break
    if left:  # no time was left for these
        for name in left:
            (folder / f"{name}.part").unlink(missing_ok=True)
        write_skipped(
            folder, read_skipped(folder) | dict.fromkeys(left, "there was no time for it")
        )
        write_sums(folder)
    counts = tally(folder, manifest.names(), len(recipe.sweeps))
    if counts.shortcomings:
        summary = f"{counts.sweeps} sweeps: {counts.shortcomings}"
        tell(MakeProgress(summary, total, total, end - time.monotonic()))
    return folder


def _train(
    project: Project, budget: Budget, sweeps: Path, until: float, end: float, tell: Tell
) -> Path:
    # More threads wait for each other: dozens of times slower if another program uses a core.
    torch.set_num_threads(1)
    tell(MakeProgress("finding onsets", 0, 1, end - time.monotonic()))
    config = read_recipe(RECIPE, str(sweeps.resolve()))
    splits = read_splits(config.folders, config.labelled)
    batch = max(2, min(config.batch, len(splits[0].sweeps) // 8))
    twice = len(splits[0].sweeps) > len(set(splits[0].sweeps.objects.tolist()))
    config = replace(config, batch=batch, identity=config.identity if twice else 0.0)
    if not budget.updates:
        each_s = _time_update(project, config, splits)
        most = MOST_EPOCHS * len(splits[0].sweeps) // batch
        budget.updates = max(FEWEST_UPDATES, min(int((until - time.monotonic()) / each_s), most))
        write_budget(project, budget)

    run = project.build / "run"

    def show(at: Progress) -> None:
        tell(MakeProgress("training", at.update, at.updates, end - time.monotonic()))
        # The machine has become busier than it was when the updates were timed.
        if at.metrics and time.monotonic() > (until + end) / 2:
            raise _OutOfTime

    with suppress(_OutOfTime):
        train(replace(config, updates=budget.updates), run, show, splits=splits)
    return run / "best.pt"


def _time_update(project: Project, config: TrainingConfig, splits: Splits) -> float:
    """Run some training updates; return the time of one, s, with its share of validation."""
    at: list[float] = []
    with TemporaryDirectory(dir=project.build) as folder:
        pilot = replace(config, updates=PILOT)
        train(pilot, Path(folder), lambda _: at.append(time.monotonic()), splits=splits)
    *updates, validated = at
    per_epoch = max(1, len(splits[0].sweeps) // config.batch)
    return float(np.median(np.diff(updates))) + (validated - updates[-1]) / per_epoch
