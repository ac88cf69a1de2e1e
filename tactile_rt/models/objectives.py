"""What a network is trained for: categories, contrasts of two views, or rebuilding the window.

An objective is a module that holds the network and its own heads, which are thrown away after the
training.

    objective(views, labels, generator) -> loss

`views` are one or two batches of loads (samples, offset, sigma) as `TactileClassifier` takes them,
`Objective.views` says how many; labels (batch,) count for the supervised objective alone. The
augmentation of frames happens inside, drawn from the generator.

- `Supervised`: cross-entropy with the category.
- `SimCLR` (Chen et al. 2020): two views of a window are to be found among all others' views.
- `SimSiam` (Chen and He 2021): one view predicts the other, which does not look back.
- `Autoencoder` (Olshausen and Field 1996): sparse features of the last step rebuild the window.
"""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import TactileClassifier

__all__ = [
    "Autoencoder",
    "Objective",
    "SimCLR",
    "SimSiam",
    "Supervised",
    "anytime_loss",
    "last_loss",
    "nt_xent",
]

# Sizes of the heads, at width 1.
CONTRASTED = (2048, 128)  # SimCLR's neck: inside, and what comes out
LEAST = 32  # the neck's output at any width: fewer directions cannot tell a batch apart
TEMPERATURE = 0.1  # of SimCLR
PROJECTED, BOTTLENECK = 2048, 512  # SimSiam's projector and predictor
WIDE, NARROW = 256, 128  # channels between the autoencoder's deconvolutions
SPARSITY = 1e-4  # of the autoencoder: weight of |features|_1


class Objective(nn.Module):
    """A network and what it is trained for.

    Attributes:
        model: The network that is trained.
        augmentation: The augmentation that is applied to the frames.
        views: The number of times that an update sees each window, each time augmented afresh.
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
        with _in_single_precision(logits):
            if self._anytime:
                return anytime_loss(logits, labels, self._smoothing, self.model.network.lag)
            return last_loss(logits, labels, self._smoothing)


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
        hidden, out = _scaled(CONTRASTED[0], width), _scaled(CONTRASTED[1], width, LEAST)
        self.neck = nn.Sequential(
            nn.Linear(features, hidden),
            nn.BatchNorm1d(hidden),
            nn.ReLU(),
            nn.Linear(hidden, out),
            nn.BatchNorm1d(out),
        )

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        first, second = (self.neck(self.embedding(v, generator)) for v in views)
        with _in_single_precision(first):
            return nt_xent(_of_all_devices(first), _of_all_devices(second))


def _of_all_devices(rows: Tensor) -> Tensor:
    """The rows of every device's share of the batch: more negatives than one's own."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return rows
    from torch.distributed.nn.functional import all_gather  # keeps the gradient

    return torch.cat(all_gather(rows))


class SimSiam(Objective):
    """A projector of three layers, a predictor with a bottleneck, and a stopped gradient."""

    views = 2

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        width, features = model.network.config.width, model.feature_size()
        out, hidden = _scaled(PROJECTED, width), _scaled(BOTTLENECK, width)
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
        with _in_single_precision(first):
            return 0.5 * (_distance(predicted[0], second) + _distance(predicted[1], first))


def _distance(prediction: Tensor, target: Tensor) -> Tensor:
    """Negative cosine similarity, the target taken as given; (batch, feature) each -> scalar."""
    return -F.cosine_similarity(prediction.float(), target.detach().float(), dim=1).mean()


class Autoencoder(Objective):
    """Three deconvolutions from a single site to the grid, all steps of the window as channels.

    loss = 0.5 mean squared error of the (normalised) frames + 1e-4 |features|_1

    The paper gives the number of layers and the two weights; sizes are ours.
    """

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        inputs, network = model.inputs, model.network
        sizes = (
            model.feature_size(),
            _scaled(WIDE, network.config.width),
            _scaled(NARROW, network.config.width),
            network.config.max_steps * network.config.frame[0],
        )
        rows, columns = (_kernels(cells) for cells in inputs.shape)
        self.decoder = nn.Sequential(
            nn.ConvTranspose2d(sizes[0], sizes[1], (rows[0], columns[0])),
            nn.ReLU(),
            nn.ConvTranspose2d(sizes[1], sizes[2], (rows[1], columns[1])),
            nn.ReLU(),
            nn.ConvTranspose2d(sizes[2], sizes[3], (rows[2], columns[2])),
        )

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        (loads,) = views
        frames = self.frames(loads, generator)
        latent = self.model.features(frames)[:, -1]
        rebuilt = self.decoder(latent[:, :, None, None]).view(frames.shape)
        with _in_single_precision(frames):
            error = F.mse_loss(rebuilt.float(), frames.float())
            return 0.5 * error + SPARSITY * latent.float().abs().sum(1).mean()


def _kernels(cells: int) -> tuple[int, int, int]:
    """Kernel sizes of three valid deconvolutions that grow one site to so many cells."""
    grow = cells - 1
    return 1 + grow // 3, 1 + (grow + 1) // 3, 1 + (grow + 2) // 3


def _in_single_precision(like: Tensor) -> torch.autocast:
    """Where losses are computed: mixed precision ends at the network's output."""
    return torch.autocast(like.device.type, enabled=False)


def _scaled(size: int, width: float, least: int = 1) -> int:
    """A layer's size at the network's width."""
    return max(round(size * width), least)
