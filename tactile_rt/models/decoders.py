"""Decoders: from what a step means to the classes' logits, `(..., feature)` -> `(..., class)`.

Both act on each step alone, so that a decision can be read off at any step.
"""

from __future__ import annotations

from torch import nn

HIDDEN = (1024, 512)  # at width 1


def linear(features: int, classes: int) -> nn.Module:
    return nn.Linear(features, classes)


def mlp(features: int, classes: int, width: float) -> nn.Module:
    """512-1024-512-classes at width 1 (paper, appendix "Model Training")."""
    wide, narrow = (round(hidden * width) for hidden in HIDDEN)
    return nn.Sequential(
        nn.Linear(features, wide),
        nn.ReLU(),
        nn.Linear(wide, narrow),
        nn.ReLU(),
        nn.Linear(narrow, classes),
    )
