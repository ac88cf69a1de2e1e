"""A checkpoint made ready for robots: calibrated on validation sweeps, exported, described."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.export.onnx_step import export_checkpoint
from tactile_rt.model_file import ModelCard
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation import predict
from tactile_rt.models.training import load_checkpoint, run_on

__all__ = ["fit_temperature", "release"]

TEMPERATURES = np.geomspace(0.25, 4.0, 81)


def release(checkpoint: Path, path: Path, name: str) -> ModelCard:
    """Fit the temperature on the validation split, then export.

    Raises:
        ModelError, RecordingError: the checkpoint or its sweep set cannot be read.
    """
    model, saved = load_checkpoint(checkpoint)
    config = saved["config"]
    validation = SweepSet.read(Path(config["data"]), "validation")
    # Half clean, half at rated noise: what the checkpoint was chosen by, too.
    posteriors = np.concatenate([predict(validation, run_on(model), level) for level in (0.0, 1.0)])
    labels = np.tile(validation.sweeps.labels, 2)
    temperature = fit_temperature(posteriors[:, -1], labels)
    recipe = validation.manifest.recipe
    options = " ".join(
        f"--{k.replace('_', '-')} {config[k]}"
        for k in ("attender", "decoder", "width", "epochs", "batch", "learning_rate", "seed")
    )
    return export_checkpoint(
        checkpoint,
        path,
        name,
        temperature=temperature,
        figures={k: v for k, v in saved["metrics"].items() if k.startswith("validation")},
        commands=(
            f"tactile-rt sweep {config['data']} {_sweep_options(recipe)}",
            f"tactile-rt train {config['data']} {checkpoint.parent} {options}",
            f"tactile-rt export {checkpoint} {path.name} --name {name}",
        ),
    )


def _sweep_options(recipe: dict[str, Any]) -> str:
    """The options of `tactile-rt sweep` that make a set of this recipe again."""
    options = recipe
    if isinstance(recipe.get("objects"), dict):  # since version 2 of the manifest
        objects = recipe["objects"]
        options = {
            "recipe": recipe["name"],
            "objects": objects["per_category"],
            **{side: f"{objects[side]:g}" for side in ("validation", "test")},
            "sweeps": recipe["sweeps"]["draws"],
            **{key: recipe[key] for key in ("profile", "seed")},
        }
    return " ".join(f"--{key} {value}" for key, value in options.items())


def fit_temperature(posteriors: NDArray[np.float32], labels: NDArray[np.int64]) -> float:
    """The temperature that minimises the negative log-likelihood (Guo et al. 2017).

    Args:
        posteriors: (sweep, class) at temperature 1; undecided sweeps (NaN) are left out.
        labels: (sweep,).
    """
    decided = ~np.isnan(posteriors[:, 0])
    logits = np.log(np.clip(posteriors[decided], 1e-12, None))
    right = labels[decided]

    def loss(temperature: float) -> float:
        scaled = logits / temperature
        scaled = scaled - scaled.max(axis=1, keepdims=True)
        chosen = scaled[np.arange(len(right)), right]
        return float((np.log(np.exp(scaled).sum(axis=1)) - chosen).mean())

    return float(min(TEMPERATURES, key=loss))
