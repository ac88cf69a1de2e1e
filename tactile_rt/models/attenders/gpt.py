"""The GPT attender: a causal transformer over each step's features and an action token."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.ead_config import MAX_STEPS

__all__ = ["BLOCK", "GPT", "HEADS", "LAYERS", "MAX_STEPS", "TOKENS", "TransformerBlock"]

HEADS = 4
LAYERS = 8
BLOCK = 2 * MAX_STEPS + 1  # positions in the table: two tokens per step, plus one as in the paper
TOKENS = 2  # a step's observation, then the action token


class TransformerBlock(nn.Module):
    """Pre-norm transformer layer: x + attention(norm(x)), then x + MLP(norm(x))."""

    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.mlp_in = nn.Linear(width, 4 * width)
        self.mlp_out = nn.Linear(4 * width, width)
        self.dropout = dropout

    def heads(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map tokens (batch, token, width) to queries, keys, values (batch, head, token, ·)."""
        qkv = self.qkv(self.norm1(x)).unflatten(-1, (3, HEADS, -1))  # (batch, token, 3, head, ·)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)  # (batch, head, token, ·) each
        return q, k, v

    def merge(self, x: Tensor, attended: Tensor) -> Tensor:
        """Complete the layer for tokens x, given the attention's output (batch, head, token, ·)."""
        x = x + self._drop(self.proj(attended.transpose(1, 2).flatten(2)))  # (batch, token, width)
        hidden = F.gelu(self.mlp_in(self.norm2(x)), approximate="tanh")  # (batch, token, 4 width)
        return x + self._drop(self.mlp_out(hidden))

    def forward(self, x: Tensor) -> Tensor:
        """Map all tokens (batch, token, width); each attends to itself and to earlier tokens."""
        q, k, v = self.heads(x)
        dropout = self.dropout if self.training else 0.0
        return self.merge(
            x, F.scaled_dot_product_attention(q, k, v, dropout_p=dropout, is_causal=True)
        )

    def _drop(self, x: Tensor) -> Tensor:
        return F.dropout(x, self.dropout, self.training)


class GPT(nn.Module):
    """Causal transformer over (observation, action token) pairs (paper, section "EAD"; GPT-2).

    A learned action token follows every step's features; its output is the step's output.

    Args:
        dropout: share of activations that are dropped in training.
        max_steps: steps of an episode, at most `MAX_STEPS`.
        inputs: features per step of the input, default `width`. The paper's ResNet18 has 512, its
            GPT 256.
    """

    def __init__(
        self, width: int, dropout: float, max_steps: int, inputs: int | None = None
    ) -> None:
        super().__init__()
        inputs = width if inputs is None else inputs
        self.features = width
        self.max_steps = max_steps
        self.dropout = dropout
        self.action = nn.Parameter(torch.randn(inputs))
        self.project_in = nn.Linear(inputs, width)
        self.positions = nn.Parameter(torch.empty(BLOCK, width))
        self.blocks = nn.ModuleList(TransformerBlock(width, dropout) for _ in range(LAYERS))
        self.norm = nn.LayerNorm(width)
        self.project_out = nn.Linear(width, width, bias=False)
        nn.init.normal_(self.positions, std=0.02)
        std = 0.02 * math.sqrt(512 / width)  # GPT-2's at full width; narrower sums fewer terms
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear):
                # Every layer adds two terms to the residual: keep its variance at that of one term.
                shrink = math.sqrt(2 * LAYERS) if name.endswith(("proj", "mlp_out")) else 1.0
                nn.init.normal_(module.weight, std=std / shrink)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Map features (batch, step, inputs) to (batch, step, width).

        Raises:
            ValueError: more steps than `max_steps`.
        """
        steps = features.shape[1]
        if steps > self.max_steps:
            raise ValueError(f"{steps} steps; this attender takes at most {self.max_steps}")
        # (batch, step, token of the step, width)
        x = self._project(features) + self.positions[: TOKENS * steps].unflatten(0, (steps, TOKENS))
        x = F.dropout(x.flatten(1, 2), self.dropout, self.training)  # (batch, token, width)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.project_out(self.norm(x[:, TOKENS - 1 :: TOKENS]))
        return out

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return zero key and value caches (batch, layer, head, step, token, width / head)."""
        head = self.positions.shape[1] // HEADS
        shape = (batch, LAYERS, HEADS, self.max_steps, TOKENS, head)
        zeros = self.positions.new_zeros
        return {"gpt_k": zeros(shape), "gpt_v": zeros(shape)}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map the features (batch, inputs) of one step to (batch, width) and a new state.

        `index` (batch,) int64 counts steps since the reset. From `max_steps` on, every step
        overwrites the last position, so reset before.
        """
        index = index.clamp(max=self.max_steps - 1)
        slots = torch.arange(self.max_steps, device=index.device)
        here = (slots == index[:, None])[:, None, :, None, None]  # where this step's pair goes
        # The observation attends to earlier pairs and itself, the action token to its pair too.
        token = torch.arange(TOKENS * self.max_steps, device=index.device)
        query = TOKENS * index[:, None] + torch.arange(TOKENS, device=index.device)
        seen = (token <= query[:, :, None])[:, None]  # (batch, 1, query, token)
        positions = self.positions[: TOKENS * self.max_steps].unflatten(0, (-1, TOKENS))
        x = self._project(features) + positions[index]  # (batch, token of the step, width)
        keys, values = [], []
        for layer, block in enumerate(self.blocks):
            assert isinstance(block, TransformerBlock)
            q, k, v = block.heads(x)  # (batch, head, token of the step, width / head)
            # (batch, head, step, token of the step, width / head)
            keys.append(torch.where(here, k[:, :, None], state["gpt_k"][:, layer]))
            values.append(torch.where(here, v[:, :, None], state["gpt_v"][:, layer]))
            attended = F.scaled_dot_product_attention(
                q, keys[-1].flatten(2, 3), values[-1].flatten(2, 3), attn_mask=seen
            )
            x = block.merge(x, attended)
        out = self.project_out(self.norm(x[:, TOKENS - 1]))
        return out, {"gpt_k": torch.stack(keys, 1), "gpt_v": torch.stack(values, 1)}

    def _project(self, features: Tensor) -> Tensor:
        """Map features (..., inputs) to tokens (..., token, width): observation, then action."""
        action = self.action.expand_as(features)
        out: Tensor = self.project_in(torch.stack([features, action], dim=-2))
        return out
