"""Pictures of a sweep set, for its card."""

from typing import BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.sim_backend.datasets.card_survey import NETWORK_CLIP, Card
from tactile_rt.stream import ArraySpec

__all__ = ["draw_card", "draw_examples"]

EXAMPLES = 12
FAINTEST_N = 1e-6


def draw_card(card: Card, spec: ArraySpec, file: BinaryIO) -> None:
    """Draw forces, coverage, counts and separability as a PNG."""
    figure = Figure(figsize=(11, 7.6), layout="constrained")
    axes = figure.subplots(2, 2)
    _forces(axes[0, 0], card)
    _coverage(axes[0, 1], card, spec)
    _counts(axes[1, 0], card)
    _separability(axes[1, 1], card)
    figure.savefig(file, dpi=100, format="png")


def _forces(axes: Axes, card: Card) -> None:
    edges = np.array(card.force_edges)
    axes.stairs(card.force_counts, edges, fill=True, color="tab:blue", alpha=0.7)
    axes.axvline(card.median_force, color="black", label=f"median {1e6 * card.median_force:.3g} uN")
    axes.axvline(NETWORK_CLIP["N"], color="tab:red", linestyle="--", label="clip of the networks")
    axes.axvline(1.0, color="tab:red", linestyle=":", label="published clip")
    axes.set_xscale("log")
    axes.set_xlabel("largest force of a touched whisker in a sweep (N)")
    axes.set_ylabel("whiskers x sweeps")
    axes.legend(fontsize=8)


def _coverage(axes: Axes, card: Card, spec: ArraySpec) -> None:
    grid = np.full(spec.grid_shape, np.nan)
    for cell, name in zip(spec.grid, spec.elements, strict=True):
        grid[cell] = 100 * card.coverage[name]
    axes.imshow(grid, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    for cell, name in zip(spec.grid, spec.elements, strict=True):
        colour = "white" if grid[cell] > 55 else "black"
        axes.text(
            cell[1], cell[0], f"{name}\n{grid[cell]:.0f}", ha="center", va="center", color=colour,
            fontsize=8,
        )  # fmt: skip
    axes.set_xticks(range(spec.grid_shape[1]))
    axes.set_yticks(range(spec.grid_shape[0]))
    axes.set_xlabel("column")
    axes.set_ylabel("row")
    axes.set_title("share of the sweeps that touch each whisker (%)", fontsize=10)


def _counts(axes: Axes, card: Card) -> None:
    names = sorted({c for split in card.sweeps.values() for c in split})
    left = np.zeros(len(names))
    for split, counts in card.sweeps.items():
        here = np.array([counts.get(c, 0) for c in names])
        axes.barh(names, here, left=left, label=split)
        left += here
    axes.invert_yaxis()
    axes.tick_params(axis="y", labelsize=7 if len(names) < 40 else 3)
    axes.set_xlabel("sweeps")
    axes.legend(fontsize=8, ncols=len(card.sweeps), loc="lower center", bbox_to_anchor=(0.5, 1))


def _separability(axes: Axes, card: Card) -> None:
    for k, s in enumerate(card.separability):
        axes.bar(
            k, 100 * s.accuracy, yerr=None if s.of else 100 * s.spread, capsize=4,
            color="tab:orange" if s.of else "tab:blue",
        )  # fmt: skip
        axes.hlines(100 * s.chance, k - 0.4, k + 0.4, color="black", linestyle="--")
    labels = [
        f"{s.classes}:\n" + ("\n".join(s.of) if s.of else f"any\n({s.subsets} choices)")
        for s in card.separability
    ]
    axes.set_xticks(range(len(labels)), labels, fontsize=8)
    axes.set_ylim(0, 106)
    axes.set_ylabel("decided rightly (%), unseen objects")
    axes.set_title("support vector machines; dashed: chance", fontsize=10)


def draw_examples(
    examples: dict[str, NDArray[np.float32]], period_ms: float, spec: ArraySpec, file: BinaryIO
) -> None:
    """Draw the force (sample, element), N, of one sweep of each of some categories as a PNG."""
    spread = np.linspace(0, len(examples) - 1, min(len(examples), EXAMPLES)).round().astype(int)
    chosen = [sorted(examples)[i] for i in spread]
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(11, 0.6 + 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    norm = LogNorm(FAINTEST_N, NETWORK_CLIP["N"])
    for at, panel in enumerate(axes.flat):
        if at >= len(chosen):
            panel.set_axis_off()
            continue
        force = np.maximum(examples[chosen[at]].T, FAINTEST_N)
        span = (0, force.shape[1] * period_ms, len(force) - 0.5, -0.5)
        image = panel.imshow(
            force, norm=norm, aspect="auto", extent=span, interpolation="nearest", cmap="magma"
        )
        panel.set_title(chosen[at], fontsize=9)
        firsts = [i for i, (row, _) in enumerate(spec.grid) if i == 0 or spec.grid[i - 1][0] != row]
        panel.set_yticks(firsts, [spec.elements[i] for i in firsts], fontsize=7)
    for panel in axes[-1]:
        panel.set_xlabel("time (ms)", fontsize=8)
    figure.colorbar(image, ax=axes, label="force on the follicle (N)", shrink=0.8)
    figure.savefig(file, dpi=100, format="png")
