"""One task of a grid: train, probe, and score on the test objects."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.files import write_whole
from tactile_rt.models.augmentation import build
from tactile_rt.models.data_checks import check_sets, check_split
from tactile_rt.models.datasets import SweepSet, windows
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.ead import count_parameters
from tactile_rt.models.evaluation import Step, hits
from tactile_rt.models.grid.plan import SUPERVISED, Grid, Task
from tactile_rt.models.onsets import find_onsets
from tactile_rt.models.svm import fit_svm
from tactile_rt.models.training import (
    ProbeConfig,
    initialise,
    load_checkpoint,
    probe,
    run_on,
    train,
)
from tactile_rt.stream import ConfigError, ModelError
from tactile_rt.sweep_set import SweepManifest

__all__ = ["Outcome", "Workbench", "outcome_path", "read_outcome", "settings_of"]

BATCH = 128
RATED = Disturbance(noise=1.0)
SUBSET = "sweeps"  # folders of a grid
RUNS, OUTCOMES = "runs", "outcomes"


class Outcome(msgspec.Struct, frozen=True):
    """What a task found.

    Attributes:
        name, seed: Name and seed of the task.
        key: The settings that the outcome depends on, as JSON; another key is another experiment.
        top1, top5, noisy: Hits as text, a 0 or 1 per test sweep: right, among the first five, right
            at the rated noise.
        parameters: The number of parameters of encoder, attender and decoder.
        seconds: The CPU time that the task took, all included, s.
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
        config = msgspec.to_builtins(grid.config(task, Path()))
        if task.random:  # trained for no update at all
            config = {k: config[k] for k in ("encoder", "attender", "width", "seed")}
        settings |= {"config": config}
        if task.random or task.cell.objective != SUPERVISED:
            settings |= {"probe": grid.probe}
    return msgspec.json.encode(settings, order="sorted").decode()


class Workbench:
    """What the tasks of one process share: the test windows as the robot would cut them.

    Args:
        grid: the grid.
        folder: of the grid, with its sweeps.
    """

    def __init__(self, grid: Grid, folder: Path) -> None:
        self.grid, self.folder = grid, folder
        self.data = folder / SUBSET
        check_split(self.data, SweepManifest.read(self.data))
        self.splits = SweepSet.read(self.data, "train"), SweepSet.read(self.data, "validation")
        self.test = SweepSet.read(self.data, "test")
        check_sets(self.data, (*self.splits, self.test))
        for task in grid.tasks():
            if task.cell is not None:  # an array that cannot be augmented so is told now
                build(grid.config(task, self.data).augmentation, self.test.manifest.spec)
        self._windows = {key: self._cut(d) for key, d in (("clean", CLEAN), ("noisy", RATED))}

    def do(self, task: Task, report: Callable[..., None] = lambda _: None) -> Outcome:
        """Do a task and keep its outcome; a network that diverges is an outcome too.

        Args:
            task: of the grid.
            report: called with `training.Progress` after every update.
        """
        began = time.process_time()
        found = Outcome(task.name, task.seed, settings_of(self.grid, self.folder, task))
        try:
            scores, parameters = self._svm() if task.cell is None else self._network(task, report)
            found = msgspec.structs.replace(
                found,
                **{k: "".join("01"[int(one)] for one in v) for k, v in scores.items()},
                parameters=parameters,
            )
        except ModelError as error:
            found = msgspec.structs.replace(found, failed=str(error))
        found = msgspec.structs.replace(found, seconds=time.process_time() - began)
        path = outcome_path(self.folder, task)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda file: file.write(msgspec.json.encode(found)))
        return found

    def _network(
        self, task: Task, report: Callable[..., None]
    ) -> tuple[dict[str, NDArray[np.bool_]], int]:
        assert task.cell is not None
        config = self.grid.config(task, self.data)
        run = self.folder / RUNS / task.slug
        best = (
            initialise(config, run, self.splits)
            if task.random
            else train(config, run, report, device="cpu", splits=self.splits)
        )
        if task.random or task.cell.objective != SUPERVISED:
            how = ProbeConfig(**self.grid.probe)
            best = probe(best, run / "probe", how, report, self.splits)
        for path in run.rglob("last.pt"):  # what is done needs not go on
            path.unlink()
        model, _ = load_checkpoint(best)
        return self._score(run_on(model)), count_parameters(model.network)

    def _svm(self) -> tuple[dict[str, NDArray[np.bool_]], int]:
        svm = fit_svm(*self.splits)
        return {"top1": svm.hits(self.test)}, 0

    def _score(self, run: Step) -> dict[str, NDArray[np.bool_]]:
        labels = self.test.sweeps.labels
        last, classes = {}, len(self.test.manifest.categories)
        for name, (cut, offset, sigma, found) in self._windows.items():
            parts = [slice(i, i + BATCH) for i in range(0, len(cut), BATCH)]
            logits = np.concatenate([run(cut[p], offset[p], sigma[p])[:, -1] for p in parts])
            logits[~found] = np.nan
            last[name] = logits[:, :classes]  # had it to name one
        return {
            "top1": hits(last["clean"], labels),
            "top5": hits(last["clean"], labels, 5),
            "noisy": hits(last["noisy"], labels),
        }

    def _cut(self, disturbance: Disturbance) -> tuple[NDArray[Any], ...]:
        rng = np.random.default_rng(0)
        parts = []
        for i in range(0, len(self.test.sweeps), BATCH):
            part = self.test[i : i + BATCH]
            values = disturbance.of_samples(part.sweeps.values, part, rng)
            at = find_onsets(values, self.test.floor)
            cut = windows(values, at.start, self.test.timing)
            parts.append((cut, at.offset, at.sigma, at.start >= 0))
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))
