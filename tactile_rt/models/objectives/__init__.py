"""What a network is trained for. An objective is a module that holds the network and its own heads.

    objective(views, labels) -> loss

`views` are one or two batches of loads (samples, offset, sigma) as `TactileClassifier` takes them,
`objective.views` says how many; labels (batch,) count for the supervised objective alone. The
augmentation of frames happens inside, from the objective's `draw` generator.
"""

from tactile_rt.models.objectives.autoencoder import Autoencoder
from tactile_rt.models.objectives.base import Objective
from tactile_rt.models.objectives.simclr import SimCLR, nt_xent
from tactile_rt.models.objectives.simsiam import SimSiam
from tactile_rt.models.objectives.supervised import Supervised, anytime_loss, last_loss

__all__ = [
    "Autoencoder",
    "Objective",
    "SimCLR",
    "SimSiam",
    "Supervised",
    "anytime_loss",
    "last_loss",
    "nt_xent",
]
