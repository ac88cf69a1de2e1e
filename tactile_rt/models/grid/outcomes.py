"""Outcomes of a grid's tasks, read from and written to the grid's folder. Needs no torch."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.models.grid.plan import OF_UNTRAINED, SUPERVISED, Grid, Task
from tactile_rt.models.training.config import TrainingConfig

SUBSET, OUTCOMES, RUNS = "sweeps", "outcomes", "runs"  # folders of a grid
TESTED = "tested.json"  # in the folder of a grid
POINT = "point.json"  # in the folder of a training
CHANCE = 0.04  # of top-1: a score this close to chance may be chance

Kept = TypeVar("Kept")
Hits = Annotated[str, msgspec.Meta(pattern="^[01]*$")]


class Training(msgspec.Struct, frozen=True, omit_defaults=True):
    """The result of one training: its settings and its score on the validation split.

    Attributes:
        score: Top-1 on the validation split, 0 to 1, the mean of clean and noisy; of a
            self-supervised network with its probe. 0 if the training diverged.
        seconds: The CPU time of updates and validations, s; 0 if the training did not run on a CPU,
            or was interrupted.
        key: The settings that the score depends on, as JSON; only in the training's own file.
    """

    learning_rate: float
    warmup: float
    updates: int
    score: float
    seconds: float
    diverged: bool = False
    key: str = ""


class Tested(msgspec.Struct, frozen=True):
    """The test objects of a grid and their sweep counts, to report results without sweeps."""

    objects: tuple[tuple[str, int], ...]
    classes: int
    known: tuple[tuple[str, int], ...] = ()  # training objects with new sweeps

    @staticmethod
    def names(objects: tuple[tuple[str, int], ...]) -> NDArray[np.str_]:
        """Return the object name (sweep,) of each sweep, given (name, number of sweeps)."""
        names, counts = zip(*objects, strict=True) if objects else ((), ())
        return np.repeat(np.array(names, dtype=np.str_), counts)


class Outcome(msgspec.Struct, frozen=True):
    """The outcome of a task: its test results and the trainings that led to them.

    Attributes:
        key: The settings that the outcome depends on, as JSON; another key is another experiment.
        top1, top5, noisy: Results as text, a 0 or 1 per test sweep: 1 if right, if among the first
            five, if right at the rated noise.
        known: The same as `top1`, on new sweeps of training objects; empty if the set has none.
        seconds: The CPU time of the training that was tested, s, as in `Training`.
        trials, growth: The trainings that chose learning rate and warm-up, and those that chose the
            number of updates; only of the first seed.
    """

    name: str
    seed: int
    key: str
    top1: Hits = ""
    top5: Hits = ""
    noisy: Hits = ""
    known: Hits = ""
    parameters: int = 0
    seconds: float = 0.0
    trials: tuple[Training, ...] = ()
    growth: tuple[Training, ...] = ()
    chosen: Training | None = None
    failed: str = ""

    def right(self, which: str = "top1") -> NDArray[np.bool_]:
        """Return a mask (sweep,) of right decisions, of `top1`, `top5`, `noisy` or `known`."""
        return np.asarray(np.array(list(getattr(self, which)), dtype=np.str_) == "1")


def shows_nothing(trials: Sequence[Training], chance: float) -> bool:
    """Return whether trials' scores are all near chance or equal, so rank no learning rates."""
    scores = [trial.score for trial in trials if not trial.diverged]
    if not scores:
        return False  # all diverged, as longer trials would
    return max(scores) < chance + CHANCE or (len(scores) > 1 and max(scores) == min(scores))


def outcome_path(folder: Path, task: Task) -> Path:
    """Return the path of the file of a task's outcome in a grid's folder."""
    return folder / OUTCOMES / f"{task.slug}.json"


def write_tested(
    folder: Path, objects: NDArray[np.str_], classes: int, known: NDArray[np.str_] | None = None
) -> None:
    """Write a grid's test objects (sweep,), objects of new sweeps, and number of classes."""
    new, old = (
        tuple((name, len(list(same))) for name, same in groupby(names.tolist()))
        for names in (objects, objects[:0] if known is None else known)
    )
    text = msgspec.json.encode(Tested(new, classes, old))
    write_whole(folder / TESTED, lambda file: file.write(text))


def read_tested(folder: Path) -> Tested:
    """Read the test objects and number of classes from a grid's folder."""
    path = folder / TESTED
    if not path.exists():
        raise ConfigError(f"no {path}: run the grid first")
    return _decode(path, Tested, "delete it and run the grid")


def runs_of(folder: Path, task: Task) -> Path:
    """Return the path of the folder of a task's trainings in a grid's folder."""
    return folder / RUNS / task.slug


def read_point(path: Path, key: str) -> Training | None:
    """Read a training's result, None if unfinished; raise if its settings are not `key`."""
    if not path.exists():
        return None
    found = _decode(path, Training, f"delete {path.parent}")
    if found.key != key:
        raise ConfigError(
            f"{path.parent} was trained with other settings: choose another folder for the grid, "
            "or delete this one to train it again"
        )
    return msgspec.structs.replace(found, key="")


def read_outcome(grid: Grid, folder: Path, task: Task) -> Outcome | None:
    """Read a task's outcome, None if unfinished; raise if its settings are not the grid's."""
    path = outcome_path(folder, task)
    if not path.exists():
        return None
    found = _decode(path, Outcome, "delete it to do it again")
    if len({len(hits) for hits in (found.top1, found.top5, found.noisy) if hits}) > 1:
        raise ConfigError(f"{path} is damaged (hits of other sweeps): delete it to do it again")
    if found.key != settings_of(grid, task):
        raise ConfigError(
            f"{folder} holds {task.name!r} trained with other settings: choose another folder, or "
            f"delete {path} and {runs_of(folder, task)} to train it again"
        )
    return found


def _decode(path: Path, kind: type[Kept], advice: str) -> Kept:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged ({error}): {advice}") from None


def settings_of(grid: Grid, task: Task) -> str:
    """Return all settings that a task's outcome depends on, as JSON."""
    settings: dict[str, Any] = {"sweeps": msgspec.to_builtins(grid.sweeps), "data": grid.data}
    if task.cell is not None:
        config = training_settings(grid.config(task, Path()))
        if task.random:  # not trained: training options have no effect
            whole = msgspec.to_builtins(grid.config(task, Path()))
            config = {k: v for k, v in config.items() if k in OF_UNTRAINED}
            config |= {k: whole[k] for k in ("encoder", "attender", "width", "seed")}
        else:
            cell = msgspec.to_builtins(task.cell)
            if not cell["recipe"]:
                del cell["recipe"]  # keeps outcomes valid from before recipes existed
            settings |= {"search": grid.search, "growth": grid.growth, "cell": cell}
            if task.cell.begin:
                settings |= {"begun": settings_of(grid, grid.find_beginning(task))}
        settings |= {"config": config}
        if task.random or task.cell.objective != SUPERVISED:
            settings |= {"probe": grid.probe}
    return msgspec.json.encode(settings, order="sorted").decode()


def training_settings(config: TrainingConfig) -> dict[str, Any]:
    """Return a training configuration's fields that differ from the defaults, as JSON values.

    So a field that is added later does not change the settings of earlier outcomes.
    """
    plain, usual = (msgspec.to_builtins(one) for one in (config, TrainingConfig("")))
    return {key: value for key, value in plain.items() if value != usual[key]}


def waiting_tasks(grid: Grid, folder: Path) -> list[Task]:
    """List the tasks of a grid without an outcome, in the grid's order."""
    return [task for task in grid.tasks() if read_outcome(grid, folder, task) is None]
