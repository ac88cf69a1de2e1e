"""No attender: each step on its own."""

from __future__ import annotations

from torch import Tensor, nn

__all__ = ["NoAttender"]


class NoAttender(nn.Module):
    """Each step on its own."""

    def forward(self, features: Tensor) -> Tensor:
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        return features, {}
