"""Loads of an array that whisks the six stimuli: the input of models to score.

The input for the right mouse array is in this package, so that scoring needs no simulator; for any
other array, `tactile-rt whisk --array ...` makes it. A stimulus has 22 steps of 5 sub-steps from
the first contact on.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, describe_error, name_some
from tactile_rt.core.files import refuse_lfs_pointer
from tactile_rt.core.stream import ArraySpec
from tactile_rt.core.stream.sensor_spec import CHANNEL_FLOOR
from tactile_rt.core.stream.stimuli import STIMULI

SHIPPED = Path(__file__).parents[1] / "assets" / "six_stimuli.npz"
STEPS, SUBSTEPS, PERIOD_MS = 22, 5, 9


@dataclass(frozen=True, eq=False)
class StimuliInput:
    """Loads that an array measures for the six stimuli, in the order of `STIMULI`.

    Attributes:
        samples: (6, step, sub-step, element, channel) The loads while the array whisks each
            stimulus, float32, N and N m.
        sigma: (6, element, channel) The noise at rest, float32, N and N m: the smallest that is
            assumed for a sensor.
        elements, channels, units: Names along the last two axes, and the unit of each channel.
    """

    samples: NDArray[np.float32]
    sigma: NDArray[np.float32]
    elements: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    name: str
    sha256: str

    @property
    def offset(self) -> NDArray[np.float32]:
        """Baseline (6, element, channel), N and N m: zero, since whiskers start at rest."""
        return np.zeros_like(self.sigma)

    def check(self, spec: ArraySpec, steps: int, substeps: int, model: str, period_ns: int) -> None:
        """Check that the input fits the array and timing that a model was trained on.

        Args:
            period_ns: period of the model's samples, ns.

        Raises:
            ConfigError: they differ in elements, channels or units, in the steps and sub-steps of a
                window, or in the period.
        """
        make = "make its input with `tactile-rt whisk OUT.npz --array ...`, for --stimuli"
        only = "only a model of base forces and moments can be compared with barrel cortex"
        for what, do in (("elements", make), ("channels", only), ("units", only)):
            ours, theirs = getattr(self, what), getattr(spec, what)
            if ours != theirs:
                raise ConfigError(
                    f"{self.name} has the {what} {_name_few(ours)}, but {model} was trained on "
                    f"{_name_few(theirs)}: {do}"
                )
        if (steps, substeps) != (STEPS, SUBSTEPS):
            raise ConfigError(
                f"{model} takes {steps} steps of {substeps} samples, but the stimuli are {STEPS} "
                f"of {SUBSTEPS}, a sample every {PERIOD_MS} ms: only a model trained on sweeps "
                f"with period_ms = {PERIOD_MS} can be compared with barrel cortex"
            )
        if period_ns != PERIOD_MS * 1_000_000:
            raise ConfigError(
                f"{model} takes a sample every {period_ns / 1e6:g} ms, but the stimuli have one "
                f"every {PERIOD_MS} ms: only a model trained on sweeps with period_ms = "
                f"{PERIOD_MS} can be compared with barrel cortex"
            )

    def raw(self) -> NDArray[np.float64]:
        """Return loads averaged over time (6, element * channel), SI, as a control."""
        mean: NDArray[np.float64] = self.samples.astype(np.float64).mean(axis=(1, 2))
        return mean.reshape(len(STIMULI), -1)


def read_stimuli(path: Path | None = None) -> StimuliInput:
    """Read the stimuli's loads that `tactile-rt whisk` wrote; without a path, the shipped file."""
    path = SHIPPED if path is None else path
    refuse_lfs_pointer(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {k: file[k] for k in ("stimuli", "values", "elements", "channels", "units")}
    except FileNotFoundError:
        raise ConfigError(f"no file {path}: make one with `tactile-rt whisk`") from None
    except Exception as error:  # numpy and zipfile raise many unrelated types for a damaged file
        reason = describe_error(error, 80)
        raise ConfigError(f"{path} is no model input of `tactile-rt whisk`: {reason}") from None
    for what in ("stimuli", "elements", "channels", "units"):
        text = arrays[what]
        if text.ndim != 1 or text.dtype.kind != "U":
            raise ConfigError(f"{path}: {what} are {text.dtype} {text.shape}, not a row of names")
        if what != "units" and len(set(text.tolist())) < len(text):
            raise ConfigError(f"{path}: two {what} have the same name")
    names = [str(n) for n in arrays["stimuli"]]
    missing = [n for n in STIMULI if n not in names]
    if missing:
        raise ConfigError(f"{path} lacks the stimuli {name_some(missing)}")
    elements, channels, units = (
        tuple(str(n) for n in arrays[k]) for k in ("elements", "channels", "units")
    )
    values = arrays["values"]
    shape = (len(names), STEPS * SUBSTEPS, len(elements), len(channels))
    if values.shape != shape or len(units) != len(channels):
        raise ConfigError(
            f"{path}: values are {values.shape}, not (stimulus, sample, element, channel) {shape}"
        )
    if values.dtype.kind not in "fiu":
        raise ConfigError(f"{path}: values are {values.dtype}, not numbers")
    if not (np.abs(values) <= np.finfo(np.float32).max).all():
        raise ConfigError(f"{path} has samples that are not finite")
    if unknown := sorted(set(units) - set(CHANNEL_FLOOR)):
        raise ConfigError(f"{path}: channels in {name_some(unknown)} cannot be scored")
    samples = values[[names.index(n) for n in STIMULI]].astype(np.float32)
    floor = np.array([CHANNEL_FLOOR[u] for u in units], dtype=np.float32)
    return StimuliInput(
        samples=samples.reshape(len(STIMULI), STEPS, SUBSTEPS, *shape[2:]),
        sigma=np.broadcast_to(floor, (len(STIMULI), *shape[2:])).copy(),
        elements=elements,
        channels=channels,
        units=units,
        name=path.name,
        sha256=hashlib.sha256(samples.tobytes()).hexdigest(),
    )


def _name_few(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:4])}{', ...' if len(names) > 4 else ''} ({len(names)})"
