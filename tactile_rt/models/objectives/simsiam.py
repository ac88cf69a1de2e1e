"""SimSiam (Chen and He 2021): one view predicts the other, which does not look back."""

from collections.abc import Sequence

from torch import Generator, Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import TactileClassifier
from tactile_rt.models.objectives.base import Objective, in_single_precision, scaled

__all__ = ["SimSiam"]

PROJECTED, HIDDEN = 2048, 512  # at width 1


class SimSiam(Objective):
    """A projector of three layers, a predictor with a bottleneck, and a stopped gradient."""

    views = 2

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        width, features = model.network.config.width, model.feature_size()
        out, hidden = scaled(PROJECTED, width), scaled(HIDDEN, width)
        self.projector = nn.Sequential(
            nn.Linear(features, out, bias=False),
            nn.BatchNorm1d(out),
            nn.ReLU(),
            nn.Linear(out, out, bias=False),
            nn.BatchNorm1d(out),
            nn.ReLU(),
            nn.Linear(out, out, bias=False),
            nn.BatchNorm1d(out, affine=False),
        )
        self.predictor = nn.Sequential(
            nn.Linear(out, hidden, bias=False),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            nn.Linear(hidden, out),
        )

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        first, second = (self.projector(self.embedding(v, generator)) for v in views)
        predicted = self.predictor(first), self.predictor(second)
        with in_single_precision(first):
            return 0.5 * (_distance(predicted[0], second) + _distance(predicted[1], first))


def _distance(prediction: Tensor, target: Tensor) -> Tensor:
    """Negative cosine similarity, the target taken as given; (batch, feature) each -> scalar."""
    return -F.cosine_similarity(prediction.float(), target.detach().float(), dim=1).mean()
