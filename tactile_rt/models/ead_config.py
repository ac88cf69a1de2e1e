"""The configuration of a network, and the names of available parts. Needs no torch."""

import math
from dataclasses import dataclass

from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError, name_some

# of `encoders.cells`
CELLS = (
    "timedecay", "timedecay-ln", "vanilla", "vanilla-ln", "vanilla-elu", "vanilla-elu-ln", "ugrnn",
    "ugrnn-ln", "intersection", "intersection-ln", "gru", "gru-ln", "lstm", "lstm-ln",
    "lstm-ln-published",
)  # fmt: skip
ZHUANG = ("zhuang", "ZhuangEncoder")
# name: (module in `encoders`, class or function), imported when a network needs it
ENCODERS: dict[str, tuple[str, str]] = {
    **{f"zhuang-{cell}": ZHUANG for cell in CELLS},
    "resnet18": ("resnet", "ResNet18Encoder"),
    "s4": ("s4", "S4Encoder"),
    "mamba": ("mamba", "MambaEncoder"),
    "gru": ("gru", "GRUEncoder"),
    "graph": ("graph_encoder", "build_encoder"),
}
ATTENDERS = ("gpt", "mamba", "none")
DECODERS = ("linear", "mlp", "mlp-all")
LN = ("", "-ln")  # a cell, and the same with layer norm
READOUTS = ("last", "mean")
PREPROCESSINGS = ("log", "paper")
MAX_STEPS = 32  # of an episode: the GPT has positions for no more
MOUSE_FRAME = (30, 5, 7)  # five sub-steps of six loads, on the grid of a mouse's whiskers
WIDTH_UNIT = 32  # every channel count is a multiple of this at width 1
WIDEST = 4  # sixteen times the paper's parameters, a billion


def added_cells() -> tuple[str, ...]:
    """List the recurrent cells that plugins add, each without and with layer norm ("-ln")."""
    return tuple(f"{cell}{ln}" for cell in packages.added_names(packages.CELLS) for ln in LN)


def encoder_class(name: str) -> tuple[str, str]:
    """Return an encoder's module in `encoders` and its class or function in that module."""
    return ENCODERS.get(name, ZHUANG)


def _list_encoders(asked: str) -> tuple[str, ...]:
    """List our encoders, and those of plugins as well if `asked` is none of ours."""
    ours = tuple(ENCODERS)
    return ours if asked in ours else (*ours, *(f"zhuang-{cell}" for cell in added_cells()))


@dataclass(frozen=True)
class EADConfig:
    """Options of a network; defaults: the paper's Intersection-LN + GPT, 63.8 M parameters."""

    classes: int
    encoder: str = "zhuang-intersection-ln"
    attender: str = "gpt"
    decoder: str = "linear"
    width: float = 1.0  # scales every channel count; the GPT's heads and layers stay
    # "last": a step's own logits (the paper). "mean": their running mean from step `lag` on, for a
    # decision at any time.
    readout: str = "last"
    dropout: float = 0.1
    max_steps: int = 22  # of an episode; the GPT has no further positions
    graph: str = ""  # of encoder "graph": the text of a TOML file, see `encoders.graph`
    frame: tuple[int, int, int] = MOUSE_FRAME  # channels, rows and columns of its input
    norm_epsilon: float = 0.0  # of the cells' layer norms; 0: each cell's own, see `cells`
    preprocessing: str = "log"  # of the input stage, see `ead`
    names: int = 0  # kinds within the classes, with logits beside those of the classes
    identity: int = 0  # units of an embedding that is trained to distinguish objects; 0: none

    @property
    def outputs(self) -> int:
        """Number of outputs: logits of the classes and of the names, units of the embedding."""
        return self.classes + self.names + self.identity

    def __post_init__(self) -> None:
        for field, known in (
            ("encoder", _list_encoders(self.encoder)),
            ("attender", ATTENDERS),
            ("decoder", DECODERS),
            ("readout", READOUTS),
            ("preprocessing", PREPROCESSINGS),
        ):
            if (value := getattr(self, field)) not in known:
                raise ConfigError(f"{field} is {value!r}, not one of {name_some(known, 8)}")
        if self.classes < 1:
            raise ConfigError(f"classes must be at least 1, not {self.classes}")
        if min(self.names, self.identity) < 0:
            raise ConfigError("names and identity must be 0 or more")
        if not 0 < self.width <= WIDEST or self.width * WIDTH_UNIT % 1:
            raise ConfigError(
                f"width must be a positive multiple of 1/{WIDTH_UNIT}, at most {WIDEST}, "
                f"not {self.width}"
            )
        if not 0 <= self.norm_epsilon < math.inf:
            raise ConfigError(f"norm_epsilon must be 0 or more, not {self.norm_epsilon}")
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"dropout must be in [0, 1), not {self.dropout}")
        if not 1 <= self.max_steps <= MAX_STEPS:
            raise ConfigError(f"max_steps must be 1 to {MAX_STEPS}, not {self.max_steps}")
        object.__setattr__(self, "frame", tuple(self.frame))  # a list, from JSON
        if len(self.frame) != 3 or min(self.frame) < 1:
            raise ConfigError(f"frame must be channels, rows and columns, not {self.frame}")
        if bool(self.graph) != (self.encoder == "graph"):
            raise ConfigError("graph must be given with encoder 'graph', and only then")
