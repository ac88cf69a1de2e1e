"""What a run writes down: a line per epoch in CSV."""

import csv
import io
from itertools import pairwise
from pathlib import Path

from tactile_rt.errors import ModelError
from tactile_rt.files import replaced

__all__ = ["log_epoch", "logged_epochs"]


def logged_epochs(path: Path, until: float) -> list[dict[str, str]]:
    """The lines of a run's `history.csv` before an epoch; none if there is no such file.

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
    """Add a line to a run's `history.csv`; one of the same epoch or later is replaced.

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
