"""What is compared: every method as its posteriors over the kinds that it knows.

Whatever a method has to choose (a penalty, a rate, how sure to be) it chooses by the validation
split of what it learns from, each for itself.
"""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.perception.data import Data
from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import load_model
from tactile_rt.export.decision_thresholds import fit_temperature
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import run_on, run_steps
from tactile_rt.models.evaluation.svm import PENALTIES, fit, window_features
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import train
from tactile_rt.sets.objects import Sweeps
from tactile_rt.sim_backend.datasets import recipes

Floats = NDArray[np.float32]
REAL, GENERATED = "real", "generated"
RATES = (1e-3, 2e-3, 5e-3)  # of the GRU, of which validation chooses
UPDATES = 3000  # of the GRU


@dataclass(frozen=True)
class Method:
    """One method.

    Attributes:
        name: What it is.
        taught: What it has learnt from.
        kinds: The kinds that it tells apart.
        posteriors: The posteriors (sweep, kind) of a set's sweeps under a disturbance; NaN where it
            finds no contact.
    """

    name: str
    taught: str
    kinds: tuple[str, ...]
    posteriors: Callable[[SweepSet, Disturbance], Floats]


def baselines(data: Data, runs: Path | None) -> Iterator[Method]:
    """The methods that every model is compared with.

    Args:
        data: of the benchmark.
        runs: where networks are trained, and found trained; None leaves them out.
    """
    real = data.sets["train"], data.sets["validation"]
    yield _guess(data.kinds)
    counts = np.bincount(real[0].sweeps.labels, minlength=len(data.kinds)).astype(float)
    yield _majority(data.kinds, counts)
    yield _svm(REAL, *real)
    if runs:
        yield _gru(REAL, *real, runs)


def onnx_model(path: Path) -> Method:
    """A model file, as it is."""
    session, card = load_model(path)
    run = run_steps(session, card)

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
        return measures.predict(sweeps, run, disturbance=disturbance)[:, -1]

    return Method(path.stem, _learnt_from(card), card.classes, posteriors)


def _learnt_from(card: ModelCard) -> str:
    """Where the objects come from, set by set."""
    told = (card.provenance.get("sweep_set"), *card.provenance.get("also", ()))
    sources = [one.get("objects", {}).get("from", "?") for one in told if isinstance(one, dict)]
    named = (GENERATED if s in recipes.GENERATED else Path(s).name for s in sources)
    return " + ".join(dict.fromkeys(named)) or "?"


def of_kinds(data: SweepSet, kinds: tuple[str, ...]) -> SweepSet:
    """The sweeps of the kinds that are among these, labelled by them."""
    known = data.manifest.categories
    number = np.array([kinds.index(k) if k in kinds else -1 for k in known])
    at = np.flatnonzero(data.sweeps.labels >= 0)
    at = at[number[data.sweeps.labels[at]] >= 0]
    found = _taken(data, at, number[data.sweeps.labels[at]])
    return replace(found, manifest=replace(found.manifest, categories=kinds))


def digest_of(*sets: SweepSet) -> str:
    """SHA-256 over the loads, sweep by sweep."""
    digest = hashlib.sha256()
    for one in sets:
        digest.update(np.ascontiguousarray(one.sweeps.values, dtype="<f4"))
    return digest.hexdigest()


def _taken(data: SweepSet, at: NDArray[np.int64], labels: NDArray[np.int64]) -> SweepSet:
    sweeps = data.sweeps
    return replace(data, sweeps=Sweeps(sweeps.values[at], labels, sweeps.objects[at]))


def _guess(kinds: tuple[str, ...]) -> Method:
    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
        drawn = np.random.default_rng(0).dirichlet(np.ones(len(kinds)), len(sweeps.sweeps))
        return drawn.astype(np.float32)

    return Method("chance", "nothing", kinds, posteriors)


def _majority(kinds: tuple[str, ...], counts: NDArray[np.float64]) -> Method:
    always = (counts / counts.sum()).astype(np.float32)

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
        return np.tile(always, (len(sweeps.sweeps), 1))

    return Method("most frequent kind", REAL, kinds, posteriors)


def _calibrated(
    name: str, taught: str, validation: SweepSet, uncalibrated: Callable[..., Floats]
) -> Method:
    """A method whose temperature the validation sweeps choose."""
    temperature = fit_temperature(uncalibrated(validation, CLEAN), validation.sweeps.labels)

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
        return measures.at_temperature(uncalibrated(sweeps, disturbance), temperature)

    return Method(name, taught, validation.manifest.categories, posteriors)


def _best(candidates: list[Callable[..., Floats]], validation: SweepSet) -> Callable[..., Floats]:
    """The one that decides most of the validation sweeps rightly."""
    labels = validation.sweeps.labels
    return max(candidates, key=lambda one: measures.hits(one(validation, CLEAN), labels).mean())


def _svm(taught: str, training: SweepSet, validation: SweepSet) -> Method:
    x, usable = window_features(training)
    classes = len(training.manifest.categories)

    def candidate(penalty: float) -> Callable[..., Floats]:
        machine = fit(x[usable], training.sweeps.labels[usable], penalty)

        def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
            features, found = window_features(sweeps, disturbance)
            posteriors = measures.softmax(machine.margins(features, classes)).astype(np.float32)
            return np.where(found[:, None], posteriors, np.float32(np.nan))

        return posteriors

    best = _best([candidate(penalty) for penalty in PENALTIES], validation)
    return _calibrated("SVM", taught, validation, best)


def _gru(taught: str, training: SweepSet, validation: SweepSet, runs: Path) -> Method:
    digest = digest_of(training, validation)  # networks of other data are not these

    def candidate(rate: float) -> Callable[..., Floats]:
        config = TrainingConfig(
            data=taught, encoder="gru", width=0.25, learning_rate=rate, epochs=1000, updates=UPDATES
        )
        folder = runs / f"gru-{taught.replace(' ', '')}-{digest[:8]}-{rate:g}"
        best = folder / "best.pt"
        if not (folder / "done").exists():
            best = train(config, folder, splits=(training, validation))
            (folder / "done").touch()
        run = run_on(load_checkpoint(best)[0])

        def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> Floats:
            return measures.predict(sweeps, run, disturbance=disturbance)[:, -1]

        return posteriors

    best = _best([candidate(rate) for rate in RATES], validation)
    return _calibrated("GRU", taught, validation, best)
