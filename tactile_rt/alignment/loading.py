"""Loading of layers from a checkpoint, an ONNX file, or responses computed elsewhere."""

import hashlib
import re
from collections.abc import Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.layers import PARTS, Layers
from tactile_rt.alignment.stimuli_input import StimuliInput
from tactile_rt.classifier.model_file import METADATA_KEY, read_model
from tactile_rt.classifier.onnx_check import BadModel, read_onnx
from tactile_rt.core.errors import ConfigError, ModelError, explain_errors, name_some
from tactile_rt.core.files import refuse_lfs_pointer
from tactile_rt.core.stream.stimuli import STIMULI
from tactile_rt.models.checkpoints import describe_checkpoint

CHECKPOINT, BEST = ".pt", "best.pt"
OF_GRID = "point.json"  # marks a run of a grid; the run's folder is named by its learning rate
FIGURES = re.compile(r"(test_|validation_)?top1")


def check_models(paths: Sequence[Path]) -> tuple[str, ...]:
    """Check that all paths are models, without loading torch; return distinct names.

    A model's name is that in its file; for a training run the folder's, in a grid the task's, with
    parent folders as needed to distinguish runs. `name_apart` makes equal names distinct.
    """
    names: list[str] = []
    runs = {path: path.resolve().parent for path in paths if path.name == BEST}
    called = {
        folder: folder.parent.name if (folder / OF_GRID).exists() else folder.name
        for folder in runs.values()
    }
    depth = 1
    while len(set(called.values())) < len(called):
        depth += 1
        called = {folder: "/".join(folder.parts[-depth:]) for folder in called}
    for path in paths:
        own = _read_name(path)
        names.append(called[runs[path]] if path in runs else own)
    return name_apart(names, paths)


def name_apart(names: Sequence[str], paths: Sequence[Path]) -> tuple[str, ...]:
    """Make names distinct by adding the file's path to a repeated name.

    The path has as many parent folders as needed; a file that is given again gets a number.
    """
    found: list[str] = []
    for k, (name, path) in enumerate(zip(names, paths, strict=True)):
        alike = [o.resolve().parts for n, o in zip(names[:k], paths[:k], strict=True) if n == name]
        called = name
        if name in found:
            mine = path.resolve().parts
            depths = range(1, len(mine) + 1)
            differ = (d for d in depths if all(mine[-d:] != other[-d:] for other in alike))
            called = f"{name} ({Path(*mine[-next(differ, 1) :])})"
        again = (f"{called[:-1]}, {number})" for number in count(2))
        found.append(called if called not in found else next(a for a in again if a not in found))
    return tuple(found)


def _read_name(path: Path) -> str:
    if path.suffix == RESPONSES:
        return path.stem
    if path.suffix == ".npy":
        raise ModelError(f"{path}: name responses by layer, in an .npz: numpy.savez")
    if path.suffix == CHECKPOINT:
        describe_checkpoint(path)
        return path.stem
    if _is_module(path):
        return path.name.partition(":")[2]
    return path.stem if _is_foreign(path) else read_model(path)[0].name


def _is_module(path: Path) -> bool:
    """Return whether a path names a torch module as ``module:function``, not a file."""
    return ":" in path.name and not path.exists()


def _is_foreign(path: Path) -> bool:
    """Return whether a file is ONNX, without the model card of this project."""
    try:
        return METADATA_KEY not in read_onnx(path.read_bytes()).metadata
    except (BadModel, OSError):
        return False  # `read_model` reports the error


def load_layers(
    path: Path,
    stimuli: StimuliInput,
    input_name: str = "",
    names: tuple[str, ...] = STIMULI,
) -> tuple[Layers, tuple[float, str] | None]:
    """Load a model's layers and, if known, its accuracy with the metric's name.

    Args:
        names: names of the stimuli; if they are not `STIMULI`, only responses can be loaded.
        input_name: the name of the input for the loads, if a foreign ONNX file has several.

    Raises:
        ConfigError: the stimuli are of another array, or do not fit a foreign model's input.
    """
    if path.suffix == RESPONSES:
        return read_responses(path, names), None
    if names != STIMULI:
        raise ConfigError(
            f"{path}: the benchmark's {len(names)} stimuli cannot be whisked: give its responses, "
            f"an .npz of ({len(names)}, unit) by layer"
        )
    if path.suffix == CHECKPOINT:
        from tactile_rt.alignment.activations import checkpoint_layers

        layers, saved = checkpoint_layers(path, stimuli)
        return layers, _find_accuracy(saved.get("metrics", {}))
    if _is_module(path):
        from tactile_rt.alignment.other_models import module_layers

        return module_layers(path.name, stimuli), None
    if _is_foreign(path):
        from tactile_rt.alignment.other_models import other_onnx_layers

        return other_onnx_layers(path, stimuli, input_name), None
    from tactile_rt.alignment.onnx_activations import onnx_layers

    layers, card = onnx_layers(path, stimuli)
    return layers, _find_accuracy(card.figures) if card else None


def load_untrained(path: Path, stimuli: StimuliInput, seed: int) -> Layers | None:
    """Build a model's network with random weights; return its layers as a control.

    For an ONNX file, the card in its metadata specifies the network. The result is None for
    responses, for models made elsewhere, and for a card that does not specify its network.

    Raises:
        ConfigError: a seed below 0.
    """
    if path.suffix == RESPONSES or _is_module(path) or _is_foreign(path):
        return None
    if seed < 0:
        raise ConfigError(f"seed must be 0 or more, not {seed}")
    from tactile_rt.alignment.activations import untrained_card_layers, untrained_layers

    if path.suffix == CHECKPOINT:
        from tactile_rt.models.checkpoints import load_checkpoint

        return untrained_layers(load_checkpoint(path)[1], stimuli, seed)
    return untrained_card_layers(read_model(path, None)[0], stimuli, seed)


def _find_accuracy(figures: object) -> tuple[float, str] | None:
    """Find a model's top-1 accuracy, 0 to 1, and its name in the model's metrics."""
    if not isinstance(figures, dict):
        return None
    for key in sorted(k for k in figures if isinstance(k, str) and FIGURES.fullmatch(k)):
        value = figures[key]
        if isinstance(value, int | float) and 0 <= value <= 1:
            return float(value), key.replace("_", " ").replace("top1", "top-1")
    return None


RESPONSES = ".npz"
ORDER = "stimuli"  # name of the array of stimulus names
NUMBERS = "fiu"
LARGEST = np.finfo(np.float32).max


def read_responses(path: Path, names: tuple[str, ...] = STIMULI) -> Layers:
    """Read a model's layers from a file of responses.

    Args:
        path: ``.npz``; each array is a layer, (stimulus, unit) or (stimulus, step, unit), in the
            order of `names`, or of a further array ``stimuli`` of names. A layer whose name does
            not begin with ``encoder.``, ``attender.`` or ``decoder.`` belongs to the encoder.

    Raises:
        ConfigError: no such file, an array that is no layer, or two arrays for one layer.
    """
    refuse_lfs_pointer(path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    traces = {}
    with explain_errors(ConfigError, f"{path}: no archive of arrays ("):
        with np.load(path, allow_pickle=False) as archive:
            order = _find_order(path, archive, names)
            for name in archive.files:
                if name == ORDER:
                    continue
                array = archive[name]
                if (
                    array.dtype.kind not in NUMBERS
                    or array.ndim not in (2, 3)
                    or array.shape[0] != len(names)
                    or 0 in array.shape
                    or array.shape[-1] < 2
                    or not (np.abs(array) <= LARGEST).all()
                ):
                    raise ConfigError(
                        f"{path}: array {name} ({array.dtype}, {array.shape}) is no layer: finite "
                        f"numbers ({len(names)} stimuli, 2 or more units)"
                    )
                part, dot, _ = name.partition(".")
                full = name if dot and part in PARTS else f"encoder.{name}"
                if full in traces:
                    short = full.removeprefix("encoder.")
                    raise ConfigError(
                        f"{path}: arrays {short} and {full} are the same layer: give one"
                    )
                array = array[order]
                traces[full] = (array if array.ndim == 3 else array[:, None]).astype(np.float32)
    if not traces:
        raise ConfigError(f"{path}: has no array, so no layer")
    return Layers(
        name=path.stem,
        traces=traces,
        first=dict.fromkeys(traces, 0),
        logits=np.zeros((len(names), 1, 0), dtype=np.float32),
        parameters=0,
        sha256=hashlib.sha256(content).hexdigest(),
        notes=("responses computed elsewhere",),
    )


def _find_order(
    path: Path, archive: Mapping[str, NDArray[Any]], names: tuple[str, ...]
) -> NDArray[np.intp]:
    """Return the row of each named stimulus in the arrays of a file."""
    if ORDER not in archive:
        return np.arange(len(names))
    own = archive[ORDER].astype(str).ravel().tolist()
    if sorted(own) != sorted(names):
        differ = name_some(sorted({*own} ^ {*names})) or "some are named twice"
        raise ConfigError(f"{path}: its stimuli are not those of the benchmark: {differ}")
    return np.array([own.index(name) for name in names])
