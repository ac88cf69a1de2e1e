"""Our networks beside the paper's published code: the same weights, parity and CPU time.

Run: python -m bench.models.peer FOLDER_OF_TACTILE_NN FOLDER_OF_PYTORCHTNN [--network N] [--part P]

The folders: `tactile-nn` of github.com/neuroagents-lab/2025-tactile-whisking (commit 3420db6) and
github.com/neuroagents-lab/PyTorchTNN (commit 50713d9), which are imported, see `published`. Needs
the `train` extra and torchvision, einops, omegaconf.

Part "protocol" compares what else was published: cells, augmentations, losses, LARS, schedules;
`--store FILE` keeps figures of theirs for the tests.

Parity is with the layer norm's epsilon of our cells set to theirs (decision 6), and the largest
logit 1. Times are CPU seconds of one thread, in turn in one process, the best of each.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import copy
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import torch
from rich.console import Console
from torch import Tensor

from bench.models import published_protocol as theirs_by
from bench.models.protocol import computed, digest, pictures, view
from bench.models.published import EPSILON, NETWORKS, NetworkPair, in_our_order, open_code
from bench.models.training_speed import STEPS, training_step
from tactile_rt.classifier.model_file import file_outputs, load_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.export.onnx_step import step_graph, write_model
from tactile_rt.models.ead import count_parameters
from tactile_rt.models.evaluation.records import Record, show

PARTS = ("parity", "training", "window")
SEEDS = 40


class Comparison(NetworkPair):
    """What is measured of a pair."""

    def parity(self, _: int) -> list[Record]:
        """Parameter counts, logits, and in double precision logits and gradients."""
        frames = torch.randn(2, STEPS, 30, 5, 7)
        exact, gradients = [], []
        for network in (self.theirs, self.ours):
            double = copy.deepcopy(network).double()
            torch.set_default_dtype(torch.float64)  # they make zeros of the default type
            exact.append(double(frames.double())[:, -1])
            exact[-1].square().sum().backward()
            torch.set_default_dtype(torch.float32)
            gradients.append({k: p.grad for k, p in double.named_parameters()})
        with torch.no_grad():
            single = [net(frames)[:, -1] for net in (self.theirs, self.ours)]
            for cell in self.cells:
                cell.epsilon = type(cell).epsilon
            floor = gap(single[0], self.ours(frames)[:, -1])
            for cell in self.cells:
                cell.epsilon = EPSILON
        counts = [count_parameters(network) for network in (self.ours, self.theirs)]
        records = [
            self.record("parameters", counts[0], "", f"== {counts[1]}", "bar: theirs"),
            self.record("parity", gap(*single), "", "<= 1e-6", "logits, both in fp32"),
            self.record(
                "parity_double", gap(*exact), "", "<= 1e-12", "logits, both in double precision"
            ),
        ]
        if self.graph:  # S4's C has changed since; batch norm's buffers have no gradient
            theirs, own = in_our_order(gradients[0], self.ours), gradients[1]
            worst = max(gap(own[k], theirs[k]) / float(own[k].abs().max()) for k in own)
            how = "over a parameter's largest gradient, both in double precision"
            records.append(self.record("parity_gradient", worst, "", "", how))
            how = "logits, fp32, with the epsilon of decision 6: what that changes"
            records.append(self.record("epsilon", floor, "", "", how))
        return records

    def training(self, repeats: int, batch: int = 32) -> list[Record]:
        """Forward and backward pass and update."""
        frames = torch.randn(batch, STEPS, 30, 5, 7)
        pair = self.theirs.train(), self.ours.train()
        for network in pair:
            training_step(network, frames[:2])()  # what the first call does once is not counted
        steps = [training_step(n, frames, bf16) for bf16 in (False, True) for n in pair]
        theirs, fp32, theirs_bf16, bf16 = best(steps, repeats)
        how = f"training step, batch {batch}, best of {repeats}"
        return [
            self.record("training", theirs, "s", "", f"theirs, {how}"),
            self.record("training_theirs_bf16", theirs / theirs_bf16, "x", "", "theirs, autocast"),
            self.record("training_fp32", theirs / fp32, "x", ">= 1.25", f"ours {fp32:.3g} s"),
            self.record("training_bf16", theirs / bf16, "x", ">= 2", f"ours {bf16:.3g} s"),
        ]

    def window(self, repeats: int) -> list[Record]:
        """One window of 22 steps: theirs, ours in torch, our file of kind "window"."""
        card, rng = self.card, np.random.default_rng(0)
        shape = (1, STEPS, card.substeps, *card.array.shape)
        scale = np.array(card.scale, dtype=np.float32)
        samples = rng.standard_normal(shape, dtype=np.float32) * scale
        offset = np.zeros((1, *card.array.shape), dtype=np.float32)
        sigma = offset + np.array(card.floor, dtype=np.float32)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "window.onnx")
            write_model(*step_graph(self.model, card), self.model, card, path, kind="window")
            session, card = load_model(path, kind="window")
        with torch.inference_mode():
            frames = self.model.inputs(*(torch.from_numpy(a) for a in (samples, offset, sigma)))
            run = lambda: file_outputs(session, card, samples, offset, sigma)["logits"]  # noqa: E731
            calls = [lambda: self.theirs(frames), lambda: self.ours(frames), run]
            theirs, ours, file = best(calls, 3 * repeats)
            apart = gap(self.theirs(frames)[:, -1], torch.from_numpy(run())[:, -1])
        how = f"one window, best of {3 * repeats}"
        return [
            self.record("window", 1e3 * theirs, "ms", "", f"theirs, {how}"),
            self.record("window_torch", theirs / ours, "x", "", f"ours {1e3 * ours:.3g} ms"),
            self.record("window_onnx", theirs / file, "x", ">= 2.4", f"ours {1e3 * file:.3g} ms"),
            self.record("window_parity", apart, "", "<= 1e-5", "logits, our file and theirs"),
        ]

    def record(self, name: str, value: float, unit: str, bar: str, how: str) -> Record:
        promised = self.name == "peer.intersection_ln" or not bar.startswith(">=")  # speed
        return Record(f"{self.name}.{name}", value, unit, bar if promised else "", "", how)


def protocol(store: Path | None) -> list[Record]:
    """Each thing of the protocol, ours and theirs; and what theirs draws from some seeds."""
    ours, theirs = computed(), theirs_by.computed_by_theirs()
    worst: dict[str, float] = {}
    for name, found in theirs.items():
        kind = name if name.startswith(("loss", "rates")) else name.partition(" ")[0]
        apart = max(gap(a, b) for a, b in zip(ours[name], found, strict=True))
        worst[kind] = max(worst.get(kind, 0.0), apart)
    views = [theirs_by.drawn_view(seed) for seed in range(SEEDS)]
    worst["views of seeds"] = max(gap(view(*drawn), made) for drawn, made in views)
    shots = [theirs_by.drawn_pictures(s, weak) for s in range(SEEDS) for weak in (False, True)]
    worst["pictures of seeds"] = max(gap(pictures(drawn), made) for drawn, made in shots)
    if store is not None:
        figures = {k: [digest(a.detach().numpy()) for a in found] for k, found in theirs.items()}
        store.write_bytes(msgspec.json.format(msgspec.json.encode(figures), indent=1) + b"\n")
    return [
        Record(f"peer.protocol.{kind}", apart, "", "<= 1e-6", "", "largest difference")
        for kind, apart in worst.items()
    ]


def gap(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().max())


def best(calls: list[Callable[[], object]], repeats: int) -> list[float]:
    """Least CPU time of each, s, in turn: whatever else the machine does meets all of them."""
    found = [float("inf")] * len(calls)
    for _ in range(repeats):
        for i, call in enumerate(calls):
            began = time.process_time()
            call()
            found[i] = min(found[i], time.process_time() - began)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tactile_nn", type=Path)
    parser.add_argument("pytorch_tnn", type=Path)
    parser.add_argument("--network", action="append", choices=NETWORKS, help="may be repeated")
    parts = (*PARTS, "protocol")
    parser.add_argument("--part", action="append", choices=parts, help="may be repeated")
    parser.add_argument("--store", type=Path, help="of part protocol: keep their figures here")
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # theirs: padding of even kernels, lazy layers
    try:
        code = open_code(args.tactile_nn, args.pytorch_tnn)
    except ConfigError as error:
        parser.error(str(error))
    records = []
    chosen = args.part or parts
    if "protocol" in chosen:
        records += protocol(args.store)
    for name in args.network or NETWORKS:
        for part in [part for part in chosen if part != "protocol"]:
            records += getattr(Comparison(name, code), part)(args.repeats)  # training changes it
    show(records, Console())
    return 1 if any(r.met is False for r in records) else 0


if __name__ == "__main__":
    sys.exit(main())
