"""Sparse autoencoder (Olshausen and Field 1996): the last step's features rebuild the window."""

from collections.abc import Sequence

from torch import Generator, Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import TactileClassifier
from tactile_rt.models.datasets import SUBSTEPS
from tactile_rt.models.objectives.base import Objective, in_single_precision, scaled

__all__ = ["Autoencoder"]

WIDE, NARROW = 256, 128  # channels between the deconvolutions, at width 1
SPARSITY = 1e-4


class Autoencoder(Objective):
    """Three deconvolutions from a single site to the grid, all steps of the window as channels.

    loss = 0.5 mean squared error of the (normalised) frames + 1e-4 |features|_1

    The paper gives the number of layers and the two weights; sizes are ours.
    """

    def __init__(self, model: TactileClassifier, augmentation: Augmentation) -> None:
        super().__init__(model, augmentation)
        inputs, network = model.inputs, model.network
        sizes = (
            model.feature_size(),
            scaled(WIDE, network.config.width),
            scaled(NARROW, network.config.width),
            network.config.max_steps * SUBSTEPS * len(inputs.clip),
        )
        rows, columns = (_kernels(cells) for cells in inputs.shape)
        self.decoder = nn.Sequential(
            nn.ConvTranspose2d(sizes[0], sizes[1], (rows[0], columns[0])),
            nn.ReLU(),
            nn.ConvTranspose2d(sizes[1], sizes[2], (rows[1], columns[1])),
            nn.ReLU(),
            nn.ConvTranspose2d(sizes[2], sizes[3], (rows[2], columns[2])),
        )

    def forward(self, views: Sequence[Loads], labels: Tensor, generator: Generator) -> Tensor:
        (loads,) = views
        frames = self.frames(loads, generator)
        latent = self.model.features(frames)[:, -1]
        rebuilt = self.decoder(latent[:, :, None, None]).view(frames.shape)
        with in_single_precision(frames):
            error = F.mse_loss(rebuilt.float(), frames.float())
            return 0.5 * error + SPARSITY * latent.float().abs().sum(1).mean()


def _kernels(cells: int) -> tuple[int, int, int]:
    """Kernel sizes of three valid deconvolutions that grow one site to so many cells."""
    grow = cells - 1
    return 1 + grow // 3, 1 + (grow + 1) // 3, 1 + (grow + 2) // 3
