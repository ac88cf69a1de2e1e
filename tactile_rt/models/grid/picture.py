"""A bar chart of a grid's results, as in the paper."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.models.grid.plan import SUPERVISED, SVM
from tactile_rt.models.grid.results import GridResults, Row

FAMILIES = {
    "zhuang": ("ConvRNN (Zhuang's graph)", "tab:blue"),
    "resnet18": ("ResNet18", "tab:orange"),
    "s4": ("S4", "tab:green"),
    "mamba": ("Mamba", "tab:purple"),
    "gru": ("plain GRU", "tab:brown"),
}
OTHER = ("other", "0.4")
PALE = 0.3
ROW_INCH, BAR = 0.34, 0.4


def draw_grid(results: GridResults, path: Path) -> None:
    """Draw bars of top-1 of every cell, trained and untrained, into a PNG file."""
    svm = next((row.top1 for row in results.rows if row.name == SVM), None)
    networks = [row for row in results.rows if row.name != SVM]
    groups = {
        "trained with labels": [r for r in networks if r.learning.startswith(SUPERVISED)],
        "trained without labels, read out by a linear probe": [
            r for r in networks if not r.learning.startswith(SUPERVISED)
        ],
    }
    groups = {title: rows for title, rows in groups.items() if rows} or {"": []}
    heights = [len(rows) + 1 for rows in groups.values()]
    figure = Figure(figsize=(9.5, ROW_INCH * sum(heights) + 1.9), layout="constrained")
    all_axes = figure.subplots(len(groups), 1, sharex=True, height_ratios=heights, squeeze=False)
    for axes, (title, rows) in zip(all_axes[:, 0], groups.items(), strict=True):
        _draw_bars(axes, rows)
        axes.set_title(title, fontsize=10, loc="left")
        axes.axvline(100 / results.classes, color="0.3", linestyle=":")
        if svm is not None:
            axes.axvline(100 * svm.value, color="tab:red", linestyle="--")
    bottom = all_axes[-1, 0]
    best = max((row.top1.high for row in results.rows if row.top1 is not None), default=1.0)
    bottom.set_xlim(0, 100 * best + 6)
    bottom.xaxis.set_major_locator(MaxNLocator(steps=[1, 2, 5, 10]))
    bottom.set_xlabel("top-1 accuracy on objects never seen in training (%)")
    handles: list[object] = [
        Patch(color=colour, label=label)
        for label, colour in dict.fromkeys(_find_family(row) for row in networks)
    ]
    handles.append(Patch(color="0.4", alpha=PALE, label="same network, untrained, linear probe"))
    if svm is not None:
        label = f"RBF SVM on the same windows ({100 * svm.value:.1f} %)"
        handles.append(bottom.plot([], [], color="tab:red", linestyle="--", label=label)[0])
    label = f"chance ({100 / results.classes:.1f} %)"
    handles.append(bottom.plot([], [], color="0.3", linestyle=":", label=label)[0])
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8)
    seeds = max((row.seeds for row in networks), default=0)
    figure.suptitle(
        f"What touched the whiskers? {results.classes} kinds of object, {results.objects} unseen "
        f"objects, {results.sweeps} sweeps\n"
        "every network tuned alike, trained until more helps no more (+: as long as was tried)\n"
        + (f"mean of up to {seeds} seeds" if seeds > 1 else "one seed")
        + ", lines: 95 % by object and seed",
        fontsize=11,
    )
    figure.savefig(path, dpi=120)


def _draw_bars(axes: Axes, rows: list[Row]) -> None:
    for k, row in enumerate(rows):
        _, colour = _find_family(row)
        if row.random is not None:
            _draw_bar(axes, k - BAR / 2, row.random, colour, PALE)
        if row.top1 is not None:
            _draw_bar(axes, k + BAR / 2, row.top1, colour, 0.9)
            end = 100 * max(row.top1.high, row.top1.value) + 1
            text = f"{100 * row.top1.value:.1f}{' +' if row.chosen and not row.flat else ''}"
            axes.text(
                end, k + BAR / 2, text, va="center", fontsize=7.5,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.6},  # on the SVM's line
            )  # fmt: skip
        elif row.failed:
            axes.text(1, k + BAR / 2, "training diverged", va="center", fontsize=7.5)
    labels = [r.network + (f", {r.learning}" * (r.learning != SUPERVISED)) for r in rows]
    axes.set_yticks(range(len(rows)), labels, fontsize=8.5)
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="x", alpha=0.25)
    axes.set_axisbelow(True)


def _draw_bar(axes: Axes, at: float, value: Interval, colour: str, alpha: float) -> None:
    axes.barh(at, 100 * value.value, BAR, color=colour, alpha=alpha, linewidth=0)
    # A percentile interval may not hold its estimate, and matplotlib rejects negative bars.
    sides = [[value.value - value.low], [value.high - value.value]]
    error = 100 * np.maximum(sides, 0.0)
    axes.errorbar(100 * value.value, at, xerr=error, fmt="none", ecolor="black", elinewidth=1)


def _find_family(row: Row) -> tuple[str, str]:
    return next((f for prefix, f in FAMILIES.items() if row.network.startswith(prefix)), OTHER)
