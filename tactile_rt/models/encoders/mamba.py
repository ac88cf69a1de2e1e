"""Mamba as an encoder: the whole frame, projected, then selective state-space blocks."""

from __future__ import annotations

from torch import Tensor, nn

from tactile_rt.models.attenders.mamba import MambaStack
from tactile_rt.models.encoders.gru import FEATURES, FRAME

__all__ = ["MambaEncoder"]


class MambaEncoder(nn.Module):
    """Frames `(batch, step, 30, 5, 7)` to features `(batch, step, 512 * width)`.

    7,322,112 parameters at width 1.
    """

    lag = 0

    def __init__(self, width: float = 1.0) -> None:
        super().__init__()
        self.features = round(FEATURES * width)
        self.embed = nn.Linear(FRAME, self.features)
        self.stack = MambaStack(self.features, "encoder")

    def forward(self, frames: Tensor) -> Tensor:
        """All steps at once, from a zero state: (batch, step, feature)."""
        features: Tensor = self.stack(self.embed(frames.flatten(2)))
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Zeros, as `MambaStack` has them."""
        return self.stack.initial_state(batch)

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """One step. frame (batch, 30, 5, 7) -> features (batch, feature), the new state."""
        return self.stack.step(self.embed(frame.flatten(1)), index, state)
