"""Admission of a model to the daemon: a trial in a child process, then loading and warm-up.

The admission runs in a background thread. Meanwhile the present model of the part goes on deciding;
the part replaces it when the new model is ready.
"""

import threading
from collections.abc import Callable
from pathlib import Path

from tactile_rt.classifier.classifier import EVERY, Classifier
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.classifier.trial import Trial, TrialLimits, try_model
from tactile_rt.core.errors import ModelError, TactileError
from tactile_rt.daemon.config import ADMISSION, LimitsConfig, ModelConfig
from tactile_rt.daemon.items import Opened


class Admission:
    """A background job that tries, loads and warms up a model; starts on construction.

    Args:
        opened: The stream that the model will classify; with None, the model is only tried.
        age: Returns the age of a step, s, see `Classifier`; used only for a live stream.
        trial: The result of an earlier trial of the same file, which is then not repeated.

    Attributes:
        stamp: The `file_stamp` of the file that is tried.
        finished: Set when the model is ready or refused.
        error: The reason for a refusal, or None if the model is not refused.
        trial: The result of the trial, or None before its end.
        classifier: The loaded, warm classifier; None until it is ready, or without a stream.
    """

    def __init__(
        self,
        config: ModelConfig,
        limits: LimitsConfig,
        opened: Opened | None,
        age: Callable[[int], float],
        trial: Trial | None = None,
    ) -> None:
        self.config, self.file = config, model_path(config)
        self.stamp = file_stamp(self.file)
        self.finished = threading.Event()
        self.error: TactileError | None = None
        self.trial = trial
        self.classifier: Classifier | None = None
        self._limits, self._opened, self._age = limits, opened, age
        self._given_up = threading.Event()
        threading.Thread(target=self._run, name=ADMISSION, daemon=True).start()

    def give_up(self) -> None:
        """Abandon the admission, because its model is no longer needed."""
        self._given_up.set()

    @property
    def words(self) -> str:
        """Result of the admission in words, for the log."""
        if self.error is not None:
            return str(self.error)
        assert self.trial is not None
        t = self.trial
        text = (
            f"{self.file}, sha256 {t.sha256[:12]}: warm after {t.load_s:.2f} s, "
            f"{t.memory_mb:.0f} MB, {1e3 * t.step_s:.1f} ms a step"
        )
        if self.classifier is not None and 1e3 * t.step_s > self.classifier.step_ms:
            text += f", longer than a step ({self.classifier.step_ms:.0f} ms): it cannot keep up"
        return text

    def _run(self) -> None:
        try:
            self._admit()
        except TactileError as error:
            self.error = error
        except Exception as error:  # any other error is the model's, too
            self.error = ModelError(f"{self.file}: {type(error).__name__}: {error}")
        self.finished.set()

    def _admit(self) -> None:
        config, opened = self.config, self._opened
        if self.trial is None:
            every = (config.every or EVERY) if config.mode == "sliding" else 0
            limits = TrialLimits(self._limits.model_mb, self._limits.model_s)
            self.trial = try_model(self.file, limits, every, self._given_up.is_set)
        if opened is None or self._given_up.is_set():
            return
        live = opened.stream.live
        self.classifier = Classifier(
            self.file, opened.spec, mode=config.mode, every=config.every or None,
            sure=config.sure or None, in_a_row=config.in_a_row,
            deadline_s=config.deadline_ms / 1e3 or None, late=config.late,
            providers=config.providers, age=self._age if live else None,
            catch_up=config.catch_up, behind_s=config.behind_ms / 1e3 or None,
            fuse_s=config.fuse_s,
        )  # fmt: skip
        if file_stamp(self.file) != self.stamp:
            raise ModelError(f"{self.file} was written while it was being tried: try again")


def model_path(config: ModelConfig) -> Path:
    """Return the path of the model's file, by default that of the packaged model."""
    return Path(config.file) if config.file else shipped_model()


def file_stamp(file: Path) -> tuple[int, ...]:
    """Return (mtime in ns, size, inode) of a file, empty if it is missing."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        return ()
    return (found.st_mtime_ns, found.st_size, found.st_ino)
