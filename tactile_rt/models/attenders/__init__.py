"""Attenders: the part of a network that combines a step's features with those of earlier steps.

Every attender maps features `(batch, step, feature)` to the same shape, causally; its `step`
computes the same for one step at a time.
"""

from torch import Tensor, nn

from tactile_rt.models.attenders.gpt import GPT, HEADS, TOKENS
from tactile_rt.models.attenders.mamba import MambaStack

__all__ = ["GPT", "HEADS", "TOKENS", "MambaStack", "NoAttender"]


class NoAttender(nn.Module):
    """Identity attender, which combines no steps."""

    def forward(self, features: Tensor) -> Tensor:
        """Return features (batch, step, feature) unchanged."""
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the features (batch, feature) of one step unchanged, and an empty state."""
        return features, {}
