"""Checkpoints of networks: read, written, checked against sweep sets, and loaded as networks.

torch writes an archive: a pickle of everything but the values of tensors, which are other members.
Reading without torch skips these values and accepts only plain Python objects. Importing torch
takes seconds, so it is imported only where a network is made, after all other checks.
"""

import pickle
import zipfile
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from tactile_rt.core.errors import ConfigError, ModelError, RecordingError, SpecMismatch
from tactile_rt.core.files import open_regular, refuse_lfs_pointer, replace_file
from tactile_rt.core.stream import ArraySpec
from tactile_rt.core.stream.sensor_spec import ChannelLimits
from tactile_rt.models.ead_config import EADConfig
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.splits import check_labelled, join_manifests

if TYPE_CHECKING:
    from tactile_rt.models.ead import TactileClassifier

PICKLE = "/data.pkl"  # in the archive, in a folder of any name
NEEDED = ("model", "network", "config", "spec", "period_ns", "categories", "refusals")
# fields of a network's configuration that a training configuration has too
NETWORK = (
    "encoder", "attender", "decoder", "width", "readout", "dropout", "graph", "norm_epsilon",
    "preprocessing",
)  # fmt: skip


def describe_checkpoint(path: Path) -> dict[str, Any]:
    """Read the contents of a `best.pt` without torch; every tensor is None.

    Raises:
        ModelError: the file is missing or no `best.pt`; the values of tensors are not checked.
    """
    refuse_lfs_pointer(path)
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            names = [name for name in archive.namelist() if name.endswith(PICKLE)]
            if not names:
                raise ModelError("a zip file without a saved network")
            with archive.open(names[0]) as pickled:
                saved = _PlainUnpickler(pickled).load()
        missing = [key for key in NEEDED if key not in saved]
        if missing:  # as in a last.pt
            raise ModelError(f"it has no {missing[0]}, which a best.pt has")
        EADConfig(**saved["network"])
        ArraySpec.from_json(saved["spec"])
    except FileNotFoundError:
        raise ModelError(f"no checkpoint {path}") from None
    except Exception as error:  # zipfile and pickle raise many unrelated types for a damaged file
        raise no_checkpoint(path, error) from None
    found: dict[str, Any] = saved
    return found


def read_network_options(path: Path) -> dict[str, Any]:
    """Read a network's options from a checkpoint, for use in a training configuration."""
    network = describe_checkpoint(path)["network"]
    return {key: value for key, value in network.items() if key in NETWORK}


def no_checkpoint(path: Path, error: Exception) -> ModelError:
    """Return a ModelError that reports that a file is no checkpoint, and why."""
    return ModelError(f"{path} is not a checkpoint of `tactile-rt train`: {reason(error)}")


def reason(error: Exception) -> str:
    """Return the first line of an error's message, or the error's type without one."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error).splitlines()[0] if str(error) else type(error).__name__


class _PlainUnpickler(pickle.Unpickler):
    def persistent_load(self, pid: Any) -> None:
        """Return None in place of the values of a tensor."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module.partition(".")[0] == "torch":
            return _skip_tensor
        raise ModelError(f"it refers to {module}.{name}")


def _skip_tensor(*_: Any) -> None:
    """Return None in place of a tensor, whatever the arguments."""


def check_array(checkpoint: Path, saved: Mapping[str, Any], manifest: SweepManifest) -> None:
    """Check that a set and a checkpoint have the same array and samples per step."""
    spec = ArraySpec.from_json(saved["spec"])
    if differences := spec.differences(manifest.spec, ("name", "rate_hz")):
        raise SpecMismatch(f"{checkpoint} was made for another array: {differences[0]}")
    channels = len(spec.channels)
    taken, given = EADConfig(**saved["network"]).frame[0], manifest.frame[0]
    if taken != given:
        raise SpecMismatch(
            f"{checkpoint} takes steps of {taken // channels} samples, not {given // channels} as "
            f"in the set (one every {manifest.period_ns / 1e6:g} ms): name a set with the sample "
            "period of its training"
        )


def trained_on(
    checkpoint: Path, saved: Mapping[str, Any], data: Sequence[Path] = ()
) -> list[tuple[Path, SweepManifest]]:
    """Return folders and manifests of the sweep sets that a checkpoint was trained on.

    Args:
        data: folders of the sets; default: those in the checkpoint's configuration.

    Raises:
        RecordingError: a folder is missing, or is no sweep set.
        SpecMismatch: a set is of another array, or the sets hold other categories.
    """
    config = saved["config"]
    folders = tuple(data) or tuple(map(Path, (config["data"], *config.get("also", ()))))
    for folder in folders:
        if not data and not folder.exists():
            raise RecordingError(
                f"{folder}, a sweep set that {checkpoint} was trained on, is not here: name it by "
                "--data"
            )
    manifests = [SweepManifest.read(folder) for folder in folders]
    manifest = join_manifests(manifests)
    check_array(checkpoint, saved, manifest)
    held = list(manifest.categories)
    classes = saved["network"]["classes"] - len(saved["refusals"])
    if saved["categories"] != held or len(held) != classes:
        other = (
            ", ".join(sorted({*saved["categories"]} ^ {*held})[:3]) or "the same in another order"
        )
        there = " and ".join(map(str, folders))
        raise SpecMismatch(
            f"{checkpoint} has other categories than {there} holds ({other}): name what "
            "it was trained on by --data"
        )
    return list(zip(folders, manifests, strict=True))


def probed_on(
    checkpoint: Path, saved: Mapping[str, Any], folder: Path, data: str = ""
) -> tuple[Path, SweepManifest]:
    """Return folder and manifest of the sweep set to probe a checkpoint on.

    Args:
        folder: the folder to write the probe into.
        data: the set's folder; empty: the first set that the checkpoint was trained on.

    Raises:
        RecordingError: the set is missing, or is no sweep set.
        SpecMismatch: the set is of another array.
        ConfigError: the set has no labels, or `folder` holds a training run to be overwritten.
    """
    best = folder / "best.pt"
    if (folder / "config.json").exists() or (best.exists() and best.samefile(checkpoint)):
        raise ConfigError(
            f"{folder} holds a training run, whose best.pt the probe would replace: choose another "
            "folder"
        )
    path = Path(data or saved["config"]["data"])
    manifest = SweepManifest.read(path)
    check_array(checkpoint, saved, manifest)
    check_labelled(path, manifest)
    return path, manifest


def load_checkpoint(path: Path) -> "tuple[TactileClassifier, dict[str, Any]]":
    """Load the network of a `best.pt` (evaluation mode, CPU) and the checkpoint's contents.

    Raises:
        ModelError: the file is missing, or is no `best.pt`.
    """
    import torch

    describe_checkpoint(path)
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        model = build_untrained(saved)
        model.load_state_dict(saved["model"])
    except Exception as error:  # torch raises many unrelated types for a damaged file
        raise no_checkpoint(path, error) from None
    return model.eval(), saved


def begin_from(
    model: "TactileClassifier",
    path: Path,
    labels: Sequence[str],
    kinds: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """Initialise a network with the weights of a checkpoint; return the checkpoint's contents.

    Args:
        model: a network of the checkpoint's architecture; its labels and kinds may differ.
        labels: the labels of `model`; a label that the checkpoint has too gets the checkpoint's
            row of the last layer, any other keeps its own.
        kinds: the kinds within each label; their rows are copied likewise.

    Raises:
        ModelError: the file is missing, or is no `best.pt`.
        SpecMismatch: the checkpoint is of another array or network.
    """
    trained, saved = load_checkpoint(path)
    there, here = asdict(trained.network.config), asdict(model.network.config)
    own_to_each = ("classes", "names", "identity", "dropout")
    differing = [key for key in here if key not in own_to_each and here[key] != there[key]]
    if differing or trained.inputs.element.tolist() != model.inputs.element.tolist():
        why = f"another {differing[0]}" if differing else "another array"
        raise SpecMismatch(f"training cannot begin with {path}: it has {why}")
    known = _name_rows((*saved["categories"], *saved["refusals"]), saved.get("kinds", {}), there)
    wanted = _name_rows(labels, kinds, here)
    both = [name for name in wanted if name in known]
    to, of = [wanted.index(n) for n in both], [known.index(n) for n in both]
    weights, own = trained.state_dict(), model.state_dict()
    # a label's row of the last layer may have moved, even if the number of rows is the same
    for name in [name for name in own if name.startswith("network.decoder.")][-2:]:
        own[name][to] = weights[name][of]
        weights[name] = own[name]
    # the channels' limits are those of the new set
    kept = {name: own[name] if name.startswith("inputs.") else w for name, w in weights.items()}
    model.load_state_dict(kept)
    return saved


def _name_rows(
    labels: Sequence[str], kinds: Mapping[str, Sequence[str]], network: Mapping[str, Any]
) -> list[Any]:
    """List names of the last layer's rows: labels, (label, kind) pairs, embedding unit numbers."""
    names = [(label, kind) for label in kinds for kind in kinds[label]] if network["names"] else []
    return [*labels, *names, *range(network["identity"])]


def build_untrained(saved: dict[str, Any]) -> "TactileClassifier":
    """Build a checkpoint's network for its array and channel limits, with random weights."""
    from tactile_rt.models.ead import TactileClassifier

    clip, scale = (saved["model"][f"inputs.{name}"].numpy() for name in ("clip", "scale"))
    limits = ChannelLimits(noise=scale, floor=scale, clip=clip, scale=scale)
    spec = ArraySpec.from_json(saved["spec"])
    return TactileClassifier(spec, EADConfig(**saved["network"]), limits)


def fill_checkpoint(
    model: "TactileClassifier",
    manifest: SweepManifest,
    refusals: Sequence[str],
    config: Mapping[str, Any],
    trained: Mapping[str, list[str]],
    metrics: Mapping[str, float],
) -> dict[str, Any]:
    """Return the contents of a `best.pt` for a trained network.

    Args:
        manifest: the manifest of the set that the network was trained on.
        refusals: the labels that are no categories, such as "unknown".
        config: the training configuration, as JSON values.
        trained: the names of the training objects, by their source.
    """
    return {
        "model": model.state_dict(),
        "config": config,
        "network": msgspec.to_builtins(model.network.config),
        "spec": manifest.spec.to_json(),
        "period_ns": manifest.period_ns,
        "categories": list(manifest.categories),
        "refusals": list(refusals),
        "kinds": manifest.kinds if model.network.config.names else {},
        "trained_objects": trained,
        "metrics": metrics,
    }


def save_whole(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint atomically, safe against a power failure.

    Raises:
        OSError: the disk is full, or failed.
    """
    import torch

    with replace_file(path) as file:
        try:
            torch.save(state, file)
        except RuntimeError as error:  # torch's own, raised after the file's
            raise (error.__context__ if isinstance(error.__context__, OSError) else error) from None
