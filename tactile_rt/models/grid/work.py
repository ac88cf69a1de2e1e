"""One task of a grid: tune, train, probe, and score on the test objects.

What a cell is tuned and trained by is the validation split alone; the test split is looked at once,
when the network is chosen.
"""

import time
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.files import write_whole
from tactile_rt.models.augmentation import build
from tactile_rt.models.checkpoints import load_checkpoint, run_on
from tactile_rt.models.data_checks import check_sets, check_split
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, RATED
from tactile_rt.models.ead import count_parameters
from tactile_rt.models.evaluation import among, cut_windows, hits, posteriors
from tactile_rt.models.grid.outcomes import (
    SUBSET,
    Outcome,
    Training,
    outcome_path,
    read_outcome,
    settings_of,
)
from tactile_rt.models.grid.plan import SUPERVISED, Grid, Task
from tactile_rt.models.svm import fit_svm
from tactile_rt.models.training import (
    ProbeConfig,
    Progress,
    initialise,
    probe,
    train,
)
from tactile_rt.stream import ModelError
from tactile_rt.sweep_set import SweepManifest

__all__ = ["Workbench"]

BATCH = 128
RUNS = "runs"  # a folder of a grid
POINT = "point.json"


class Workbench:
    """What the tasks of one process share: the test windows as the robot would cut them.

    Args:
        grid: the grid.
        folder: of the grid, with its sweeps.
        accelerator: what trains, as `train` takes it.
    """

    def __init__(self, grid: Grid, folder: Path, accelerator: str = "cpu") -> None:
        self.grid, self.folder, self.accelerator = grid, folder, accelerator
        self.data = folder / SUBSET
        check_split(self.data, SweepManifest.read(self.data))
        self.splits = SweepSet.read(self.data, "train"), SweepSet.read(self.data, "validation")
        self.test = SweepSet.read(self.data, "test")
        check_sets(self.data, (*self.splits, self.test))
        for task in grid.tasks():
            if task.cell is not None:  # an array that cannot be augmented so is told now
                build(grid.config(task, self.data).augmentation, self.test.manifest.spec)
        self._shares: dict[float, tuple[SweepSet, SweepSet]] = {}
        self._clean, self._noisy = (
            list(cut_windows(self.test, batch=BATCH, disturbance=one)) for one in (CLEAN, RATED)
        )

    def do(self, task: Task, report: Callable[..., None] = lambda _: None) -> Outcome:
        """Do a task and keep its outcome; a network that diverges is an outcome too.

        Args:
            task: of the grid, after those that it needs.
            report: called with `training.Progress` after every update.
        """
        found = Outcome(task.name, task.seed, settings_of(self.grid, self.folder, task))
        try:
            if task.cell is None:
                found = self._svm(found)
            elif task.random:
                found = self._untrained(found, task)
            else:
                found = self._trained(found, task, report)
        except ModelError as error:
            found = msgspec.structs.replace(found, failed=str(error))
        path = outcome_path(self.folder, task)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda file: file.write(msgspec.json.encode(found)))
        return found

    def _trained(self, found: Outcome, task: Task, report: Callable[..., None]) -> Outcome:
        if task.seed:
            first = read_outcome(self.grid, self.folder, msgspec.structs.replace(task, seed=0))
            if first is None or first.chosen is None:
                raise ModelError("its first seed diverged, so nothing is known to train it with")
            chosen = self._train(task, first.chosen, report)
        else:
            trials = self._search(task, report)
            growth = self._grow(task, max(trials, key=_score), report)
            found = msgspec.structs.replace(found, trials=trials, growth=growth)
            chosen = max(growth, key=_score)
        if not chosen.score:
            raise ModelError("every training of it diverged")
        run = self._run(task, chosen)
        assert task.cell is not None
        best = run / ("" if task.cell.objective == SUPERVISED else "probe") / "best.pt"
        if not best.exists():  # where only what its trainings scored was kept
            (run / POINT).unlink()
            chosen = self._train(task, chosen, report)
        return self._scored(
            msgspec.structs.replace(found, chosen=chosen, seconds=chosen.seconds), best
        )

    def _search(self, task: Task, report: Callable[..., None]) -> tuple[Training, ...]:
        """The trials: every rate with the first warm-up, then the other warm-ups with the best."""
        search = self.grid.search

        def of(rate: float, warmup: float) -> Training:
            return self._train(task, Training(rate, warmup, search.updates, 0.0, 0.0), report)

        rates = [of(rate, search.warmup[0]) for rate in search.learning_rate]
        best = max(rates, key=_score).learning_rate
        return (*rates, *(of(best, warmup) for warmup in search.warmup[1:]))

    def _grow(
        self, task: Task, best: Training, report: Callable[..., None]
    ) -> tuple[Training, ...]:
        """Trainings of twice as many updates each, until one gains too little."""
        growth = self.grid.growth
        points: list[Training] = []
        updates, before = growth.first, -inf
        while updates <= growth.most:
            at = msgspec.structs.replace(best, updates=updates)
            points.append(self._train(task, at, report))
            if points[-1].score < before + growth.gain:
                break
            updates, before = 2 * updates, points[-1].score
        return tuple(points)

    def _train(self, task: Task, at: Training, report: Callable[..., None]) -> Training:
        """One training, unless it is there; of a diverged one the score is 0."""
        run = self._run(task, at)
        if (run / POINT).exists():
            return msgspec.json.decode((run / POINT).read_bytes(), type=Training)
        chosen: dict[str, Any] = {
            "learning_rate": at.learning_rate, "warmup": at.warmup, "updates": at.updates,
        }  # fmt: skip
        cell = task.cell
        assert cell is not None
        if cell.begin:
            begun = read_outcome(self.grid, self.folder, self._begun(task))
            if begun is None or begun.chosen is None:
                raise ModelError(f"{cell.begin!r} diverged, and there is nothing to begin with")
            self._train(self._begun(task), begun.chosen, report)  # where only its outcome was kept
            chosen["begin"] = str(self._run(self._begun(task), begun.chosen) / "best.pt")
        config = self.grid.config(task, self.data, **chosen)
        began, updates = time.process_time(), 0

        def count(progress: Progress) -> None:
            nonlocal updates
            updates += not progress.metrics
            report(progress)

        splits = self.splits_of(cell.share)
        try:
            best = train(config, run, count, device=self.accelerator, splits=splits)
            # what was done before an interruption cost as much
            seconds = (time.process_time() - began) * at.updates / max(updates, 1)
            if cell.objective != SUPERVISED:
                best = probe(best, run / "probe", ProbeConfig(**self.grid.probe), report, splits)
            metrics = load_checkpoint(best)[1]["metrics"]
            score = (metrics["validation_top1"] + metrics["validation_top1_noisy"]) / 2
        except ModelError:
            run.mkdir(parents=True, exist_ok=True)
            score, seconds = 0.0, time.process_time() - began
        if self.accelerator != "cpu":  # a processor's time for starting kernels says nothing
            seconds = 0.0
        done = msgspec.structs.replace(at, score=score, seconds=seconds)
        write_whole(run / POINT, lambda file: file.write(msgspec.json.encode(done)))
        for path in run.rglob("last.pt"):  # what is done needs not go on
            path.unlink()
        return done

    def _run(self, task: Task, at: Training) -> Path:
        """The folder of one training."""
        name = f"rate{at.learning_rate:g}_warmup{at.warmup:g}_updates{at.updates}"
        return self.folder / RUNS / task.slug / name

    def _begun(self, task: Task) -> Task:
        """What a task's network begins with."""
        assert task.cell is not None
        names = {one.name: one for one in self.grid.cells}
        return Task(task.cell.begin, task.seed, names[task.cell.begin])

    def _untrained(self, found: Outcome, task: Task) -> Outcome:
        run = self.folder / RUNS / task.slug
        best = initialise(self.grid.config(task, self.data), run, self.splits)
        best = probe(best, run / "probe", ProbeConfig(**self.grid.probe), splits=self.splits)
        return self._scored(found, best)

    def splits_of(self, share: float) -> tuple[SweepSet, SweepSet]:
        """The splits to train and to validate on, with some of the objects to train on."""
        if share == 1:
            return self.splits
        if share not in self._shares:
            training, validating = self.splits
            manifest = training.manifest
            of: dict[str, list[str]] = {}
            for name in manifest.split["train"]:
                of.setdefault(manifest.category(name), []).append(name)
            taken = [n for names in of.values() for n in names[: max(round(share * len(names)), 1)]]
            some = training[np.flatnonzero(np.isin(training.sweeps.objects, taken))]
            self._shares[share] = some, validating
        return self._shares[share]

    def _svm(self, found: Outcome) -> Outcome:
        began = time.process_time()
        right = fit_svm(*self.splits).hits(self.test)
        seconds = time.process_time() - began
        return msgspec.structs.replace(found, top1=_as_text(right), seconds=seconds)

    def _scored(self, found: Outcome, best: Path) -> Outcome:
        """The outcome with what a checkpoint's network makes of the test split."""
        model, _ = load_checkpoint(best)
        run, labels, classes = (
            run_on(model),
            self.test.sweeps.labels,
            len(self.test.manifest.categories),
        )
        clean, noisy = (  # had it to name one
            among(posteriors(cut, run)[:, -1], classes) for cut in (self._clean, self._noisy)
        )
        return msgspec.structs.replace(
            found,
            top1=_as_text(hits(clean, labels)),
            top5=_as_text(hits(clean, labels, 5)),
            noisy=_as_text(hits(noisy, labels)),
            parameters=count_parameters(model.network),
        )


def _score(point: Training) -> float:
    return point.score


def _as_text(hits: NDArray[np.bool_]) -> str:
    return "".join("01"[int(one)] for one in hits)
