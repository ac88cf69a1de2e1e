"""From a project's folder to a model that decides, and a page that says how well.

    sweeps -> training -> export -> evaluation -> report

Each part is made once: what is there is not made again, and what was interrupted goes on.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from tactile_rt.evidence.classification import evaluate_model
from tactile_rt.evidence.records import Record, write
from tactile_rt.export.release import release
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.training import Progress, TrainingConfig, read_recipe, train
from tactile_rt.models.training.loop import read_splits
from tactile_rt.project.folder import Project
from tactile_rt.project.plan import Plan, plan_sweeps, read_plan, sized, write_plan
from tactile_rt.project.report import write_report
from tactile_rt.sim_backend.datasets.dataset import describe_set, finished_objects, make_sweeps
from tactile_rt.stream import ConfigError

__all__ = ["Stage", "make"]

LEAST_MINUTES = 1.0
TRAINED_BY = 0.87  # of the time given: the rest is for export, evaluation and report
PILOT = 24  # updates that are timed
MOST_EPOCHS = 60
FEWEST_UPDATES = 200
RECIPE = "small"  # of the training

Splits = tuple[SweepSet, SweepSet]


@dataclass(frozen=True)
class Stage:
    """How far a project is.

    Attributes:
        name: The name of what is being made.
        done, of: How much of it is there, and how much there is to be.
        left_s: The time that everything still takes, s.
    """

    name: str
    done: int
    of: int
    left_s: float


Tell = Callable[[Stage], None]


def make(project: Project, minutes: float, tell: Tell = lambda _: None) -> list[Record]:
    """Make a project's model within a time, or go on with what was begun.

    Args:
        project: which.
        minutes: for everything, from now on. A little time makes a smaller set and a shorter
            training, and so a worse model, but a model.
        tell: is told of every step.

    Returns:
        The figures of the report.

    Raises:
        ConfigError: too little time, or a mistake in one of the project's files.
    """
    if not minutes >= LEAST_MINUTES:
        raise ConfigError(f"--minutes must be at least {LEAST_MINUTES:g}, not {minutes:g}")
    project.line()  # a mistake in robot.toml is told before the work, not after
    end = time.monotonic() + 60 * minutes
    plan = read_plan(project)
    if plan is None:
        tell(Stage("timing sweeps", 0, 1, 60 * minutes))
        plan = plan_sweeps(project, 60 * minutes)
        write_plan(project, plan)
    sweeps = _sweep(project, plan, end, tell)
    best = _train(project, plan, sweeps, end - (1 - TRAINED_BY) * 60 * minutes, tell)
    tell(Stage("exporting", 0, 1, end - time.monotonic()))
    release(best, project.model, project.folder.resolve().name)
    tell(Stage("evaluating", 0, 1, end - time.monotonic()))
    project.report.mkdir(exist_ok=True)
    records = evaluate_model(project.model, sweeps, svm=True, pictures=project.report)
    write(records, project.report / "figures.json")
    write_report(project, sweeps, records)
    return records


def _sweep(project: Project, plan: Plan, end: float, tell: Tell) -> Path:
    folder = project.build / "sweeps"
    recipe = sized(project.recipe(), plan)
    names = describe_set(recipe).names()
    there = len(finished_objects(folder, names))
    for done, _ in enumerate(make_sweeps(recipe, folder), start=1):
        if done > there:
            tell(Stage("sweeping", done, len(names), end - time.monotonic()))
    return folder


def _train(project: Project, plan: Plan, sweeps: Path, end: float, tell: Tell) -> Path:
    torch.set_num_threads(os.cpu_count() or 1)
    tell(Stage("finding onsets", 0, 1, end - time.monotonic()))
    config = read_recipe(RECIPE, str(sweeps.resolve()))
    splits = read_splits(sweeps, config)
    batch = max(2, min(config.batch, len(splits[0].sweeps) // 8))
    config = replace(config, batch=batch)
    if not plan.updates:
        each_s = _time_of_an_update(project, config, splits)
        most = MOST_EPOCHS * len(splits[0].sweeps) // batch
        plan.updates = max(FEWEST_UPDATES, min(int((end - time.monotonic()) / each_s), most))
        write_plan(project, plan)

    def show(at: Progress) -> None:
        tell(Stage("training", at.update, at.updates, end - time.monotonic()))

    config = replace(config, updates=plan.updates)
    return train(config, project.build / "run", show, splits=splits)


def _time_of_an_update(project: Project, config: TrainingConfig, splits: Splits) -> float:
    """The time that one takes with its share of the validation after every epoch, s."""
    at: list[float] = []
    with TemporaryDirectory(dir=project.build) as folder:
        train(
            replace(config, updates=PILOT),
            Path(folder),
            lambda _: at.append(time.monotonic()),
            splits=splits,
        )
    *updates, validated = at
    per_epoch = max(1, len(splits[0].sweeps) // config.batch)
    return float(np.median(np.diff(updates))) + (validated - updates[-1]) / per_epoch
