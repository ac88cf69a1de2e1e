"""Configurations of a training, stored as a run's `config.json`, and of a probe.

Needs no torch, so that invalid values are reported before torch is loaded.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core.errors import ConfigError, ModelError, name_some
from tactile_rt.core.files import write_whole
from tactile_rt.models.checkpoints import NETWORK
from tactile_rt.models.ead_config import MOUSE_FRAME, READOUTS, EADConfig
from tactile_rt.sets.sensor_faults import SensorFaults
from tactile_rt.sets.splits import read_manifests

OBJECTIVES = ("supervised", "simclr", "simsiam", "autoencoder", "predictive")
AUGMENTATIONS = ("none", "tactile", "tactile-paper", "image", "image-paper", "image-paper-weak")
LOSSES = ("anytime", "last")
OPTIMIZERS = ("sgd", "adam", "adamw", "lars", "lars-paper")
SCHEDULES = ("step", "constant", "cosine", "cosine-annealing", "one-cycle")
PRECISIONS = ("bf16", "fp32")
FIRST_WEIGHTS = ("kaiming", "paper")
RATES_PER = ("update", "epoch")
WINDOWS = ("onset", "sweep")
PAIRS = ONE_SWEEP, TWO_SWEEPS = ("one-sweep", "two-sweeps")
PATHS = ("data", "also", "begin")  # keys of a configuration whose values are paths
EMBEDDED = 128  # units of the embedding that is trained on identity
LARGEST = 1e38  # about the largest number in single precision


@dataclass(frozen=True)
class TrainingConfig:
    """The configuration of a training; the defaults are the shipped model's recipe.

    Attributes:
        data: The folder of the sweep set to train on.
        also: The folders of further sweep sets of the same array to train on as well; sensor
            faults are drawn by the first set's recipe.
        begin: The checkpoint with the initial weights, of the same array and network; labels only
            it has are dropped, labels it lacks get random weights. Empty: all weights are random.
        encoder, attender, decoder, width, readout, dropout, graph, norm_epsilon, preprocessing:
            Fields of the network, as in `EADConfig`.
        first_weights: The initial weights of a graph: "kaiming", or "paper", drawn by
            `graph_encoder.draw_as_published`.
        window: The first sample of a window: "onset", where the runtime's detector reports contact,
            or "sweep", where the object starts to move (the paper).
        jitter: The largest number of samples by which a window begins earlier or later.
        faults: The sensor faults that are drawn each time that a sweep is used; None: those of the
            set's recipe.
        objective: The objective: "supervised", or self-supervised "simclr", "simsiam",
            "autoencoder", "predictive".
        loss: The loss of the supervised objective: "anytime" (half of the weight on the last step,
            half on all steps that an input has reached) or "last" (the paper: only the last step).
        augmentation: The name of the augmentation, see `augmentation`; the two views of a window
            differ by augmentation, onset and sensor faults.
        pairs: The source of the two views of "simclr" and "simsiam": "one-sweep", the same window
            twice, or "two-sweeps", windows of two sweeps of the same object, as when a robot
            touches an object twice.
        temperature: The temperature of "simclr" and of `identity`, by which similarities are
            divided: 0.1 in the paper; higher where pairs of views are hard to match, as for
            "two-sweeps".
        names: The weight of the cross-entropy over the kinds within an object's class, in addition
            to that over classes (supervised); 0: kinds are not learnt.
        identity: The weight of a supervised contrastive loss between objects, which trains an
            embedding; any two sweeps of an object are a pair (supervised).
        masking: The share of a window's steps that is set to zero, from 0 to less than 1.
        optimizer, schedule: Names of the optimizer and of the learning rate's schedule, see
            `updates`.
        rate_per: The time after which the schedule changes the rate: "update", or "epoch" (the
            paper).
        learning_rate: The peak of the learning rate.
        own_rates: True if parameters that define their own rate and weight decay (the state spaces
            of S4) get them; False in the paper.
        warmup: The share of all updates in which the rate rises; 0.1 for 10 of 100 epochs, as in
            the paper.
        drop_every: The share of all updates between tenfold drops of the schedule "step"; 0.3 for
            StepLR(30) and 100 epochs.
        easy: The share of all epochs in which noise, offset and drift rise from 0 to the amounts of
            the set's recipe.
        updates: The number of updates after which training stops, in place of `epochs`; 0:
            `epochs` decides.
        batch: The number of sweeps per update, summed over all devices.
        label_smoothing: The share of a label that is spread evenly over all classes.
        clip_norm: The largest norm of the gradient; a larger gradient is scaled down to it; 0: no
            clipping.
        precision: The number format of the products, "bf16" (mixed) or "fp32".
        seed: The seed of the weights, the windows, the noise and the augmentation.

    Raises:
        ConfigError: an invalid value.
    """

    data: str
    also: tuple[str, ...] = ()
    begin: str = ""
    encoder: str = "zhuang-intersection-ln"
    attender: str = "none"
    decoder: str = "mlp"
    width: float = 0.125
    readout: str = "mean"
    dropout: float = 0.1
    graph: str = ""
    norm_epsilon: float = 0.0
    preprocessing: str = "log"
    first_weights: str = "kaiming"
    window: str = "onset"
    jitter: int = 5
    faults: SensorFaults | None = None
    objective: str = "supervised"
    loss: str = "anytime"
    augmentation: str = "none"
    pairs: str = ONE_SWEEP
    temperature: float = 0.1
    names: float = 0.0
    identity: float = 0.0
    masking: float = 0.0
    optimizer: str = "adamw"
    schedule: str = "one-cycle"
    rate_per: str = "update"
    learning_rate: float = 5e-3
    weight_decay: float = 1e-4
    own_rates: bool = True
    warmup: float = 0.05
    drop_every: float = 0.3
    easy: float = 0.0
    epochs: int = 14
    updates: int = 0
    batch: int = 32
    label_smoothing: float = 0.05
    clip_norm: float = 1.0
    precision: str = "bf16"
    seed: int = 0

    def __post_init__(self) -> None:
        if isinstance(self.faults, Mapping):  # from JSON
            object.__setattr__(self, "faults", SensorFaults(**self.faults))
        for name, known in (
            ("objective", OBJECTIVES),
            ("loss", LOSSES),
            ("augmentation", AUGMENTATIONS),
            ("optimizer", OPTIMIZERS),
            ("schedule", SCHEDULES),
            ("rate_per", RATES_PER),
            ("window", WINDOWS),
            ("pairs", PAIRS),
            ("first_weights", FIRST_WEIGHTS),
            ("precision", PRECISIONS),
        ):
            if (value := getattr(self, name)) not in known:
                raise ConfigError(f"{name} is {value!r}, not one of {name_some(known, 8)}")
        for name in ("epochs", "batch", "learning_rate", "drop_every", "temperature"):
            _check_positive(name, getattr(self, name))
        for name in ("updates", "clip_norm", "weight_decay", "jitter", "names", "identity"):
            if not (getattr(self, name) >= 0 and isfinite(getattr(self, name))):
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")
        for name in ("masking", "warmup", "label_smoothing", "easy"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name} must be in [0, 1), not {getattr(self, name)}")
        if self.objective in ("simclr", "simsiam") and self.batch < 2:
            raise ConfigError(
                f"{self.objective} compares sweeps of a batch: batch must be 2 or more"
            )
        if self.related and not self.labelled:
            raise ConfigError(f"names and identity need objective supervised, not {self.objective}")
        if self.pairs != ONE_SWEEP and self.objective not in ("simclr", "simsiam"):
            raise ConfigError(f"pairs needs objective simclr or simsiam, not {self.objective}")
        if self.schedule == "one-cycle" and self.rate_per == "epoch":
            raise ConfigError("schedule one-cycle changes the rate per update, not per epoch")
        _check_seed(self.seed)

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders of the sets to train on."""
        return tuple(map(Path, (self.data, *self.also)))

    @property
    def labelled(self) -> bool:
        """True if the training uses labels."""
        return self.objective == "supervised"

    @property
    def related(self) -> bool:
        """True if kinds or objects are learnt in addition to classes."""
        return self.names > 0 or self.identity > 0

    def check_sets(self) -> None:
        """Check by their manifests that the sets can be trained on, without reading sweeps.

        Raises:
            ConfigError: the network is invalid, the sets cannot be joined, or a set has no labels
                though the objective needs them.
            RecordingError: a set is missing, is no sweep set, or has an invalid split.
        """
        _, whole = read_manifests(self.folders, self.labelled)
        self.network(len(whole.categories), whole.frame)

    def network(
        self, classes: int, frame: tuple[int, int, int] = MOUSE_FRAME, names: int = 0
    ) -> EADConfig:
        """Return the network's configuration for given numbers of classes and of kinds (`names`).

        Raises:
            ConfigError: the network is invalid.
        """
        own = {name: getattr(self, name) for name in NETWORK}
        identity = EMBEDDED if self.identity else 0
        return EADConfig(classes=classes, frame=frame, names=names, identity=identity, **own)


def as_json(config: TrainingConfig) -> dict[str, Any]:
    """Return a configuration as JSON values, with lists in place of tuples."""
    plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(asdict(config)))
    return plain


def begin_run(config: TrainingConfig, folder: Path) -> None:
    """Create a run's folder, or check that an existing folder holds this configuration.

    Raises:
        ConfigError: the folder holds a run of another or of an unknown configuration.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, mine = folder / "config.json", as_json(config)
    # Before its first epoch is finished, a run has no results, so its options may change.
    if not (folder / "last.pt").exists():
        text = msgspec.json.format(msgspec.json.encode(mine), indent=1)
        write_whole(path, lambda file: file.write(text))
        return
    try:
        theirs = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except FileNotFoundError:
        raise ConfigError(
            f"{path} is missing, so that this run cannot be identified: choose another folder, or "
            f"delete {folder / 'last.pt'} to begin anew"
        ) from None
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged ({error}): choose another folder") from None
    keys = {**mine, **theirs}
    if differing := [key for key in keys if not _equal(key, theirs.get(key), mine.get(key))]:
        raise ConfigError(
            f"{folder} holds a run of another configuration (other {name_some(differing)}): choose "
            "another folder, or repeat the options that began it"
        )


def _equal(key: str, one: Any, other: Any) -> bool:
    """Return whether two values of a key are equal; paths are compared after resolving."""
    if key in PATHS and one and other:
        names = [[value] if isinstance(value, str) else value for value in (one, other)]
        one, other = ([str(Path(name).resolve()) for name in some] for some in names)
    return bool(one == other)


@dataclass(frozen=True)
class ProbeConfig:
    """The configuration of a probe: the paper's, except for `standardise`.

    Attributes:
        data: The folder of the sweep set; empty: the set that the network was trained on.
        drop_epochs: The number of epochs between tenfold drops of the learning rate (StepLR).
        standardise: True to scale features to zero mean and unit variance for the fit, which is
            then folded into the layer. Without it (the paper), small features hardly train.
        readout: The features to fit on: "last", those of the last step (the paper), or "mean", the
            mean of all steps that an input has reached, which suits a network without memory.
        seed: The seed of the layer, the windows and their order.
    """

    data: str = ""
    epochs: int = 100
    batch: int = 256
    learning_rate: float = 0.1
    momentum: float = 0.9
    drop_epochs: int = 30
    standardise: bool = True
    readout: str = "last"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.readout not in READOUTS:
            raise ConfigError(f"readout is {self.readout!r}, not one of {', '.join(READOUTS)}")
        for name in ("epochs", "batch", "learning_rate", "drop_epochs"):
            _check_positive(name, getattr(self, name))
        if not 0 <= self.momentum < 1:
            raise ConfigError(f"momentum must be in [0, 1), not {self.momentum}")
        _check_seed(self.seed)


def _check_positive(name: str, value: float) -> None:
    if not value > 0:  # also if it is NaN
        raise ConfigError(f"{name} must be positive, not {value}")
    if not value < LARGEST:
        raise ConfigError(f"{name} must be below {LARGEST:g}, not {value}")


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**32:
        raise ConfigError(f"seed must be 0 to {2**32 - 1}, not {seed}")


class DivergedError(ModelError):
    """Error of a training with infinite or NaN gradients; a lower learning rate may help."""


@dataclass
class Progress:
    """The progress of a run, reported after every update and every epoch.

    After an epoch, `metrics` holds the values of the epoch's line in `history.csv`, and "waiting",
    the share of the epoch's time that was spent waiting for data.
    """

    epoch: int
    epochs: int
    update: int
    updates: int
    loss: float
    metrics: dict[str, float] = field(default_factory=dict)
