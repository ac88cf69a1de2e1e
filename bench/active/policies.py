"""How the array is moved: policies see observations of the environment, no more."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Observation = dict[str, NDArray[np.float32]]

TOUCH_N = 2e-5  # a force that is a touch, beyond the noise of a mean over 10 ms
STEP_S = 0.05
SPEED_MM_S = 60.0  # of a velocity of 1
WEIGHTS = (5, 5)  # (motion, feature) of a learnt policy


class Policy(Protocol):
    """Chooses the five numbers of motion of an action, see `ActiveWhisking`."""

    def begin(self, rng: np.random.Generator) -> None:
        """Another episode begins."""

    def move(self, seen: Observation) -> Floats:
        """(5,) amplitude, offset and velocity of the head, each in [-1, 1]."""


def _strength(seen: Observation) -> Floats:
    """(element,) the largest force on each whisker in the last step, N."""
    found: Floats = np.linalg.norm(seen["loads"][..., :3], axis=-1).max(axis=0).astype(float)
    return found


@dataclass
class Passive:
    """Whiskers held at rest go past the object and back, at another height every time.

    As in the sweeps on which the shipped model was trained: 28 to 40 mm/s.
    """

    _speed: float = 0.0
    _way: float = 1.0
    _still: int = 0
    _climb: float = 1.0
    _climbing: int = 0

    def begin(self, rng: np.random.Generator) -> None:
        self._speed = rng.uniform(28, 40) / SPEED_MM_S
        self._way, self._climb = 1.0, rng.choice([-1.0, 1.0])
        self._still = self._climbing = 0

    def move(self, seen: Observation) -> Floats:
        if self._climbing:
            self._climbing -= 1
            return np.array([-1.0, 0.0, 0.0, 0.0, self._climb * self._speed])
        self._still = self._still + 1 if abs(seen["head"][4]) < 2e-3 else 0
        if self._still > 4:  # at the end of its way
            self._way, self._still = -self._way, 0
            self._climbing = 4  # 5 to 8 mm
            self._climb = -self._climb if abs(seen["head"][2]) > 6e-3 else self._climb
        return np.array([-1.0, 0.0, 0.0, self._way * self._speed, 0.0])


@dataclass
class Scripted:
    """Whisk; go ahead until something is felt, then slowly along it, up and down."""

    _time: float = 0.0
    _phase: float = 0.0

    def begin(self, rng: np.random.Generator) -> None:
        self._time, self._phase = 0.0, rng.uniform(0, 2 * np.pi)

    def move(self, seen: Observation) -> Floats:
        self._time += STEP_S
        felt = (_strength(seen) > TOUCH_N).any()
        ahead = 0.2 if felt else 0.8
        up = 0.4 * np.sin(2 * np.pi * self._time / 1.0 + self._phase)
        return np.array([0.5, 0.0, 0.0, ahead, up])


@dataclass
class Learnt:
    """tanh(weights @ features): how much is felt, how high on the pad, and a slow rhythm.

    Attributes:
        weights: The (motion, feature) weights.
    """

    weights: Floats = field(default_factory=lambda: np.zeros(WEIGHTS))
    _time: float = 0.0

    def begin(self, rng: np.random.Generator) -> None:
        self._time = 0.0

    def move(self, seen: Observation) -> Floats:
        self._time += STEP_S
        felt = np.tanh(_strength(seen) / (2 * TOUCH_N)).reshape(3, -1).mean(axis=1)  # rows B, C, D
        turn = 2 * np.pi * self._time
        features = np.array([1.0, 2 * felt.mean(), felt[0] - felt[2], np.sin(turn), np.cos(turn)])
        moved: Floats = np.tanh(self.weights @ features)
        return moved
