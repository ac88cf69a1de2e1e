"""The paper's largest networks at full size with random weights, to measure what a step costs.

Needs the `train` extra.
"""

from __future__ import annotations

import gc
import hashlib
from collections.abc import Iterator
from pathlib import Path

import torch

from tactile_rt import export
from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import read_model, shipped_model
from tactile_rt.core.packages import VERSION
from tactile_rt.core.stream import MOUSE, ArraySpec
from tactile_rt.core.stream.sensor_spec import channel_limits
from tactile_rt.export.graph_forms import Precision
from tactile_rt.export.model_steps import Subject
from tactile_rt.export.onnx_step import OPSET, step_graph, write_model
from tactile_rt.models.ead import EADConfig, TactileClassifier

CLASSES = 117  # of the paper
NETWORKS = (("intersection-ln", "none"), ("intersection-ln-gpt", "gpt"))
FULL_PRECISIONS: tuple[Precision, ...] = ("fp32", "int8")
PERIOD_NS = 9_000_000
LOAD_INT8_MS = "<= 1000"


def full_size(folder: Path) -> Iterator[Subject]:
    """Make the published networks with random weights, each with the bar that it must meet."""
    for name, path in full_size_models(folder):
        gc.collect()
        load_ms = LOAD_INT8_MS if name.endswith("int8") else ""
        yield Subject(name.replace("-", "_"), path, load_ms=load_ms)


def full_size_models(folder: Path) -> list[tuple[str, Path]]:
    """Intersection-LN without and with the GPT, each in fp32 and int8: (name, file).

    A file that this release has written to the folder before is not written again.

    Args:
        folder: where they go, some 500 MB; made if it is not there.
    """
    spec = read_model(shipped_model())[0].array
    sources = sorted(Path(export.__file__).parent.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:8]
    files = []
    for name, attender in NETWORKS:
        for precision in FULL_PRECISIONS:
            path = folder / f"{name}-{precision}-{VERSION}-{OPSET}-{digest}.onnx"
            files.append((f"{name}-{precision}", path))
            if path.exists():
                continue
            config = EADConfig(CLASSES, "zhuang-intersection-ln", attender)
            model, card = random_model(spec, config, f"{name}-{precision}")
            proto, state = step_graph(model, card, integer=precision == "int8")
            write_model(proto, state, model, card, path, precision)
    return files


def random_model(
    spec: ArraySpec, config: EADConfig, name: str, seed: int = 0
) -> tuple[TactileClassifier, ModelCard]:
    """An untrained network for an array, and the card of a file of it."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = TactileClassifier(spec, config, channel_limits(spec)).eval()
    return model, ModelCard(
        name=name,
        spec=spec.to_json(),
        period_ns=PERIOD_NS,
        substeps=MOUSE.substeps,
        steps=MOUSE.steps,
        labels=tuple(f"class {i}" for i in range(config.classes)),
        state=(),
        clip=tuple(model.inputs.clip.tolist()),
        scale=tuple(model.inputs.scale.tolist()),
        floor=tuple(channel_limits(spec).floor.tolist()),
        provenance={"weights": f"random, seed {seed}"},
    )
