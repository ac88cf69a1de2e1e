"""Attenders: the parts of a network that join a step's features with those of earlier steps.

Every attender maps features `(batch, step, feature)` to the same shape, causally, and has a
`step` that gives the same step by step.
"""

from torch import Tensor, nn

from tactile_rt.models.attenders.gpt import GPT, HEADS, TOKENS
from tactile_rt.models.attenders.mamba import MambaStack

__all__ = ["GPT", "HEADS", "TOKENS", "MambaStack", "NoAttender"]


class NoAttender(nn.Module):
    """An attender that leaves each step on its own."""

    def forward(self, features: Tensor) -> Tensor:
        """Return features (batch, step, feature) unchanged."""
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return features (batch, feature) unchanged, and {}."""
        return features, {}
