"""Cross-entropy with the category, at the last step or at every step that can know anything."""

from collections.abc import Sequence

from torch import Generator, Tensor
from torch.nn import functional as F

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import TactileClassifier
from tactile_rt.models.objectives.base import Objective, in_single_precision

__all__ = ["Supervised", "anytime_loss", "last_loss"]


def anytime_loss(logits: Tensor, labels: Tensor, smoothing: float, lag: int) -> Tensor:
    """Half the cross-entropy of the last step, half the mean of all steps that can know anything.

    logits (batch, step, class), labels (batch,) -> scalar. The first `lag` steps, before any input
    has reached the output, would only teach the prior.
    """
    steps = logits[:, lag:]
    n = steps.shape[1]
    each = F.cross_entropy(
        steps.flatten(0, 1).float(),
        labels.repeat_interleave(n),
        reduction="none",
        label_smoothing=smoothing,
    ).view(-1, n)
    return 0.5 * each[:, -1].mean() + 0.5 * each.mean()


def last_loss(logits: Tensor, labels: Tensor, smoothing: float) -> Tensor:
    """The cross-entropy of the last step, as published; shapes as above."""
    return F.cross_entropy(logits[:, -1].float(), labels, label_smoothing=smoothing)


class Supervised(Objective):
    """Categories.

    Args:
        model, augmentation: as in `Objective`.
        loss: "anytime" or "last".
        smoothing: of the labels.
    """

    def __init__(
        self, model: TactileClassifier, augmentation: Augmentation, loss: str, smoothing: float
    ) -> None:
        super().__init__(model, augmentation)
        self._anytime, self._smoothing = loss == "anytime", smoothing

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        (loads,) = views
        logits = self.model.network(self.frames(loads, generator))
        with in_single_precision(logits):
            if self._anytime:
                return anytime_loss(logits, labels, self._smoothing, self.model.network.lag)
            return last_loss(logits, labels, self._smoothing)
