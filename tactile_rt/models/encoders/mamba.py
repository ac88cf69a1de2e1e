"""Mamba encoder: a projection of the flattened frame, then selective state-space blocks."""

from math import prod

from torch import Tensor, nn

from tactile_rt.models.attenders.mamba import MambaStack
from tactile_rt.models.ead_config import MOUSE_FRAME
from tactile_rt.models.encoders.gru import FEATURES


class MambaEncoder(nn.Module):
    """Encoder by a `MambaStack` on flattened frames, to 512 * width features per step.

    7,322,112 parameters at width 1 on the mouse's frames.
    """

    lag = 0

    def __init__(self, width: float = 1.0, frame: tuple[int, ...] = MOUSE_FRAME) -> None:
        super().__init__()
        self.features = round(FEATURES * width)
        self.embed = nn.Linear(prod(frame), self.features)
        self.stack = MambaStack(self.features, "encoder")

    def forward(self, frames: Tensor) -> Tensor:
        """Map all frames of a window to features (batch, step, feature), from a zero state."""
        features: Tensor = self.stack(self.embed(frames.flatten(2)))
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return the zero state of the `MambaStack` before the first step."""
        return self.stack.initial_state(batch)

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to features (batch, feature) and the state."""
        return self.stack.step(self.embed(frame.flatten(1)), index, state)
