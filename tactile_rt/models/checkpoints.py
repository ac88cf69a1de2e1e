"""What is trained and shipped as one, and its checkpoints."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactile_rt.core.errors import ConfigError, SpecMismatch
from tactile_rt.core.files import replaced
from tactile_rt.core.stream import ArraySpec, Timing
from tactile_rt.core.stream.sensor_spec import ChannelLimits, channel_limits
from tactile_rt.models.checkpoint_files import describe_checkpoint, no_checkpoint
from tactile_rt.models.ead import EAD, EADConfig
from tactile_rt.models.inputs import InputStage, paper_units

__all__ = [
    "TactileClassifier",
    "begin_from",
    "load_checkpoint",
    "run_on",
    "save_whole",
    "untrained",
]


class TactileClassifier(nn.Module):
    """Samples in SI units to logits: the input stage and the network, trained and shipped as one.

    Args:
        limits: what is believed of the channels; None: what `channel_limits` says of an array
            without a described sensor.

    Raises:
        ConfigError: the network is for another array, or its preprocessing for other units.
    """

    def __init__(
        self, spec: ArraySpec, network: EADConfig, limits: ChannelLimits | None = None
    ) -> None:
        super().__init__()
        if network.preprocessing == "paper":
            clip, scale = paper_units(spec)
        else:
            limits = limits or channel_limits(spec)
            clip, scale = limits.clip.tolist(), limits.scale.tolist()
        self.inputs = InputStage(spec.grid, spec.grid_shape, clip, scale, network.preprocessing)
        channels, *grid = network.frame
        if tuple(grid) != tuple(spec.grid_shape) or channels % len(spec.channels):
            found = " x ".join(map(str, network.frame))
            rows, columns = spec.grid_shape
            raise ConfigError(
                f"a network for frames of {found} (channels x rows x columns) does not fit an "
                f"array of {len(spec.channels)} channels on {rows} x {columns} cells"
            )
        self.network = EAD(network)

    @property
    def timing(self) -> Timing:
        """How the windows are cut that it takes."""
        config = self.network.config
        return Timing(config.max_steps, config.frame[0] // len(self.inputs.clip))

    def forward(self, samples: Tensor, offset: Tensor, sigma: Tensor) -> Tensor:
        """(batch, step, sub-step, element, channel) SI -> logits (batch, step, class)"""
        logits: Tensor = self.network(self.inputs(samples, offset, sigma))
        return logits

    def features(self, frames: Tensor) -> Tensor:
        """(batch, step, channel, row, column) -> (batch, step, feature): encoder and attender."""
        return self.network.features(frames)

    @torch.no_grad()
    def feature_size(self) -> int:
        """How many features a step has; the attender may change the encoder's number."""
        frame = torch.zeros(1, 1, *self.network.config.frame)
        mode = self.training
        size = self.eval().features(frame.to(self.inputs.clip)).shape[-1]
        self.train(mode)
        return size


def run_on(
    model: TactileClassifier,
) -> Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]:
    """The function that `evaluation.predict` wants, of a torch model."""

    def run(
        samples: NDArray[np.float32], offset: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        model.eval()
        device = model.inputs.clip.device
        with torch.inference_mode():
            logits = model(*(torch.from_numpy(a).to(device) for a in (samples, offset, sigma)))
        out: NDArray[np.float32] = logits.float().cpu().numpy()
        return out

    return run


def load_checkpoint(path: Path) -> tuple[TactileClassifier, dict[str, Any]]:
    """The network of a `best.pt`, in evaluation mode on the CPU, with what it was trained on.

    Raises:
        ModelError: not there, or not such a checkpoint.
    """
    describe_checkpoint(path)
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        model = untrained(saved)
        model.load_state_dict(saved["model"])
    except Exception as error:  # torch raises many unrelated types for a damaged file
        raise no_checkpoint(path, error) from None
    return model.eval(), saved


def begin_from(model: TactileClassifier, path: Path, labels: Sequence[str]) -> None:
    """Give a network that is to be trained the weights of a checkpoint.

    Args:
        model: of the same network, but that it may tell apart other things.
        labels: what the network is to tell apart; it knows those from the beginning that the
            checkpoint knew by the same name.

    Raises:
        ModelError: no such checkpoint.
        SpecMismatch: it is of another array or network.
    """
    trained, saved = load_checkpoint(path)
    there, here = asdict(trained.network.config), asdict(model.network.config)
    differing = [
        key for key in here if key not in ("classes", "dropout") and here[key] != there[key]
    ]
    if differing or trained.inputs.element.tolist() != model.inputs.element.tolist():
        why = f"another {differing[0]}" if differing else "another array"
        raise SpecMismatch(f"{path} cannot be begun with: it is of {why}")
    known = (*saved["categories"], *saved["refusals"])
    both = [name for name in labels if name in known]
    to, of = [labels.index(n) for n in both], [known.index(n) for n in both]
    weights, own = trained.state_dict(), model.state_dict()
    # a row of the last layer is of a label, whose place may be another though as many are known
    for name in [name for name in own if name.startswith("network.decoder.")][-2:]:
        own[name][to] = weights[name][of]
        weights[name] = own[name]
    # what the channels are limited to is the new set's to say
    kept = {name: own[name] if name.startswith("inputs.") else w for name, w in weights.items()}
    model.load_state_dict(kept)


def untrained(saved: dict[str, Any]) -> TactileClassifier:
    """The network of a checkpoint as it might be before training: for the same channels."""
    clip, scale = (saved["model"][f"inputs.{name}"].numpy() for name in ("clip", "scale"))
    limits = ChannelLimits(noise=scale, floor=scale, clip=clip, scale=scale)
    spec = ArraySpec.from_json(saved["spec"])
    return TactileClassifier(spec, EADConfig(**saved["network"]), limits)


def save_whole(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint whole or not at all, also if the machine stops a moment later.

    Raises:
        OSError: the medium is full, or failed.
    """
    with replaced(path) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:  # what torch says once the file has said what is wrong
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
