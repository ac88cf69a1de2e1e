"""Forward and backward pass of an update as one CUDA graph.

An update of a recurrent network is thousands of kernels, each of which takes longer to start than
to run. A graph of them is started once.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from tactile_rt.models.objectives import Objective

__all__ = ["replayed"]


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
        bf16: whether products are computed in that format.

    Returns:
        The function; None if there is something in the objective that cannot be captured, such as
        what another package adds and decides by values.
    """
    before = {name: buffer.clone() for name, buffer in objective.named_buffers()}
    loss = _Loss(objective).train()
    try:
        with torch.autocast("cuda", torch.bfloat16, enabled=bf16, cache_enabled=False):
            # In place: from here on the module replays.
            torch.cuda.make_graphed_callables(loss, (*seen, labels), allow_unused_input=True)
    except RuntimeError:
        return None
    finally:
        for name, buffer in objective.named_buffers():
            buffer.copy_(before[name])
    return loss
