"""A made-up brain with known truth, for trying and validating the benchmark.

- *Geometry.* Six stimuli are points in a space of `FEATURES` features, placed by distance, by shape
  and at random. Each mouse has this shared geometry, except for a share `private` of the features'
  variance, which is its own.
- *Units* mix the features, each unit with its own weights, into the logarithm of a firing rate.
  Spikes are Poisson, and all units of a trial share a gain that varies from trial to trial.
- *Damage.* A model that lost a share d of the shared variance has private variance instead. At
  d = 0 it is another mouse, at d = 1 it shares nothing.

Every random number comes from one seed.
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
GAIN_SHAPE = 8.0  # of the gamma distribution of a trial's gain: a standard deviation of 35 %
# Share of each layer's variance that comes from the model's geometry: the first layer is random,
# the last is the best.
LAYERS = (0.0, 0.4, 0.7, 1.0)
LAYER_UNITS = 200
# Share of the shared variance that each of the example's models has lost.
MODELS = {"another-mouse": 0.0, "lost-25": 0.25, "lost-50": 0.5, "random": 1.0}


@dataclass(frozen=True)
class Brain:
    """The recorded mice, sessions, units and trials, and the parameters of their responses."""

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
                raise ConfigError(f"{name}: at least 1, not {getattr(self, name)}")
        if not 0 <= self.private <= 1:
            raise ConfigError(f"private: a share from 0 to 1, not {self.private}")

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
        """Draw features (6, feature) of a mouse that lost a share of the shared variance."""
        kept = (1 - self.private) * (1 - lost)
        own = _standardise(rng.normal(size=shared.shape))
        return np.asarray(np.sqrt(kept) * shared + np.sqrt(1 - kept) * own)

    def rates(self, rng: np.random.Generator, features: Floats, units: int) -> Floats:
        """Draw units and return their rates (6, unit) without noise, in spikes per second."""
        weights = rng.normal(size=(features.shape[1], units)) / np.sqrt(features.shape[1])
        level = np.log(MIDDLE_HZ) + SPREAD * rng.normal(size=units)
        return np.asarray(np.exp(level + self.tuning * features @ weights))

    def animals(self, rng: np.random.Generator, shared: Floats) -> tuple[Animal, ...]:
        """Draw all mice, recorded in trials of 1 s each, without writing files."""
        return tuple(
            self.animal(rng, self.features(rng, shared), f"mouse-{k + 1:02d}")
            for k in range(self.mice)
        )

    def animal(self, rng: np.random.Generator, features: Floats, name: str) -> Animal:
        """Draw the recordings of a mouse of given features."""
        sessions = []
        for k in range(self.sessions):
            rates = self.rates(rng, features, self.units)
            stimulus = rng.permutation(np.repeat(np.arange(len(STIMULI)), self.trials))
            spikes = rng.poisson(rates[stimulus] * gains(rng, len(stimulus))[:, None])
            sessions.append(NeuralSession(name, f"{name}-{k + 1}", spikes.astype(float), stimulus))
        return Animal(name, tuple(sessions))

    def model(self, rng: np.random.Generator, features: Floats) -> dict[str, Floats]:
        """Draw a model's layers by name from its features: responses (6, unit) without noise."""
        base = self.rates(rng, features, LAYER_UNITS)
        return {
            f"encoder.layer{k}": _blend(base, _draw_alike(rng, base), kept)
            for k, kept in enumerate(LAYERS)
        }


def example_models(
    brain: Brain, rng: np.random.Generator, shared: Floats
) -> Mapping[str, dict[str, Floats]]:
    """Draw the models of known truth in `MODELS`, each as its layers by name."""
    return {
        name: brain.model(rng, brain.features(rng, shared, lost)) for name, lost in MODELS.items()
    }


def gains(rng: np.random.Generator, trials: int) -> Floats:
    """Draw the gain of every trial, (trial,), with mean one."""
    return rng.gamma(GAIN_SHAPE, 1 / GAIN_SHAPE, size=trials)


def _standardise(values: Floats) -> Floats:
    centred = values - values.mean(axis=0)
    return np.asarray(centred / np.sqrt((centred**2).mean()))


def _draw_alike(rng: np.random.Generator, rates: Floats) -> Floats:
    """Draw random responses with the same unit means and variance over stimuli as the given."""
    level = rates.mean(axis=0)
    spread = np.sqrt(((rates - level) ** 2).mean())
    return np.asarray(level + spread * _standardise(rng.normal(size=rates.shape)))


def _blend(rates: Floats, others: Floats, kept: float) -> Floats:
    level = rates.mean(axis=0)
    mixed = level + np.sqrt(kept) * (rates - level) + np.sqrt(1 - kept) * (others - level)
    return np.asarray(mixed)
