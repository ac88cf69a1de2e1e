"""The paper's published networks, from folders of their code, and their weights in our layouts.

The folders: `tactile-nn` of github.com/neuroagents-lab/2025-tactile-whisking (commit 3420db6) and
github.com/neuroagents-lab/PyTorchTNN (commit 50713d9). Their code is imported, none is copied. It
needs torchvision, einops and omegaconf.
"""

import contextlib
import io
import logging
import sys
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from bench.inference.full_size import random_model
from bench.models.training_speed import CLASSES, STEPS
from tactile_rt.classifier.model_file import read_model, shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.models.ead import EAD, EADConfig
from tactile_rt.models.encoders.cells import Cell

CODE = "tactile_model"
EPSILON = 1e-5  # torch's own, as in pt_tnn/recurrent_cells/intersection_cell.py
GRAPH = "model_configs/rnn_fdb_converted_{}.json"
GATES = {  # of our cells' convolutions: where in theirs each is
    "ugrnn": (1, 0), "intersection": (1, 3, 0, 2), "gru": (0, 1), "lstm": (0, 1, 2, 3),
}  # fmt: skip
NORMS = {  # theirs by our rows
    "ugrnn": ("ln_c_act", "ln_g_act"),
    "intersection": ("ln_h_act", "ln_y_act", "ln_gh_act", "ln_gy_act"),
    "gru": ("ln_r_pre", "ln_u_pre", "ln_c_pre"),
    "lstm": ("ln_input", "ln_transform", "ln_forget", "ln_output", "ln_state"),
}
GRAPHS = {  # by our cells, their files of the graph
    "timedecay": "modern",
    "ugrnn": "modern_ugrnn", "ugrnn-ln": "modern_ugrnn_ln",
    "gru": "modern_gru", "gru-ln": "modern_gru_ln",
    "lstm": "modern_lstm", "lstm-ln-published": "modern_lstm_ln",
    "intersection": "modern_intersection", "intersection-ln": "modern_intersection_ln",
}  # fmt: skip
NETWORKS = {  # encoder and attender: ours, then theirs, and the attender's width
    "intersection_ln": ("zhuang-intersection-ln", "none", "zhuang_return_all", None, 512),
    "intersection_ln_gpt": ("zhuang-intersection-ln", "gpt", "zhuang_return_all", "gpt", 512),
    "resnet18_gpt": ("resnet18", "gpt", "pytorch_resnet18", "gpt", 256),
    "s4_gpt": ("s4", "gpt", "s4", "gpt", 512),
    "s4": ("s4", "none", "s4", None, 512),
} | {
    cell.replace("-", "_"): (f"zhuang-{cell}", "none", "zhuang_return_all", None, 512)
    for cell in GRAPHS
    if cell != "intersection-ln"
}


def open_code(tactile_nn: Path, pytorch_tnn: Path) -> Path:
    """Make their code importable; the folder with their configurations.

    Raises:
        ConfigError: a folder does not hold the code.
    """
    for folder, found in ((tactile_nn, f"{CODE}/enc_att_dec"), (pytorch_tnn, "pt_tnn")):
        if not (folder / found).is_dir():
            raise ConfigError(f"{folder} has no folder {found}")
    code = tactile_nn.resolve() / CODE
    sys.path[:0] = [str(code), str(pytorch_tnn.resolve())]
    logging.disable(logging.WARNING)  # of CUDA kernels that they lack here
    try:
        import torchvision  # noqa: F401
    except RuntimeError:
        # The package index has it built for CUDA only; with a torch for the CPU it then lacks
        # two operators that no network here uses, but that it wants to know of.
        for name in [m for m in sys.modules if m.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        for name in ("nms", "qnms"):
            torch.library.define(f"torchvision::{name}", "(Tensor a, Tensor b, float c) -> Tensor")
    return code


class Published(nn.Module):
    """One of their networks with random weights, its largest logit about 1.

    Frames (batch, 22, 30, 5, 7) -> the last step's logits (batch, 1, class).

    Args:
        code: from `open_code`.
        graph: the name of the file of their graph, where it is one.
        encoder, attender: names of their configurations.
        width: of what the attender gives.
    """

    def __init__(
        self, code: Path, graph: str, encoder: str, attender: str | None, width: int
    ) -> None:
        super().__init__()
        with contextlib.redirect_stdout(io.StringIO()):
            from enc_att_dec.model import EncAttDec
            from omegaconf import OmegaConf

        parts = {"encoder": encoder, "attender": attender, "decoder": "linear"}
        folder = code / "hydra_configs/model"
        model = {k: OmegaConf.load(folder / k / f"{v}.yaml") for k, v in parts.items() if v}
        model["encoder"].model_config_file = str(code / GRAPH.format(graph))
        sizes = {"repr_dim": 512, "hidden_dim": width, "out_dim": CLASSES}
        data = {"input_shape": [30, 5, 7], "n_times": STEPS}
        config = OmegaConf.create({"model": {**model, **sizes}, "data": data})
        with contextlib.redirect_stdout(io.StringIO()):
            self.network = EncAttDec(config)
        x = torch.randn(4, STEPS, 30, 5, 7)
        with torch.no_grad():
            self(x)  # lazy layers take their shapes
            for parameter in self.parameters():  # none at a value that hides a mistake
                if parameter.dim() == 1:
                    parameter += 0.1 * torch.randn_like(parameter)
            scale = self.eval()(x).abs().max()
            for parameter in self.network.decoder.parameters():
                parameter /= scale
            for module in self.modules():  # S4's roots of unity, in single precision
                for cached in ("omega", "z"):
                    module.__dict__.pop(cached, None)
            for name, buffer in self.named_buffers():
                if name.endswith("l_kernel"):  # as before the first call, which changes S4's C
                    buffer.zero_()

    def forward(self, frames: Tensor) -> Tensor:
        logits: Tensor = self.network(frames)
        return logits[:, None]


class NetworkPair:
    """A network of theirs, and ours with its weights and their layer norm's epsilon."""

    def __init__(self, name: str, code: Path) -> None:
        torch.manual_seed(0)
        encoder, attender, *published = NETWORKS[name]
        self.name, self.graph = f"peer.{name}", encoder.startswith("zhuang-")
        graph = GRAPHS.get(encoder.removeprefix("zhuang-"), "modern")
        self.theirs = Published(code, graph, *published).eval()
        config = EADConfig(CLASSES, encoder, attender)
        self.model, self.card = random_model(read_model(shipped_model())[0].array, config, name)
        self.ours = self.model.network
        self.ours.load_state_dict(in_our_order(self.theirs.state_dict(), self.ours))
        self.cells = [module for module in self.ours.modules() if isinstance(module, Cell)]
        for cell in self.cells:
            cell.epsilon = EPSILON


def in_our_order(theirs: dict[str, Tensor], ours: EAD) -> dict[str, Tensor]:
    """Weights of theirs, or their gradients, under our names and in our layouts."""
    parts: dict[str, dict[str, Tensor]] = {"encoder": {}, "attender": {}, "decoder": {}}
    for name, value in theirs.items():
        _, part, rest = name.split(".", 2)
        if not rest.endswith((".attn.bias", "l_kernel")):  # no weights: a mask, a length
            parts[part][rest] = value
    encoder, attender = parts["encoder"], list(parts["attender"].values())
    cell = ours.config.encoder.removeprefix("zhuang-")
    layouts = {
        "zhuang": partial(_zhuang, cell=cell),
        "s4": _s4,
        "resnet18": lambda e: list(e.values()),
    }
    order = layouts[ours.config.encoder.partition("-")[0]](encoder)
    order += attender[:1] + attender[3:4] + attender[1:3] + attender[4:]  # positions come second
    order += parts["decoder"].values()
    own = ours.state_dict()
    return {k: v.reshape(own[k].shape) for k, v in zip(own, order, strict=True)}


def _zhuang(encoder: dict[str, Tensor], cell: str) -> list[Tensor]:
    order = []
    for i in range(1, 7):
        conv = f"TG.conv{i}._pre_memory.conv"
        order += [encoder[f"{conv}.weight"].movedim(1, -1), encoder[f"{conv}.bias"]]
    kind = cell.partition("-")[0]
    for i in range(1, 7):
        node = f"TG.conv{i}._recurrent_cell."
        if cell == "timedecay":
            order.append(encoder[f"{node}tau"])
            continue
        if "-ln" in cell:
            for part in ("weight", "bias"):
                order.append(torch.stack([encoder[f"{node}{n}.{part}"] for n in NORMS[kind]]))
        for part in ("weight", "bias"):
            gates = encoder[f"{node}conv{'_ru' if kind == 'gru' else ''}.{part}"].chunk(
                len(GATES[kind])
            )
            joined = torch.cat([gates[g] for g in GATES[kind]])
            order.append(joined.movedim(1, -1) if part == "weight" else joined)
        if kind == "gru":
            candidate = [encoder[f"{node}conv_c.{part}"] for part in ("weight", "bias")]
            order += [candidate[0].movedim(1, -1), candidate[1]]
    if cell == "timedecay":
        order += [encoder[f"TG.fc{i}._recurrent_cell.tau"] for i in (7, 8)]
    dense = [encoder[f"TG.fc{i}._pre_memory.lin.{k}"] for i in (7, 8) for k in ("weight", "bias")]
    dense[0] = dense[0].unflatten(1, (-1, 24)).transpose(1, 2)  # channel, site -> site, channel
    return order + dense


def _s4(encoder: dict[str, Tensor]) -> list[Tensor]:
    order = [encoder["embed.weight"], encoder["embed.bias"]]
    for i in range(4):
        layer = f"s4_layers.{i}.layer."
        dt, decay, imaginary = (
            encoder[f"{layer}kernel.{k}"] for k in ("inv_dt", "A_real", "A_imag")
        )
        order += [dt, decay, -imaginary]
        order += [encoder[f"{layer}kernel.{k}"].transpose(2, 3) for k in "PBC"]  # real, imaginary
        order.append(encoder[f"{layer}D"])
        order += [encoder[f"s4_layers.{i}.output_linear.0.{k}"] for k in ("weight", "bias")]
        order += [encoder[f"norms.{i}.{k}"] for k in ("weight", "bias")]
    return [*order, encoder["decoder.weight"], encoder["decoder.bias"]]
