"""What a run writes down: a line per epoch in CSV, and TensorBoard's files where asked."""

import csv
import io
import os
import socket
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

from tactile_rt.errors import ConfigError, ModelError
from tactile_rt.extras import install_line
from tactile_rt.files import replaced

__all__ = ["Board", "log_epoch", "logged_epochs"]

FORMAT = "brain.Event:2"  # the only one that TensorBoard has ever read


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


class Board:
    """TensorBoard's view of a run, if it is wanted. Nothing is written before `begin`.

    Its records are written here and now, by TensorBoard's own writer of records: its writer of
    events has a thread, which tells of a full disk by a traceback.

    Args:
        folder: the run's.
        wanted: False: nothing is ever written.

    Raises:
        ConfigError: wanted, but tensorboard is not installed.
    """

    def __init__(self, folder: Path, wanted: bool) -> None:
        self._folder = folder / "tensorboard"
        self._path: Path | None = None
        self._records: Any = None
        self._wanted = wanted
        if wanted:
            try:
                import tensorboard.summary.writer.record_writer  # noqa: F401
            except ImportError:
                raise ConfigError(
                    "--tensorboard needs tensorboard, which is not installed: "
                    + install_line("tensorboard")
                ) from None

    def begin(self, done: int) -> None:
        """Go on after so many updates: what a killed run wrote of later ones is dropped.

        Raises:
            OSError: the medium is full, or failed; so do `write` and `close`.
        """
        if not self._wanted:
            return
        from tensorboard.compat.proto.event_pb2 import SessionLog
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._folder.mkdir(parents=True, exist_ok=True)
        name = f"events.out.tfevents.{time.time_ns()}.{socket.gethostname()}.{os.getpid()}"
        self._path = self._folder / name
        self._records = RecordWriter(self._path.open("wb"))
        self._add(file_version=FORMAT)
        self._add(step=done + 1, session_log=SessionLog(status=SessionLog.START))

    def write(self, update: int, values: dict[str, float]) -> None:
        """Scalars after an update."""
        if self._records is not None:
            from tensorboard.compat.proto.summary_pb2 import Summary

            named = [Summary.Value(tag=name, simple_value=v) for name, v in values.items()]
            self._add(step=update, summary=Summary(value=named))

    def close(self) -> None:
        """Write what is left."""
        records, self._records = self._records, None
        if records is not None:
            records.close()

    def _add(self, **event: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event

        try:
            self._records.write(Event(wall_time=time.time(), **event).SerializeToString())
            self._records.flush()
        except OSError as error:
            with suppress(OSError):
                self.close()  # or it would be tried again when nobody listens
            raise OSError(error.errno, os.strerror(error.errno or 0), str(self._path)) from None
