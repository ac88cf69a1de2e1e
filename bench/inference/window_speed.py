"""CPU time of a whole window at once: the exported file beside the same network written plainly.

Both take one episode of samples and give the logits of its every step. Needs the `train` extra.
"""

from __future__ import annotations

import copy
import importlib
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import (
    ModelCard,
    file_outputs,
    load_model,
    read_model,
    shipped_model,
)
from tactile_rt.core.packages import install_extra
from tactile_rt.models.evaluation.records import Record

if TYPE_CHECKING:  # a robot has no torch
    from tactile_rt.models.ead import TactileClassifier

CLASSES = 117  # of the paper
ENCODER = "zhuang-intersection-ln"
BAR = ">= 2.4"  # the plain network's time over the file's
NAME = "inference.window"
PEER = "the same network, plain eager conv2d, written here from the paper (not the published code)"

Window = Callable[[], NDArray[np.float32]]  # one episode through a network: logits (step, class)


def window_speed(quick: bool) -> list[Record]:
    """Intersection-LN on one episode: plain torch, ours in torch, and the exported windows.

    Quick: at 1/8 width, once: what it is made of, not a figure.
    """
    try:
        torch: Any = importlib.import_module("torch")
        making: Any = importlib.import_module("bench.inference.full_size")
    except ModuleNotFoundError as error:
        why = f"needs {error.name} ({install_extra('train')})"
        return [Record(f"{NAME}.measured", 0, "of 4", how=why)]
    from tactile_rt.models.ead import EADConfig

    width, repeats = (1 / 8, 1) if quick else (1.0, 5)
    spec = read_model(shipped_model())[0].array
    config = EADConfig(CLASSES, ENCODER, "none", width=width)
    model, card = making.random_model(spec, config, "window")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
            return _measured(_windows(model, card, Path(folder)), width, repeats)
    finally:
        torch.set_num_threads(before)


def _windows(model: TactileClassifier, card: ModelCard, folder: Path) -> dict[str, Window]:
    """The ways to run an episode, the plain one first."""
    import torch

    from bench.models.plain_network import PlainEncoder
    from tactile_rt.export.onnx_step import export_step
    from tactile_rt.models.encoders.zhuang import ZhuangEncoder

    rng, scale = np.random.default_rng(0), np.array(card.scale, dtype=np.float32)
    shape = (1, card.steps, card.substeps, *card.array.shape)
    samples = (rng.standard_cauchy(shape) * scale).astype(np.float32)
    offset = np.zeros((1, *card.array.shape), dtype=np.float32)
    sigma = np.full_like(offset, card.floor)
    arrays = [torch.from_numpy(a) for a in (samples, offset, sigma)]
    plain = copy.deepcopy(model)
    assert isinstance(plain.network.encoder, ZhuangEncoder)
    plain.network.encoder = PlainEncoder(plain.network.encoder).eval()
    windows: dict[str, Window] = {
        "plain": lambda: plain(*arrays)[0].numpy(),
        "torch": lambda: model(*arrays)[0].numpy(),
    }
    for precision in ("fp32", "int8"):
        path = folder / f"{precision}.onnx"
        with torch.inference_mode(False):
            export_step(model, card, path, precision, "window")
        session, written = load_model(path, kind="window")
        path.unlink()
        windows[precision] = lambda session=session, written=written: file_outputs(  # type: ignore[misc]
            session, written, samples, offset, sigma
        )["logits"][0]
    return windows


def _measured(windows: dict[str, Window], width: float, repeats: int) -> list[Record]:
    logits = {name: run() for name, run in windows.items()}  # and warms up
    taken: dict[str, list[float]] = {name: [] for name in windows}
    for _ in range(repeats):  # in turn: whatever else the machine does meets all of them
        for name, run in windows.items():
            began = time.thread_time()
            run()
            taken[name].append(time.thread_time() - began)
    best = {name: min(seconds) for name, seconds in taken.items()}
    how = f"CPU time, width {width:g}, batch 1, one thread, best of {repeats}"
    spread = float(logits["plain"].std())
    records = [
        Record(f"{NAME}.{name}", 1e3 * seconds, "ms CPU", how=how) for name, seconds in best.items()
    ]
    for name in list(windows)[1:]:
        bar = BAR if name == "fp32" and width == 1 else ""  # promised at full width
        gap = float(abs(logits[name] - logits["plain"]).max())
        what = f"{how}; logits within {gap:.1e} of the plain ones, whose spread is {spread:.2g}"
        ratio = best["plain"] / best[name]
        records.append(Record(f"{NAME}.{name}_times_plain", ratio, "x", bar, PEER, what))
    return records
