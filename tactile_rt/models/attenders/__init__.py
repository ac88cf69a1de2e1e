"""Attenders: what a step's features mean in the light of the steps before it.

Every attender maps features `(batch, step, feature)` to the same shape, causally, and has a
`step` that gives the same one by one.
"""

from tactile_rt.models.attenders.gpt import BLOCK, GPT, HEADS, LAYERS, MAX_STEPS, TOKENS
from tactile_rt.models.attenders.mamba import MambaAttender
from tactile_rt.models.attenders.none import NoAttender

__all__ = [
    "BLOCK",
    "GPT",
    "HEADS",
    "LAYERS",
    "MAX_STEPS",
    "TOKENS",
    "MambaAttender",
    "NoAttender",
]
