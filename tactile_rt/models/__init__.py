"""Encoder-Attender-Decoder networks in torch. Needs the `train` extra."""

from tactile_rt.models.ead import EAD, EADConfig, count_parameters
from tactile_rt.models.inputs import InputStage

__all__ = ["EAD", "EADConfig", "InputStage", "count_parameters"]
