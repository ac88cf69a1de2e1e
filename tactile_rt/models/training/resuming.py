"""Going on with a run that was interrupted: is it this one, and how far did it come?

A run's folder holds `config.json`, written before its first epoch, and `last.pt`, written after
each one: a run that is killed goes on from there and ends with the same numbers.
"""

from dataclasses import asdict, dataclass
from math import ceil, inf
from pathlib import Path
from typing import Any

import msgspec
import torch
from torch.optim.lr_scheduler import LRScheduler

from tactile_rt.errors import ConfigError, ModelError, name_some
from tactile_rt.files import write_whole
from tactile_rt.models.checkpoint_files import describe_checkpoint, reason
from tactile_rt.models.objectives import Objective
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.logs import logged_epochs
from tactile_rt.models.training.optimizers import build_schedule

__all__ = ["RunState", "as_json", "begin_run"]

PATHS = ("data", "also", "begin")  # keys of a configuration


@dataclass
class RunState:
    """How far a run is, and all that it takes to go on.

    Attributes:
        objective: The network and what it is trained for.
        optimizer: The optimizer of its parameters.
        config: The configuration of the run.
        per_epoch: The number of updates of an epoch.
        epoch: The number of epochs that are done.
        done: The number of updates that are done.
        best: The best score of a validation so far.
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
    # a run of before a key was thought of
    defaults = as_json(TrainingConfig(config.data))
    differing = [
        key
        for key in {**mine, **theirs}
        if not _same(key, theirs.get(key, defaults.get(key)), mine.get(key))
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
