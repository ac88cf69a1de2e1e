"""Which whiskers touch and where along them: one small recurrent network that every whisker runs.

It sees one whisker's own loads and that whisker's shape, nothing of the neighbours. Distances are
learnt relative to the whisker's length.
"""

import math
import pickle
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.classifier.contact_point import WhiskerShapes
from tactile_rt.errors import ConfigError, ModelError
from tactile_rt.files import write_whole
from tactile_rt.models.datasets import SweepSet
from tactile_rt.sensor_spec import CHANNEL_FLOOR
from tactile_rt.sweep_set import SweepManifest, contacts_of

__all__ = [
    "ContactConfig",
    "ContactNetwork",
    "Felt",
    "load_contacts",
    "predict_contacts",
    "tared",
    "train_contacts",
]

UNITS = ("N",) * 3 + ("N m",) * 3  # force, then moment
FLOOR = tuple(CHANNEL_FLOOR[unit] for unit in UNITS)  # what the detector takes for least noise
FEWEST_AT_REST = 2  # samples that have a standard deviation
FAINT_N = 1e-6  # of force: below it the ratio of moment to force fades to nothing
SHARP = 20.0  # errors of distance beyond 1 / SHARP of the length count linearly (Huber)
MOST = {"hidden": 1024, "learning_rate": 1.0}  # beyond which nothing is learnt, or nothing fits
FEWEST_UPDATES = 11  # of a schedule: the rise to its peak, a tenth, must have a step
UNTOUCHED = 0.1  # of the whiskers that a sweep never touches, how many are learnt from

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ContactConfig:
    """How to train.

    Attributes:
        hidden: The number of units in the recurrent layer.
        epochs, batch: Passes over the training split, and whiskers (of one sweep each) per update.
        learning_rate: The peak of the learning rate, from which it falls to nothing along a cosine.
        seed: The seed of the weights, the order of the sweeps and the noise.

    Raises:
        ConfigError: a value that cannot be.
    """

    hidden: int = 48
    epochs: int = 12
    batch: int = 128
    learning_rate: float = 4e-3
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "epochs", "batch", "learning_rate"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, not {getattr(self, name)}")
        for name, most in MOST.items():
            if getattr(self, name) > most:
                raise ConfigError(f"{name} must be at most {most:g}, not {getattr(self, name)}")
        if not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed must be 0 to {2**32 - 1}, not {self.seed}")


class ContactNetwork(nn.Module):
    """Base loads to touch and distance, causal and step by step if wanted.

    Args:
        shapes: of the array's whiskers.
        hidden: units of the recurrent layer.
    """

    morphology: Tensor
    length: Tensor
    floor: Tensor

    def __init__(self, shapes: WhiskerShapes, hidden: int) -> None:
        super().__init__()
        self.shapes = shapes
        described = np.stack(
            [
                np.log(shapes.length / 0.01),
                shapes.curvature * shapes.length,
                np.log(shapes.base_radius / 3e-5),
                np.log(shapes.tip_radius / shapes.base_radius),
                np.log(shapes.young_modulus / 5e9),
            ],
            axis=1,
        )
        self.register_buffer("morphology", torch.tensor(described, dtype=torch.float32))
        self.register_buffer("length", torch.tensor(shapes.length, dtype=torch.float32))
        self.register_buffer("floor", torch.tensor(FLOOR))
        inputs = len(UNITS) + 2 + described.shape[1]
        self.enter = nn.Sequential(nn.Linear(inputs, hidden), nn.GELU())
        self.memory = nn.GRU(hidden, hidden, batch_first=True)
        self.leave = nn.Sequential(nn.Linear(2 * hidden, hidden), nn.GELU(), nn.Linear(hidden, 3))

    def forward(
        self, loads: Tensor, sigma: Tensor, element: Tensor, state: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Samples of several whiskers, each from rest or from where `state` left off.

        loads      (whisker, step, 6)   tared, N and N m
        sigma      (whisker, 6)         noise at rest, N and N m
        element    (whisker,)           int64, which of the array's
        state      (1, whisker, hidden)
        ->  logit of touching (whisker, step), distance as share of the length (whisker, step),
            state after the last step
        """
        scale = torch.sqrt(self.floor**2 + sigma**2).unsqueeze(1)
        squeezed = torch.sign(loads) * torch.log1p(loads.abs() / scale)
        length = self.length[element][:, None]
        # The estimate for a straight whisker: the network learns how far to trust it, and what to
        # add, which takes fewer epochs than to find it out.
        force, moment = loads[..., 1:3], loads[..., 4:6]
        across = moment[..., 1] * force[..., 0] - moment[..., 0] * force[..., 1]
        ratio = across / (force.square().sum(-1) + FAINT_N**2) / length
        steps = loads.shape[1]
        noise = torch.log(scale[..., :1] / self.floor[0]).expand(-1, steps, -1)
        shape = self.morphology[element].unsqueeze(1).expand(-1, steps, -1)
        seen = torch.cat([squeezed, ratio.clamp(-1.0, 2.0).unsqueeze(-1), noise, shape], dim=-1)
        now = self.enter(seen)
        past, state = self.memory(now, state)
        touch, trust, more = self.leave(torch.cat([now, past], dim=-1)).unbind(-1)
        classical = torch.logit(ratio.clamp(0.02, 0.98))
        return touch, torch.sigmoid(torch.sigmoid(trust) * classical + more), state


@dataclass(frozen=True)
class Felt:
    """Loads as a robot has them: noisy, and tared on the samples before the object came.

    Attributes:
        loads: (sweep, sample, element, 6) Tared forces and moments, N and N m.
        sigma: (sweep, element, 6) The noise at rest, one standard deviation, N and N m.
    """

    loads: Floats
    sigma: Floats


def tared(data: SweepSet, level: float = 0.0, seed: int = 0) -> Felt:
    """Add sensor noise and tare on the lead.

    Args:
        data: the sweeps.
        level: of the white noise, in units of the rated noise.
        seed: of the noise.
    """
    values = data.sweeps.values
    if not level:
        return Felt(values, np.zeros((len(values), *values.shape[2:]), dtype=np.float32))
    rng, lead = np.random.default_rng(seed), data.manifest.lead
    noise = data.noise * np.float32(level)
    values = values + rng.standard_normal(values.shape, dtype=np.float32) * noise
    quiet = values[:, :lead]
    return Felt(values - quiet.mean(axis=1, keepdims=True), quiet.std(axis=1, ddof=1))


def train_contacts(
    data: SweepSet,
    validation: SweepSet,
    shapes: WhiskerShapes,
    config: ContactConfig,
    checkpoint: Path,
    progress: Callable[[int, float, float], None] = lambda epoch, loss, error: None,
) -> ContactNetwork:
    """Train, keep the network of the best validation loss, and write it.

    Args:
        data, validation: splits with contacts.
        shapes: of the set's whiskers.
        config: how.
        checkpoint: file to write.
        progress: called after each epoch with its number, and training and validation losses.

    Raises:
        ConfigError: the set has no contacts, or another number of whiskers, or touches nothing.
    """
    truth, known = _shares(data, shapes), _shares(validation, shapes)
    torch.manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    network = ContactNetwork(shapes, config.hidden)
    touched = np.isfinite(truth).any(axis=1)  # (sweep, element)
    if not touched.any():
        raise ConfigError("no whisker touches anything in the training split: make more sweeps")
    rows = np.argwhere(touched | (rng.random(touched.shape) < UNTOUCHED))
    updates = config.epochs * (math.ceil(len(rows) / config.batch) + 2)
    optimizer = torch.optim.AdamW(network.parameters(), config.learning_rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        config.learning_rate,
        max(updates, FEWEST_UPDATES),
        pct_start=0.1,
        cycle_momentum=False,
    )
    every = np.argwhere(np.isfinite(known).any(axis=1))
    if not len(every):
        raise ConfigError("no whisker touches anything in the validation split: make more sweeps")
    held_out = [(tared(validation, level, seed=1), known) for level in (0.0, 1.0)]
    best = math.inf
    for epoch in range(config.epochs):
        # Half of the whiskers without noise, the others with this epoch's.
        level, halves = float(rng.uniform(0.1, 1.0)), np.array_split(rng.permutation(rows), 2)
        felt = (tared(data), tared(data, level, config.seed + epoch + 2))
        batches = [
            (which, at)
            for which, half in zip(felt, halves, strict=True)
            for at in np.array_split(half, max(1, math.ceil(len(half) / config.batch)))
            if len(at)
        ]
        losses = []
        for k in rng.permutation(len(batches)):
            which, at = batches[k]
            loss = _loss(network, which, truth, at)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            losses.append(float(loss.detach()))
        with torch.no_grad():
            errors = [float(_loss(network, which, t, every)) for which, t in held_out]
        error = float(np.mean(errors))
        progress(epoch + 1, float(np.mean(losses)), error)
        if error < best:
            best = error
            _save(network, data, shapes, config, checkpoint)
    if best == math.inf:
        raise ModelError(
            f"{checkpoint} is not written: no error on the validation sweeps was a number; try a "
            "lower learning rate"
        )
    return load_contacts(checkpoint, data)


def predict_contacts(network: ContactNetwork, felt: Felt) -> tuple[Floats, Floats]:
    """Probability of touching, and distance from the base (m): (sweep, sample, element) each."""
    sweeps, samples, elements, _ = felt.loads.shape
    touch = np.empty((sweeps, samples, elements), dtype=np.float32)
    share = np.empty_like(touch)
    every = torch.arange(elements)
    with torch.no_grad():
        for i in range(sweeps):
            loads = torch.from_numpy(felt.loads[i]).transpose(0, 1)
            logit, distance, _ = network(loads, torch.from_numpy(felt.sigma[i]), every)
            touch[i], share[i] = torch.sigmoid(logit).T.numpy(), distance.T.numpy()
    return touch, share * network.length.numpy()


def load_contacts(checkpoint: Path, data: SweepSet | None = None) -> ContactNetwork:
    """Read a trained network.

    Args:
        checkpoint: file that `train_contacts` wrote.
        data: if given, sweeps whose array must be the network's.

    Raises:
        ConfigError: not such a file, or another array's.
    """
    try:
        stored: dict[str, Any] = torch.load(checkpoint, weights_only=True)
        shapes = WhiskerShapes(**{k: v.numpy() for k, v in stored["shapes"].items()})
        network = ContactNetwork(shapes, stored["config"]["hidden"])
        network.load_state_dict(stored["weights"])
        elements = tuple(stored["elements"])
    except OSError:
        raise
    except Exception as error:  # torch and pickle raise a dozen unrelated types for a bad file
        reason = str(error).partition("\n")[0] or type(error).__name__
        if isinstance(error, pickle.UnpicklingError):  # torch would have us trust the file
            reason = "it is another file, or damaged"
        raise ConfigError(
            f"{checkpoint} is no network of `tactile-rt locate train`: {reason}"
        ) from None
    if data is not None:
        _check_loads(data.manifest)
        made = stored.get("made_for")  # an early one knows its elements alone
        if elements != data.manifest.spec.elements or made not in (None, _made_for(data.manifest)):
            raise ConfigError(
                f"{checkpoint} is of another array than the sweeps, or of another sample period: "
                "train one on them"
            )
    return network.eval()


def _save(
    network: ContactNetwork,
    data: SweepSet,
    shapes: WhiskerShapes,
    config: ContactConfig,
    checkpoint: Path,
) -> None:
    stored = {
        "weights": network.state_dict(),
        "config": asdict(config),
        "shapes": {k: torch.from_numpy(v) for k, v in asdict(shapes).items()},
        "elements": list(data.manifest.spec.elements),
        "made_for": _made_for(data.manifest),
    }
    write_whole(checkpoint, lambda file: torch.save(stored, file))


def _shares(data: SweepSet, shapes: WhiskerShapes) -> Floats:
    """(sweep, sample, element) distance as share of the length; NaN where nothing is touched."""
    contacts, elements = contacts_of(data.sweeps), data.manifest.spec.elements
    _check_loads(data.manifest)
    if len(shapes) != len(elements):
        raise ConfigError(f"{len(shapes)} whisker shapes for a set of {len(elements)} whiskers")
    return np.asarray(contacts / shapes.length, dtype=np.float32)


def _check_loads(manifest: SweepManifest) -> None:
    """Raise a `ConfigError` where what whiskers measure is not force and moment at the base, or
    there is no time at rest to measure their noise in."""
    spec = manifest.spec
    if manifest.lead < FEWEST_AT_REST:
        raise ConfigError(
            f"the sweeps have a lead of {manifest.lead} samples at rest, and the noise needs "
            f"{FEWEST_AT_REST}: make sweeps of a longer lead_ms"
        )
    if spec.units != UNITS:
        given = ", ".join(f"{c} ({u})" for c, u in zip(spec.channels, spec.units, strict=True))
        raise ConfigError(
            f"where along a whisker it touches is told by all three forces and moments at its base "
            f"(N, N m); the sweeps of {spec.name!r} have {given}"
        )


def _made_for(manifest: SweepManifest) -> str:
    """The array and the sample period, as text."""
    spec = replace(manifest.spec, name="", rate_hz=1.0)
    return f"{manifest.period_ns} {spec.to_json()}"


def _loss(network: ContactNetwork, felt: Felt, truth: Floats, at: NDArray[np.int64]) -> Tensor:
    """Cross-entropy of touching plus Huber loss of the touching whiskers' distance.

    Args:
        at: (whisker, 2) sweep and element of each.
    """
    sweep, element = at.T
    loads = torch.from_numpy(felt.loads[sweep, :, element])
    sigma = torch.from_numpy(felt.sigma[sweep, element])
    wanted = torch.from_numpy(truth[sweep, :, element])
    logit, share, _ = network(loads, sigma, torch.from_numpy(element))
    touching = torch.isfinite(wanted)
    loss = F.binary_cross_entropy_with_logits(logit, touching.float())
    if touching.any():
        loss = loss + F.huber_loss(SHARP * share[touching], SHARP * wanted[touching])
    return loss
