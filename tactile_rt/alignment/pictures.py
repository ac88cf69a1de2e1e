"""Plots of the report, drawn by matplotlib as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import combinations
from math import ceil, isfinite, nan

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from tactile_rt.alignment.rdm import Floats, to_matrices

COLOURS = {
    "raw": "#8a8f98", "encoder": "#c4523a", "attender": "#2f8a58", "decoder": "#3a6fb8",
}  # fmt: skip
INK, MISSING = "#22252a", "#e3e3e0"
MAPS_A_ROW = 4


@dataclass(frozen=True)
class Bar:
    """A bar of a plot. It has dots, a mark and a frame, and is hatched if its value is NaN."""

    name: str
    value: float
    part: str
    dots: Sequence[float] | Floats = ()
    mark: float = nan
    ring: bool = False


@dataclass(frozen=True)
class Level:
    """A horizontal line of a bar plot. If `half` is above 0, it has a band of that half-width."""

    name: str
    value: float
    colour: str
    half: float = 0.0
    dash: str = "-"


@dataclass(frozen=True)
class Point:
    """A model in a scatter plot; points of a `group` share colour and line."""

    name: str
    x: float
    y: float
    error: float = 0.0
    group: str = ""


def draw_bars(columns: Sequence[Bar], levels: Sequence[Level], title: str) -> str:
    """Draw bars side by side, with horizontal lines and bands; return SVG."""
    figure, axes = _start_figure(9.5, 4.6)
    for level in levels:
        if not isfinite(level.value):
            continue
        axes.axhline(level.value, color=level.colour, linestyle=level.dash, label=level.name)
        if level.half > 0:
            low, high = level.value - level.half, level.value + level.half
            axes.axhspan(low, high, color=level.colour, alpha=0.2)
    for k, bar in enumerate(columns):
        if isfinite(bar.value):
            colour = COLOURS.get(bar.part, MISSING)
            axes.bar(k, bar.value, 0.7, color=colour, edgecolor=INK, linewidth=2 * bar.ring)
        else:
            axes.axvspan(k - 0.35, k + 0.35, facecolor=MISSING, hatch="//", edgecolor="white")
        # Without random jitter, so that an animal has the same place in every bar.
        places = k + 0.5 * ((np.arange(len(bar.dots)) + 0.5) / max(len(bar.dots), 1) - 0.5)
        axes.plot(places, bar.dots, "o", color="white", markeredgecolor=INK, markersize=4)
        if isfinite(bar.mark):
            axes.hlines(bar.mark, k - 0.4, k + 0.4, color=INK, linewidth=3)
    names = [bar.name for bar in columns]
    axes.set_xticks(range(len(names)), names, rotation=45, ha="right", fontsize=8)
    axes.set_ylabel(title)
    axes.axhline(0, color="0.5", linewidth=0.8)
    if axes.get_legend_handles_labels()[0]:
        figure.legend(loc="outside upper right", ncols=3, fontsize=8)
    return _finish_figure(figure)


def draw_scatter(points: Sequence[Point], x_title: str, y_title: str, log: bool = False) -> str:
    """Draw models as named points, with a least-squares line per group; return SVG."""
    figure, axes = _start_figure(7.2, 4.2)
    for group in dict.fromkeys(p.group for p in points):
        of = [p for p in points if p.group == group]
        xs, ys = np.array([p.x for p in of]), np.array([p.y for p in of])
        label = f"{group or 'others'}: {len(of)} model{'s' * (len(of) != 1)}"
        at = np.log10(xs) if log else xs
        if len(of) > 2 and np.ptp(at) > 0:
            slope, start = np.polyfit(at, ys, 1)
            if np.ptp(ys) > 0:
                label += f", r = {np.corrcoef(at, ys)[0, 1]:.2f}"
            ends = np.array([at.min(), at.max()])
            shown = 10**ends if log else ends
            axes.plot(shown, slope * ends + start, "--", color=f"C{len(axes.containers)}")
        axes.errorbar(
            xs, ys, [p.error for p in of], fmt="o", label=label, color=f"C{len(axes.containers)}"
        )
    for point in points:
        axes.annotate(
            _escape(point.name), (point.x, point.y), (6, 5), textcoords="offset points", fontsize=8
        )
    if log:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(EngFormatter())
    else:
        axes.xaxis.set_major_formatter(PercentFormatter(1))
    axes.set_xlabel(x_title)
    axes.set_ylabel(y_title)
    axes.legend(fontsize=8)
    return _finish_figure(figure)


def draw_profiles(series: Sequence[tuple[str, Floats]], names: Sequence[str]) -> str:
    """Draw RDMs (pair,) as lines over the pairs of stimuli; return SVG.

    RDMs are scaled to standard deviation 1, so the correlation of two RDMs is that of their lines.
    An RDM that is constant or has a NaN gets no line. The first RDM is drawn as the reference.
    """
    figure, axes = _start_figure(9.5, 5.2)
    for k, (name, values) in enumerate(series):
        spread = float(np.std(values))
        if isfinite(spread) and spread > 0:
            line = (values - np.mean(values)) / spread
            colour, width = (INK, 3) if k == 0 else (f"C{k - 1}", 1.5)
            axes.plot(line, "o-", label=_escape(name), color=colour, linewidth=width)
    pairs = [f"{a} and {b}" for a, b in combinations(names, 2)]
    axes.set_xticks(range(len(pairs)), pairs, rotation=70, ha="right", fontsize=8)
    axes.set_ylabel("dissimilarity, scaled")
    axes.legend(fontsize=8)
    return _finish_figure(figure)


def draw_heat_maps(maps: Sequence[tuple[str, Floats]], names: Sequence[str]) -> str:
    """Draw RDMs (pair,) as heat maps, grey if an entry is NaN; return SVG."""
    rows = ceil(len(maps) / MAPS_A_ROW)
    figure = Figure(figsize=(9.5, 2.2 * rows + 0.9), layout="constrained")
    panels = figure.subplots(rows, MAPS_A_ROW, squeeze=False)
    for panel in panels.flat:
        panel.set_axis_off()
    for k, (title, entries) in enumerate(maps):
        panel = panels.flat[k]
        panel.set_axis_on()
        panel.set_facecolor(MISSING)
        panel.set_title(_escape(title), fontsize=8)
        if np.isfinite(entries).all():
            panel.pcolormesh(to_matrices(entries), cmap="Blues", vmin=0)
        panel.set(aspect="equal", xlim=(0, len(names)), ylim=(len(names), 0))
        left, below = k % MAPS_A_ROW == 0, k + MAPS_A_ROW >= len(maps)
        at = np.arange(len(names)) + 0.5
        panel.set_yticks(at if left else [], names if left else [], fontsize=6)
        panel.set_xticks(
            at, names if below else [""] * len(names), fontsize=6, rotation=45, ha="right"
        )
    return _finish_figure(figure)


def _start_figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _escape(text: str) -> str:
    """Escape the dollar signs of a text, which matplotlib would read as mathematics."""
    return text.replace("$", r"\$")


def _finish_figure(figure: Figure) -> str:
    """Convert a figure to an SVG element; equal figures give equal text."""
    out = StringIO()
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "tactile_rt"}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    return text[text.index("<svg") :]
