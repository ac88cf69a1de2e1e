"""What a real sensor does that a simulated one does not, put into stored sweeps."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.datasets import SweepSet, channel_values
from tactile_rt.stream import ConfigError

__all__ = ["CLEAN", "OFFSET", "Disturbance"]

OFFSET = {"N": 20e-6, "N m": 1e-7}  # a unit of offset that appears after the tare, SI


@dataclass(frozen=True)
class Disturbance:
    """What is wrong with the sensor; each sweep is a draw of its own.

    Attributes:
        noise: white, on every stored sample, in units of the rated noise.
        gain: one standard deviation of every whisker's relative gain error.
        dead: how many whiskers, drawn at random, read zero throughout.
        offset: a constant that appears with the contact, after the tare, in units of `OFFSET`;
            its sign is drawn for every whisker and channel.
        rest: stored samples of silence before each sweep, for the tare; a robot has them, the
            sweeps have only a short lead.

    Raises:
        ConfigError: a negative amount.
    """

    noise: float = 0.0
    gain: float = 0.0
    dead: int = 0
    offset: float = 0.0
    rest: int = 0

    def __post_init__(self) -> None:
        for name in ("noise", "gain", "dead", "offset", "rest"):
            if not getattr(self, name) >= 0:  # which NaN is not either
                raise ConfigError(f"{name} is {getattr(self, name)}, must not be negative")

    def of_samples(
        self, values: NDArray[np.float32], data: SweepSet, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """What the detector sees, of (sweep, sample, element, channel) SI."""
        n, elements = len(values), values.shape[2]
        if self.rest:
            silence = np.zeros((n, self.rest, *values.shape[2:]), dtype=np.float32)
            values = np.concatenate([silence, values], axis=1)
        if self.gain:
            error = rng.normal(size=(n, 1, elements, 1)).astype(np.float32)
            values = values * (1 + np.float32(self.gain) * error)
        if self.dead:
            rank = rng.permuted(np.tile(np.arange(elements), (n, 1)), axis=1)
            values = values * (rank >= self.dead)[:, None, :, None]
        if self.noise:
            noise = rng.normal(size=values.shape).astype(np.float32)
            values = values + noise * data.noise * np.float32(self.noise)
        return values

    def of_windows(
        self, samples: NDArray[np.float32], data: SweepSet, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """What the network sees, of (sweep, step, sub-step, element, channel) SI."""
        if not self.offset:
            return samples
        size = channel_values(data.manifest.spec, OFFSET) * np.float32(self.offset)
        sign = rng.choice(np.array([-1, 1], dtype=np.float32), (len(samples), *samples.shape[3:]))
        there: NDArray[np.float32] = samples + (sign * size)[:, None, None]
        return there


CLEAN = Disturbance()
