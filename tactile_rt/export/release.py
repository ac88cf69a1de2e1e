"""Release of a checkpoint for robots: calibration on validation sweeps, export, measures."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnx

from tactile_rt.classifier.model_card import Kind
from tactile_rt.classifier.model_file import METADATA_KEY, ModelCard, file_outputs, load_model
from tactile_rt.core.files import write_whole
from tactile_rt.export.decision_thresholds import fit_names, fit_rules, fit_temperature
from tactile_rt.export.graph_forms import Precision
from tactile_rt.export.identity import fit_identity
from tactile_rt.export.onnx_step import export_checkpoint
from tactile_rt.models.checkpoints import load_checkpoint, trained_on
from tactile_rt.models.datasets import SweepSet, drawn_as, join_sets, relabel_set
from tactile_rt.models.evaluation.measures import (
    Floats,
    Step,
    among,
    hits,
    predict,
    run_on,
)
from tactile_rt.sets.splits import join_manifests


def release(
    checkpoint: Path,
    path: Path,
    name: str,
    precision: Precision = "fp32",
    kind: Kind = "step",
    data: Sequence[Path] = (),
    licence: str = "",
) -> ModelCard:
    """Calibrate a checkpoint on its validation sweeps, then export it as a model file.

    The cost of a precision below fp32 on validation sweeps is measured and stored.

    Args:
        data: folders of the sweep sets that it was trained on; default: those in its configuration.

    Raises:
        ModelError, RecordingError: the checkpoint or its sweep set cannot be read.
        SpecMismatch: the set is of another array, or of other categories.
    """
    model, saved = load_checkpoint(checkpoint)
    config = saved["config"]
    trained = trained_on(checkpoint, saved, data)
    manifests = [manifest for _, manifest in trained]
    known = join_manifests(manifests).categories
    sets = [  # with windows drawn as in training, also to fit the decision rules
        drawn_as(relabel_set(SweepSet.read_known(folder, manifest, "validation"), known), config)
        for folder, manifest in trained
        if manifest.split.get("validation")
    ]
    validation = join_sets(sets)
    # Half clean, half at rated noise, as for the choice of the checkpoint.
    posteriors = np.concatenate([predict(validation, run_on(model), level) for level in (0.0, 1.0)])
    labels = np.tile(validation.sweeps.labels, 2)
    last = among(posteriors[:, -1], len(known))
    right = hits(last, labels).reshape(2, -1).mean(axis=1).tolist()
    temperature = fit_temperature(last, labels)
    answers = (*known, *saved["refusals"])
    unknown, prediction_sets = fit_rules(sets, run_on(model), temperature, answers, len(known))
    kinds = saved.get("kinds", {})
    names = fit_names(sets, run_on(model, "names"), kinds) if kinds else {}
    identity = model.network.config.identity
    card = export_checkpoint(
        checkpoint,
        (model, saved),
        manifests,
        path,
        name,
        temperature=temperature,
        rules=(unknown, prediction_sets),
        names=names,
        identity=fit_identity(sets, run_on(model, "embedding")) if identity else None,
        figures={"validation_top1": right[0], "validation_top1_noisy": right[1]},
        precision=precision,
        kind=kind,
        licence=licence,
    )
    if precision == "fp32":
        return card
    return _add_figures(path, card, quantisation_figures(run_on(model), path, validation))


def load_runner(path: Path) -> Step:
    """Load a model file, step or window; return a function from samples to logits."""
    session, card = load_model(path, kind=None)

    def run(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        # One by one, as a robot runs it: a batch would share the scale of its activations.
        parts = (slice(i, i + 1) for i in range(len(samples)))
        outputs = [file_outputs(session, card, samples[i], offset[i], sigma[i]) for i in parts]
        return np.concatenate([output["logits"] for output in outputs])

    return run


def quantisation_figures(trained: Step, path: Path, sweeps: SweepSet) -> dict[str, float]:
    """Compare a file of reduced precision with the trained network at the last step.

    Returns:
        On sweeps without and with rated noise: ``quantisation_top1_drop``, percentage points;
        ``quantisation_agreement`` of decisions, %; ``quantisation_posterior``, the largest
        difference of a posterior; and ``quantisation_sweeps``, the number of both.
    """
    classes = len(sweeps.manifest.categories)
    before, after = (
        np.concatenate([among(predict(sweeps, run, n)[:, -1], classes) for n in (0.0, 1.0)])
        for run in (trained, load_runner(path))
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


def _add_figures(path: Path, card: ModelCard, figures: dict[str, float]) -> ModelCard:
    """Add measured results to the card in a model file; return the new card."""
    card = msgspec.structs.replace(card, figures={**card.figures, **figures})
    proto = onnx.load(path)
    onnx.helper.set_model_props(proto, {METADATA_KEY: msgspec.json.encode(card).decode()})
    write_whole(path, lambda file: onnx.save(proto, file))
    return card
