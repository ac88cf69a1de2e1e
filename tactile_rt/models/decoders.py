"""Decoders: networks that map the features of steps to the logits of classes.

Every decoder maps features `(batch, step, feature)` to logits `(batch, step, class)`, where a
step's logits use no later step. It has two parts: `embed` returns the embedding `(batch, step,
unit)`, the input of the last linear layer; `logits` applies that layer. `step` embeds one step.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

HIDDEN = (1024, 512)  # at width 1


class LinearDecoder(nn.Linear):
    """Decoder of each step by one linear layer, so the features themselves are the embedding."""

    def __init__(self, features: int, classes: int, width: float = 1.0, steps: int = 22) -> None:
        super().__init__(features, classes)

    def embed(self, features: Tensor) -> Tensor:
        """Return features (..., feature) unchanged."""
        return features

    def logits(self, embedding: Tensor) -> Tensor:
        """Map the embedding (..., feature) to logits (..., class)."""
        logits: Tensor = self(embedding)
        return logits

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the features (batch, feature) of one step unchanged, and an empty state."""
        return features, {}


class MLPDecoder(nn.Sequential):
    """Decoder of each step by an MLP, feature-1024-512-class at width 1 (Chung et al. 2025)."""

    def __init__(self, features: int, classes: int, width: float = 1.0, steps: int = 22) -> None:
        wide, narrow = hidden(width)
        super().__init__(
            nn.Linear(features, wide),
            nn.ReLU(),
            nn.Linear(wide, narrow),
            nn.ReLU(),
            nn.Linear(narrow, classes),
        )

    def embed(self, features: Tensor) -> Tensor:
        """Map features (..., feature) to the embedding (..., unit)."""
        for layer in list(self)[:-1]:
            features = layer(features)
        return features

    def logits(self, embedding: Tensor) -> Tensor:
        """Map the embedding (..., unit) to logits (..., class)."""
        logits: Tensor = self[-1](embedding)
        return logits

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map one step's features (batch, feature) to an embedding (batch, unit), and no state."""
        return self.embed(features), {}


class MLPAllDecoder(nn.Module):
    """Decoder of all steps so far by an MLP, (steps * feature)-1024-512-class at width 1.

    At step t the features of later steps count as zero. So the last step's logits are the
    paper's, and the first layer is a running sum with one matrix product for each step.
    """

    def __init__(self, features: int, classes: int, width: float = 1.0, steps: int = 22) -> None:
        super().__init__()
        wide, narrow = hidden(width)
        self.weight = nn.Parameter(torch.empty(steps, wide, features))
        self.bias = nn.Parameter(torch.empty(wide))
        bound = 1 / math.sqrt(steps * features)  # of one layer that reads all steps
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)
        self.layer2 = nn.Linear(wide, narrow)
        self.layer3 = nn.Linear(narrow, classes)

    def forward(self, features: Tensor) -> Tensor:
        """Map features (batch, step, feature) to logits (batch, step, class)."""
        return self.logits(self.embed(features))

    def embed(self, features: Tensor) -> Tensor:
        """Map features (batch, step, feature) to the embedding (batch, step, unit).

        Raises:
            ValueError: more steps than the decoder has weights for.
        """
        steps = features.shape[1]
        if steps > len(self.weight):
            raise ValueError(f"{steps} steps; this decoder takes at most {len(self.weight)}")
        products = torch.einsum("btf,thf->bth", features, self.weight[:steps])  # (b, step, hidden)
        # At least single precision: sums of many steps would stall in autocast's types.
        exact = torch.promote_types(products.dtype, torch.float32)
        return self._apply_rest(products.cumsum(1, dtype=exact))

    def logits(self, embedding: Tensor) -> Tensor:
        """Map the embedding (..., unit) to logits (..., class)."""
        logits: Tensor = self.layer3(embedding)
        return logits

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return the state before the first step: the first layer's sum (batch, hidden), 0."""
        return {"decoder_sum": self.bias.new_zeros(batch, len(self.bias))}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map features (batch, feature) of step `index` (batch,) to an embedding and a state.

        Features of steps beyond the decoder's number of steps are ignored.
        """
        weight = self.weight[index.clamp(max=len(self.weight) - 1)]  # (batch, hidden, feature)
        product = torch.matmul(weight, features[:, :, None])[:, :, 0]  # (batch, hidden)
        inside = (index < len(self.weight))[:, None]  # (batch, 1)
        total = state["decoder_sum"] + torch.where(inside, product, 0.0)
        return self._apply_rest(total), {"decoder_sum": total}

    def _apply_rest(self, total: Tensor) -> Tensor:
        """Map the first layer's sum (..., hidden) to the embedding (..., unit)."""
        return F.relu(self.layer2(F.relu(total + self.bias)))


def hidden(width: float) -> tuple[int, int]:
    """Return the sizes of an MLP's two hidden layers, scaled by `width`."""
    wide, narrow = (round(units * width) for units in HIDDEN)
    return wide, narrow


# arguments: the numbers of features and classes, the width, and an episode's steps
KINDS: dict[str, type[LinearDecoder | MLPDecoder | MLPAllDecoder]] = {
    "linear": LinearDecoder,
    "mlp": MLPDecoder,
    "mlp-all": MLPAllDecoder,
}
