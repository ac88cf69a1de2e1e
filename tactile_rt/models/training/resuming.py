"""Going on with a run that was interrupted: is it this one, and how far did it come?

A run's folder holds `config.json`, written before its first epoch, and `last.pt` and a line of
`history.csv`, written after each one: a run that is killed goes on from there and ends with the
same numbers.
"""

import csv
import io
from dataclasses import asdict, dataclass
from itertools import pairwise
from math import ceil, inf
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch.optim.lr_scheduler import LRScheduler

from tactile_rt.core.errors import ConfigError, ModelError, name_some
from tactile_rt.core.files import replaced, write_whole
from tactile_rt.models.checkpoint_files import describe_checkpoint, reason
from tactile_rt.models.objectives import Objective
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.optimizers import build_schedule

__all__ = ["RunState", "as_json", "begin_run", "log_epoch", "logged_epochs"]

PATHS = ("data", "also", "begin")  # keys of a configuration


@dataclass
class RunState:
    """How far a run is, and all that it takes to go on.

    Attributes:
        epoch, done: The numbers of epochs and of updates that are done.
    """

    objective: Objective
    optimizer: torch.optim.Optimizer
    config: TrainingConfig
    per_epoch: int
    epoch: int = 0
    done: int = 0
    best: float = -inf

    def __post_init__(self) -> None:
        self.updates = self.config.updates or self.config.epochs * self.per_epoch
        self.epochs = ceil(self.updates / self.per_epoch)
        self.schedule: LRScheduler = build_schedule(
            self.optimizer, self.config, self.updates, self.per_epoch
        )

    def state(self) -> dict[str, Any]:
        """What `last.pt` holds."""
        return {
            "model": self.objective.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "epoch": self.epoch,
            "done": self.done,
            "best": self.best,
        }

    def resume(self, folder: Path) -> None:
        """Go on from the `last.pt` of a folder, if there is one.

        Raises:
            ModelError: it, `best.pt` or `history.csv` is damaged, or the best network is gone.
        """
        last = folder / "last.pt"
        if not last.exists():
            return
        try:
            saved = torch.load(last, map_location="cpu", weights_only=True)
            self.objective.load_state_dict(saved["model"])
            self.optimizer.load_state_dict(saved["optimizer"])
            self.schedule.load_state_dict(saved["schedule"])
            self.epoch, self.done, self.best = saved["epoch"], saved["done"], saved["best"]
        except Exception as error:  # torch raises many unrelated types for a damaged file
            raise ModelError(
                f"{last} is damaged ({reason(error)[:60]}): delete it to begin the run anew"
            ) from None
        try:
            describe_checkpoint(folder / "best.pt")
        except ModelError as error:
            raise ModelError(f"{error}: delete {last} to begin the run anew") from None
        logged_epochs(folder / "history.csv", until=self.epoch + 1)  # else told after an epoch


def as_json(config: TrainingConfig) -> dict[str, Any]:
    """As a file has it, which knows no tuples."""
    plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(asdict(config)))
    return plain


def begin_run(config: TrainingConfig, folder: Path) -> None:
    """Make the folder of a run, or check that the one that is there is of this very run.

    Raises:
        ConfigError: it is of another configuration, or of none that is known.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, mine = folder / "config.json", as_json(config)
    # Before its first epoch is finished a run has nothing to lose: correct its options and go on.
    if not (folder / "last.pt").exists():
        text = msgspec.json.format(msgspec.json.encode(mine), indent=1)
        write_whole(path, lambda file: file.write(text))
        return
    try:
        theirs = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except FileNotFoundError:
        raise ConfigError(
            f"{path} is gone, so that nobody knows what run this is: choose another folder, or "
            f"delete {folder / 'last.pt'} to begin anew"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged ({error}): choose another folder") from None
    differing = [
        key for key in {**mine, **theirs} if not _same(key, theirs.get(key), mine.get(key))
    ]
    if differing:
        raise ConfigError(
            f"{folder} holds a run of another configuration (other {name_some(differing)}): choose "
            "another folder, or repeat the options that began it"
        )


def _same(key: str, one: Any, other: Any) -> bool:
    """Whether two values of a key are; a path may be spelt in several ways."""
    if key in PATHS and one and other:
        names = [[value] if isinstance(value, str) else value for value in (one, other)]
        one, other = ([str(Path(name).resolve()) for name in some] for some in names)
    return bool(one == other)


def logged_epochs(path: Path, until: float) -> list[dict[str, str]]:
    """Read the lines of a run's `history.csv` before an epoch.

    Raises:
        ModelError: it is damaged, or lines are missing.
    """
    if until <= 1 or not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file, strict=True))
        epochs = [int(line["epoch"]) for line in lines]
        whole = epochs[-1] >= until - 1 and all(b == a + 1 for a, b in pairwise(epochs))
    except (UnicodeDecodeError, csv.Error, IndexError, KeyError, TypeError, ValueError):
        whole = False
    if not whole:
        raise ModelError(f"{path} is damaged: delete it to go on without what it tells")
    return [line for line, epoch in zip(lines, epochs, strict=True) if epoch < until]


def log_epoch(path: Path, metrics: dict[str, float]) -> None:
    """Add a line to `history.csv`, in place of those of later epochs.

    Raises:
        OSError: the medium is full, or failed.
    """
    # A line that was logged before the run was killed, but not yet saved, is written again.
    old = logged_epochs(path, metrics["epoch"])
    text = io.StringIO()
    writer = csv.DictWriter(text, list(metrics))
    writer.writeheader()
    writer.writerows([*old, metrics])
    with replaced(path) as whole:
        whole.write(text.getvalue().encode())
