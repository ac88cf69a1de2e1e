"""Responses computed elsewhere, as a model to score: an ``.npz`` with one array per layer."""

import hashlib
import zipfile
from pathlib import Path

import numpy as np

from tactile_rt.models.alignment.layers import PARTS, Layers
from tactile_rt.models.alignment.rdm import STIMULI
from tactile_rt.stream import ConfigError

__all__ = ["RESPONSES", "responses_layers"]

RESPONSES = ".npz"
NUMBERS = "fiu"


def responses_layers(path: Path) -> Layers:
    """Layers of a file of responses.

    Args:
        path: ``.npz``; each array is a layer, (6, unit) or (6, step, unit), its stimuli in the
            order of `STIMULI`. A layer whose name does not begin with ``encoder.``, ``attender.``
            or ``decoder.`` is one of the encoder's.

    Raises:
        ConfigError: no such file, or an array that is no layer, by name.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    traces = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            for name in archive.files:
                array = archive[name]
                if (
                    array.dtype.kind not in NUMBERS
                    or array.ndim not in (2, 3)
                    or array.shape[0] != len(STIMULI)
                    or 0 in array.shape
                    or array.shape[-1] < 2
                    or not np.isfinite(array).all()
                ):
                    raise ConfigError(
                        f"{path}: array {name} ({array.dtype}, {array.shape}) is no layer: finite "
                        f"numbers ({len(STIMULI)} stimuli, 2 or more units)"
                    )
                full = (
                    name if name.partition(".")[0] in PARTS and "." in name else f"encoder.{name}"
                )
                traces[full] = (array if array.ndim == 3 else array[:, None]).astype(np.float32)
    except (ValueError, zipfile.BadZipFile, EOFError, OSError, AttributeError) as error:
        raise ConfigError(f"{path}: no archive of arrays ({error})") from None
    if not traces:
        raise ConfigError(f"{path}: has no array, so no layer")
    return Layers(
        name=path.stem,
        traces=traces,
        first=dict.fromkeys(traces, 0),
        logits=np.zeros((len(STIMULI), 1, 0), dtype=np.float32),
        parameters=0,
        sha256=hashlib.sha256(content).hexdigest(),
        notes=("responses computed elsewhere",),
    )
