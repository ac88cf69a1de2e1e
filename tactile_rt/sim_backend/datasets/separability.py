"""The published check that a set can be learnt from: support vector machines on few classes.

Chung et al. (2025) decode 2, 3 and 4 classes (cups, microwaves, chairs, trains) from the raw
loads. Here the same is done for every set, by object: the machine is tested on objects that it
never saw, or it would only have to recognise sweeps of a thing that it knows.

The machine itself is handed in: `models.svm.fit`, the same that networks are compared with.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.sensor_spec import ChannelLimits
from tactile_rt.timing import STEP_MS, STEPS

__all__ = ["Features", "Fit", "Separability", "check_separability", "window_features"]

PENALTY = 10.0  # C of the machine
SUBSETS = 12  # of each number of classes, at most
PER_CLASS = 120  # sweeps of a class to train on, at most: enough to see that it can be learnt
# The published classes, each with what comes nearest to it, best first.
PUBLISHED = (
    ("cup", "mug"),
    ("microwave", "books", "house", "sofa"),
    ("chair",),
    ("train", "truck", "car", "plane"),
)

# (sweep, feature) values, (sweep,) names and a penalty -> a machine: other values to their names.
Fit = Callable[
    [NDArray[np.float32], NDArray[Any], float], Callable[[NDArray[np.float32]], NDArray[Any]]
]


@dataclass(frozen=True)
class Features:
    """What a machine sees of some sweeps.

    Attributes:
        values: The (sweep, feature) features, see `window_features`.
        categories: The (sweep,) names of the categories.
    """

    values: NDArray[np.float32]
    categories: NDArray[np.str_]


@dataclass(frozen=True)
class Separability:
    """How well classes are told apart, on objects that were not trained on.

    Attributes:
        classes: The number of classes at a time.
        subsets: The number of choices of so many classes that were tried.
        accuracy: The mean accuracy over these choices, each the mean over its classes; 0 to 1.
        spread: The standard deviation of the accuracy over these choices.
        chance: The accuracy that guessing gives; 0 to 1.
        of: The names of the classes, where there was one choice.
    """

    classes: int
    subsets: int
    accuracy: float
    spread: float
    chance: float
    of: tuple[str, ...] = ()


def window_features(
    values: NDArray[np.float32], start: int, period_ms: float, limits: ChannelLimits
) -> NDArray[np.float32]:
    """(22 * element * channel,) what a machine sees of one sweep.

    Args:
        values: (sample, element, channel) SI.
        start: sample of first contact.
        period_ms: of the samples, ms.
        limits: what is believed of the channels.
    """
    edges = start + np.arange(STEPS + 1) * STEP_MS / period_ms
    edges = np.minimum(edges.round().astype(int), len(values) - 1)
    steps = np.stack([values[a : max(b, a + 1)].mean(axis=0) for a, b in itertools.pairwise(edges)])
    steps = np.clip(steps, -limits.clip, limits.clip)
    features = np.sign(steps) * np.log1p(np.abs(steps) / limits.noise)
    flat: NDArray[np.float32] = features.astype(np.float32).ravel()
    return flat


def check_separability(train: Features, test: Features, fit: Fit) -> list[Separability]:
    """2, 3 and 4 classes: the published ones or what comes nearest, then any.

    Args:
        train, test: sweeps of different objects.
        fit: fits a machine.

    Returns:
        Nothing for a number of classes that the set does not have.
    """
    known = sorted(set(train.categories) & set(test.categories))
    rng = np.random.default_rng(0)
    found = []
    for nearest, n in itertools.product((True, False), (2, 3, 4)):
        pool = _nearest(known) if nearest else known
        if len(pool) < n:
            continue
        if nearest:
            subsets = [tuple(pool[:n])]
        else:
            subsets = _subsets(rng, pool, n)
        right = [_accuracy(train, test, classes, fit) for classes in subsets]
        found.append(
            Separability(
                n,
                len(subsets),
                float(np.mean(right)),
                float(np.std(right)),
                1 / n,
                subsets[0] if nearest else (),
            )
        )
    return found


def _nearest(known: list[str]) -> list[str]:
    """What comes nearest to the published classes, as far as the set has it."""
    return [next(c for c in names if c in known) for names in PUBLISHED if set(names) & set(known)]


def _subsets(rng: np.random.Generator, known: list[str], n: int) -> list[tuple[str, ...]]:
    if math.comb(len(known), n) <= SUBSETS:
        return list(itertools.combinations(known, n))
    drawn: dict[tuple[str, ...], None] = {}
    while len(drawn) < SUBSETS:
        drawn[tuple(sorted(rng.choice(known, n, replace=False).tolist()))] = None
    return list(drawn)


def _accuracy(train: Features, test: Features, classes: tuple[str, ...], fit: Fit) -> float:
    """Mean over classes of the share of test sweeps that are decided rightly."""
    chosen = np.concatenate([np.flatnonzero(train.categories == c)[:PER_CLASS] for c in classes])
    predict = fit(train.values[chosen], train.categories[chosen], PENALTY)
    right = []
    for c in classes:
        sweeps = test.values[test.categories == c]
        right.append(float((predict(sweeps) == c).mean()))
    return float(np.mean(right))
