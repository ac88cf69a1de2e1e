"""`make check-export`: every encoder x attender x decoder, as a stream in torch and as a file.

Small networks: the streaming rewrite against the trained window (bar 2e-6, also after a reset at
every step, and in the form that is quantised), the same in double precision (bar 1e-9, where a
mistake cannot pass for rounding), and the file in fp32 against the window (bar 1e-5), logits and
embedding, as a step over many episodes in a row and as a window. In both, samples that are no
number must be as good as rest. And the file in the classifier: a stream cut at random must give
the very decisions of the whole. Wide networks take other forms of their products: with
one decoder, so do the small ones here, once more. Prints the worst of each and fails if one misses
its bar.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import copy
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

from bench.inference.full_size import random_model
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import file_outputs, load_model, read_model, shipped_model
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.core.stream import NS_PER_S, Chunk
from tactile_rt.export import streaming as streaming_module
from tactile_rt.export.onnx_step import PARITY_BAR, step_graph, write_model
from tactile_rt.export.streaming import streaming
from tactile_rt.models.ead import EAD, TactileClassifier
from tactile_rt.models.ead_config import ATTENDERS, DECODERS, ENCODERS, EADConfig

STREAM_BAR, DOUBLE_BAR = 2e-6, 1e-9  # some constants are single
# What is measured, and the most that it may be; bit by bit is 0.
BARS = {
    "stream": STREAM_BAR,
    "reset": STREAM_BAR,
    "integer": STREAM_BAR,
    "double": DOUBLE_BAR,
    "file": PARITY_BAR,
    "window": PARITY_BAR,
    "bad": 0.0,
    "cut": 0.0,
}
STEPS, CLASSES, WIDTH = 22, 7, 1 / 32
# A GRU's initial weights grow as it gets smaller, and its drives are sums of 1,050 inputs: one of
# 16 features is driven five times as hard as one of 512, and rounds as much more.
WIDTHS = {"gru": 1 / 4}
FORMS = {"": (streaming_module.LARGE, streaming_module.WIDE), "as if wide": (0, 0)}
Combination = tuple[str, str, str, str]
SPEC = read_model(shipped_model())[0].array


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--encoder", action="append", help="only this one; may be repeated")
    parser.add_argument("--wide-only", action="store_true", help="only the forms of wide networks")
    parser.add_argument("--torch-only", action="store_true", help="export nothing: seconds")
    parser.add_argument("--episodes", type=int, default=500, help="in a row, through each file")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    args = parser.parse_args()
    encoders = args.encoder or [name for name in ENCODERS if name != "graph"]
    small = [] if args.wide_only else [""]
    grid = list(itertools.product(encoders, ATTENDERS, DECODERS, small))
    grid += [
        (encoder, attender, DECODERS[-1], "as if wide")
        for encoder, attender in itertools.product(encoders, ATTENDERS)
        if encoder.startswith("zhuang") or attender == "gpt"
    ]
    began, found, console = time.perf_counter(), {}, Console(width=120)
    jobs = [(c, 0 if args.torch_only else args.episodes) for c in grid]
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        for combination, figures in pool.imap_unordered(measure, jobs):
            found[combination] = figures
            console.print(*combination, *(f"{f:.1e}" for f in figures), highlight=False)
        pool.close()
        pool.join()  # else their semaphores are thought to be lost
    table = Table("encoder", *BARS)
    for encoder in encoders:
        rows = [f for c, f in found.items() if c[0] == encoder]
        table.add_row(encoder, *(f"{worst:.1e}" for worst in np.max(rows, axis=0)))
    console.print(table)
    # NaN misses a bar, too.
    missed = [
        c
        for c, figures in found.items()
        if not all(x <= bar for x, bar in zip(figures, BARS.values(), strict=True))
    ]
    for combination in missed:
        console.print("misses a bar:", *combination)
    console.print(f"{len(found)} combinations, {time.perf_counter() - began:.0f} s")
    return 1 if missed else 0


def measure(job: tuple[Combination, int]) -> tuple[Combination, list[float]]:
    """Largest differences, in the order of `BARS`: of outputs, and last of posteriors."""
    (encoder, attender, decoder, form), episodes = job
    streaming_module.LARGE, streaming_module.WIDE = FORMS[form]
    torch.set_num_threads(1)
    torch.manual_seed(1)  # not of the weights (0) nor of the input (2), which would go together
    readout = "mean" if decoder == "mlp" else "last"
    width = WIDTHS.get(encoder, WIDTH)
    config = EADConfig(CLASSES, encoder, attender, decoder, width, readout)
    model, card = random_model(SPEC, config, encoder)
    with torch.no_grad():  # no parameter at a value that hides a mistake, such as zero
        for name, parameter in model.named_parameters():
            if parameter.dim() < 2 or name.endswith(("gamma", "beta")):
                parameter += 0.1 * torch.randn_like(parameter)
    figures = [*in_torch(model), 0.0, 0.0, 0.0, 0.0]
    if episodes:
        with tempfile.TemporaryDirectory() as folder:
            proto, state = step_graph(model, card)
            path, window = Path(folder, "step.onnx"), Path(folder, "window.onnx")
            write_model(proto, state, model, card, path)
            window_card = write_model(proto, state, model, card, window, kind="window")
            figures[4] = over_episodes(model, path, episodes)
            figures[5] = float(window_card.figures["parity"])
            figures[6] = float(np.max([after_bad_samples(p) for p in (path, window)]))
            figures[7] = cut_at_random(path)
    return job[0], figures


@torch.inference_mode()
def in_torch(model: TactileClassifier) -> list[float]:
    x = torch.randn(STEPS, STEPS, 30, 5, 7, generator=torch.Generator().manual_seed(2))
    network = model.network
    expected = network(x)
    # Lane i begins anew at step i.
    tails = [network(x[i : i + 1, i:])[0] for i in range(STEPS)]
    step = streaming(network)
    plain, anew = stepped(step, x), stepped(step, x, reset=True)
    integer = stepped(streaming(network, True), x)
    after = [float(abs(anew[i, i:] - tail).max()) for i, tail in enumerate(tails)]
    exact, x = copy.deepcopy(network).double(), x[:3].double()
    return [
        float(abs(plain - expected).max()),
        float(np.max(after)),
        float(abs(integer - expected).max()),
        float(abs(stepped(streaming(exact).double(), x) - exact(x)).max()),
    ]


def stepped(network: EAD, x: torch.Tensor, reset: bool = False) -> torch.Tensor:
    """Logits (lane, step, class), step by step; lane i is reset before step i, or none is."""
    zeros = network.initial_state(len(x))
    if x.dtype == torch.float64:
        zeros = {k: v.double() if v.is_floating_point() else v for k, v in zeros.items()}
    state, logits = zeros, []
    for t in range(x.shape[1]):
        if reset:
            state = {k: v.clone() for k, v in state.items()}
            for k, v in state.items():
                v[t] = zeros[k][t]
        out, state = network.step(x[:, t], state)
        logits.append(out)
    return torch.stack(logits, 1)


def over_episodes(model: TactileClassifier, path: Path, episodes: int) -> float:
    """Of a file as a robot runs it, one episode after the other, against windows in torch."""
    session, card = load_model(path)
    stepper = Stepper(session, card)
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
            arrays = [torch.from_numpy(a) for a in (samples, offset, sigma)]
            expected = model(*arrays).numpy()
            embedded = model.network.embed(model.inputs(*arrays)).numpy()
        spread = max(1.0, float(embedded.std()))  # of the features of a linear decoder
        for i in range(n):
            stepper.begin(offset[i], sigma[i])
            for step in range(card.steps):
                stepper.samples[0] = samples[i, step]
                gap = abs(stepper.run()[0] - expected[i, step]).max()
                hidden = abs(stepper.embedding[0] - embedded[i, step]).max() / spread
                worst = float(np.max([worst, gap, hidden]))  # NaN stays
    return worst


def after_bad_samples(path: Path) -> float:
    """Of a window with NaN and infinity in a step, against rest there; NaN if that is left."""
    session, card = load_model(path, kind=None)
    rng, scale = np.random.default_rng(5), np.array(card.scale, dtype=np.float32)
    shape = (1, card.steps, card.substeps, *card.array.shape)
    rest = rng.standard_normal(shape, dtype=np.float32) * scale
    offset = rng.standard_normal((1, *card.array.shape), dtype=np.float32) * scale
    rest[:, 3, :, ::2] = offset[:, None, ::2]
    bad = rest.copy()
    bad[:, 3, :, ::2] = np.resize((np.nan, np.inf, -np.inf), bad[:, 3, :, ::2].shape)
    found, expected = (file_outputs(session, card, s, offset, abs(offset)) for s in (bad, rest))
    return float(np.max([abs(found[name] - expected[name]).max() for name in expected]))


def cut_at_random(path: Path) -> float:
    """Of a stream with touches and a gap, in chunks of random sizes against all at once."""
    card = read_model(path)[0]
    rng = np.random.default_rng(3)
    n = 3600  # three touches, of an episode each
    values = rng.normal(size=(n, *SPEC.shape)) * card.floor
    for first in range(200, n, 1200):
        load = rng.normal(size=SPEC.shape) * np.array(card.scale) * 3
        values[first : first + 1100] += load
    values[500:540] = np.nan
    seq = np.arange(n, dtype=np.int64)
    t_ns = np.round(seq * (NS_PER_S / SPEC.rate_hz)).astype(np.int64)
    whole = Chunk(seq, t_ns, values.astype(np.float32), np.ones(values.shape[:2], np.bool_))
    edges = [0, *np.sort(rng.choice(np.arange(1, n), 300, replace=False)).tolist(), n]
    parts = [
        Chunk(*(getattr(whole, name)[a:b] for name in ("seq", "t_ns", "values", "valid")))
        for a, b in itertools.pairwise(edges)
    ]
    expected = Classifier(path, SPEC).push(whole)
    classifier = Classifier(path, SPEC)
    found = [decision for part in parts for decision in classifier.push(part)]
    if len(expected) < STEPS or len(found) != len(expected):
        return np.nan
    return max(
        float(abs(a.probabilities - b.probabilities).max())
        for a, b in zip(found, expected, strict=True)
    )


if __name__ == "__main__":
    sys.exit(main())
