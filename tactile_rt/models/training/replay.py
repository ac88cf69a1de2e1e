"""The loss of an update, on a GPU as one CUDA graph with its gradients.

An update of a recurrent network is thousands of kernels, each of which takes longer to start than
to run. A graph of them is started once.
"""

import logging
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor, nn

from tactile_rt.models.checkpoint_files import reason
from tactile_rt.models.objectives import Objective
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.feeding import Batch, BatchFeed, generator_of

if TYPE_CHECKING:
    from lightning.fabric import Fabric

__all__ = ["batch_loss", "replayed"]


def batch_loss(
    fabric: "Fabric",
    wrapped: Callable[..., Tensor],
    objective: Objective,
    config: TrainingConfig,
    feed: BatchFeed,
) -> Callable[[Batch, Generator], Tensor]:
    """The loss of a batch, whose augmentation is drawn from the generator: ready for `backward`.

    Args:
        wrapped: the objective, as `fabric` has set it up.
    """
    device, bf16 = fabric.device.type, config.precision == "bf16"

    def by_kernels(batch: Batch, generator: Generator) -> Tensor:
        # Not Fabric's, which casts a recurrent network's weights anew at every step.
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            loss: Tensor = wrapped(batch.views, batch.labels, generator)
            return loss

    if device != "cuda" or fabric.world_size > 1:
        return by_kernels
    with closing(feed.epoch(0)) as drawn:
        batch = next(drawn)
    seen = objective.see(batch.views, generator_of(fabric.device, config.seed))
    graph = replayed(objective, seen, batch.labels, bf16)
    if graph is None:
        return by_kernels

    def by_graph(batch: Batch, generator: Generator) -> Tensor:
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            seen = objective.see(batch.views, generator)
        return graph(*seen, batch.labels)

    return by_graph


class _Loss(nn.Module):
    """An objective's loss of tensors alone, which is what can be captured."""

    def __init__(self, objective: Objective) -> None:
        super().__init__()
        self.objective = objective

    def forward(self, *tensors: Tensor) -> Tensor:
        *seen, labels = tensors
        return self.objective.loss(seen, labels)


def replayed(
    objective: Objective, seen: Sequence[Tensor], labels: Tensor, bf16: bool
) -> Callable[..., Tensor] | None:
    """The objective's loss as a function of (*seen, labels), all of the shapes of those given.

    The objective is left as it was, its running means, too. While the function is made, no other
    thread may use the GPU.

    Args:
        objective: on a GPU, in training mode.
        seen, labels: of any batch, as `Objective.loss` takes them.

    Returns:
        The function; None, which is logged, if there is something in the objective that cannot be
        captured, such as what another package adds and decides by values.
    """
    before = {name: buffer.clone() for name, buffer in objective.named_buffers()}
    loss = _Loss(objective).train()
    try:
        with torch.autocast("cuda", torch.bfloat16, enabled=bf16, cache_enabled=False):
            # In place: from here on the module replays.
            torch.cuda.make_graphed_callables(loss, (*seen, labels), allow_unused_input=True)
    except RuntimeError as error:
        logging.getLogger(__name__).warning(
            "an update cannot be one CUDA graph (%s): training goes on kernel by kernel, slower",
            reason(error),
        )
        return None
    finally:
        for name, buffer in objective.named_buffers():
            buffer.copy_(before[name])
    return loss
