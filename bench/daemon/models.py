"""The arrays of the soak, and a model for the one that no model is shipped for."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import onnx
from onnx import helper, numpy_helper

from tactile_rt.classifier.model_file import METADATA_KEY, load_model, shipped_model
from tactile_rt.core.stream import ArraySpec

MORE = 5  # whiskers beyond those of the shipped model's array
PITCH_M = 0.002
AXES = {"samples": 2, "offset": 1, "sigma": 1}  # inputs, and where they have the whiskers


def finger_array(rate_hz: float = 110.0) -> ArraySpec:
    """The shipped model's array, 30 x 6, at another rate."""
    _, card = load_model(shipped_model())
    return replace(card.array, name="finger", rate_hz=rate_hz)


def whisker_array(rate_hz: float = 1000.0) -> ArraySpec:
    """The same array with a row of five more whiskers: 35 x 6."""
    spec = finger_array(rate_hz)
    row = 1 + max(r for r, _ in spec.grid)
    return replace(
        spec, name="whiskers", elements=(*spec.elements, *(f"X{i}" for i in range(MORE))),
        grid=(*spec.grid, *((row, i) for i in range(MORE))),
        positions=(*spec.positions, *((0.0, PITCH_M * i, -0.01) for i in range(MORE))),
        orientations=(*spec.orientations, *spec.orientations[:MORE]),
    )  # fmt: skip


def write_wide_model(path: Path, spec: ArraySpec) -> None:
    """The shipped network as a model for `whisker_array`: it leaves the further whiskers out."""
    _, card = load_model(shipped_model())
    kept = np.array([spec.elements.index(e) for e in card.array.elements], np.int64)
    model = onnx.load(shipped_model())
    graph = model.graph
    for node in graph.node:
        for i, name in enumerate(node.input):
            if name in AXES:
                node.input[i] = f"{name}_kept"
    graph.initializer.append(numpy_helper.from_array(kept, "kept"))
    for n, (name, axis) in enumerate(AXES.items()):
        graph.node.insert(
            n, helper.make_node("Gather", [name, "kept"], [f"{name}_kept"], axis=axis)
        )
        (put,) = (p for p in graph.input if p.name == name)
        put.type.tensor_type.shape.dim[axis].dim_value = len(spec.elements)
    for entry in model.metadata_props:
        if entry.key == METADATA_KEY:
            fields = msgspec.json.decode(entry.value)
            fields["spec"] = spec.to_json()
            entry.value = msgspec.json.encode(fields).decode()
    onnx.save(model, path)
