"""A model on its way into the daemon: tried in a process of its own, then loaded and warm.

All of that happens in a thread that nobody waits for. Where a model decides already, it goes on
meanwhile; the part takes the new one when it is there.
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
    """Begins at once.

    Args:
        opened: the stream that it will classify; None: it is only tried.
        age: of the stream, see `Classifier`; used if it is live.
        trial: of the same file, if there was one.

    Attributes:
        stamp: What the file was when it was tried, see `file_stamp`.
        finished: Set when the model is there, or refused.
        error: The reason for which the model is refused; None: it is not.
        trial: What the trial found; None before.
        classifier: The model, warm; None before, and without a stream.
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
        """Nobody wants it any more."""
        self._given_up.set()

    @property
    def words(self) -> str:
        """What came of it."""
        if self.error is not None:
            return str(self.error)
        assert self.trial is not None
        t = self.trial
        said = (
            f"{self.file}, sha256 {t.sha256[:12]}: warm after {t.load_s:.2f} s, "
            f"{t.memory_mb:.0f} MB, {1e3 * t.step_s:.1f} ms a step"
        )
        if self.classifier is not None and 1e3 * t.step_s > self.classifier.step_ms:
            said += f", longer than the {self.classifier.step_ms:.0f} ms of it: it cannot keep up"
        return said

    def _run(self) -> None:
        try:
            self._try()
        except TactileError as error:
            self.error = error
        except Exception as error:  # whatever it is, it is the model's
            self.error = ModelError(f"{self.file}: {type(error).__name__}: {error}")
        self.finished.set()

    def _try(self) -> None:
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
    """The model's file; that of the package if the configuration names none."""
    return Path(config.file) if config.file else shipped_model()


def file_stamp(file: Path) -> tuple[int, ...]:
    """Changes when a file is replaced, written, or taken away."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        return ()
    return (found.st_mtime_ns, found.st_size, found.st_ino)
