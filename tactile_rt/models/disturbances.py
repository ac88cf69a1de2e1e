"""Disturbances of a real sensor that simulated sweeps lack, for robustness tests of a model.

The faults that training draws are in `sets.sensor_faults`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.datasets import SweepSet

OFFSET = 2.0  # a unit of offset that appears after the baseline, in units of the rated noise

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Disturbance:
    """Amounts of the sensor faults of a robustness test, drawn anew for each sweep.

    Attributes:
        noise: The white noise on every stored sample, in units of the rated noise; recorded sweeps
            already have one unit, and only the difference is added.
        gain: The standard deviation of every whisker's relative gain error.
        dead: The number of whiskers, drawn at random, that read zero throughout.
        rows: The number of rows of the grid, drawn at random, whose whiskers all read zero.
        offset: The size of a constant that appears with the contact, after the baseline, in units
            of `OFFSET`; a sign is drawn for every whisker and channel.
        drift: The size at the window's end of a linear drift that begins at contact, in units of
            `OFFSET`; a sign is drawn as for the offset.
        swapped: True if the x and y channels are swapped.
        rest: The number of zero samples put before each simulated sweep, for the baseline; a robot
            rests for longer than the short lead of a simulated sweep.

    Raises:
        ConfigError: a negative amount.
    """

    noise: float = 0.0
    gain: float = 0.0
    dead: int = 0
    rows: int = 0
    offset: float = 0.0
    drift: float = 0.0
    swapped: bool = False
    rest: int = 0

    def __post_init__(self) -> None:
        for name in ("noise", "gain", "dead", "rows", "offset", "drift", "rest"):
            if not getattr(self, name) >= 0:  # also if it is NaN
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")

    def disturb_samples(self, values: Floats, data: SweepSet, rng: np.random.Generator) -> Floats:
        """Add rest, gain errors, dead whiskers, swapped channels and noise to sweeps.

        Args:
            values: (sweep, sample, element, channel), SI, of the sweeps in `data`.
        """
        if self == CLEAN:
            return values
        n, elements = len(values), values.shape[2]
        if data.manifest.lead:  # faults act on the change from rest, which is not 0 in a field
            values = values - values[:, : data.manifest.lead].mean(axis=1, keepdims=True)
        if self.rest and not data.recorded.any():
            silence = np.zeros((n, self.rest, *values.shape[2:]), dtype=np.float32)
            values = np.concatenate([silence, values], axis=1)
        if self.gain:
            error = rng.normal(size=(n, 1, elements, 1)).astype(np.float32)
            values = values * (1 + np.float32(self.gain) * error)
        if self.dead:
            rank = rng.permuted(np.tile(np.arange(elements), (n, 1)), axis=1)
            values = values * (rank >= self.dead)[:, None, :, None]
        if self.rows:
            grid = np.array(data.manifest.spec.grid)[:, 0]
            rank = rng.permuted(np.tile(np.unique(grid), (n, 1)), axis=1)
            gone = (grid == rank[:, : self.rows, None]).any(axis=1)
            values = values * ~gone[:, None, :, None]
        if self.swapped:
            values = values[..., _swap_x_and_y(data.manifest.spec.channels)]
        if self.noise:
            noise = rng.normal(size=values.shape).astype(np.float32)
            lacking = np.sqrt(max(self.noise**2 - 1, 0))
            level = np.where(data.recorded, lacking, self.noise).astype(np.float32)
            values = values + noise * data.noise * level[:, None, None, None]
        return values

    def disturb_windows(self, samples: Floats, data: SweepSet, rng: np.random.Generator) -> Floats:
        """Add offset and drift to windows (sweep, step, sub-step, element, channel), SI."""
        steps, substeps = samples.shape[1:3]
        course = np.arange(1, steps * substeps + 1, dtype=np.float32) / (steps * substeps)
        for amount, over_time in ((self.offset, np.ones_like(course)), (self.drift, course)):
            if amount:
                size = OFFSET * data.noise * np.float32(amount)
                shape = (len(samples), *samples.shape[3:])
                sign = rng.choice(np.array([-1, 1], dtype=np.float32), shape)
                over = over_time.reshape(steps, substeps, 1, 1)
                samples = samples + (sign * size)[:, None, None] * over
        return samples


CLEAN = Disturbance()
RATED = Disturbance(noise=1.0)


def _swap_x_and_y(channels: Sequence[str]) -> list[int]:
    """Return channel indices in which names ending in x and y are swapped."""
    other = {"x": "y", "y": "x"}
    swapped = [name[:-1] + other.get(name[-1], name[-1]) for name in channels]
    return [channels.index(name if name in channels else channels[k])
            for k, name in enumerate(swapped)]  # fmt: skip
