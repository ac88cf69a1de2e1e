"""The card of a sweep set: what is in it, measured, with pictures, for whoever may use it.

README.md       for reading
card.json       the same numbers
card.png        forces, which whiskers are touched, what was drawn, what can be told apart
examples.png    a sweep of some categories
"""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.files import write_whole
from tactile_rt.sim_backend.datasets.card_survey import Card, survey
from tactile_rt.sim_backend.datasets.separability import Fit, Separability
from tactile_rt.stream import ArraySpec
from tactile_rt.sweep_set import SweepManifest

__all__ = ["write_card"]

EXAMPLES = 12
FAINTEST = 5000  # times below what networks believe is where a picture begins
PREFIXES = {0: "", -1: "m", -2: "u", -3: "n", -4: "p"}
PAPER = (
    "The recipe follows the published generator (Chung et al. 2025): 312 sweeps of an object with "
    "high variation, 288 of them to train on, 16 with low. The table of the paper has totals of "
    "208 x 9,981 and 32 x 9,881 sweeps, which neither its text nor its code comes to."
)


def write_card(folder: Path, fit: Fit) -> Card:
    """Write the card of a set, or of what there is of it, into its folder.

    Args:
        folder: the set's.
        fit: fits a support vector machine, as `models.svm.fit`.

    Raises:
        RecordingError: no such set, nothing in it, or an object is damaged.
    """
    manifest = SweepManifest.read(folder)
    card, examples = survey(folder, fit)
    spec, period_ms = manifest.spec, manifest.period_ns * 1e-6
    write_whole(folder / "card.png", lambda file: _draw_card(card, spec, file))
    if examples:
        write_whole(
            folder / "examples.png",
            lambda file: _draw_examples(examples, period_ms, spec, card, file),
        )
    numbers = msgspec.json.format(msgspec.json.encode(asdict(card)), indent=1)
    write_whole(folder / "card.json", lambda file: file.write(numbers))
    text = _text(folder.resolve().name, manifest, card)
    write_whole(folder / "README.md", lambda file: file.write(text.encode()))
    return card


def _text(name: str, manifest: SweepManifest, card: Card) -> str:
    recipe, period_ms = manifest.recipe, manifest.period_ns * 1e-6
    sweeps = sum(sum(split.values()) for split in card.sweeps.values())
    objects = sum(sum(split.values()) for split in card.objects.values())
    versions = ", ".join(f"{package} {v}" for package, v in manifest.versions.items())
    parts = [
        f"# {name}",
        f"{sweeps} simulated sweeps of {objects} objects past the whisker array "
        f"{manifest.spec.name} ({len(manifest.spec.elements)} whiskers), stored every "
        f"{period_ms:g} ms. Recipe `{recipe.get('name', 'unnamed')}`, profile "
        f"`{recipe.get('profile', 'unknown')}`, seed {recipe.get('seed', 'unknown')}; made with "
        f"{versions or 'versions that were not noted'}. `manifest.json` has all that made it.",
        PAPER if str(recipe.get("name", "")).startswith("paper-") else "",
        "## Categories",
        _counts(manifest, card),
        _skipped(card),
        "## What was drawn",
        _table(
            ("parameter", "least", "mean", "greatest"),
            [(key, *(f"{v:.4g}" for v in values)) for key, values in card.parameters.items()],
        ),
        "## What is felt",
        _felt(card),
        "![forces, whiskers touched, draws, separability](card.png)",
        "Share of the sweeps in which each whisker is touched, on the array's grid (%):",
        _coverage(card, manifest.spec),
        "## Can it be learnt from?",
        _separability(card.separability),
        "![one sweep of some categories](examples.png)" if card.whiskers_touched else "",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _counts(manifest: SweepManifest, card: Card) -> str:
    splits = tuple(card.sweeps)
    rows = [
        (
            category,
            *(
                f"{card.objects[s][category]} / {card.sweeps[s][category]}"
                if category in card.sweeps[s]
                else "-"
                for s in splits
            ),
        )
        for category in (*manifest.categories, *manifest.withheld)
    ]
    total = [f"{sum(card.objects[s].values())} / {sum(card.sweeps[s].values())}" for s in splits]
    return "Objects / sweeps of each category in each split:\n\n" + _table(
        ("category", *splits), [*rows, ("all", *total)]
    )


def _skipped(card: Card) -> str:
    if not card.skipped:
        return ""
    rows = sorted(card.skipped.items())
    return f"{len(rows)} objects could not be made:\n\n" + _table(("object", "why"), rows)


def _felt(card: Card) -> str:
    limits = "; ".join(
        f"beyond {limit}: {n} ({100 * n / card.samples:.2g} %)" for limit, n in card.clips.items()
    )
    largest, where = card.largest
    lines = [
        f"- Largest load of a touched whisker in a sweep: median {_amount(card.median_load, card)}"
        f"; the largest of all {_amount(largest, card)} ({where}).",
        f"- A sweep that touches, touches {card.whiskers_touched:.1f} whiskers on average.",
        f"- Sweeps without any touch: {card.without_touch}, of which {card.misses} pass beside "
        f"the array and {card.unstable} could not be simulated at this profile.",
        f"- Values that a limit would clip: {limits}.",
    ]
    if card.not_finite:
        lines.append(f"- **{card.not_finite} sweeps hold values that are no numbers.**")
    return "\n".join(lines)


def _amount(value: float, card: Card) -> str:
    """A load in words, e.g. 39 uN."""
    power = min(max(math.floor(math.log10(value) / 3), -4), 0) if value > 0 else 0
    return f"{value / 1000**power:.3g} {PREFIXES[power]}{card.unit}"


def _coverage(card: Card, spec: ArraySpec) -> str:
    rows, columns = spec.grid_shape
    cells = {cell: card.coverage[name] for cell, name in zip(spec.grid, spec.elements, strict=True)}
    return _table(
        ("row", *(str(c) for c in range(columns))),
        [
            (
                r,
                *(f"{100 * cells[r, c]:.0f}" if (r, c) in cells else "" for c in range(columns)),
            )
            for r in range(rows)
        ],
    )


def _separability(found: list[Separability]) -> str:
    if not found:
        return "Not checked: there are no training and test sweeps of two categories."
    rows = [
        (
            f"{s.classes} ({', '.join(s.of) if s.of else f'any, {s.subsets} choices'})",
            f"{100 * s.accuracy:.1f}" + ("" if s.of else f" +- {100 * s.spread:.1f}"),
            f"{100 * s.chance:.0f}",
        )
        for s in found
    ]
    return (
        "Support vector machines (RBF) on the first second of contact, tested on objects that "
        "they never saw, as Chung et al. (2025) check their sets; the named classes are the ones "
        "nearest to theirs (cups, microwaves, chairs, trains). Spread over choices of classes.\n\n"
        + _table(("classes", "right (%)", "chance (%)"), rows)
    )


def _draw_card(card: Card, spec: ArraySpec, file: BinaryIO) -> None:
    """Draw forces, coverage, counts and separability as a PNG."""
    figure = Figure(figsize=(11, 7.6), layout="constrained")
    axes = figure.subplots(2, 2)
    _draw_loads(axes[0, 0], card)
    _draw_coverage(axes[0, 1], card, spec)
    _draw_counts(axes[1, 0], card)
    _draw_separability(axes[1, 1], card)
    figure.savefig(file, dpi=100, format="png")


def _draw_loads(axes: Axes, card: Card) -> None:
    edges = np.array(card.load_edges)
    axes.stairs(card.load_counts, edges, fill=True, color="tab:blue", alpha=0.7)
    median = f"median {_amount(card.median_load, card)}"
    axes.axvline(card.median_load, color="black", label=median)
    axes.axvline(card.clip, color="tab:red", linestyle="--", label="clip of the networks")
    if card.unit == "N":
        axes.axvline(1.0, color="tab:red", linestyle=":", label="published clip")
    axes.set_xscale("log")
    axes.set_xlabel(f"largest load of a touched whisker in a sweep ({card.unit})")
    axes.set_ylabel("whiskers x sweeps")
    axes.legend(fontsize=8)


def _draw_coverage(axes: Axes, card: Card, spec: ArraySpec) -> None:
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


def _draw_counts(axes: Axes, card: Card) -> None:
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


def _draw_separability(axes: Axes, card: Card) -> None:
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


def _draw_examples(
    examples: dict[str, NDArray[np.float32]],
    period_ms: float,
    spec: ArraySpec,
    card: Card,
    file: BinaryIO,
) -> None:
    """Draw the load (sample, element) of one sweep of each of some categories as a PNG."""
    spread = np.linspace(0, len(examples) - 1, min(len(examples), EXAMPLES)).round().astype(int)
    chosen = [sorted(examples)[i] for i in spread]
    columns = min(4, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(11, 0.6 + 2.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    faintest = card.clip / FAINTEST
    norm = LogNorm(faintest, card.clip)
    for at, panel in enumerate(axes.flat):
        if at >= len(chosen):
            panel.set_axis_off()
            continue
        load = np.maximum(examples[chosen[at]].T, faintest)
        span = (0, load.shape[1] * period_ms, len(load) - 0.5, -0.5)
        image = panel.imshow(
            load, norm=norm, aspect="auto", extent=span, interpolation="nearest", cmap="magma"
        )
        panel.set_title(chosen[at], fontsize=9)
        firsts = [i for i, (row, _) in enumerate(spec.grid) if i == 0 or spec.grid[i - 1][0] != row]
        panel.set_yticks(firsts, [spec.elements[i] for i in firsts], fontsize=7)
    for panel in axes[-1]:
        panel.set_xlabel("time (ms)", fontsize=8)
    figure.colorbar(image, ax=axes, label=f"load at the base ({card.unit})", shrink=0.8)
    figure.savefig(file, dpi=100, format="png")
