"""A checkpoint made ready for robots: calibrated on validation sweeps, exported, described."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import EmbeddingStatistics, Kind
from tactile_rt.classifier.model_file import METADATA_KEY, ModelCard, file_outputs, load_model
from tactile_rt.core.files import write_whole
from tactile_rt.export.onnx_step import export_checkpoint
from tactile_rt.export.precision import Precision
from tactile_rt.export.promises import fitted_rules
from tactile_rt.models.checkpoints import load_checkpoint, trained_on
from tactile_rt.models.datasets import SweepSet, drawn_as, joined, relabelled
from tactile_rt.models.ead import TactileClassifier, run_on
from tactile_rt.models.evaluation.measures import Step, among, cut_windows, hits, predict, run_over
from tactile_rt.sets.manifest import SweepManifest, join_manifests

__all__ = ["fit_temperature", "quantisation_figures", "release", "run_file"]

TEMPERATURES = np.geomspace(0.25, 4.0, 81)


def release(
    checkpoint: Path,
    path: Path,
    name: str,
    precision: Precision = "fp32",
    kind: Kind = "step",
    data: Sequence[Path] = (),
    licence: str = "",
) -> ModelCard:
    """Fit the temperature on the validation split, then export.

    What a precision below fp32 costs on validation sweeps is measured and stored.

    Args:
        data: where the sweep sets that it was trained on lie now; default: where they lay.

    Raises:
        ModelError, RecordingError: the checkpoint or its sweep set cannot be read.
        SpecMismatch: the set is of another array, or of other categories.
    """
    model, saved = load_checkpoint(checkpoint)
    config = saved["config"]
    folders = trained_on(checkpoint, saved, data)
    known = join_manifests([SweepManifest.read(folder) for folder in folders]).categories
    sets = [  # their windows as the network knows them, for the rules of its decisions, too
        drawn_as(relabelled(SweepSet.read(folder, "validation"), known), config)
        for folder in folders
        if SweepManifest.read(folder).split.get("validation")
    ]
    validation = joined(sets)
    # Half clean, half at rated noise: what the checkpoint was chosen by, too.
    posteriors = np.concatenate([predict(validation, run_on(model), level) for level in (0.0, 1.0)])
    labels = np.tile(validation.sweeps.labels, 2)
    last = among(posteriors[:, -1], len(known))
    right = hits(last, labels).reshape(2, -1).mean(axis=1).tolist()
    temperature = fit_temperature(last, labels)
    told = (*known, *saved["refusals"])
    unknown, candidates = fitted_rules(sets, run_on(model), temperature, told, len(known))
    card = export_checkpoint(
        checkpoint,
        path,
        name,
        temperature=temperature,
        rules=(unknown, candidates),
        embeddings=embedding_statistics(model, validation, len(known)),
        figures={"validation_top1": right[0], "validation_top1_noisy": right[1]},
        precision=precision,
        kind=kind,
        data=folders,
        licence=licence,
    )
    if precision == "fp32":
        return card
    return _described(path, card, quantisation_figures(run_on(model), path, validation))


def embedding_statistics(
    model: TactileClassifier, data: SweepSet, classes: int
) -> EmbeddingStatistics | None:
    """Where labelled sweeps of the known classes lie; None if a class has fewer than two."""

    def embed(
        samples: NDArray[np.float32], offset: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        device = model.inputs.clip.device
        windows = (torch.from_numpy(a).to(device) for a in (samples, offset, sigma))
        with torch.inference_mode():
            steps = model.eval().network.embed(model.inputs(*windows))
            mean: NDArray[np.float32] = steps.mean(dim=1).float().cpu().numpy()
        return mean

    found, touched = run_over(cut_windows(data), embed)
    found, labels = found[touched].astype(float), data.sweeps.labels[touched]
    if np.bincount(labels, minlength=classes)[:classes].min() < 2:
        return None
    means = np.stack([found[labels == k].mean(axis=0) for k in range(classes)])
    apart = found - means[labels]
    return EmbeddingStatistics.of(means, apart.T @ apart / len(apart))


def run_file(path: Path) -> Step:
    """The function that `evaluation.predict` wants, of a model file of either kind."""
    session, card = load_model(path, kind=None)

    def run(
        samples: NDArray[np.float32], offset: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        # One by one, as a robot runs it: a batch would share the scale of its activations.
        parts = (slice(i, i + 1) for i in range(len(samples)))
        outputs = [file_outputs(session, card, samples[i], offset[i], sigma[i]) for i in parts]
        return np.concatenate([output["logits"] for output in outputs])

    return run


def quantisation_figures(trained: Step, path: Path, sweeps: SweepSet) -> dict[str, float]:
    """What a file's precision costs on sweeps, half of them at rated noise, at the last step.

    Returns:
        ``quantisation_top1_drop`` in points, ``quantisation_agreement`` in %,
        ``quantisation_posterior``, the largest difference of a posterior, and
        ``quantisation_sweeps``, how many that were.
    """
    file, classes = run_file(path), len(sweeps.manifest.categories)
    before, after = (
        np.concatenate([among(predict(sweeps, run, n)[:, -1], classes) for n in (0.0, 1.0)])
        for run in (trained, file)
    )
    labels = np.tile(sweeps.sweeps.labels, 2)
    decided = ~np.isnan(before[:, 0])
    same = before[decided].argmax(1) == after[decided].argmax(1)
    top1 = [hits(posteriors, labels).mean() for posteriors in (before, after)]
    return {
        "quantisation_top1_drop": 100 * float(top1[0] - top1[1]),
        "quantisation_agreement": 100 * float(same.mean()),
        "quantisation_posterior": float(np.abs(before[decided] - after[decided]).max()),
        "quantisation_sweeps": len(labels),
    }


def _described(path: Path, card: ModelCard, figures: dict[str, float]) -> ModelCard:
    """Write further figures into a file."""
    card = msgspec.structs.replace(card, figures={**card.figures, **figures})
    proto = onnx.load(path)
    onnx.helper.set_model_props(proto, {METADATA_KEY: msgspec.json.encode(card).decode()})
    write_whole(path, lambda file: onnx.save(proto, file))
    return card


def fit_temperature(posteriors: NDArray[np.float32], labels: NDArray[np.int64]) -> float:
    """The temperature that minimises the negative log-likelihood (Guo et al. 2017).

    Args:
        posteriors: (sweep, class) at temperature 1; undecided sweeps (NaN) are left out.
        labels: (sweep,).

    Returns:
        One of `TEMPERATURES`; 1 if no sweep is decided.
    """
    decided = ~np.isnan(posteriors[:, 0])
    if not decided.any():
        return 1.0
    logits = np.log(np.clip(posteriors[decided], 1e-12, None))
    right = labels[decided]

    def loss(temperature: float) -> float:
        scaled = logits / temperature
        scaled = scaled - scaled.max(axis=1, keepdims=True)
        chosen = scaled[np.arange(len(right)), right]
        return float((np.log(np.exp(scaled).sum(axis=1)) - chosen).mean())

    return float(min(TEMPERATURES, key=loss))
