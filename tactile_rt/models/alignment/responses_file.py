"""Responses computed elsewhere, as a model to score: an ``.npz`` with one array per layer."""

import hashlib
from pathlib import Path

import numpy as np

from tactile_rt.errors import ConfigError
from tactile_rt.models.alignment.layers import PARTS, Layers
from tactile_rt.models.alignment.rdm import STIMULI

__all__ = ["RESPONSES", "responses_layers"]

RESPONSES = ".npz"
NUMBERS = "fiu"
LARGEST = np.finfo(np.float32).max


def responses_layers(path: Path) -> Layers:
    """Layers of a file of responses.

    Args:
        path: ``.npz``; each array is a layer, (6, unit) or (6, step, unit), its stimuli in the
            order of `STIMULI`. A layer whose name does not begin with ``encoder.``, ``attender.``
            or ``decoder.`` is one of the encoder's.

    Raises:
        ConfigError: no such file, an array that is no layer, by name, or two that are one layer.
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
                    or not (np.abs(array) <= LARGEST).all()
                ):
                    raise ConfigError(
                        f"{path}: array {name} ({array.dtype}, {array.shape}) is no layer: finite "
                        f"numbers ({len(STIMULI)} stimuli, 2 or more units)"
                    )
                part, dot, _ = name.partition(".")
                full = name if dot and part in PARTS else f"encoder.{name}"
                if full in traces:
                    short = full.removeprefix("encoder.")
                    raise ConfigError(f"{path}: arrays {short} and {full} are one layer: name one")
                traces[full] = (array if array.ndim == 3 else array[:, None]).astype(np.float32)
    except ConfigError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{path}: no archive of arrays ({reason})") from None
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
