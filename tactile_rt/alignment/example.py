"""A synthetic brain with known ground truth, to try and validate the benchmark.

- *Geometry.* Six stimuli are points in a space of `FEATURES` features, placed by distance, by shape
  and at random. Each mouse has this shared geometry, except for a share `private` of the features'
  variance, which is its own.
- *Units* mix the features, each unit with its own weights, into the logarithm of a firing rate.
  Spikes are Poisson, and all units of a trial share a gain that varies from trial to trial.
- *Damage.* A model that lost a share d of the shared variance has private variance instead. At
  d = 0 it is another mouse, at d = 1 it shares nothing.

All random numbers depend on one seed.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.rdm import Floats
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES, STIMULI

FEATURES = 6
# Median rate of units in spikes per second, and the spread of its logarithm over units.
MIDDLE_HZ, SPREAD = 5.0, 0.8
GAIN_SHAPE = 8.0  # shape of the gamma distribution of trials' gains: 35 % standard deviation
# Share of each layer's variance that comes from the model's geometry: none in the first layer, all
# in the last.
LAYERS = (0.0, 0.4, 0.7, 1.0)
LAYER_UNITS = 200
# Share of the shared variance that each of the example's models has lost.
MODELS = {"another-mouse": 0.0, "lost-25": 0.25, "lost-50": 0.5, "random": 1.0}


@dataclass(frozen=True)
class Brain:
    """Parameters of the synthetic brain: its size, and the statistics of its responses."""

    mice: int = 11
    sessions: int = 2  # of each mouse; each session has other units
    units: int = 45
    trials: int = 40
    private: float = 0.15  # share of the variance of a mouse's features that is its own, 0 to 1
    tuning: float = 0.32  # standard deviation over stimuli of the logarithm of a unit's rate
    # weights in the shared geometry of distance, shape, and random features of each stimulus
    distance: float = 1.0
    shape: float = 0.5
    own: float = 0.7

    def __post_init__(self) -> None:
        for name in ("mice", "sessions", "units", "trials"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if not 0 <= self.private <= 1:
            raise ConfigError(f"private must be from 0 to 1, not {self.private}")

    def geometry(self, rng: np.random.Generator) -> Floats:
        """Draw the shared geometry (6, feature): zero mean over stimuli, mean square one."""
        shape = np.repeat([-1.0, 1.0], len(DISTANCES))[:, None]
        distance = np.tile([-1.0, 0.0, 1.0], len(SHAPES))[:, None]
        return _standardise(
            self.distance * distance * rng.normal(size=FEATURES)
            + self.shape * shape * rng.normal(size=FEATURES)
            + self.own * rng.normal(size=(len(STIMULI), FEATURES))
        )

    def features(self, rng: np.random.Generator, shared: Floats, lost: float = 0.0) -> Floats:
        """Draw a mouse's features (6, feature), with a share `lost` of shared variance replaced."""
        kept = (1 - self.private) * (1 - lost)
        own = _standardise(rng.normal(size=shared.shape))
        return np.asarray(np.sqrt(kept) * shared + np.sqrt(1 - kept) * own)

    def rates(self, rng: np.random.Generator, features: Floats, units: int) -> Floats:
        """Draw units; return their mean rates (6, unit) for the stimuli, in spikes per second."""
        weights = rng.normal(size=(features.shape[1], units)) / np.sqrt(features.shape[1])
        level = np.log(MIDDLE_HZ) + SPREAD * rng.normal(size=units)
        return np.asarray(np.exp(level + self.tuning * features @ weights))

    def animals(self, rng: np.random.Generator, shared: Floats) -> tuple[Animal, ...]:
        """Draw recordings of all mice, with trials of 1 s, in memory."""
        return tuple(
            self.animal(rng, self.features(rng, shared), f"mouse-{k + 1:02d}")
            for k in range(self.mice)
        )

    def animal(self, rng: np.random.Generator, features: Floats, name: str) -> Animal:
        """Draw the recorded sessions of a mouse with given features (6, feature)."""
        sessions = []
        for k in range(self.sessions):
            rates = self.rates(rng, features, self.units)
            stimulus = rng.permutation(np.repeat(np.arange(len(STIMULI)), self.trials))
            spikes = rng.poisson(rates[stimulus] * gains(rng, len(stimulus))[:, None])
            sessions.append(NeuralSession(name, f"{name}-{k + 1}", spikes.astype(float), stimulus))
        return Animal(name, tuple(sessions))

    def model(self, rng: np.random.Generator, features: Floats) -> dict[str, Floats]:
        """Draw a model with given features: responses (6, unit), without noise, by layer."""
        base = self.rates(rng, features, LAYER_UNITS)
        return {
            f"encoder.layer{k}": _blend(base, _draw_alike(rng, base), kept)
            for k, kept in enumerate(LAYERS)
        }


def example_models(
    brain: Brain, rng: np.random.Generator, shared: Floats
) -> Mapping[str, dict[str, Floats]]:
    """Draw the example models in `MODELS`: responses (6, unit) by model and layer."""
    return {
        name: brain.model(rng, brain.features(rng, shared, lost)) for name, lost in MODELS.items()
    }


def gains(rng: np.random.Generator, trials: int) -> Floats:
    """Draw a random gain (trial,) for each trial, with mean 1."""
    return rng.gamma(GAIN_SHAPE, 1 / GAIN_SHAPE, size=trials)


def _standardise(values: Floats) -> Floats:
    centred = values - values.mean(axis=0)
    return np.asarray(centred / np.sqrt((centred**2).mean()))


def _draw_alike(rng: np.random.Generator, rates: Floats) -> Floats:
    """Draw random responses with the unit means and the variance over stimuli of `rates`."""
    level = rates.mean(axis=0)
    spread = np.sqrt(((rates - level) ** 2).mean())
    return np.asarray(level + spread * _standardise(rng.normal(size=rates.shape)))


def _blend(rates: Floats, others: Floats, kept: float) -> Floats:
    level = rates.mean(axis=0)
    mixed = level + np.sqrt(kept) * (rates - level) + np.sqrt(1 - kept) * (others - level)
    return np.asarray(mixed)
