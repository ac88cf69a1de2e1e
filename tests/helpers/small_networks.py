"""Small EAD networks and windows for them, shared by the tests of networks."""

import torch
from torch import Tensor

from tactile_rt.models.ead import EAD, EADConfig

STEPS = 22
TOLERANCE = 2e-6
# A loop of maps and a vector, joined in every way.
GRAPH = """
readout = "fc"
[inputs.frame]
channels = 30
rows = 5
columns = 7
[nodes.first]
kind = "valid"
channels = 32
reads = ["frame", { source = "fc", fusion = "gate" }]
cell = "gru-ln"
[nodes.up]
channels = 64
reads = ["first", "down", "fc", { source = "up", fusion = "sum" }]
cell = "lstm-ln"
[nodes.down]
channels = 32
reads = ["up", "down"]
[nodes.fc]
kind = "dense"
channels = 64
cell = "timedecay"
reads = ["up", { source = "down", fusion = "gate" }]
"""


def stir(module: torch.nn.Module) -> None:
    """Move every bias, norm and decay off its initial value, so that each of them matters."""
    with torch.no_grad():
        for name, parameter in module.named_parameters():
            if parameter.dim() < 2 or name.endswith(("gamma", "beta")):
                parameter += 0.1 * torch.randn_like(parameter)


def build(
    encoder="zhuang-intersection-ln", attender="gpt", readout="last", width=1 / 32, **more
) -> EAD:
    """A small network in evaluation mode whose every parameter matters."""
    torch.manual_seed(1)
    ead = EAD(EADConfig(7, encoder, attender, width=width, readout=readout, **more)).eval()
    stir(ead)
    return ead


def frames(batch=2, steps=STEPS, seed=0) -> Tensor:
    return torch.randn(batch, steps, 30, 5, 7, generator=torch.Generator().manual_seed(seed))


def stream(ead: EAD, x: Tensor) -> Tensor:
    """Logits (batch, step, class), one step after the other."""
    state = ead.initial_state(len(x))
    logits = []
    for t in range(x.shape[1]):
        out, state = ead.step(x[:, t], state)
        logits.append(out)
    return torch.stack(logits, 1)
