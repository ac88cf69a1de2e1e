"""The card of a sweep set, for its users: counts and measurements, with a picture.

README.md       for reading
card.png        forces, and a sweep of some categories
"""

import math
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import ArraySpec
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sim_backend.datasets.card_survey import Card, Fit, Separability, survey

COLUMNS, EXAMPLES = 4, 12
FAINTEST = 5000  # the networks' clip is this many times the faintest load of a picture
PREFIXES = {0: "", -1: "m", -2: "u", -3: "n", -4: "p"}
PAPER = (
    "The recipe follows the published generator (Chung et al. 2025): 312 sweeps of an object with "
    "high variation, 288 of them to train on, 16 with low. The table of the paper has totals of "
    "208 x 9,981 and 32 x 9,881 sweeps, which neither its text nor its code comes to."
)


def write_card(folder: Path, fit: Fit) -> Card:
    """Write README.md and card.png into a (perhaps unfinished) set's folder; return the card."""
    manifest = SweepManifest.read(folder)
    card, examples = survey(folder, fit)
    write_whole(folder / "card.png", lambda file: _draw_card(card, examples, manifest, file))
    text = _write_text(folder.resolve().name, manifest, card)
    write_whole(folder / "README.md", lambda file: file.write(text.encode()))
    return card


def _write_text(name: str, manifest: SweepManifest, card: Card) -> str:
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
        _list_counts(manifest, card),
        _list_skipped(card),
        "## What was drawn",
        _format_table(
            ("parameter", "least", "mean", "greatest"),
            [(key, *(f"{v:.4g}" for v in values)) for key, values in card.parameters.items()],
        ),
        "## What is felt",
        _describe_loads(card),
        "![forces, and one sweep of some categories](card.png)",
        "Share of the sweeps in which each whisker is touched, on the array's grid (%):",
        _map_coverage(card, manifest.spec),
        "## Can it be learnt from?",
        _list_accuracies(card.separability),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _format_table(head: tuple[str, ...], rows: list[tuple[Any, ...]]) -> str:
    lines = [head, ("---",) * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)


def _list_counts(manifest: SweepManifest, card: Card) -> str:
    splits = tuple(card.sweeps)

    def count(split: str, category: str) -> str:
        objects, sweeps = card.objects[split], card.sweeps[split]
        return f"{objects[category]} / {sweeps[category]}" if category in sweeps else "-"

    named = (*manifest.categories, *manifest.withheld)
    rows = [(category, *(count(s, category) for s in splits)) for category in named]
    total = [f"{sum(card.objects[s].values())} / {sum(card.sweeps[s].values())}" for s in splits]
    table = _format_table(("category", *splits), [*rows, ("all", *total)])
    return f"Objects / sweeps of each category in each split:\n\n{table}"


def _list_skipped(card: Card) -> str:
    if not card.skipped:
        return ""
    rows = sorted(card.skipped.items())
    return f"{len(rows)} objects could not be made:\n\n" + _format_table(("object", "why"), rows)


def _describe_loads(card: Card) -> str:
    limits = "; ".join(
        f"beyond {limit}: {n} ({100 * n / card.samples:.2g} %)" for limit, n in card.clips.items()
    )
    largest, where = card.largest
    lines = [
        "- Largest load of a touched whisker in a sweep: median "
        f"{_format_load(card.median_load, card)}; the largest of all "
        f"{_format_load(largest, card)} ({where}).",
        f"- A sweep that touches, touches {card.whiskers_touched:.1f} whiskers on average.",
        f"- Sweeps without any touch: {card.without_touch}, of which {card.misses} pass beside "
        f"the array and {card.unstable} could not be simulated at this profile.",
        f"- Values that a limit would clip: {limits}.",
    ]
    if card.not_finite:
        lines.append(f"- **{card.not_finite} sweeps hold values that are no numbers.**")
    return "\n".join(lines)


def _format_load(value: float, card: Card) -> str:
    """Return a load as text with its unit, e.g. 39 uN."""
    power = min(max(math.floor(math.log10(value) / 3), -4), 0) if value > 0 else 0
    return f"{value / 1000**power:.3g} {PREFIXES[power]}{card.unit}"


def _map_coverage(card: Card, spec: ArraySpec) -> str:
    rows, columns = spec.grid_shape
    cells = {cell: card.coverage[name] for cell, name in zip(spec.grid, spec.elements, strict=True)}
    shown = {cell: f"{100 * share:.0f}" for cell, share in cells.items()}
    lines = [(r, *(shown.get((r, c), "") for c in range(columns))) for r in range(rows)]
    return _format_table(("row", *map(str, range(columns))), lines)


def _list_accuracies(found: list[Separability]) -> str:
    if not found:
        return "Not checked: there are no training and test sweeps of two categories."
    rows = [
        (", ".join(s.classes), f"{100 * s.accuracy:.1f}", f"{100 / len(s.classes):.0f}")
        for s in found
    ]
    return (
        "Support vector machines (RBF) on the first second of contact, tested on objects that "
        "they never saw, as Chung et al. (2025) check their sets, of the classes that come nearest "
        "to theirs (cups, microwaves, chairs, trains).\n\n"
        + _format_table(("classes", "right (%)", "chance (%)"), rows)
    )


def _draw_card(
    card: Card, examples: dict[str, NDArray[np.float32]], manifest: SweepManifest, file: BinaryIO
) -> None:
    """Draw a histogram of loads, and an example sweep of some categories, as a PNG."""
    spread = np.linspace(0, len(examples) - 1, min(len(examples), EXAMPLES)).round().astype(int)
    chosen = [sorted(examples)[i] for i in spread]
    rows = -(-len(chosen) // COLUMNS)
    figure = Figure(figsize=(11, 3.6 + 2.4 * rows), layout="constrained")
    heights = [3.6, 2.4 * rows] if rows else [3.6]
    faintest = card.clip / FAINTEST
    above, *below = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False).flat
    _draw_loads(above.subplots(), card)
    if below:
        axes = below[0].subplots(rows, COLUMNS, squeeze=False, sharex=True)
        for panel in axes.flat[len(chosen) :]:
            panel.set_axis_off()
        norm = LogNorm(faintest, card.clip)
        spec, grid = manifest.spec, manifest.spec.grid
        firsts = [i for i, (row, _) in enumerate(grid) if i == 0 or grid[i - 1][0] != row]
        for panel, name in zip(axes.flat, chosen, strict=False):
            load = np.maximum(examples[name].T, faintest)
            span = (0, load.shape[1] * manifest.period_ns * 1e-6, len(load) - 0.5, -0.5)
            image = panel.imshow(
                load, norm=norm, aspect="auto", extent=span, interpolation="nearest", cmap="magma"
            )
            panel.set_title(f"{name}, ms", fontsize=9)
            panel.set_yticks(firsts, [spec.elements[i] for i in firsts], fontsize=7)
        below[0].colorbar(image, ax=axes, label=f"load at the base ({card.unit})", shrink=0.8)
    figure.savefig(file, dpi=100, format="png")


def _draw_loads(axes: Axes, card: Card) -> None:
    edges = np.array(card.load_edges)
    axes.stairs(card.load_counts, edges, fill=True, color="tab:blue", alpha=0.7)
    median = f"median {_format_load(card.median_load, card)}"
    axes.axvline(card.median_load, color="black", label=median)
    axes.axvline(card.clip, color="tab:red", linestyle="--", label="clip of the networks")
    if card.unit == "N":
        axes.axvline(1.0, color="tab:red", linestyle=":", label="published clip")
    axes.set_xscale("log")
    axes.set_xlabel(f"largest load of a touched whisker in a sweep ({card.unit})")
    axes.set_ylabel("whiskers x sweeps")
    axes.legend(fontsize=8)
