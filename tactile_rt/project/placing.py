"""Sizes and places at which objects touch an array, found from the reach of its whiskers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.objects.catalogue import make_object
from tactile_rt.sim_backend.sweep import Sweep, centrelines, draw_sweep, usual_distance, usual_size
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES

SPREAD = (5.5 / 6.5, 8 / 6.5)  # relative range of the distances, as `draw_sweep` draws them
ABOUT_MM = 6.0  # largest height of an object of 40 mm above or below the middle of the tips
NEARER = (1.0, 0.8, 0.6, 0.45, 0.3)  # shares of the usual distance, tried in turn
TRIALS, ENOUGH = 48, 0.97  # sweeps that are tried, and the share of them that should touch
_make_object = lru_cache(2 * TRIALS)(make_object)  # the same objects pass at every distance


@dataclass(frozen=True)
class ObjectPlacing:
    """Size and places of objects that touch an array.

    Attributes:
        size_mm: Largest extent of an object.
        distance_mm: Least and largest distance from the bases of the whiskers.
        height_mm: Least and largest height.
        touching: Share of sweeps at these places in which an object touches a whisker.
    """

    size_mm: float
    distance_mm: tuple[float, float]
    height_mm: tuple[float, float]
    touching: float


def place_objects(animals: tuple[WhiskerArray, ...], kinds: Sequence[str]) -> ObjectPlacing:
    """Find the farthest places at which nearly all sweeps touch, or else most sweeps.

    Objects are as large as the tips are apart, at the height of the tips, and no nearer than
    needed: nearer objects jam stiff whiskers.

    Args:
        kinds: categories of the objects.
    """
    size, usual = usual_size(animals), usual_distance(animals)
    tips = [line[-1] for a in animals for line in centrelines(a.whiskers, a.mount)]
    middle, about = float(np.median([tip[2] for tip in tips])), ABOUT_MM * size / Sweep.size_mm
    height = (round(middle - about, 1), round(middle + about, 1))
    tried = []
    for nearer in NEARER:
        near, far = (round(share * nearer * usual, 2) for share in SPREAD)
        touching = _share_touching(animals, kinds, size, (near, far), height)
        tried.append(ObjectPlacing(size, (near, far), height, touching))
        if touching >= ENOUGH:
            break
    return max(tried, key=lambda one: one.touching)


def _share_touching(
    animals: tuple[WhiskerArray, ...],
    kinds: Sequence[str],
    size_mm: float,
    distance_mm: tuple[float, float],
    height_mm: tuple[float, float],
) -> float:
    """Return the share of random sweeps in which an object touches; no sweep is simulated."""
    rng, touching = np.random.default_rng(0), 0
    for number in range(TRIALS):
        distance, height = float(rng.uniform(*distance_mm)), float(rng.uniform(*height_mm))
        chosen = {"size_mm": size_mm, "distance_mm": distance, "height_mm": height}
        target = _make_object(kinds[number % len(kinds)], number // len(kinds))
        sweep = draw_sweep(rng, chosen=chosen)
        touching += SweepSimulation(animals, target, sweep, PROFILES["realtime"]).touches
    return touching / TRIALS
