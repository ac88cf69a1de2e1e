"""The paper's protocol on fixed inputs, as our code computes it: cells, views, losses, rates.

`peer` computes the same with the published code, compares, and stores figures of it in
``tests/models/data/published.json``, by which the tests know that nothing has changed since.
"""

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactile_rt.models.augmentation import Augmentation, augment_as_published
from tactile_rt.models.encoders.cells import CELLS
from tactile_rt.models.published_pictures import Draw, as_drawn
from tactile_rt.models.training.config import SCHEDULES, TrainingConfig
from tactile_rt.models.training.objectives import Autoencoder, Objective, SimCLR, SimSiam
from tactile_rt.models.training.updates import LARS, build_schedule

EPSILON = 1e-5  # of their layer norms: torch's own
OURS = ("timedecay-ln", "vanilla", "vanilla-ln", "lstm-ln")  # cells that their code has not
CELL_NAMES = tuple(name for name in CELLS if name not in OURS)
CHANNELS, STEPS, ROWS, COLUMNS = 4, 6, 4, 6  # of a cell on trial
BATCH, WINDOW, FRAME, FEATURES = 6, 22, (30, 5, 7), 512
VIEWS = [(axis, turns, reverse) for axis in (0, -1, -2) for turns in range(4) for reverse in (0, 1)]
PICTURES = [
    Draw(
        mirrored=bool(k % 2),
        order=tuple(np.random.default_rng([7, k]).permutation(4).tolist()) if k % 5 else (),
        by=(0.3 + 0.12 * k, 1.7 - 0.1 * k, 0.25 + 0.1 * k, 0.03 * (k - 6)),
        grey=k % 4 == 3,
        sigma=0.0 if k % 3 else 0.1 + 0.15 * k,
    )
    for k in range(12)
]
LOSSES: dict[str, Callable[..., Objective]] = {
    "simclr": partial(SimCLR, temperature=0.1), "simsiam": SimSiam, "autoencoder": Autoencoder,
}  # fmt: skip
SHAPES = {"weight": (4, 3), "bias": (4,), "gamma": (2, 5)}  # of parameters that LARS moves
RATE, DECAY, UPDATES = 0.1, 1e-4, 5
EPOCHS, WARMUP = 100, 10


def fixed(shape: tuple[int, ...], *seed: int) -> Tensor:
    """Normal numbers in double precision, the same with every release of torch."""
    return torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))


def digest(values: NDArray[np.float64]) -> list[float]:
    """Eight numbers of the size of the values that tell any change of them."""
    flat = values.astype(np.float64).ravel()
    weights = np.random.default_rng(len(flat)).standard_normal((8, len(flat)))
    found: list[float] = (weights @ flat / np.sqrt(len(flat))).tolist()
    return found


def cell(name: str, run: Callable[[nn.Module, list[Tensor]], list[Tensor]] | None = None) -> Tensor:
    """(step, batch, channel, row, column) outputs of a cell with fixed weights.

    Args:
        name: one of `CELL_NAMES`.
        run: computes them otherwise, of our cell and maps (batch, channel, row, column).
    """
    made = CELLS[name](CHANNELS).double()
    made.epsilon = EPSILON
    with torch.no_grad():
        for k, parameter in enumerate(made.parameters()):
            parameter.copy_(0.5 * fixed(tuple(parameter.shape), 1, k))
        maps = [fixed((2, CHANNELS, ROWS, COLUMNS), 2, t) for t in range(STEPS)]
        if run is not None:
            return torch.stack(run(made, maps))
        state = tuple(torch.zeros(ROWS, COLUMNS, 2, CHANNELS).double() for _ in made.states)
        out = []
        for x in maps:
            h, state = made(x.permute(2, 3, 0, 1), state)
            out.append(h.permute(2, 3, 0, 1))
        return torch.stack(out)


def windows() -> Tensor:
    """(batch, step, channel, row, column) frames, some of them beyond what pictures have."""
    return (0.4 + 0.4 * fixed((3, WINDOW, *FRAME), 3)).float()


def view(axis: int, turns: int, reverse: int) -> Tensor:
    """What the published augmentation makes of `windows` once it has drawn this."""
    return augment_as_published(windows(), axis, turns, bool(reverse))


def pictures(draw: Draw) -> Tensor:
    """What the published image augmentation makes of `windows`."""
    return as_drawn(windows(), draw)


def features() -> Tensor:
    """(batch, step, feature) what an encoder might say, of two views one after the other."""
    return fixed((2 * BATCH, WINDOW, FEATURES), 4).float()


class _Known(nn.Module):
    """In the place of a classifier: its features are known, its frames are its loads."""

    def __init__(self) -> None:
        super().__init__()
        config = SimpleNamespace(width=1.0, readout="last", frame=FRAME)
        self.network = SimpleNamespace(config=config, lag=0, feature_size=FEATURES)
        self.said: list[Tensor] = []

    def inputs(self, samples: Tensor, *_: Tensor) -> Tensor:
        return samples

    def features(self, frames: Tensor) -> Tensor:
        return self.said.pop(0)


def loss(
    name: str, run: Callable[[Objective, Tensor, Tensor], Tensor] | None = None
) -> tuple[Tensor, list[Tensor]]:
    """A self-supervised loss in training mode, heads with fixed weights, and its gradients.

    Args:
        name: one of `LOSSES`.
        run: computes it otherwise, of our objective, the features and the frames.
    """
    model = _Known()
    objective = LOSSES[name](model, Augmentation(lambda x, _: x, lambda x, _: x))
    with torch.no_grad():
        for k, parameter in enumerate(objective.parameters()):
            inputs = parameter[0].numel()
            parameter.copy_(inputs**-0.5 * fixed(tuple(parameter.shape), 5, k))
    objective.train()
    said = features().requires_grad_()
    frames = fixed((BATCH, WINDOW, *FRAME), 6).float()
    if run is not None:
        value = run(objective, said, frames)
    else:
        model.said = {
            "simclr": [said], "simsiam": list(said.chunk(2)), "autoencoder": [said[:BATCH]],
        }[name]  # fmt: skip
        views = [(frames, frames, frames)] * objective.views
        value = objective(views, torch.zeros(BATCH), torch.Generator())
    (gradient,) = torch.autograd.grad(value, said)
    return value.detach(), [gradient]


def moved(published: bool = True) -> list[Tensor]:
    """Parameters after some updates of LARS, by the names of `SHAPES`."""
    named = {k: nn.Parameter(fixed(s, 8, n)) for n, (k, s) in enumerate(SHAPES.items())}
    groups = [
        {"params": [named["weight"], named["bias"]]},
        {"params": [named["gamma"]], "stacked": True},
    ]
    optimizer = LARS(groups, RATE, weight_decay=DECAY, published=published)
    for update in range(UPDATES):
        for n, (name, parameter) in enumerate(named.items()):
            parameter.grad = fixed(SHAPES[name], 9, n, update)
        optimizer.step()
    return [parameter.detach() for parameter in named.values()]


def rates(schedule: str) -> NDArray[np.float64]:
    """(epoch,) the rate of each epoch of a run of three updates an epoch."""
    assert schedule in SCHEDULES
    config = TrainingConfig(
        "", schedule=schedule, rate_per="epoch", learning_rate=RATE, warmup=WARMUP / EPOCHS,
        drop_every=0.3, epochs=EPOCHS,
    )  # fmt: skip
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))], RATE)
    scheduler = build_schedule(optimizer, config, 3 * EPOCHS, 3)
    found = []
    for _ in range(3 * EPOCHS):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    by_epoch = np.array(found).reshape(EPOCHS, 3)
    assert (by_epoch == by_epoch[:, :1]).all()
    return by_epoch[:, 0]


def computed() -> dict[str, list[Tensor]]:
    """All of it by our code, by names: what is stored of the published code goes by the same."""
    found = {f"cell {name}": [cell(name)] for name in CELL_NAMES}
    found |= {f"view {k}": [view(*drawn)] for k, drawn in enumerate(VIEWS)}
    found |= {f"picture {k}": [pictures(drawn)] for k, drawn in enumerate(PICTURES)}
    for name in LOSSES:
        value, gradients = loss(name)
        found[f"loss {name}"] = [value, *gradients]
    found["lars"] = moved()
    found |= {f"rates {s}": [torch.from_numpy(rates(s))] for s in SCHEDULES if s != "one-cycle"}
    return found
