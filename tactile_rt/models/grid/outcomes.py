"""What the tasks of a grid have found, as it is kept in the grid's folder. Needs no torch."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.grid.plan import SUPERVISED, Grid, Task
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.stream import ConfigError

__all__ = [
    "SUBSET",
    "Outcome",
    "Training",
    "outcome_path",
    "read_outcome",
    "settings_of",
    "waiting_tasks",
]

SUBSET, OUTCOMES = "sweeps", "outcomes"  # folders of a grid


class Training(msgspec.Struct, frozen=True):
    """One training and what the validation split says of it.

    Attributes:
        learning_rate, warmup, updates: The settings of the training, as in `TrainingConfig`.
        score: Top-1 of the validation split, 0 to 1, the mean of clean and noisy; of a
            self-supervised network by its probe. 0 if it diverged.
        seconds: The CPU time of its updates, and of what it was validated by, s; 0 if something
            else than a CPU trained it.
    """

    learning_rate: float
    warmup: float
    updates: int
    score: float
    seconds: float


class Outcome(msgspec.Struct, frozen=True):
    """What a task found.

    Attributes:
        name, seed: Name and seed of the task.
        key: The settings that the outcome depends on, as JSON; another key is another experiment.
        top1, top5, noisy: Hits as text, a 0 or 1 per test sweep: right, among the first five, right
            at the rated noise.
        parameters: The number of parameters of encoder, attender and decoder.
        seconds: The CPU time of the training that was scored, s, as in `Training`.
        trials: The trials that chose rate and warm-up; of the first seed alone.
        growth: The trainings with more and more updates; of the first seed alone.
        chosen: The training that was scored.
        failed: The reason why there is no figure; empty if there is one.
    """

    name: str
    seed: int
    key: str
    top1: str = ""
    top5: str = ""
    noisy: str = ""
    parameters: int = 0
    seconds: float = 0.0
    trials: tuple[Training, ...] = ()
    growth: tuple[Training, ...] = ()
    chosen: Training | None = None
    failed: str = ""

    def right(self, which: str = "top1") -> NDArray[np.bool_]:
        """(sweep,) of `top1`, `top5` or `noisy`."""
        right: NDArray[np.bool_] = np.array(list(getattr(self, which)), dtype=np.str_) == "1"
        return right


def outcome_path(folder: Path, task: Task) -> Path:
    """Where a grid's folder keeps a task's outcome."""
    return folder / OUTCOMES / f"{task.slug}.json"


def read_outcome(grid: Grid, folder: Path, task: Task) -> Outcome | None:
    """What a task found, if it is done.

    Raises:
        ConfigError: it was done with other settings.
    """
    path = outcome_path(folder, task)
    if not path.exists():
        return None
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Outcome)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{path} is damaged ({error}): delete it to do it again") from None
    if found.key != settings_of(grid, folder, task):
        raise ConfigError(
            f"{folder} holds {task.name!r} trained with other settings: choose another folder, or "
            f"delete {path} to train it again"
        )
    return found


def settings_of(grid: Grid, folder: Path, task: Task) -> str:
    """Everything that an outcome depends on, as JSON."""
    settings: dict[str, Any] = {"sweeps": msgspec.to_builtins(grid.sweeps), "data": grid.data}
    if task.cell is not None:
        config, usual = (
            msgspec.to_builtins(one) for one in (grid.config(task, Path()), TrainingConfig(""))
        )
        if task.random:  # trained for no update at all
            config = {k: config[k] for k in ("encoder", "attender", "width", "seed")}
        else:
            # A key that was thought of later leaves what was done before as it is.
            config = {k: v for k, v in config.items() if v != usual[k]}
            settings |= {"search": grid.search, "growth": grid.growth, "cell": task.cell}
        settings |= {"config": config}
        if task.random or task.cell.objective != SUPERVISED:
            settings |= {"probe": grid.probe}
    return msgspec.json.encode(settings, order="sorted").decode()


def waiting_tasks(grid: Grid, folder: Path) -> list[Task]:
    """The tasks of a grid that are not done yet, in their order.

    Raises:
        ConfigError: as `read_outcome`.
    """
    return [task for task in grid.tasks() if read_outcome(grid, folder, task) is None]
