"""Accuracy of a model with a degraded sensor: noisy, drifting, miswired, partly dead."""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import OFFSET, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.records import Record, record_share

REST = 80  # samples at rest for the baseline, 0.7 s at the mouse array's period


def rated_amount(data: SweepSet, factor: float = 1.0) -> str:
    """Format `factor` times the rated noise per sample, e.g. "10 uN and 0.05 uN m"."""
    largest: dict[str, float] = {}
    for unit, noise in zip(data.manifest.spec.units, data.noise.tolist(), strict=True):
        largest[unit] = max(largest.get(unit, 0.0), noise)
    return " and ".join(f"{1e6 * factor * v:.3g} u{unit}" for unit, v in largest.items())


def conditions(data: SweepSet) -> dict[str, Disturbance]:
    """Return the disturbances to test, by names that state amounts for the set's sensor."""
    rated, whiskers = rated_amount(data), len(data.manifest.spec.elements)
    found = {
        "noise at a quarter of the rated": Disturbance(noise=0.25),
        "noise at half the rated": Disturbance(noise=0.5),
        f"rated noise, {rated}": Disturbance(noise=1.0),
        f"rated noise, after {REST} samples of rest": Disturbance(noise=1.0, rest=REST),
        "noise at twice the rated": Disturbance(noise=2.0),
        f"offset of {rated_amount(data, OFFSET / 4)} after the baseline": Disturbance(offset=0.25),
        f"offset of {rated_amount(data, OFFSET)} after the baseline": Disturbance(offset=1.0),
        f"drift of {rated_amount(data, OFFSET)} in a window": Disturbance(drift=1.0),
        "gain error of 20 % per whisker": Disturbance(gain=0.2),
    }
    if whiskers > 1:
        dead = max(1, whiskers // 5)
        found[f"{dead} dead whisker{'s' if dead > 1 else ''}"] = Disturbance(dead=dead)
    if data.manifest.spec.grid_shape[0] > 1:
        found["a dead row of whiskers"] = Disturbance(rows=1)
    channels = data.manifest.spec.channels
    if any(name.endswith("x") and f"{name[:-1]}y" in channels for name in channels):
        found["x and y connected the wrong way round"] = Disturbance(swapped=True)
    if data.manifest.recorded:  # recordings contain their sensor's noise
        return {name: d for name, d in found.items() if not 0 < d.noise <= 1}
    return found


def measure_robustness(
    test: SweepSet, run: measures.Step, clean: NDArray[np.float32]
) -> list[Record]:
    """Measure accuracy under every disturbance, and the loss against undisturbed sweeps.

    Args:
        clean: (sweep, class) posteriors at the last step of the same sweeps, undisturbed.
    """
    labels, objects = test.sweeps.labels, test.sweeps.objects
    base = measures.hits(clean, labels).astype(np.float64)
    records = []
    for name, disturbance in conditions(test).items():
        there = measures.predict(test, run, disturbance=disturbance)[:, -1]
        right = measures.hits(there, labels)
        lost = measures.accuracy(base - right, objects)
        how = f"{100 * lost.value:.1f} points lost ({100 * lost.low:.1f} to {100 * lost.high:.1f})"
        how += f"; {len(labels)} of the sweeps"
        records.append(record_share(f"top-1, {name}", measures.accuracy(right, objects), "", how))
    return records
