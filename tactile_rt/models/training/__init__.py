"""Train EAD networks: what to train (`config`, `recipes`), how (`loop`), and what comes of it.

    tactile-rt train data/default24 runs/mine
    tactile-rt train data/default24 runs/simclr --recipe paper-simclr --width 0.125
    tactile-rt probe runs/simclr/best.pt runs/simclr-probe

A run folder holds `config.json`, `history.csv` (a line per epoch), `last.pt` (everything needed to
go on) and `best.pt` (the network of the best validation).
"""

from tactile_rt.models.checkpoints import (
    TactileClassifier,
    load_checkpoint,
    network_of,
    run_on,
)
from tactile_rt.models.training.config import Progress, TrainingConfig
from tactile_rt.models.training.loop import initialise, train
from tactile_rt.models.training.probing import ProbeConfig, probe
from tactile_rt.models.training.recipes import read_recipe, shipped_recipes

__all__ = [
    "ProbeConfig",
    "Progress",
    "TactileClassifier",
    "TrainingConfig",
    "initialise",
    "load_checkpoint",
    "network_of",
    "probe",
    "read_recipe",
    "run_on",
    "shipped_recipes",
    "train",
]
