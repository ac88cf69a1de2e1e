"""Train EAD networks: what to train (`config`, `recipes`), how (`loop`), and what comes of it.

    tactile-rt train data/default24 runs/mine
    tactile-rt train data/default24 runs/simclr --recipe paper-simclr --set width=0.125
    tactile-rt probe runs/simclr/best.pt runs/simclr-probe

A run folder holds `config.json`, `history.csv` (a line per epoch), `last.pt` (everything needed to
go on) and `best.pt` (the network of the best validation).

Nothing is imported before it is asked for: `config` and `recipes` do without torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactile_rt.models.checkpoints import TactileClassifier, load_checkpoint, run_on
    from tactile_rt.models.training.config import ProbeConfig, Progress, TrainingConfig
    from tactile_rt.models.training.loop import initialise, train
    from tactile_rt.models.training.probing import probe
    from tactile_rt.models.training.recipes import read_recipe, shipped_recipes

__all__ = [
    "ProbeConfig",
    "Progress",
    "TactileClassifier",
    "TrainingConfig",
    "initialise",
    "load_checkpoint",
    "probe",
    "read_recipe",
    "run_on",
    "shipped_recipes",
    "train",
]

_HOMES = {
    "checkpoints": ("TactileClassifier", "load_checkpoint", "run_on"),
    "training.config": ("ProbeConfig", "Progress", "TrainingConfig"),
    "training.loop": ("initialise", "train"),
    "training.probing": ("probe",),
    "training.recipes": ("read_recipe", "shipped_recipes"),
}


def __getattr__(name: str) -> Any:
    for module, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"tactile_rt.models.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
