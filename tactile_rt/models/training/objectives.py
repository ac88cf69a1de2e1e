"""Objectives of a training: classification, contrast of two views, reconstruction, prediction.

An objective is a module that holds the network and the objective's own heads, which are discarded
after the training.

    objective(views, labels, generator) -> loss

`views` are `Objective.views` batches of loads (samples, offset, sigma), one or two, the input of
`TactileClassifier`. Only the supervised objective uses labels: classes (batch,), or classes, kinds
and objects (batch, 3). Two methods share the work: `see` computes the augmented frames, with draws
from the generator, and `loss` computes the loss, with no random draws but dropout.

- `Supervised`: cross-entropy of the category and of the kind within it, and a supervised
  contrast between objects (Khosla et al. 2020).
- `SimCLR` (Chen et al. 2020): each view of a window must be matched with the other view.
- `SimSiam` (Chen and He 2021): one view predicts the other, whose gradient is stopped.
- `Autoencoder` (Olshausen and Field 1996): sparse features of each step reconstruct its frame.
- `Predictive` (autoregressive predictive coding, Chung et al. 2019): the features of each step
  predict the frames of later steps.

At width 1 the heads and losses are those of the paper's code (neuroagents-lab,
2025-tactile-whisking).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.augmentation import Augmentation, Loads, build
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.ead import TactileClassifier
from tactile_rt.models.encoders.graph_encoder import GraphEncoder, draw_as_published
from tactile_rt.models.training.config import TrainingConfig

# Sizes of the heads, at width 1.
CONTRASTED = (2048, 128)  # SimCLR's neck: hidden and output
LEAST = 32  # smallest output of the neck: fewer dimensions cannot separate a batch
PROJECTED, BOTTLENECK = 2048, 512  # SimSiam's projector and predictor
NECK_SPREAD = 0.01  # standard deviation of the neck's initial weights
DECONVOLUTIONS = 3
PREDICTED = 4  # steps ahead that `Predictive` predicts
OUTSIDE = -1e4  # the logit of a kind of another class
SPARSITY = 1e-4  # of the autoencoder: weight of the mean of |features|


def build_objective(config: TrainingConfig, training: SweepSet) -> "Objective":
    """Build the objective of a configuration, with its network.

    Raises:
        ConfigError: the network is invalid, or the augmentation does not suit the array.
    """
    manifest = training.manifest
    kinds = manifest.kinds if config.names else {}
    names = sum(map(len, kinds.values()))
    network = config.network(len(training.classes), manifest.frame, names)
    model = TactileClassifier(manifest.spec, network, manifest.limits)
    if config.first_weights == "paper" and isinstance(model.network.encoder, GraphEncoder):
        draw_as_published(model.network.encoder)
    augmentation = build(config.augmentation, manifest.spec, config.masking)
    if config.labelled:
        objects = training.sweeps.objects
        if config.identity and len(set(objects.tolist())) == len(objects):
            raise ConfigError(
                f"identity: no object of {config.data} has two sweeps: make more of each"
            )
        class_of = [manifest.categories.index(c) for c in kinds for _ in kinds[c]]
        return Supervised(
            model, augmentation, config.loss, config.label_smoothing, class_of,
            config.names, config.identity, config.temperature,
        )  # fmt: skip
    model.network.decoder.requires_grad_(False)  # self-supervised objectives do not use it
    if config.objective == "simclr":
        return SimCLR(model, augmentation, config.temperature)
    others = {"simsiam": SimSiam, "autoencoder": Autoencoder, "predictive": Predictive}
    return others[config.objective](model, augmentation)


class Objective(nn.Module):
    """Base class of objectives: a network, the augmentation of its input, and its loss.

    Attributes:
        views: The number of differently augmented views of each window in an update.
    """

    views = 1

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__()
        self.model = model
        self.augmentation = augmentation

    def frames(self, loads: Loads, generator: Generator) -> Tensor:
        """Compute augmented frames (batch, step, sub-step * channel, row, column) from loads."""
        return self.augmentation.frames(self.model.inputs(*loads), generator)

    def embedding(self, frames: Tensor) -> Tensor:
        """Map frames (batch, step, ...) to one feature vector per window (batch, feature).

        The features are the attender's output in the last step or, if the network's readout is
        "mean", its mean over all steps that an input has reached.
        """
        features = self.model.features(frames)
        network = self.model.network
        if network.config.readout == "mean":
            return features[:, network.lag :].mean(dim=1)
        return features[:, -1]

    def see(self, views: Sequence[Loads], generator: Generator) -> list[Tensor]:
        """Compute the input of `loss`: the augmented frames of every view.

        Args:
            views: `self.views` batches of loads, SI.
        """
        mask = self.augmentation.mask
        return [mask(self.frames(view, generator), generator) for view in views]

    def loss(self, seen: Sequence[Tensor], labels: Tensor) -> Tensor:
        """Compute the loss of a batch, given the result of `see` and labels (batch,)."""
        raise NotImplementedError

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        """Compute the loss of a batch, with arguments as for `see` and `loss`."""
        return self.loss(self.see(views, generator), labels)


def anytime_loss(logits: Tensor, labels: Tensor, smoothing: float, lag: int) -> Tensor:
    """Average the last step's cross-entropy and the mean cross-entropy from step `lag` on.

    logits (batch, step, class), labels (batch,) -> scalar. The first `lag` steps, which no input
    has reached, would only teach the prior. A window with label -1 has no loss.
    """
    steps = logits[:, lag:]
    n = steps.shape[1]
    each = F.cross_entropy(
        steps.flatten(0, 1).float(),
        labels[:, None].expand(-1, n).flatten(),
        reduction="none",
        ignore_index=-1,
        label_smoothing=smoothing,
    ).view(-1, n)
    return 0.5 * each[:, -1].mean() + 0.5 * each.mean()


def last_loss(logits: Tensor, labels: Tensor, smoothing: float) -> Tensor:
    """Return the last step's cross-entropy (the paper); shapes as in `anytime_loss`."""
    each = F.cross_entropy(
        logits[:, -1].float(), labels, reduction="none", ignore_index=-1, label_smoothing=smoothing
    )
    return each.mean()


def identity_loss(embedding: Tensor, objects: Tensor, temperature: float) -> Tensor:
    """Return the supervised contrastive loss of embeddings by object (Khosla et al. 2020).

    embedding (n, unit) of unit norm, objects (n,) numbers, -1 for no object -> scalar, the mean
    over rows whose object has another row. Cosines are divided by the temperature.
    """
    itself = torch.eye(len(objects), dtype=torch.bool, device=objects.device)
    same = (objects[:, None] == objects) & (objects >= 0) & ~itself
    similarity = (embedding @ embedding.T / temperature).masked_fill(itself, float("-inf"))
    found = torch.where(same, F.log_softmax(similarity, dim=1), 0.0).sum(dim=1)
    others = same.sum(dim=1)
    return -(found / others.clamp(min=1)).sum() / (others > 0).sum().clamp(min=1)


class Supervised(Objective):
    """Supervised objective: classes and, with labels (batch, 3), kinds and objects.

    Args:
        loss: "anytime" or "last".
        class_of: (name,) the class of each kind; a kind competes only with kinds of its class.
        names, identity: weights of the losses of kinds and of objects.
        temperature: temperature of the loss of objects.
    """

    class_of: Tensor

    def __init__(
        self,
        model: TactileClassifier,
        augmentation: Augmentation,
        loss: str,
        smoothing: float,
        class_of: Sequence[int] = (),
        names: float = 0.0,
        identity: float = 0.0,
        temperature: float = 0.1,
    ) -> None:
        super().__init__(model, augmentation)
        self._anytime, self._smoothing = loss == "anytime", smoothing
        self._names, self._identity, self._temperature = names, identity, temperature
        self.register_buffer("class_of", torch.tensor(class_of, dtype=torch.int64), False)

    def loss(self, seen: Sequence[Tensor], labels: Tensor) -> Tensor:
        (frames,) = seen
        network = self.model.network
        answers = network.answer(frames)
        with _in_single_precision(answers):
            found = network.split(answers.float())
            if labels.dim() == 1:
                return self._cross_entropy(found["logits"], labels, self._smoothing)
            classes, names, objects = labels.unbind(1)
            loss = self._cross_entropy(found["logits"], classes, self._smoothing)
            if "names" in found:
                inside = classes[:, None] == self.class_of  # (batch, name)
                own = found["names"].masked_fill(~inside[:, None], OUTSIDE)
                share = (names >= 0).float().mean().clamp(min=1 / len(names))
                loss = loss + self._names * self._cross_entropy(own, names, 0.0) / share
            if self._identity:
                rows = torch.cat([found["embedding"][:, -1], objects[:, None].float()], dim=1)
                rows = _gather_rows(rows)
                contrast = identity_loss(rows[:, :-1], rows[:, -1], self._temperature)
                loss = loss + self._identity * contrast
            return loss

    def _cross_entropy(self, logits: Tensor, labels: Tensor, smoothing: float) -> Tensor:
        if self._anytime:
            return anytime_loss(logits, labels, smoothing, self.model.network.lag)
        return last_loss(logits, labels, smoothing)


def nt_xent(first: Tensor, second: Tensor, temperature: float) -> Tensor:
    """Return the NT-Xent loss of SimCLR: the cross-entropy of matching two views of windows.

    first, second (n, feature): the two views of each of n windows -> scalar. Cosines are divided by
    the temperature.
    """
    z = F.normalize(torch.cat([first, second]).float(), dim=1)
    n = len(first)
    similarity = (z @ z.T / temperature).fill_diagonal_(float("-inf"))
    partner = torch.arange(2 * n, device=z.device).roll(n)
    return F.cross_entropy(similarity, partner)


class SimCLR(Objective):
    """SimCLR objective: two views of a sweep must agree after a projection head, the neck.

    The neck (Linear, BN, ReLU, Linear, BN) is discarded after training. Both views form one batch,
    also for batch norms.
    """

    views = 2

    def __init__(
        self, model: TactileClassifier, augmentation: Augmentation, temperature: float
    ) -> None:
        super().__init__(model, augmentation)
        self._temperature = temperature
        width, features = model.network.config.width, model.network.feature_size
        hidden, out = _scale(CONTRASTED[0], width), _scale(CONTRASTED[1], width, LEAST)
        self.neck = _stack(features, hidden, out, bias=False)
        for layer in self.neck:
            if isinstance(layer, nn.Linear):
                nn.init.normal_(layer.weight, std=NECK_SPREAD)

    def loss(self, seen: Sequence[Tensor], labels: Tensor) -> Tensor:
        first, second = self.neck(self.embedding(torch.cat(list(seen)))).chunk(2)
        with _in_single_precision(first):
            return nt_xent(_gather_rows(first), _gather_rows(second), self._temperature)


def _gather_rows(rows: Tensor) -> Tensor:
    """Concatenate the rows of all devices' shares of a batch, for more negative pairs."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return rows
    gathered: Tensor = _GatheredRows.apply(rows)  # type: ignore[no-untyped-call]
    return gathered


class _GatheredRows(torch.autograd.Function):
    """Concatenation of all devices' rows, with gradients summed over the devices' losses."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor) -> Tensor:
        parts = [torch.empty_like(rows) for _ in range(torch.distributed.get_world_size())]
        torch.distributed.all_gather(parts, rows.contiguous())
        return torch.cat(parts)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        total = slope.clone(memory_format=torch.contiguous_format)
        torch.distributed.all_reduce(total)
        return total.chunk(torch.distributed.get_world_size())[torch.distributed.get_rank()]


class SimSiam(Objective):
    """SimSiam objective: a projector, a predictor with a bottleneck, and a stopped gradient."""

    views = 2

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        width, features = model.network.config.width, model.network.feature_size
        out, hidden = _scale(PROJECTED, width), _scale(BOTTLENECK, width)
        self.projector = _stack(features, out, out, out)
        self.predictor = nn.Sequential(*_stack(out, hidden), nn.ReLU(), nn.Linear(hidden, out))

    def loss(self, seen: Sequence[Tensor], labels: Tensor) -> Tensor:
        first, second = (self.projector(self.embedding(frames)) for frames in seen)
        predicted = self.predictor(first), self.predictor(second)
        with _in_single_precision(first):
            return 0.5 * (_distance(predicted[0], second) + _distance(predicted[1], first))


def _distance(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the mean negative cosine similarity. Both are (batch, feature); no gradient flows into
    the target.
    """
    return -F.cosine_similarity(prediction.float(), target.detach().float(), dim=1).mean()


class Autoencoder(Objective):
    """Autoencoder objective: a linear layer and three 3 x 3 deconvolutions rebuild each frame.

    loss = 0.5 mean squared error of the (normalised) frames + 1e-4 mean |features|
    """

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        features, (channels, *grid) = model.network.feature_size, model.network.config.frame
        cells = grid[0] * grid[1]
        first = min(channels, features // cells + 1)
        layers: list[nn.Module] = [nn.Linear(features, first * cells)]
        layers.append(nn.Unflatten(1, (first, *grid)))
        for n in range(DECONVOLUTIONS):
            layers += [nn.ReLU()] if n else []
            layers.append(nn.ConvTranspose2d(channels if n else first, channels, 3, padding=1))
        self.decoder = nn.Sequential(*layers)

    def loss(self, seen: Sequence[Tensor], labels: Tensor) -> Tensor:
        (frames,) = seen
        latent = self.model.features(frames)
        rebuilt = self.decoder(latent.flatten(0, 1)).view(frames.shape)
        with _in_single_precision(frames):
            error = F.mse_loss(rebuilt.float(), frames.float())
            return 0.5 * error + SPARSITY * latent.float().abs().mean()


class Predictive(Objective):
    """Predictive objective: a linear layer predicts the next four frames from each step's features.

    A causal network reads no later steps, so the targets are hidden; masked steps are predicted
    too. The loss is the mean squared error of the normalised frames, over all predictions within
    the window from steps that an input has reached.
    """

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        channels, rows, columns = model.network.config.frame
        self.head = nn.Linear(model.network.feature_size, PREDICTED * channels * rows * columns)

    def see(self, views: Sequence[Loads], generator: Generator) -> list[Tensor]:
        """Compute the frames to predict, and the masked frames that the network reads."""
        (frames,) = (self.frames(view, generator) for view in views)
        return [frames, self.augmentation.mask(frames, generator)]

    def loss(self, seen: Sequence[Tensor], labels: Tensor) -> Tensor:
        frames, shown = seen  # (batch, step, channel, row, column) each
        predicted = self.head(self.model.features(shown)).unflatten(-1, (PREDICTED, -1))
        flat, first = frames.flatten(2), self.model.network.lag
        with _in_single_precision(frames):
            errors = [
                (predicted[:, first:-n, n - 1].float() - flat[:, first + n :].float()).square()
                for n in range(1, PREDICTED + 1)
            ]
            return torch.cat(errors, dim=1).mean()


def _in_single_precision(like: Tensor) -> torch.autocast:
    """Return a context without autocast, to compute losses in single precision."""
    return torch.autocast(like.device.type, enabled=False)


def _stack(*sizes: int, bias: bool = True) -> nn.Sequential:
    """Build linear layers of these sizes, each with batch norm, and ReLUs between them."""
    layers: list[nn.Module] = []
    for of, to in pairwise(sizes):
        layers += [nn.Linear(of, to, bias), nn.BatchNorm1d(to), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def _scale(size: int, width: float, least: int = 1) -> int:
    """Return a layer's size scaled by the network's width, at least `least`."""
    return max(round(size * width), least)
