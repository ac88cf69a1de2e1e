"""Attenders: what a step's features mean in the light of the steps before it.

Every attender maps features `(batch, step, feature)` to the same shape, causally, and has a
`step` that gives the same one by one.
"""

from torch import Tensor, nn

from tactile_rt.models.attenders.gpt import GPT, HEADS, TOKENS
from tactile_rt.models.attenders.mamba import MambaStack

__all__ = ["GPT", "HEADS", "TOKENS", "MambaStack", "NoAttender"]


class NoAttender(nn.Module):
    """Each step on its own."""

    def forward(self, features: Tensor) -> Tensor:
        """features (batch, step, feature), as they are"""
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """features (batch, feature), as they are, {}"""
        return features, {}
