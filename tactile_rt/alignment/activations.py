"""Activations of every layer of a torch network in response to the six stimuli.

Layers are as in the paper: a node of the encoder's graph after its ReLU, a residual block's sum, a
transformer block's output at the action token, a linear layer after its ReLU. Networks run in
evaluation mode: with dropout or batch statistics, scores would depend on chance and on the batch.
"""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.alignment.layers import Layers, table
from tactile_rt.alignment.stimuli_input import StimuliInput
from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Timing
from tactile_rt.core.stream.sensor_spec import ChannelLimits
from tactile_rt.models.attenders.gpt import GPT, TOKENS
from tactile_rt.models.attenders.mamba import MambaStack
from tactile_rt.models.checkpoints import build_untrained, load_checkpoint
from tactile_rt.models.ead import EADConfig, TactileClassifier, count_parameters
from tactile_rt.models.encoders.graph import Graph, Node
from tactile_rt.models.encoders.graph_encoder import GraphEncoder, draw_as_published
from tactile_rt.models.encoders.gru import GRUEncoder

Traces = dict[str, Tensor]
Change = Callable[[Tensor], Tensor]


def checkpoint_layers(path: Path, stimuli: StimuliInput) -> tuple[Layers, dict[str, Any]]:
    """Run a checkpoint on the stimuli; return its layers and the checkpoint's contents."""
    model, saved = load_checkpoint(path)
    spec, timing = ArraySpec.from_json(saved["spec"]), model.timing
    stimuli.check(spec, timing.steps, timing.substeps, str(path), saved["period_ns"])
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    name = path.resolve().parent.name if path.stem in ("best", "last") else path.stem
    layers = network_layers(model, stimuli, name, sha256)
    return replace(layers, training=table(saved.get("config"))), saved


def untrained_layers(saved: dict[str, Any], stimuli: StimuliInput, seed: int = 0) -> Layers:
    """Run a checkpoint's network with random weights on the stimuli; return its layers."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = _draw_first_weights(build_untrained(saved), saved.get("config"))
    return network_layers(model, stimuli, f"untrained, seed {seed}")


def untrained_card_layers(card: ModelCard, stimuli: StimuliInput, seed: int = 0) -> Layers | None:
    """Run a model card's network with random weights on the stimuli; return its layers.

    The result is None if the network cannot be built from the card, which may be from another
    program or a later release.
    """
    network = card.provenance.get("network")
    if not isinstance(network, dict):
        return None
    scale, floor, clip = (
        np.asarray(v, dtype=np.float32) for v in (card.scale, card.floor, card.clip)
    )
    spec = ArraySpec.from_json(card.spec)
    stimuli.check(spec, card.steps, card.substeps, card.name, card.period_ns)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        limits = ChannelLimits(scale, floor, clip, scale)
        try:
            model = TactileClassifier(spec, EADConfig(**network), limits)
        except (TypeError, ValueError, ConfigError):
            return None
        if model.timing != Timing(card.steps, card.substeps):
            return None
        model = _draw_first_weights(model, card.provenance.get("training"))
    return network_layers(model, stimuli, f"untrained, seed {seed}")


def network_layers(
    model: TactileClassifier, stimuli: StimuliInput, name: str = "network", sha256: str = ""
) -> Layers:
    """Run a network on the six stimuli in evaluation mode; return its layers."""
    mode = model.training
    model.eval()
    try:
        with torch.inference_mode():
            device = model.inputs.clip.device
            loads = (stimuli.samples, stimuli.offset, stimuli.sigma)
            frames = model.inputs(*(torch.from_numpy(a).to(device) for a in loads))
            network = model.network
            traces, features, first = _trace_encoder(network.encoder, frames)
            after = dict.fromkeys(traces, 0) | first
            with _record_taps(_tap_attender(network.attender), "attender", frames) as recorded:
                features = network.attender(features)
            traces |= recorded
            with _record_taps(_tap_decoder(network.decoder), "decoder", frames) as recorded:
                network.decoder(features)
            traces |= recorded
            logits = network(frames)
    finally:
        model.train(mode)
    return Layers(
        name=name,
        traces={k: v.float().cpu().numpy() for k, v in traces.items()},
        first={k: after.get(k, network.lag) for k in traces},
        logits=logits.float().cpu().numpy(),
        parameters=count_parameters(network),
        sha256=sha256,
        network=asdict(network.config),
    )


def _draw_first_weights(model: TactileClassifier, training: object) -> TactileClassifier:
    """Draw a model's initial weights as its training configuration specifies; return the model."""
    paper = table(training).get("first_weights") == "paper"
    if paper and isinstance(model.network.encoder, GraphEncoder):
        draw_as_published(model.network.encoder)
    return model


def reach(graph: Graph) -> dict[str, int]:
    """Return the first step, by node, at which the frame affects the node's output."""
    distance = {graph.frame.name: -1}
    nodes = graph.nodes
    for _ in graph.nodes:
        for node in nodes:
            # The frame is read without delay, all other sources with a delay of one step.
            known = [distance[e.source] for e in node.reads if e.source in distance]
            if known:
                distance[node.name] = min(min(known) + 1, distance.get(node.name, len(nodes)))
    return {n.name: distance[n.name] for n in nodes if n.name in distance}


def _trace_encoder(encoder: Any, frames: Tensor) -> tuple[Traces, Tensor, dict[str, int]]:
    """Run an encoder; return traces, features (6, step, feature), and first steps by layer."""
    if isinstance(encoder, GraphEncoder):
        traces, features = _trace_graph(encoder, frames)
        return traces, features, {f"encoder.{k}": v for k, v in reach(encoder.graph).items()}
    if isinstance(encoder, GRUEncoder):
        state, steps = encoder.initial_state(len(frames)), []
        for t in range(frames.shape[1]):
            _, state = encoder.step(frames[:, t], torch.zeros(0), state)
            steps.append(state["gru_h"])
        layers = torch.stack(steps, 1).unbind(2)
        return {f"encoder.layer{i}": x for i, x in enumerate(layers)}, layers[-1], {}
    with _record_taps(_tap_encoder(encoder), "encoder", frames) as recorded:
        features = encoder(frames)
    if not recorded:  # an unknown kind of encoder
        recorded["encoder.features"] = features
    return recorded, features, {}


def _trace_graph(encoder: GraphEncoder, frames: Tensor) -> tuple[Traces, Tensor]:
    """Run a graph encoder step by step; return all nodes' outputs and the features."""
    # Not by `forward`, which skips outputs that reach no feature of the window.
    found: dict[str, list[Tensor]] = {node.name: [] for node in encoder.graph.nodes}
    original = encoder._run_cell

    def recording(node: Node, *rest: Any) -> tuple[Tensor, tuple[Tensor, ...]]:
        h, memory = original(node, *rest)
        found[node.name].append(h.movedim(2, 0).flatten(1))
        return h, memory

    encoder._run_cell = recording  # type: ignore[method-assign, assignment]
    try:
        state, steps = encoder.initial_state(len(frames)), []
        for t in range(frames.shape[1]):
            out, state = encoder.step(frames[:, t], torch.zeros(0), state)
            steps.append(out)
    finally:
        del encoder.__dict__["_run_cell"]
    return {f"encoder.{k}": torch.stack(v, 1) for k, v in found.items()}, torch.stack(steps, 1)


# (name of the layer, module, True to record its input and not its output, function to apply)
Tap = tuple[str, nn.Module, bool, Change | None]


def _tap_encoder(encoder: Any) -> list[Tap]:
    taps: list[Tap] = []
    for name in ("stem", "embed"):
        if hasattr(encoder, name):
            taps.append((name, getattr(encoder, name), False, F.relu if name == "stem" else None))
    if hasattr(encoder, "blocks"):  # ResNet18 and S4: the whole block, residual included
        taps += [(f"block{i}", block, False, None) for i, block in enumerate(encoder.blocks)]
    if isinstance(stack := getattr(encoder, "stack", None), MambaStack):
        taps += _tap_mamba(stack)
    taps += [(n, getattr(encoder, n), False, None) for n in ("fc", "out") if hasattr(encoder, n)]
    return taps


def _tap_attender(attender: nn.Module) -> list[Tap]:
    if isinstance(attender, MambaStack):
        return _tap_mamba(attender)
    if isinstance(attender, GPT):

        def action(x: Tensor) -> Tensor:
            return x[:, TOKENS - 1 :: TOKENS]

        blocks: list[Tap] = [(f"block{i}", b, False, action) for i, b in enumerate(attender.blocks)]
        last = [(n, getattr(attender, n), False, None) for n in ("norm", "project_out")]
        return [*blocks, *last]
    return []


def _tap_mamba(stack: MambaStack) -> list[Tap]:
    """List taps of the residual sum after each block, the next norm's input."""
    after = [*list(stack.norms)[1:], stack.norm]
    taps: list[Tap] = [(f"block{i}", norm, True, None) for i, norm in enumerate(after)]
    return [*taps, ("norm", stack.norm, False, None)]


def _tap_decoder(decoder: nn.Module) -> list[Tap]:
    if isinstance(decoder, nn.Sequential):
        hidden = [m for m in decoder if isinstance(m, nn.ReLU)]
        taps: list[Tap] = [(f"fc{i + 1}", m, False, None) for i, m in enumerate(hidden)]
        return [*taps, ("logits", decoder[-1], False, None)]
    if hasattr(decoder, "layer2") and hasattr(decoder, "layer3"):
        two, three = decoder.layer2, decoder.layer3
        assert isinstance(two, nn.Module) and isinstance(three, nn.Module)
        return [
            ("fc1", two, True, None),
            ("fc2", three, True, None),
            ("logits", three, False, None),
        ]
    return [("logits", decoder, False, None)]


@contextmanager
def _record_taps(taps: list[Tap], part: str, frames: Tensor) -> Iterator[Traces]:
    """Record the tapped tensors (6, step, unit) of forward passes within a ``with`` block."""
    shape = frames.shape[:2]
    traces: Traces = {f"{part}.{name}": frames for name, *_ in taps}  # placeholders, in order

    def keep(name: str, change: Change | None, x: Tensor) -> None:
        x = change(x) if change else x
        traces[f"{part}.{name}"] = x.reshape(*shape, -1)

    handles = []
    for name, module, before, change in taps:
        if before:
            handles.append(
                module.register_forward_pre_hook(
                    lambda _, args, n=name, c=change: keep(n, c, args[0])
                )
            )
        else:
            handles.append(
                module.register_forward_hook(lambda _, __, out, n=name, c=change: keep(n, c, out))
            )
    try:
        yield traces
    finally:
        for handle in handles:
            handle.remove()
