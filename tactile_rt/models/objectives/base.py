"""What all objectives share."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import TactileClassifier

__all__ = ["Objective", "in_single_precision", "scaled"]


class Objective(nn.Module):
    """A network and what it is trained for.

    Attributes:
        model: the network.
        augmentation: of the frames.
        views: how many times an update sees each window, each time augmented afresh.
    """

    views = 1

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__()
        self.model = model
        self.augmentation = augmentation

    def frames(self, loads: Loads, generator: Generator) -> Tensor:
        """Augmented frames of a batch, (batch, step, sub-step * channel, row, column)."""
        return self.augmentation.frames(self.model.inputs(*loads), generator)

    def embedding(self, loads: Loads, generator: Generator) -> Tensor:
        """(batch, feature): what encoder and attender make of a window.

        By its last step, or, where the network's readout is "mean", on average over all steps
        that can know anything.
        """
        features = self.model.features(self.frames(loads, generator))
        network = self.model.network
        if network.config.readout == "mean":
            return features[:, network.lag :].mean(dim=1)
        return features[:, -1]

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        """The loss of a batch.

        Args:
            views: `self.views` batches of loads, SI.
            labels: (batch,).
            generator: on the loads' device; the augmentation of frames draws from it.
        """
        raise NotImplementedError


def in_single_precision(like: Tensor) -> torch.autocast:
    """Where losses are computed: mixed precision ends at the network's output."""
    return torch.autocast(like.device.type, enabled=False)


def scaled(size: int, width: float, least: int = 1) -> int:
    """A layer's size at the network's width."""
    return max(round(size * width), least)
