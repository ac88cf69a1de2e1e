"""What a run writes down: a line per epoch in CSV, and TensorBoard's files where asked."""

import csv
import os
from pathlib import Path
from typing import Any

from tactile_rt.stream import ConfigError

__all__ = ["Board", "log_epoch"]


def log_epoch(path: Path, metrics: dict[str, float]) -> None:
    """Add a line to a run's `history.csv`; one of the same epoch or later is replaced."""
    # A line that was logged before the run was killed, but not yet saved, is written again.
    old = []
    if path.exists():
        with path.open(newline="") as file:
            old = [r for r in csv.DictReader(file) if int(r["epoch"]) < metrics["epoch"]]
    partial = path.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(metrics))
        writer.writeheader()
        writer.writerows([*old, metrics])
    os.replace(partial, path)


class Board:
    """TensorBoard's view of a run, if it is wanted. Nothing is written before `begin`.

    Args:
        folder: the run's.
        wanted: False: nothing is ever written.

    Raises:
        ConfigError: wanted, but tensorboard is not installed.
    """

    def __init__(self, folder: Path, wanted: bool) -> None:
        self._folder = folder / "tensorboard"
        self._kind: Any = None
        self._writer: Any = None
        if wanted:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError:
                raise ConfigError(
                    "--tensorboard needs tensorboard, which is not installed: "
                    "pip install tensorboard"
                ) from None
            self._kind = SummaryWriter

    def begin(self, done: int) -> None:
        """Go on after so many updates: what a killed run wrote of later ones is dropped."""
        if self._kind is not None:
            self._writer = self._kind(str(self._folder), purge_step=done + 1)

    def write(self, update: int, values: dict[str, float]) -> None:
        """Scalars after an update."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(name, value, update)

    def close(self) -> None:
        """Write what is left."""
        if self._writer is not None:
            self._writer.close()
