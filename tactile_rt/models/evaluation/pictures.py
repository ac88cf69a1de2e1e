"""Pictures of benchmark results, for reports and `docs/`."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

__all__ = ["draw_accuracy_over_time", "draw_confusion"]


def draw_confusion(table: NDArray[np.int64], labels: tuple[str, ...], path: Path) -> None:
    """Draw a confusion matrix (true, decided) as percentages of each true class.

    Only classes of which there were sweeps have a row, and a column only what is one of them or was
    decided; the latter stand behind.
    """
    there, decided = table.sum(axis=1) > 0, table.sum(axis=0) > 0
    rows = np.flatnonzero(there)
    columns = np.concatenate([rows, np.flatnonzero(decided & ~there)])
    share = (100 * table / np.maximum(table.sum(axis=1, keepdims=True), 1))[np.ix_(rows, columns)]
    cell = 0.26  # inches
    size = (max(7.2, 1.4 + cell * len(columns)), max(6.0, 1.6 + cell * len(rows)))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    axes.imshow(share, cmap="Blues", vmin=0, vmax=100)
    for i, row in enumerate(share):
        for j, value in enumerate(row):
            if value >= 0.5:
                colour = "white" if value > 55 else "black"
                axes.text(j, i, f"{value:.0f}", ha="center", va="center", color=colour, fontsize=8)
    if len(columns) > len(rows):
        axes.axvline(len(rows) - 0.5, color="0.5", lw=1)
    axes.set_xticks(range(len(columns)), [labels[k] for k in columns], rotation=90)
    axes.set_yticks(range(len(rows)), [labels[k] for k in rows])
    axes.set_xlabel("decided")
    axes.set_ylabel("really swept past the array")
    axes.set_title(f"{int(table.sum())} sweeps of objects never seen in training (%)")
    figure.savefig(path, dpi=110)


def draw_accuracy_over_time(
    curves: dict[str, NDArray[np.float64]], step_s: float, path: Path
) -> None:
    """Draw top-1 accuracy (step,) of each curve against the time since contact onset."""
    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axes = figure.subplots()
    for name, curve in curves.items():
        axes.plot(1e3 * step_s * np.arange(1, len(curve) + 1), 100 * curve, marker="o", label=name)
    axes.set_xlabel("time since contact onset (ms)")
    axes.set_ylabel("top-1 accuracy on unseen objects (%)")
    axes.set_ylim(0, 100)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)
