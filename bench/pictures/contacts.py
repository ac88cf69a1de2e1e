"""Draw docs/pictures/contacts.png: error of contact distance against the force, clean and at rated
noise.

python -m bench.pictures.contacts runs/locate/best.pt data/contacts
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from tactile_rt.evidence.locating import LEVELS, distance_estimates, measure_contacts
from tactile_rt.models.contact_regression import load_contacts
from tactile_rt.models.datasets import SweepSet

DOCS = Path(__file__).parents[2] / "docs"
SHOWN = {
    "network": ("#d95f0e", "network"),
    "straight": ("#9aa3ad", "moment / force, straight"),
    "resting": ("#5b7f95", "resting shape"),
    "bent": ("#1f6fb2", "bent shape"),
    "bent-averaged": ("#1f6fb2", "bent shape, 5 samples averaged"),
}
EDGES = np.logspace(-7, -2.5, 13)  # N


def main(checkpoint: Path, folder: Path) -> None:
    data = SweepSet.read(folder, "test")
    network = load_contacts(checkpoint, data)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), sharey=True, layout="constrained")
    for axis, level in zip(axes, LEVELS.values(), strict=True):
        split = measure_contacts(network, data, level)
        true = np.isfinite(split.truth)
        length = network.shapes.length[np.nonzero(true)[1]]
        which = np.digitize(split.force[true], EDGES)
        for who, found in distance_estimates(network, split, level > 0).items():
            error = 100 * np.abs(found - split.truth[true]) / length
            bins = [k for k in range(1, len(EDGES)) if (which == k).sum() >= 200]
            middle = [np.sqrt(EDGES[k - 1] * EDGES[k]) * 1e6 for k in bins]
            colour, label = SHOWN[who]
            style = "--" if who == "bent-averaged" else "-"
            medians = [np.median(error[which == k]) for k in bins]
            axis.plot(middle, medians, style, color=colour, label=label)
        if level:
            axis.axvline(10, color="#cccccc", zorder=0)
            axis.text(10.5, 0.04, "noise, one sigma", color="#777777", fontsize=8)
        title = "clean" if not level else "rated noise: 10 \N{MICRO SIGN}N, 0.05 \N{MICRO SIGN}N m"
        axis.set(xscale="log", yscale="log", title=title, ylim=(0.03, 150))
        axis.set_xlabel("true transverse force at the base (\N{MICRO SIGN}N)")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("median error (% of whisker length)")
    axes[1].legend(frameon=False, fontsize=8)
    figure.savefig(DOCS / "pictures" / "contacts.png", dpi=130)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
