"""CPU time of a training step, beside the same network written plainly."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bench.models.plain_network import PlainEncoder
from tactile_rt.models.ead import EAD, EADConfig
from tactile_rt.models.encoders.cells import CELLS
from tactile_rt.models.evaluation.records import Record

STEPS, CLASSES = 22, 117
PEER = "the same network, plain eager conv2d (beside the published code: bench/models/peer.py)"


def training_speed(quick: bool) -> list[Record]:
    """Forward and backward pass and update of Intersection-LN, and of small networks.

    Quick: batch 2 at 1/8 width, once: what it is made of, not a figure.
    """
    width, batch, repeats = (1 / 8, 2, 1) if quick else (1.0, 32, 2)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [*_beside_the_peer(width, batch, repeats), *_small(2 if quick else 32, repeats)]
    finally:
        torch.set_num_threads(before)


def _beside_the_peer(width: float, batch: int, repeats: int) -> list[Record]:
    torch.manual_seed(0)
    config = EADConfig(CLASSES, "zhuang-intersection-ln", "none", width=width)
    ours, plain = EAD(config), EAD(config)
    plain.load_state_dict(ours.state_dict())
    plain.encoder = PlainEncoder(ours.encoder)
    frames = torch.randn(batch, STEPS, 30, 5, 7)
    with torch.no_grad():
        found, peer = ours(frames), plain(frames)
        few = frames[:2]
        exact = copy.deepcopy(plain).double()(few.double())
        gap, own, others = (
            float((a - b).abs().max())
            for a, b in ((found, peer), (found[:2], exact), (peer[:2], exact))
        )
    steps = [training_step(ours, frames), training_step(plain, frames)]
    steps.append(training_step(ours, frames, bf16=True))
    best = [float("inf")] * 3
    for _ in range(repeats):  # in turn: whatever else the machine does meets all of them
        for i, step in enumerate(steps):
            best[i] = min(best[i], _cpu_seconds(step))
    fp32_bar, bf16_bar = (">= 1.25", ">= 2") if width == 1 else ("", "")  # promised at full width
    how = f"CPU time, width {width:g}, batch {batch}, one thread, best of {repeats}"
    name, scale = "models.step", f"largest logit {float(peer.abs().max()):.2g}"
    double = "largest gap to the peer in double precision, 2 windows"
    return [
        # between two networks in single precision there is the rounding of both
        Record(f"{name}.parity", own, "", "<= 1e-6", PEER, f"ours in fp32, {double}; {scale}"),
        Record(f"{name}.parity_plain", others, "", how=f"the peer's in fp32, {double}"),
        Record(f"{name}.parity_both", gap, "", how="largest gap of both in fp32"),
        Record(f"{name}.plain", best[1], "s", anchor="published: 21-25 s", how=how),
        Record(f"{name}.fp32", best[0], "s", how=how),
        Record(f"{name}.fp32_times_plain", best[1] / best[0], "x", fp32_bar, PEER, how),
        Record(f"{name}.bf16_times_plain", best[1] / best[2], "x", bf16_bar, PEER, how),
    ]


def _small(batch: int, repeats: int) -> list[Record]:
    records = []
    for cell in CELLS:
        torch.manual_seed(0)
        ead = EAD(EADConfig(CLASSES, f"zhuang-{cell}", "none", width=1 / 16))
        step = training_step(ead, torch.randn(batch, STEPS, 30, 5, 7))
        step()
        seconds = min(_cpu_seconds(step) for _ in range(repeats))
        how = f"CPU time, width 1/16, batch {batch}, fp32, one thread"
        records.append(Record(f"models.step.small.{cell}", 1e3 * seconds, "ms", how=how))
    return records


def training_step(network: nn.Module, frames: Tensor, bf16: bool = False) -> Callable[[], None]:
    """One update of a network (batch, step, ...) -> (batch, step, class) as a function."""
    optimizer = torch.optim.AdamW(network.parameters(), 1e-4)
    labels = torch.arange(len(frames)) % CLASSES

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            logits = network(frames)
        loss = F.cross_entropy(logits[:, -1].float(), labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def _cpu_seconds(step: Callable[[], None]) -> float:
    began = time.process_time()
    step()
    return time.process_time() - began
