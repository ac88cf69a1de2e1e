"""Implausible loads, which no touch produces: a sensor wired wrongly, or half of it missing.

A network should classify in spite of the faults in `sensor_faults`. The faults here it should
name, since such loads say nothing about the object. Training makes them out of sound sweeps.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec

Samples = NDArray[np.float32]  # (sweep, ..., element, channel), SI

AXES = "xyz"
GAINS = (2.5, 5.0)  # range of the factor by which loads are too large or too small
MISSING = (0.45, 0.7)  # of the elements
FEWEST = 4  # smallest array in which half of the elements can be missing


def _swap_axes(samples: Samples, spec: ArraySpec, rng: np.random.Generator) -> Samples:
    """Swap two random axes in each sweep, of the force, the moment or both."""
    vectors = _find_vectors(spec)
    out = samples.copy()
    for k in range(len(out)):
        first, second = rng.choice(3, 2, replace=False)
        for axes in _pick_vectors(vectors, rng):
            out[k][..., [axes[first], axes[second]]] = samples[k][..., [axes[second], axes[first]]]
    return out


def _invert_axes(samples: Samples, spec: ArraySpec, rng: np.random.Generator) -> Samples:
    """Invert random axes in each sweep, of the force, the moment or both."""
    vectors = _find_vectors(spec) or [tuple(range(len(spec.channels)))]
    out = samples.copy()
    for k in range(len(out)):
        turned = rng.permutation(len(vectors[0]))[: rng.integers(1, len(vectors[0]) + 1)]
        for axes in _pick_vectors(vectors, rng):
            out[k][..., [axes[i] for i in turned]] *= -1
    return out


def _scale_loads(samples: Samples, spec: ArraySpec, rng: np.random.Generator) -> Samples:
    """Multiply or divide the loads of each sweep by a random factor within `GAINS`."""
    n, (least, most) = len(samples), np.log(GAINS)
    factor = np.exp(rng.uniform(least, most, n) * rng.choice([-1, 1], n))
    each = factor.reshape(-1, *(1,) * (samples.ndim - 1))
    amplified: Samples = (samples * each).astype(np.float32)
    return amplified


def _silence_half(samples: Samples, spec: ArraySpec, rng: np.random.Generator) -> Samples:
    """Set about half of each sweep's elements to zero, at random or on one side."""
    elements = len(spec.elements)
    grid = np.array(spec.grid, dtype=np.float64)
    alive = np.ones((len(samples), elements))
    for k in range(len(samples)):
        along = rng.normal(size=2) @ grid.T if rng.random() < 0.5 else rng.random(elements)
        alive[k, np.argsort(along)[: round(rng.uniform(*MISSING) * elements)]] = 0
    shape = (len(samples), *(1,) * (samples.ndim - 3), elements, 1)
    return (samples * alive.reshape(shape)).astype(np.float32)


IMPLAUSIBLE: dict[str, Callable[[Samples, ArraySpec, np.random.Generator], Samples]] = {
    "swapped channels": _swap_axes,
    "turned channels": _invert_axes,
    "wrong gain": _scale_loads,
    "missing elements": _silence_half,
}


def implausible(spec: ArraySpec) -> tuple[str, ...]:
    """Return the names of the implausible faults that are possible for an array."""
    possible = {
        "swapped channels": bool(_find_vectors(spec)),
        "missing elements": len(spec.elements) >= FEWEST,
    }
    return tuple(name for name in IMPLAUSIBLE if possible.get(name, True))


def _find_vectors(spec: ArraySpec) -> list[tuple[int, ...]]:
    """Return channel indices (x, y, z) of each vector among the channels, such as force."""
    names = list(spec.channels)
    stems = dict.fromkeys(name[:-1] for name in names if name[-1] in AXES)
    whole = [stem for stem in stems if all(stem + axis in names for axis in AXES)]
    return [tuple(names.index(stem + axis) for axis in AXES) for stem in whole]


def _pick_vectors(
    vectors: list[tuple[int, ...]], rng: np.random.Generator
) -> list[tuple[int, ...]]:
    """Return all vectors or, with probability 1/2, a random one."""
    return vectors if rng.random() < 0.5 else [vectors[rng.integers(len(vectors))]]
