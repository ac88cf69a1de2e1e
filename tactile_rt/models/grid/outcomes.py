"""Outcomes of a grid's tasks, as stored in the grid's folder. Needs no torch."""

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
TESTED = "tested.json"  # a file of a grid
POINT = "point.json"  # a file of one of its trainings
CHANCE = 0.04  # of top-1: what is so near to chance may be chance

Kept = TypeVar("Kept")
Hits = Annotated[str, msgspec.Meta(pattern="^[01]*$")]


class Training(msgspec.Struct, frozen=True, omit_defaults=True):
    """One training and its score on the validation split.

    Attributes:
        score: Top-1 of the validation split, 0 to 1, the mean of clean and noisy; of a
            self-supervised network by its probe. 0 if it diverged.
        seconds: The CPU time of its updates and validations, s; 0 if it did not train on a CPU, or
            was interrupted.
        key: The settings that it depends on, as JSON; stored in its own folder alone.
    """

    learning_rate: float
    warmup: float
    updates: int
    score: float
    seconds: float
    diverged: bool = False
    key: str = ""


class Tested(msgspec.Struct, frozen=True):
    """The test objects of a grid: enough to report its outcomes without its sweeps."""

    objects: tuple[tuple[str, int], ...]
    classes: int
    known: tuple[tuple[str, int], ...] = ()  # of new sweeps of training objects

    @staticmethod
    def names(objects: tuple[tuple[str, int], ...]) -> NDArray[np.str_]:
        """(sweep,) the object of each."""
        names, counts = zip(*objects, strict=True) if objects else ((), ())
        return np.repeat(np.array(names, dtype=np.str_), counts)


class Outcome(msgspec.Struct, frozen=True):
    """The outcome of a task.

    Attributes:
        key: The settings that the outcome depends on, as JSON; another key is another experiment.
        top1, top5, noisy: Hits as text, a 0 or 1 per test sweep: right, among the first five, right
            at the rated noise.
        known: Hits on new sweeps of the objects that it was trained on; empty where the set holds
            none out.
        seconds: The CPU time of the training that was scored, s, as in `Training`.
        trials, growth: The trainings that chose rate and warm-up, then updates; first seed only.
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
        """Return (sweep,) hits of `top1`, `top5` or `noisy`."""
        return np.asarray(np.array(list(getattr(self, which)), dtype=np.str_) == "1")


def saw_nothing(trials: Sequence[Training], chance: float) -> bool:
    """Return whether trials cannot rank learning rates: all near chance, or all equal."""
    scores = [trial.score for trial in trials if not trial.diverged]
    if not scores:
        return False  # all diverged: longer trials would, too
    return max(scores) < chance + CHANCE or (len(scores) > 1 and max(scores) == min(scores))


def outcome_path(folder: Path, task: Task) -> Path:
    """Return the path of a task's outcome in a grid's folder."""
    return folder / OUTCOMES / f"{task.slug}.json"


def write_tested(
    folder: Path, objects: NDArray[np.str_], classes: int, known: NDArray[np.str_] | None = None
) -> None:
    """Write a grid's test objects (sweep,), known ones, and number of classes into its folder."""
    new, old = (
        tuple((name, len(list(same))) for name, same in groupby(names.tolist()))
        for names in (objects, objects[:0] if known is None else known)
    )
    text = msgspec.json.encode(Tested(new, classes, old))
    write_whole(folder / TESTED, lambda file: file.write(text))


def read_tested(folder: Path) -> Tested:
    """Read the test objects of a grid."""
    path = folder / TESTED
    if not path.exists():
        raise ConfigError(f"no {path}: run the grid first")
    return _decode(path, Tested, "delete it and run the grid")


def runs_of(folder: Path, task: Task) -> Path:
    """Return the folder of a task's trainings in a grid's folder."""
    return folder / RUNS / task.slug


def read_point(path: Path, key: str) -> Training | None:
    """Read the result of a training with these settings, if it is done."""
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
    """Read a task's outcome, if it is done."""
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
    """Return everything that an outcome depends on, as JSON."""
    settings: dict[str, Any] = {"sweeps": msgspec.to_builtins(grid.sweeps), "data": grid.data}
    if task.cell is not None:
        config = training_settings(grid.config(task, Path()))
        if task.random:  # trained for no update at all
            whole = msgspec.to_builtins(grid.config(task, Path()))
            config = {k: v for k, v in config.items() if k in OF_UNTRAINED}
            config |= {k: whole[k] for k in ("encoder", "attender", "width", "seed")}
        else:
            cell = msgspec.to_builtins(task.cell)
            if not cell["recipe"]:
                del cell["recipe"]  # what was done before there were any is as it was
            settings |= {"search": grid.search, "growth": grid.growth, "cell": cell}
            if task.cell.begin:
                settings |= {"begun": settings_of(grid, grid.find_beginning(task))}
        settings |= {"config": config}
        if task.random or task.cell.objective != SUPERVISED:
            settings |= {"probe": grid.probe}
    return msgspec.json.encode(settings, order="sorted").decode()


def training_settings(config: TrainingConfig) -> dict[str, Any]:
    """Return a training configuration's fields that differ from the defaults, as JSON values.

    So a field that is added later leaves the settings of earlier outcomes as they are.
    """
    plain, usual = (msgspec.to_builtins(one) for one in (config, TrainingConfig("")))
    return {key: value for key, value in plain.items() if value != usual[key]}


def waiting_tasks(grid: Grid, folder: Path) -> list[Task]:
    """Return the tasks of a grid that are not done yet, in their order."""
    return [task for task in grid.tasks() if read_outcome(grid, folder, task) is None]
