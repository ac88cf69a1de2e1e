"""One task of a grid: tune, train, probe, and score on the test objects.

Tuning and training use the validation split only; the test split is used once, for the final
network.
"""

import time
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.files import write_whole
from tactile_rt.models.augmentation import build
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.datasets import SweepSet, check_sets, drawn_as
from tactile_rt.models.disturbances import CLEAN, RATED
from tactile_rt.models.ead import count_parameters
from tactile_rt.models.evaluation.measures import (
    CutWindows,
    among,
    cut_windows,
    hits,
    posteriors,
    run_on,
)
from tactile_rt.models.evaluation.svm import fit_svm
from tactile_rt.models.grid import outcomes
from tactile_rt.models.grid.outcomes import Outcome, Training
from tactile_rt.models.grid.plan import SUPERVISED, Grid, Task
from tactile_rt.models.training.batches import check_batches
from tactile_rt.models.training.config import TWO_SWEEPS, DivergedError, ProbeConfig, TrainingConfig
from tactile_rt.models.training.loop import initialise, launch_devices, train
from tactile_rt.models.training.probing import probe
from tactile_rt.sets.manifest import NEW_SWEEPS, SweepManifest
from tactile_rt.sets.objects import holds_out_sweeps
from tactile_rt.sets.splits import check_split

BATCH = 128
LONGER = (1, 2, 4)  # factors of a trial's updates, tried until trials can rank learning rates
FURTHER = 2  # most learning rates to try beyond those in the plan
Report = Callable[..., None]


class Workbench:
    """Runner of a grid's tasks in one process, with shared splits and test windows."""

    def __init__(self, grid: Grid, folder: Path, accelerator: str = "cpu") -> None:
        self.grid, self.folder, self.accelerator = grid, folder, accelerator
        self.data = folder / outcomes.SUBSET
        check_split(self.data, SweepManifest.read(self.data))
        self.splits = SweepSet.read(self.data, "train"), SweepSet.read(self.data, "validation")
        self.test = SweepSet.read(self.data, "test")
        self.known = None
        if holds_out_sweeps(self.test.manifest):
            self.known = SweepSet.read(self.data, NEW_SWEEPS)
        check_sets(self.data, (*self.splits, self.test))
        self._shares: dict[float, tuple[SweepSet, SweepSet]] = {}
        self._cut: dict[str, tuple[list[CutWindows], list[CutWindows]]] = {}
        self._check_tasks()

    def _check_tasks(self) -> None:
        """Check that the sweep set and this machine can run every task."""
        manifest = self.test.manifest
        for task in self.grid.tasks():
            if task.cell is None:
                continue
            config = self.grid.config(task, self.data)
            build(config.augmentation, manifest.spec)
            config.network(len(manifest.categories), manifest.frame)
            sweeps = self.splits_with_share(task.cell.share)[0].sweeps
            pairs, length = config.pairs == TWO_SWEEPS, sweeps.values.shape[1]
            check_batches(sweeps.objects, length, config.batch, config.jitter, pairs)
        with launch_devices(config, self.accelerator):
            pass

    def do(self, task: Task, report: Report = lambda _: None) -> Outcome:
        """Run a task, write its outcome and return it; divergence is an outcome too."""
        found = Outcome(task.name, task.seed, outcomes.settings_of(self.grid, task))
        try:
            if task.cell is None:
                found = self._do_svm(found)
            elif task.random:
                found = self._do_untrained(found, task)
            else:
                found = self._do_cell(found, task, report)
        except DivergedError as error:
            found = msgspec.structs.replace(found, failed=str(error))
        path = outcomes.outcome_path(self.folder, task)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda file: file.write(msgspec.json.encode(found)))
        return found

    def _do_cell(self, found: Outcome, task: Task, report: Report) -> Outcome:
        assert task.cell is not None
        if task.cell.recipe:
            config = self.grid.config(task, self.data)
            once = Training(config.learning_rate, config.warmup, 0, 0.0, 0.0)
            chosen = self._train(task, once, report)
        elif task.seed:
            first = outcomes.read_outcome(
                self.grid, self.folder, msgspec.structs.replace(task, seed=0)
            )
            if first is None or first.chosen is None:
                raise DivergedError("its first seed diverged, so nothing is known to train it with")
            chosen = self._train(task, first.chosen, report)
        else:
            trials = self._search(task, report)
            growth = self._grow(task, max(trials, key=_score), report)
            found = msgspec.structs.replace(found, trials=trials, growth=growth)
            chosen = max(growth, key=_score)
        if chosen.diverged:
            raise DivergedError("every training of it diverged")
        run = self._run_folder(task, chosen)
        best = run / ("" if task.cell.objective == SUPERVISED else "probe") / "best.pt"
        if not best.exists():  # only the scores were kept, so train again
            (run / outcomes.POINT).unlink()
            chosen = self._train(task, chosen, report)
        found = msgspec.structs.replace(found, chosen=chosen, seconds=chosen.seconds)
        return self._score_test(found, best, self.grid.config(task, self.data))

    def _search(self, task: Task, report: Report) -> tuple[Training, ...]:
        """Try every learning rate with the first warm-up, then other warm-ups with the best rate.

        If the trials cannot rank the rates, they are repeated with twice the updates. If the best
        rate is the lowest or the highest, the next rate beyond is tried too.
        """
        search = self.grid.search
        chance = 1 / len(self.test.manifest.categories)
        trials: list[Training] = []

        def of(rate: float, warmup: float, updates: int) -> Training:
            trials.append(self._train(task, Training(rate, warmup, updates, 0.0, 0.0), report))
            return trials[-1]

        for longer in LONGER:
            updates = longer * search.updates
            rates = [of(rate, search.warmup[0], updates) for rate in search.learning_rate]
            if not outcomes.shows_nothing(rates, chance):
                break
        for _ in range(FURTHER if len(rates) > 1 else 0):
            rates.sort(key=lambda one: one.learning_rate)
            best, place = max(rates, key=_score), [one.learning_rate for one in rates]
            if outcomes.shows_nothing(rates, chance) or best not in (rates[0], rates[-1]):
                break
            at, step = (0, place[0] / place[1]) if best is rates[0] else (-1, place[-1] / place[-2])
            rates.append(of(place[at] * step, search.warmup[0], updates))
        best = max(rates, key=_score)
        for warmup in search.warmup[1:]:
            of(best.learning_rate, warmup, updates)
        return tuple(one for one in trials if one.updates == updates)

    def _grow(self, task: Task, best: Training, report: Report) -> tuple[Training, ...]:
        """Train with more and more updates, doubled each time, until the gain is too small."""
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

    def _train(self, task: Task, at: Training, report: Report) -> Training:
        """Train a cell, or read an existing result; a diverged training scores 0."""
        cell, run = task.cell, self._run_folder(task, at)
        assert cell is not None
        begin = ""
        if cell.begin:
            begun = outcomes.read_outcome(self.grid, self.folder, self.grid.find_beginning(task))
            if begun is None or begun.chosen is None:
                raise DivergedError(
                    f"{cell.begin!r} diverged, so there is no checkpoint to begin with"
                )
            begin = str(self._run_folder(self.grid.find_beginning(task), begun.chosen) / "best.pt")
        config = self.grid.config(
            task, self.data, learning_rate=at.learning_rate, warmup=at.warmup, updates=at.updates,
            begin=begin,
        )  # fmt: skip
        key = self._settings_key(task, config)
        if (found := outcomes.read_point(run / outcomes.POINT, key)) is not None:
            return found
        if cell.begin:  # of the initial network only the outcome may have been kept
            assert begun is not None and begun.chosen is not None
            self._train(self.grid.find_beginning(task), begun.chosen, report)
        timed = self.accelerator == "cpu" and not (run / "last.pt").exists()
        began = time.process_time()
        splits, diverged = self.splits_with_share(cell.share), False
        try:
            best = train(config, run, report, device=self.accelerator, splits=splits)
            seconds = time.process_time() - began
            if cell.objective != SUPERVISED:
                best = probe(best, run / "probe", ProbeConfig(**self.grid.probe), report, splits)
            metrics = load_checkpoint(best)[1]["metrics"]
            score = (metrics["validation_top1"] + metrics["validation_top1_noisy"]) / 2
        except DivergedError:
            run.mkdir(parents=True, exist_ok=True)
            score, diverged, seconds = 0.0, True, time.process_time() - began
        done = Training(
            at.learning_rate, at.warmup, at.updates, score,
            seconds if timed else 0.0, diverged, key,
        )  # fmt: skip
        write_whole(run / outcomes.POINT, lambda file: file.write(msgspec.json.encode(done)))
        for path in run.rglob("last.pt"):  # a finished training is not resumed
            path.unlink()
        return msgspec.structs.replace(done, key="")

    def _settings_key(self, task: Task, config: TrainingConfig) -> str:
        """Return the settings that a training's score depends on, as JSON, without folder names."""
        settings: dict[str, Any] = {"sweeps": msgspec.to_builtins(self.grid.sweeps)}
        settings["config"] = outcomes.training_settings(config)
        settings["config"].pop("data")
        if config.begin:
            settings["config"]["begin"] = "/".join(Path(config.begin).parts[-3:-1])
            settings["begun"] = outcomes.settings_of(self.grid, self.grid.find_beginning(task))
        assert task.cell is not None
        if task.cell.objective != SUPERVISED:
            settings["probe"] = self.grid.probe
        return msgspec.json.encode(settings, order="sorted").decode()

    def _run_folder(self, task: Task, at: Training) -> Path:
        name = f"rate{at.learning_rate:g}_warmup{at.warmup:g}_updates{at.updates}"
        return outcomes.runs_of(self.folder, task) / name

    def _do_untrained(self, found: Outcome, task: Task) -> Outcome:
        run, config = outcomes.runs_of(self.folder, task), self.grid.config(task, self.data)
        best = initialise(config, run, self.splits)
        best = probe(best, run / "probe", ProbeConfig(**self.grid.probe), splits=self.splits)
        return self._score_test(found, best, config)

    def splits_with_share(self, share: float) -> tuple[SweepSet, SweepSet]:
        """Return training and validation splits, with only a share of the training objects."""
        if share == 1:
            return self.splits
        if share not in self._shares:
            training, validating = self.splits
            manifest = training.manifest
            of: dict[str, list[str]] = {}
            there = set(training.sweeps.objects.tolist())  # some may have been skipped
            for name in filter(there.__contains__, manifest.split["train"]):
                of.setdefault(manifest.category(name), []).append(name)
            taken = [n for names in of.values() for n in names[: max(round(share * len(names)), 1)]]
            some = training[np.flatnonzero(np.isin(training.sweeps.objects, taken))]
            self._shares[share] = some, validating
        return self._shares[share]

    def _do_svm(self, found: Outcome) -> Outcome:
        began = time.process_time()
        right = fit_svm(*self.splits).hits(self.test)
        seconds = time.process_time() - began
        return msgspec.structs.replace(found, top1=_as_text(right), seconds=seconds)

    def _score_test(self, found: Outcome, best: Path, config: TrainingConfig) -> Outcome:
        model, _ = load_checkpoint(best)
        run, labels = run_on(model), self.test.sweeps.labels
        classes = len(self.test.manifest.categories)
        # Conditional on the answer being a class.
        clean, noisy = (among(posteriors(c, run)[:, -1], classes) for c in self._cut_test(config))
        known = np.zeros(0, np.bool_)
        if self.known is not None:
            drawn = drawn_as(self.known, {"window": config.window})
            answers = posteriors(cut_windows(drawn, batch=BATCH, disturbance=CLEAN), run)
            known = hits(among(answers[:, -1], classes), self.known.sweeps.labels)
        return msgspec.structs.replace(
            found,
            top1=_as_text(hits(clean, labels)),
            top5=_as_text(hits(clean, labels, 5)),
            noisy=_as_text(hits(noisy, labels)),
            known=_as_text(known),
            parameters=count_parameters(model.network),
        )

    def _cut_test(self, config: TrainingConfig) -> tuple[list[CutWindows], list[CutWindows]]:
        if config.window not in self._cut:
            test = drawn_as(self.test, {"window": config.window})
            clean = list(cut_windows(test, batch=BATCH, disturbance=CLEAN))
            noisy = list(cut_windows(test, batch=BATCH, disturbance=RATED))
            self._cut[config.window] = clean, noisy
        return self._cut[config.window]


def _score(point: Training) -> tuple[bool, float]:
    return not point.diverged, point.score


def _as_text(hits: NDArray[np.bool_]) -> str:
    return "".join("01"[int(one)] for one in hits)
