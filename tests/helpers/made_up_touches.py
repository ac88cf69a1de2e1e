"""Made-up touches of a force-torque sensor: presses, slides and taps, no two alike."""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.opening import make_codec

KINDS = ("press", "slide", "double")
RATE_HZ = 100.0
NOISE = np.array([0.04] * 3 + [8e-4] * 3)


def wrench_spec() -> ArraySpec:
    """The array of a Bota sensor."""
    spec = make_codec("serial", "bota", {}).spec
    assert spec is not None
    return spec


def touch(kind: str, rng: np.random.Generator) -> NDArray[np.float32]:
    """(sample, 1, 6) a touch with a second of rest before and after it, N and N m."""
    strength, speed = 4 * 2 ** rng.uniform(-1, 1), np.exp(rng.uniform(-0.35, 0.35))
    u = np.linspace(0, 1, int(0.8 * RATE_HZ / speed))
    across = np.zeros_like(u)
    if kind == "double":
        along = np.maximum(np.sin(3 * np.pi * u), 0) * ((u < 1 / 3) | (u > 2 / 3))
    else:
        along = np.clip(np.minimum(u / 0.15, (1 - u) / 0.15), 0, 1)
    if kind == "slide":
        across = 0.6 * along
    if kind in ("push", "twist"):
        across = (kind == "push") * 1.2 * along
        along = 0.2 * along
    turn = np.sin(2 * np.pi * u) if kind == "twist" else np.zeros_like(u)
    lever = 0.02 * rng.uniform(-1, 1, 2)
    wrench = np.stack(
        [across, 0 * u, along, lever[1] * along, -lever[0] * along, 0.02 * turn], axis=1
    )
    rest = np.zeros((int(RATE_HZ), 6))
    whole = np.concatenate([rest, strength * wrench, rest])
    noisy = whole + NOISE * rng.normal(size=whole.shape)
    found: NDArray[np.float32] = noisy.astype(np.float32)[:, None]
    return found


def felt(kinds: list[str], seed: int) -> NDArray[np.float32]:
    """(sample, 1, 6) these touches, one after the other, after three seconds of rest."""
    rng = np.random.default_rng(seed)
    rest = NOISE * rng.normal(size=(int(3 * RATE_HZ), 1, 6))
    parts = [rest.astype(np.float32), *(touch(kind, rng) for kind in kinds)]
    found: NDArray[np.float32] = np.concatenate(parts)
    return found
