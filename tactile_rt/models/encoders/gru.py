"""GRU encoder on the flattened frame: a control without the grid or the paper's graph."""

from math import prod

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.ead_config import MOUSE_FRAME

FEATURES = 512  # per step, at width 1
LAYERS = 2


class GRUEncoder(nn.Module):
    """Encoder by a two-layer GRU (Cho et al. 2014), to 512 * width features per step.

    3,978,240 parameters at width 1 on the mouse's frames.
    """

    lag = 0

    def __init__(self, width: float = 1.0, frame: tuple[int, ...] = MOUSE_FRAME) -> None:
        super().__init__()
        self.features = round(FEATURES * width)
        self.gru = nn.GRU(prod(frame), self.features, LAYERS, batch_first=True)

    def forward(self, frames: Tensor) -> Tensor:
        """Map all frames of a window to features (batch, step, feature), from a zero state."""
        features: Tensor = self.gru(frames.flatten(2))[0]
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return the state before the first step: zero hidden states (batch, layer, feature)."""
        return {"gru_h": self.gru.all_weights[0][1].new_zeros(batch, LAYERS, self.features)}

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to features (batch, feature) and the state."""
        x, new = frame.flatten(1), []  # (batch, number)
        for layer, h in enumerate(state["gru_h"].unbind(1)):
            w_ih, w_hh, b_ih, b_hh = self.gru.all_weights[layer]
            r_x, z_x, n_x = F.linear(x, w_ih, b_ih).chunk(3, dim=-1)  # (batch, feature) each
            r_h, z_h, n_h = F.linear(h, w_hh, b_hh).chunk(3, dim=-1)
            r, z = torch.sigmoid(r_x + r_h), torch.sigmoid(z_x + z_h)
            x = (1 - z) * torch.tanh(n_x + r * n_h) + z * h
            new.append(x)
        return x, {"gru_h": torch.stack(new, 1)}
