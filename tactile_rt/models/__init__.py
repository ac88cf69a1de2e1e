"""Encoder-Attender-Decoder networks in torch, trained and evaluated. Needs the `train` extra.

`alignment` and the RSA benchmark run without torch, so modules are imported only when used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tactile_rt.models.ead import EAD, InputStage, count_parameters
    from tactile_rt.models.ead_config import EADConfig

__all__ = ["EAD", "EADConfig", "InputStage", "count_parameters"]

_HOMES = {
    "EAD": "ead",
    "EADConfig": "ead_config",
    "InputStage": "ead",
    "count_parameters": "ead",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
