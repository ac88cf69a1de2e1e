"""Fidelity of exports: comparison of the layers of an exported model and its original.

It needs no neural data, only two files of one network: the RDM of every layer for the six stimuli.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tactile_rt.alignment.gate import FAIL, INCONCLUSIVE, PASS, Check
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.rdm import pearson, rdm
from tactile_rt.alignment.stimuli_input import StimuliInput

OUTPUT = "output"
LEAST_PEARSON = {"fp32": 0.9999}
REDUCED_PEARSON = 0.98  # for any other precision
LARGEST_DIFFERENCE = 1e-5
FLAT = 1e-6  # an RDM with a smaller range is meaningless, e.g. all 0 for an output of two classes


@dataclass(frozen=True)
class LayerFidelity:
    """The result of comparing a layer between the reference and the exported model."""

    layer: str
    # correlation of the two RDMs of the layer; NaN if one is missing or both are flat
    pearson: float
    # largest difference between the two (6, unit) responses, as a share of the reference's largest
    # response if that is above 1; infinite if the numbers of units differ
    difference: float
    kept: bool


def compare_layers(reference: Layers, exported: Layers) -> tuple[LayerFidelity, ...]:
    """Compare every layer that both models have, and their outputs."""
    ours, theirs = reference.patterns, exported.patterns
    begin = reference.first.get("decoder.logits", 0)
    for layers, patterns in ((reference, ours), (exported, theirs)):
        patterns[OUTPUT] = layers.logits[:, begin:].mean(axis=1, dtype=np.float64)
    return tuple(
        _compare_layer(name, ours[name], theirs[name], exported.precision)
        for name in ours
        if name in theirs
    )


def check_fidelity(reference: Layers, exported: Layers) -> tuple[Check, tuple[LayerFidelity, ...]]:
    """Run the fidelity test of the gate; return the result and each layer's comparison."""
    rows = compare_layers(reference, exported)
    layers = [row for row in rows if row.layer != OUTPUT]
    missing = [name for name in reference.traces if name not in exported.traces]
    bad = [row for row in rows if not row.kept]
    bar = LEAST_PEARSON.get(exported.precision, REDUCED_PEARSON)
    what = f"{exported.precision}: RDM correlation at least {bar}"
    if exported.precision == "fp32":
        what += f" and responses within {LARGEST_DIFFERENCE:.0e}"
    if bad:
        worst = min(bad, key=lambda row: (np.nan_to_num(row.pearson, nan=-1.0), -row.difference))
        why = (
            f"{len(bad)} of {len(rows)} taps miss it, {worst.layer} by most: correlation "
            f"{worst.pearson:.6f}, difference {worst.difference:.1e}"
        )
        return Check("fidelity", FAIL, f"{what}; {why}"), rows
    if missing:
        what += f"; {len(missing)} layers could not be compared ({', '.join(missing[:4])}, ...)"
    if not layers:
        return Check("fidelity", INCONCLUSIVE, f"{what}; no layer but the output"), rows
    return Check("fidelity", PASS, f"{what}; kept by {len(rows)} taps{_describe_worst(rows)}"), rows


def export_layers(path: Path, stimuli: StimuliInput, reference: Layers) -> Layers:
    """Run an ONNX file on the stimuli; return its layers for comparison with a reference."""
    from tactile_rt.alignment.onnx_activations import onnx_layers

    exported, _ = onnx_layers(path, stimuli)
    # In the reference the first step at which input reaches a layer is known. An ONNX file reveals
    # it only by differences, below single precision in a network that hardly responds.
    known = {k: step for k, step in reference.first.items() if k in exported.traces}
    return replace(exported, first={**exported.first, **known})


def _compare_layer(name: str, a: np.ndarray, b: np.ndarray, precision: str) -> LayerFidelity:
    """Compare a layer's responses (6, unit) in the reference and in the export."""
    if a.shape != b.shape:
        return LayerFidelity(name, float("nan"), float("inf"), False)
    one, other = rdm(a), rdm(b)
    flat = np.ptp(one) < FLAT and np.ptp(other) < FLAT
    r = float("nan") if flat else float(pearson(one, other))
    difference = float(np.abs(a - b).max() / max(1.0, np.abs(a).max()))
    bar = LEAST_PEARSON.get(precision, REDUCED_PEARSON)
    none = not (np.isfinite(one).all() or np.isfinite(other).all())
    same = r >= bar or none or flat
    near = difference <= LARGEST_DIFFERENCE or precision != "fp32"
    return LayerFidelity(name, r, difference, bool(same and near and np.isfinite(difference)))


def _describe_worst(rows: Sequence[LayerFidelity]) -> str:
    finite = [row for row in rows if np.isfinite(row.pearson)]
    if not finite:
        return ""
    least = min(finite, key=lambda row: row.pearson)
    return (
        f", the least alike {least.layer}: correlation {least.pearson:.6f}, largest difference "
        f"{max(row.difference for row in rows):.1e}"
    )
