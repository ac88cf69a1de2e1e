"""`make check-export`: every encoder x attender x decoder, as a stream in torch and as a file.

Small networks: the streaming rewrite against the trained window (bar 2e-6, also after a reset in
the middle, and in the form that is quantised), and the file in fp32 against the window (bar 1e-5),
as a step over many episodes in a row and as a window. Prints the worst of each and fails if one
misses its bar.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import itertools
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from tactile_rt.export.full_size import random_model
from tactile_rt.export.onnx_step import PARITY_BAR, file_logits, step_graph, write_model
from tactile_rt.export.streaming import streaming
from tactile_rt.model_file import load_model, read_model, shipped_model
from tactile_rt.models.ead import ATTENDERS, DECODERS, ENCODERS, EADConfig
from tactile_rt.models.training import TactileClassifier

STREAM_BAR = 2e-6
BATCH, STEPS, CLASSES, RESET = 3, 22, 7, 9
Combination = tuple[str, str, str]
SPEC = read_model(shipped_model())[0].array


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--encoder", action="append", help="only this one; may be repeated")
    parser.add_argument("--torch-only", action="store_true", help="export nothing: seconds")
    parser.add_argument("--episodes", type=int, default=500, help="in a row, through each file")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    args = parser.parse_args()
    encoders = args.encoder or [name for name in ENCODERS if name != "graph"]
    grid = list(itertools.product(encoders, ATTENDERS, DECODERS))
    began, found, console = time.perf_counter(), {}, Console()
    jobs = [(c, 0 if args.torch_only else args.episodes) for c in grid]
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        for combination, figures in pool.imap_unordered(measure, jobs):
            found[combination] = figures
            console.print(*combination, *(f"{f:.1e}" for f in figures), highlight=False)
    table = Table("encoder", "stream", "after a reset", "to be quantised", "file", "window file")
    for encoder in encoders:
        rows = [f for c, f in found.items() if c[0] == encoder]
        table.add_row(encoder, *(f"{worst:.1e}" for worst in np.max(rows, axis=0)))
    console.print(table)
    # NaN misses a bar, too.
    bars = [STREAM_BAR] * 3 + [PARITY_BAR] * 2
    missed = [c for c, f in found.items() if not all(x <= b for x, b in zip(f, bars, strict=True))]
    for combination in missed:
        console.print("misses a bar:", *combination)
    console.print(f"{len(found)} combinations, {time.perf_counter() - began:.0f} s")
    return 1 if missed else 0


def measure(job: tuple[Combination, int]) -> tuple[Combination, list[float]]:
    """Largest differences of logits: stream, after a reset, to be quantised, file, window file."""
    (encoder, attender, decoder), episodes = job
    torch.set_num_threads(1)
    readout = "mean" if decoder == "mlp" else "last"
    config = EADConfig(CLASSES, encoder, attender, decoder, 1 / 32, readout)
    model, card = random_model(SPEC, config, encoder)
    with torch.no_grad():  # no parameter at a value that hides a mistake, such as zero
        for name, parameter in model.named_parameters():
            if parameter.dim() < 2 or name.endswith(("gamma", "beta")):
                parameter += 0.1 * torch.randn_like(parameter)
    figures = [*in_torch(model), 0.0, 0.0]
    if episodes:
        with tempfile.TemporaryDirectory() as folder:
            proto, state = step_graph(model, card)
            path, window = Path(folder, "step.onnx"), Path(folder, "window.onnx")
            write_model(proto, state, model, card, path)
            window_card = write_model(proto, state, model, card, window, kind="window")
            figures[3] = over_episodes(model, path, episodes)
            figures[4] = float(window_card.figures["parity"])
    return job[0], figures


@torch.inference_mode()
def in_torch(model: TactileClassifier) -> list[float]:
    x = torch.randn(BATCH, STEPS, 30, 5, 7, generator=torch.Generator().manual_seed(0))
    expected, tail = model.network(x), model.network(x[:, RESET:])
    worst = []
    for integer in (False, True):
        network = streaming(model.network, integer)
        whole, again = [], []
        state = network.initial_state(BATCH)
        for t in range(STEPS):
            logits, state = network.step(x[:, t], state)
            whole.append(logits)
        state = network.initial_state(BATCH)
        for t in range(RESET, STEPS):
            logits, state = network.step(x[:, t], state)
            again.append(logits)
        worst.append(float(abs(torch.stack(whole, 1) - expected).max()))
        worst.append(float(abs(torch.stack(again, 1) - tail).max()))
    return [worst[0], worst[1], worst[2]]


def over_episodes(model: TactileClassifier, path: Path, episodes: int) -> float:
    """Of a file at batch 1, one episode after the other, against windows in torch."""
    session, card = load_model(path)
    rng = np.random.default_rng(1)
    scale = np.array(card.scale, dtype=np.float32)
    elements, channels = card.array.shape
    worst = 0.0
    for first in range(0, episodes, 20):
        n = min(20, episodes - first)
        shape = (n, card.steps, card.substeps, elements, channels)
        samples = (rng.standard_cauchy(shape) * scale).astype(np.float32)
        offset = (rng.normal(size=(n, elements, channels)) * scale).astype(np.float32)
        sigma = np.abs(offset)
        with torch.inference_mode():
            arrays = (samples, offset, sigma)
            expected = model(*(torch.from_numpy(a) for a in arrays)).numpy()
        for i in range(n):
            lane = slice(i, i + 1)
            found = file_logits(session, card, samples[lane], offset[lane], sigma[lane])
            worst = float(np.maximum(worst, abs(found - expected[lane]).max()))
    return worst


if __name__ == "__main__":
    sys.exit(main())
