"""Print the errors of contact distance by mechanics, on the test objects of a set with contacts.

python -m bench.perception.contact_points data/contacts
"""

import sys
from pathlib import Path

import numpy as np

from tactile_rt.classifier.contact_point import ESTIMATES, WhiskerShapes
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import read_sweeps
from tactile_rt.sim_backend.arrays.files import load_animals

FELT_N = 30e-6  # of transverse force: three times the rated noise


def main(folder: Path) -> None:
    manifest, sweeps = SweepManifest.read(folder), read_sweeps(folder, "test")
    animals = load_animals(str(manifest.recipe.get("array", "mouse")))
    whiskers = [whisker for animal in animals for whisker in animal.whiskers]
    shapes = WhiskerShapes(
        length=np.array([w.length for w in whiskers]) * 1e-3,
        curvature=np.array([w.curvature for w in whiskers]) * 1e3,
        base_radius=np.array([w.base_radius for w in whiskers]) * 1e-3,
        tip_radius=np.array([w.tip_radius for w in whiskers]) * 1e-3,
        young_modulus=np.array([w.young_modulus for w in whiskers]),
    )
    truth = sweeps.contacts
    assert truth is not None, "make the set with --set contacts=true"
    truth[:, : manifest.lead] = np.nan
    touching = np.isfinite(truth)
    element, wanted = np.nonzero(touching)[2], truth[touching]
    felt = np.linalg.norm(sweeps.values[touching][:, 1:3], axis=1) >= FELT_N
    rng = np.random.default_rng(7)
    noise = manifest.limits.noise * rng.standard_normal(sweeps.values.shape, dtype=np.float32)
    for name, values in (("clean", sweeps.values), ("noisy", sweeps.values + noise)):
        rested = values - values[:, : manifest.lead].mean(axis=1, keepdims=True)
        loads = rested[touching].astype(np.float64)
        for who, estimate in ESTIMATES.items():
            error = 100 * np.abs(estimate(loads, element, shapes) - wanted)
            error /= shapes.length[element]
            for where, some in (("all", error), ("felt", error[felt])):
                median, p95 = np.percentile(some, [50, 95])
                line = f"{name} {who} {where}: median {median:.3g} %, 95th percentile {p95:.3g} %"
                sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
