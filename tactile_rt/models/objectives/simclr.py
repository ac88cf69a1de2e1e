"""SimCLR (Chen et al. 2020): two views of a window are to be found among all others' views."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import TactileClassifier
from tactile_rt.models.objectives.base import Objective, in_single_precision, scaled

__all__ = ["SimCLR", "nt_xent"]

HIDDEN, OUT = 2048, 128  # of the neck, at width 1
LEAST = 32  # its output's size at any width: fewer directions cannot tell a batch apart
TEMPERATURE = 0.1


def nt_xent(first: Tensor, second: Tensor, temperature: float = TEMPERATURE) -> Tensor:
    """Normalised temperature-scaled cross-entropy: of 2 n views, which is the other of the pair?

    first, second (n, feature): the two views of each of n windows -> scalar.
    """
    z = F.normalize(torch.cat([first, second]).float(), dim=1)
    n = len(first)
    similarity = (z @ z.T / temperature).fill_diagonal_(float("-inf"))
    partner = torch.arange(2 * n, device=z.device).roll(n)
    return F.cross_entropy(similarity, partner)


class SimCLR(Objective):
    """Contrast of two views; the neck (Linear, BN, ReLU, Linear, BN) is thrown away afterwards."""

    views = 2

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        width, features = model.network.config.width, model.feature_size()
        hidden, out = scaled(HIDDEN, width), scaled(OUT, width, LEAST)
        self.neck = nn.Sequential(
            nn.Linear(features, hidden),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            nn.Linear(hidden, out),
            nn.BatchNorm1d(out),
        )

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        first, second = (self.neck(self.embedding(v, generator)) for v in views)
        with in_single_precision(first):
            return nt_xent(_of_all_devices(first), _of_all_devices(second))


def _of_all_devices(rows: Tensor) -> Tensor:
    """The rows of every device's share of the batch: more negatives than one's own."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return rows
    from torch.distributed.nn.functional import all_gather  # keeps the gradient

    return torch.cat(all_gather(rows))
