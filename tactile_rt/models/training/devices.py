"""Where a run computes: this process alone, or with others under torchrun, each with its share."""

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.training.config import TrainingConfig

if TYPE_CHECKING:
    from lightning.fabric import Fabric

__all__ = ["is_first", "launched"]


def is_first() -> bool:
    """Whether this process is the one that writes: of torchrun's it is the first."""
    return os.environ.get("RANK", "0") == "0"


@contextmanager
def launched(config: TrainingConfig, device: str) -> Iterator["Fabric"]:
    """The devices of a run, together until the block ends.

    Args:
        device: "auto", "cpu", "cuda", ...

    Raises:
        ConfigError: a batch is too small to be shared, or there is no such device here.
    """
    # Imported here: seconds that whoever only loads a checkpoint need not spend.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from lightning.fabric import Fabric
        from lightning.fabric.strategies.ddp import DDPStrategy

    size = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if (config.batch < 2 * size and config.objective != "supervised") or config.batch < size:
        raise ConfigError(f"a batch of {config.batch} is too small to be shared by {size} devices")
    for name in ("lightning.fabric", "lightning.pytorch"):  # a run says enough itself
        logging.getLogger(name).setLevel(logging.WARNING)
    # Of kernels of 1 x 1, whose numbers lie alike whichever strides they are told to have.
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
    try:
        fabric = Fabric(
            accelerator=device,
            devices=local,
            num_nodes=size // local,
            # Static: some layers of some networks (a position never reached) have no part in a
            # window, and always the same ones.
            strategy=DDPStrategy(static_graph=True) if size > 1 else "auto",
        )
    # no such kind; none of it in this machine; none of what it needs
    except (ValueError, RuntimeError, ModuleNotFoundError) as error:
        raise ConfigError(f"accelerator is {device!r}: {error}") from None
    joined = torch.distributed.is_available() and torch.distributed.is_initialized()
    fabric.launch()
    try:
        yield fabric
    finally:
        if size > 1 and not joined:
            torch.distributed.destroy_process_group()
