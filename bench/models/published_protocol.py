"""What `protocol` computes, by the published code itself, of which `published` tells.

Their classes are used as they are. Where one draws at random, what it draws is told to it, and
`drawn_view` and `drawn_pictures` draw from a seed as it does.
"""

import random
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from bench.models.protocol import (
    CELL_NAMES,
    DECAY,
    EPOCHS,
    FEATURES,
    LOSSES,
    PICTURES,
    RATE,
    SHAPES,
    UPDATES,
    VIEWS,
    WARMUP,
    cell,
    fixed,
    loss,
    windows,
)
from bench.models.published import GATES, NORMS
from tactile_rt.models.published_pictures import Draw
from tactile_rt.models.training.objectives import Objective

CELLS = {
    "timedecay": "TimeDecayRecurrentCell", "vanilla": "VanillaRNNCell", "ugrnn": "UGRNNCell",
    "intersection": "IntersectionRNNCell", "gru": "GRUCell", "lstm": "LSTMCell",
}  # fmt: skip


def computed_by_theirs() -> dict[str, list[Tensor]]:
    """As `protocol.computed`, by their code."""
    found = {
        f"cell {name}": [cell(name, lambda own, maps, name=name: their_cell(own, name, maps))]
        for name in CELL_NAMES
    }
    found |= {f"view {k}": [their_view(*drawn)] for k, drawn in enumerate(VIEWS)}
    found |= {f"picture {k}": [their_pictures(drawn)] for k, drawn in enumerate(PICTURES)}
    for name in LOSSES:
        value, gradients = loss(name, lambda o, said, x, name=name: their_loss(name, o, said, x))
        found[f"loss {name}"] = [value, *gradients]
    found["lars"] = their_moved()
    schedules = ("step", "constant", "cosine", "cosine-annealing")
    found |= {f"rates {s}": [torch.from_numpy(their_rates(s))] for s in schedules}
    return found


def their_cell(ours: nn.Module, name: str, maps: list[Tensor]) -> list[Tensor]:
    """Outputs (batch, channel, row, column) of their cell with our weights, step by step."""
    from pt_tnn import recurrent_cells

    which = name.partition("-")[0]
    kind, norms = CELLS[which], NORMS.get(which, ("ln",))
    channels = maps[0].shape[1]
    normal = "-ln" in name
    cell = getattr(recurrent_cells, kind)(
        input_in_channels=channels, out_channels=channels, ksize=[2, 2], layernorm=normal
    ).double()
    weights: dict[str, Any] = dict(ours.named_parameters())
    theirs = dict(cell.named_parameters())
    with torch.no_grad():
        if "tau" in weights:
            theirs["tau"].copy_(weights["tau"])
        elif kind == "VanillaRNNCell":
            parts = weights["conv.weight"].movedim(-1, 1).split(channels, 1)
            for part, weight in zip(("input", "state"), parts, strict=True):
                theirs[f"conv_{part}.weight"].copy_(weight)
            theirs["conv_input.bias"].copy_(weights["conv.bias"])
            theirs["conv_state.bias"].zero_()
        else:
            for ending in ("weight", "bias"):
                chunks = weights[f"conv.{ending}"].chunk(len(GATES[which]))
                joined = torch.cat([chunks[g] for g in np.argsort(GATES[which])])
                joined = joined.movedim(-1, 1) if ending == "weight" else joined
                theirs[f"conv{'_ru' if kind == 'GRUCell' else ''}.{ending}"].copy_(joined)
            if kind == "GRUCell":
                theirs["conv_c.weight"].copy_(weights["candidate.weight"].movedim(-1, 1))
                theirs["conv_c.bias"].copy_(weights["candidate.bias"])
        for row, norm in enumerate(norms if normal else ()):
            theirs[f"{norm}.weight"].copy_(weights["gamma"][row])
            theirs[f"{norm}.bias"].copy_(weights["beta"][row])
        out, state = [], None
        for x in maps:
            h, state = cell(x, state)
            out.append(h)
    return out


def their_view(axis: int, turns: int, reverse: int) -> Tensor:
    """Their augmentation of `windows`, told what to draw."""
    from torchvision.transforms import functional as F
    from utils.input_transform import Random90Rotation, RandomTemporalFlip

    x = windows()
    if axis:
        x = F.hflip(x) if axis == -1 else F.vflip(x)
    x = Random90Rotation(multipliers=(turns or 4,))(x)
    steps = x.unflatten(2, (-1, 6)).flatten(1, 2)  # (batch, sub-step, channel, row, column)
    steps = RandomTemporalFlip(dims=[1], p=float(reverse) or -1.0)(steps)
    found: Tensor = steps.unflatten(1, (x.shape[1], -1)).flatten(2, 3)
    return found


def drawn_view(seed: int) -> tuple[tuple[int, int, int], Tensor]:
    """What their augmentation draws from a seed, and what it makes of `windows`."""
    from utils.input_transform import SSLTransform

    _seed(seed)
    axis = -1 if torch.rand(1) < 0.5 else -2
    axis = axis if torch.rand(1) < 0.5 else 0
    turns = random.choices(range(1, 5))[0] % 4
    torch.rand(1)  # of the angle's interval, which has no width
    reverse = int(torch.rand(1) < 0.5)
    _seed(seed)
    return (axis, turns, reverse), SSLTransform(use_temporal=True)(windows())


def their_pictures(done: Draw) -> Tensor:
    """Their operations on pictures, applied to `windows`, told what to draw."""
    from torchvision.transforms import functional as F

    frames = windows()
    x = frames.unflatten(2, (-1, 3)).flatten(0, 2)  # (picture, colour, row, column)
    if done.mirrored:
        x = F.hflip(x)
    change = F.adjust_brightness, F.adjust_contrast, F.adjust_saturation, F.adjust_hue
    for what in done.order:
        x = change[what](x, done.by[what])
    if done.grey:
        x = F.rgb_to_grayscale(x, num_output_channels=3)
    if done.sigma:
        x = F.gaussian_blur(x, [3, 3], [done.sigma, done.sigma])
    return x.reshape(frames.shape)


def drawn_pictures(seed: int, weak: bool) -> tuple[Draw, Tensor]:
    """What their transform of pictures draws from a seed, and what it makes of `windows`."""
    from utils.input_transform import SimCLRTransform, SimSiamTransform

    strength, hue = (0.4, 0.1) if weak else (0.8, 0.2)

    def even(low: float, high: float) -> float:
        return float(torch.empty(1).uniform_(low, high))

    _seed(seed)
    mirrored = bool(torch.rand(1) < 0.5)
    order: tuple[int, ...] = ()
    by = 1.0, 1.0, 1.0, 0.0
    if not torch.rand(1) > 0.8:
        order = tuple(torch.randperm(4).tolist())
        factors = [even(max(0.0, 1 - strength), 1 + strength) for _ in range(3)]
        by = factors[0], factors[1], factors[2], even(-hue, hue)
    grey = bool(torch.rand(1) < 0.2)
    sigma = 0.0 if torch.rand(1) > 0.5 else even(0.1, 2.0)
    _seed(seed)
    made = (SimSiamTransform if weak else SimCLRTransform)()(windows())
    return Draw(mirrored, order, by, grey, sigma), made


def their_loss(name: str, objective: Objective, said: Tensor, frames: Tensor) -> Tensor:
    """Their loss of features (batch, step, feature), with the weights of our heads."""
    import loss_functions

    said = said[: len(frames)] if name == "autoencoder" else said[:, -1]
    if name == "autoencoder":
        channels, rows, columns = frames.shape[2:]
        theirs = loss_functions.AutoEncoderLoss(FEATURES, channels, rows, columns)
        layers = [theirs.decoder.fc, *theirs.decoder.deconv]
        own = [layer for layer in objective.decoder if not isinstance(layer, nn.Unflatten)]
        _copied(own, layers)
        loss: Tensor = theirs.train()(said, frames)
        return loss
    first, second = said.chunk(2)
    if name == "simclr":
        theirs = loss_functions.SimCLRLoss(FEATURES)
        neck = theirs.neck
        _copied([m for m in objective.neck if not isinstance(m, nn.ReLU)],
                [neck.fc0, neck.bn0, neck.fc1, neck.bn1])  # fmt: skip
        loss = theirs.train()(torch.stack([first, second], 1).flatten(0, 1))
        return loss
    theirs = loss_functions.SimSiamLoss(FEATURES)
    projector, predictor = theirs.projection_mlp, theirs.prediction_mlp
    layers = [*projector.layer1, *projector.layer2, *projector.layer3]
    _copied([*objective.projector, *objective.predictor],
            [*layers, *predictor.layer1, predictor.layer2])  # fmt: skip
    loss = theirs.train()(first, second)
    return loss


def _copied(own: list[nn.Module], theirs: list[nn.Module]) -> None:
    for mine, other in zip(own, theirs, strict=True):
        other.load_state_dict(mine.state_dict())


def their_moved() -> list[Tensor]:
    """Parameters after some updates of their LARS; to them each row of a norm is a tensor."""
    from utils.optimizer import LARS

    parameters: dict[str, list[nn.Parameter]] = {}
    for n, (name, shape) in enumerate(SHAPES.items()):
        whole = fixed(shape, 8, n)
        parameters[name] = [nn.Parameter(p) for p in (whole if name == "gamma" else [whole])]
    every = [p for parts in parameters.values() for p in parts]
    optimizer = LARS(every, lr=RATE, momentum=0.9, weight_decay=DECAY)
    for update in range(UPDATES):
        for n, (name, parts) in enumerate(parameters.items()):
            gradient = fixed(SHAPES[name], 9, n, update)
            for part, slope in zip(parts, gradient if name == "gamma" else [gradient], strict=True):
                part.grad = slope
        optimizer.step()
    with torch.no_grad():
        return [torch.stack(list(p)) if k == "gamma" else p[0] for k, p in parameters.items()]


def their_rates(schedule: str) -> NDArray[np.float64]:
    """(epoch,) the rate of each epoch by their schedules."""
    from utils import lr_scheduler

    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], RATE)
    if schedule == "cosine-annealing":
        # Not by its constructor, which tells torch of an argument that newer ones do not take.
        theirs = object.__new__(lr_scheduler.CosineAnnealingWarmupScheduler)
        settings = {"num_epochs": EPOCHS, "initial_lr": RATE, "min_lr": 0.0}
        theirs.__dict__ |= {**settings, "warmup_epochs": WARMUP, "warmup_ratio": 1e-4}
        theirs.optimizer = optimizer
        found = []
        for epoch in range(EPOCHS):
            theirs.last_epoch = epoch
            found.append(theirs.get_lr()[0])
        return np.array(found)
    make: Any = {
        "step": lambda: torch.optim.lr_scheduler.StepLR(optimizer, step_size=30),
        "constant": lambda: torch.optim.lr_scheduler.ConstantLR(optimizer, 1.0, EPOCHS),
        "cosine": lambda: lr_scheduler.get_cosine_schedule_with_warmup(optimizer, WARMUP, EPOCHS),
    }[schedule]
    scheduler, found = make(), []
    for _ in range(EPOCHS):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return np.array(found)


def _seed(seed: int) -> None:
    torch.manual_seed(seed)
    random.seed(seed)
