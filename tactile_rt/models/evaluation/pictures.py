"""Pictures of benchmark results, for reports and `docs/`."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec
from tactile_rt.models import augmentation
from tactile_rt.models.ead import InputStage
from tactile_rt.models.evaluation import measures

EVERY = 2  # steps from one drawn frame to the next


def draw_confusion(table: NDArray[np.int64], labels: tuple[str, ...], path: Path) -> None:
    """Draw a confusion matrix (true, decided) as percentages of each true class.

    Rows are the classes with test sweeps; columns are the same classes, then other classes that
    were decided.
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


def draw_over_time(
    curves: dict[str, NDArray[np.float32]],
    labels: NDArray[np.int64],
    objects: NDArray[np.str_],
    step_ms: float,
    path: Path,
) -> None:
    """Draw top-1 accuracy over the time since first touch, with 95 % intervals by object.

    Args:
        curves: posteriors (sweep, step, class) of each curve, by the curve's name.
        labels: (sweep,) true classes.
        objects: (sweep,) names.
        step_ms: the duration of a step, ms.
    """
    figure = Figure(figsize=(7.2, 3.8), layout="constrained")
    axes = figure.subplots()
    for name, posteriors in curves.items():
        steps = posteriors.shape[1]
        found = [
            measures.accuracy(measures.hits(posteriors[:, k], labels), objects)
            for k in range(steps)
        ]
        at = step_ms * np.arange(1, steps + 1)
        (line,) = axes.plot(at, [100 * f.value for f in found], marker="o", ms=3, label=name)
        low, high = [100 * f.low for f in found], [100 * f.high for f in found]
        axes.fill_between(at, low, high, color=line.get_color(), alpha=0.2, linewidth=0)
    chance = 100 / next(iter(curves.values())).shape[2]
    axes.axhline(chance, color="0.4", linestyle=":", label="chance")
    axes.set_xlabel("time since the first touch (ms)")
    axes.set_ylabel("right on unseen objects (%)")
    axes.set_ylim(0, 101)
    axes.set_xlim(0, None)
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.savefig(path, dpi=110)


def draw_augmentations(
    spec: ArraySpec, samples: NDArray[np.float32], names: tuple[str, ...], path: Path
) -> None:
    """Draw a window's frames as each augmentation changes them, and with masked steps.

    A row is an augmentation, a column a step, a cell a place of the grid: the root mean square of
    its channels, each a share of the channel's largest load. This is the paper's Figure 2b.

    Args:
        samples: (step, sub-step, element, channel), SI.
        names: the augmentations; "none" leaves the frames as they are.
    """
    clip = np.abs(samples).max(axis=(0, 1, 2))
    stage = InputStage(spec.grid, spec.grid_shape, clip.tolist(), clip.tolist(), "paper")
    window = torch.from_numpy(samples)[None]
    rest = torch.zeros_like(window[:, 0, 0])
    names = (*names, "masking")
    figure = Figure(figsize=(11, 0.85 * len(names)), layout="constrained")
    grid = figure.subplots(len(names), -(-len(samples) // EVERY))
    for name, row in zip(names, grid, strict=True):
        draw = torch.Generator().manual_seed(0)
        share = 0.75 if name == "masking" else 0.0  # of the steps, as published
        built = augmentation.build("none" if share else name, spec, share)
        frames = built.mask(
            built.frames(stage(*built.loads((window, rest, rest), draw)), draw), draw
        )
        cells = frames[0].square().mean(dim=1).sqrt().numpy()
        for at, axes in zip(range(0, len(samples), EVERY), row, strict=True):
            axes.imshow(np.sqrt(cells[at]), cmap="inferno", vmin=0, vmax=1)
            axes.set_xticks([])
            axes.set_yticks([])
            if name == names[0]:
                axes.set_title(f"step {at + 1}", fontsize=9)
        row[0].set_ylabel(
            "as it is" if name == "none" else name, rotation=0, ha="right", va="center"
        )
    figure.suptitle("One touch: the load at each element, as augmentations change it", fontsize=11)
    figure.savefig(path, dpi=110)
