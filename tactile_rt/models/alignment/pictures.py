"""Figures of the report, as SVG that takes its colours from the page: light or dark."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.rdm import square

__all__ = ["Bar", "Level", "Point", "bars", "heat_map", "profiles", "scatter"]

Values = Sequence[float]
COLOURS = 6  # of groups and of lines: the page's classes g0 to g5


@dataclass(frozen=True)
class Bar:
    """One bar: `part` is its colour's CSS class, `dots` animals by name, `mark` a control's value;
    NaN is drawn hatched."""

    name: str
    value: float
    part: str
    dots: tuple[tuple[str, float], ...] = ()
    mark: float = math.nan
    ring: bool = False  # this is the one that counts


@dataclass(frozen=True)
class Level:
    """A horizontal line, or a band where `half` is above 0; `kind` is its CSS class."""

    name: str
    value: float
    kind: str
    half: float = 0.0


@dataclass(frozen=True)
class Point:
    """One model in a scatter plot; models of one `group` share a colour and a line."""

    name: str
    x: float
    y: float
    error: float = 0.0
    group: str = ""


class PlotArea:
    """A plot's area and its vertical axis, which holds all finite values and 0."""

    def __init__(self, values: Values, width: float, height: float, bottom: float) -> None:
        self.left, self.right, self.top = 56.0, width - 170.0, 16.0
        self.bottom = height - bottom
        self.width, self.height = width, height
        finite = [v for v in (*values, 0.0) if math.isfinite(v)]
        self.low, self.high = min(finite), max(finite)
        margin = 0.06 * max(self.high - self.low, 0.1)
        self.low -= margin if self.low < 0 else 0.0
        self.high += margin

    def y(self, value: float) -> float:
        share = (value - self.low) / (self.high - self.low)
        return self.bottom - share * (self.bottom - self.top)

    def axis(self, title: str) -> list[str]:
        out = []
        for tick in ticks(self.low, self.high):
            y = self.y(tick)
            kind = "zero" if tick == 0 else "grid"
            out.append(f'<line class="{kind}" x1="{self.left}" x2="{self.right}" {_ys(y)}/>')
            out.append(
                f'<text class="tick" x="{self.left - 8}" y="{y + 4:.1f}" text-anchor="end">'
                f"{tick:g}</text>"
            )
        middle = (self.top + self.bottom) / 2
        out.append(
            f'<text class="title" transform="translate(14 {middle:.1f}) rotate(-90)" '
            f'text-anchor="middle">{escape(title)}</text>'
        )
        return out


def bars(columns: Sequence[Bar], levels: Sequence[Level], title: str, label: str) -> str:
    """Bars side by side, with lines and bands that are named on the right."""
    values = [v for b in columns for v in (b.value, b.mark, *(d for _, d in b.dots))]
    values += [v for at in levels for v in (at.value - at.half, at.value + at.half)]
    longest = max((len(b.name) for b in columns), default=0)
    frame = PlotArea(values, 960.0, 330.0 + 5.0 * longest, 24.0 + 5.0 * longest)
    out = []
    there = [at for at in levels if math.isfinite(at.value)]
    for at in there:
        if at.half > 0:
            top, low = frame.y(at.value + at.half), frame.y(at.value - at.half)
            out.append(
                f'<rect class="{at.kind}" x="{frame.left}" y="{top:.1f}" '
                f'width="{frame.right - frame.left}" height="{low - top:.1f}"/>'
            )
    out += frame.axis(title)
    pitch = (frame.right - frame.left) / max(len(columns), 1)
    wide = min(0.7 * pitch, 46.0)
    for i, bar in enumerate(columns):
        out += _bar(bar, frame, frame.left + (i + 0.5) * pitch, wide)
    for at in there:
        out.append(
            f'<line class="{at.kind}" x1="{frame.left}" x2="{frame.right}" '
            f"{_ys(frame.y(at.value))}/>"
        )
    # Names would lie on each other where levels are close.
    y = frame.top
    for at in sorted(there, key=lambda one: -one.value):
        y = max(y + 15.0, frame.y(at.value) + 4.0)
        out.append(
            f'<text class="level {at.kind}" x="{frame.right + 8}" y="{y:.1f}">'
            f"{escape(at.name)}</text>"
        )
    return _svg(out, frame.width, frame.height, label)


def scatter(
    points: Sequence[Point], x_title: str, y_title: str, label: str, log: bool = False
) -> str:
    """Models as points, each with its name, and the least-squares line through three or more.

    Of several groups, each has a line of its own.
    """
    frame = PlotArea(
        [v for p in points for v in (p.y - p.error, p.y + p.error)], 720.0, 400.0, 52.0
    )
    xs = np.array([p.x for p in points])
    xs = np.log10(xs) if log else xs
    ys = np.array([p.y for p in points])
    margin = 0.08 * max(float(np.ptp(xs)), 1e-3)
    low, high = float(xs.min()) - margin, float(xs.max()) + margin

    def x_of(x: float) -> float:
        return frame.left + (x - low) / (high - low) * (frame.right - frame.left)

    out = frame.axis(y_title)
    if log:
        steps = (1, 2, 5) if high - low > 1 else range(1, 10)
        decades = [10.0**k for k in range(math.floor(low), math.ceil(high) + 1)]
        marks = [(math.log10(m * ten), _count(m * ten)) for ten in decades for m in steps]
    else:
        marks = [(tick, f"{100 * tick:g} %") for tick in ticks(low, high)]
    for tick, text in marks:
        if low <= tick <= high:
            out.append(
                f'<text class="tick" x="{x_of(tick):.1f}" y="{frame.bottom + 18}" '
                f'text-anchor="middle">{text}</text>'
            )
    out.append(
        f'<text class="title" x="{(frame.left + frame.right) / 2}" y="{frame.height - 8}" '
        f'text-anchor="middle">{escape(x_title)}</text>'
    )
    groups = list(dict.fromkeys(p.group for p in points))
    several = len(groups) > 1
    colours = {g: f"g{k % COLOURS}" if several else "model" for k, g in enumerate(groups)}
    for k, group in enumerate(groups):
        member = np.array([p.group == group for p in points])
        colour = colours[group] if several else ""
        # Past its own models the line of a group would leave the plot.
        ends = (float(xs[member].min()), float(xs[member].max())) if several else (low, high)
        line = _line(xs[member], ys[member], ends, x_of, frame, colour, out)
        said = line or _models(int(member.sum()))
        x, y = frame.right + 8, frame.top + 12 + 34 * k
        if several:
            out.append(
                f'<text class="level {colour}" x="{x}" y="{y}">{escape(group or "others")}</text>'
                f'<text class="tick" x="{x}" y="{y + 15}">{said}</text>'
            )
        elif line:
            out.append(f'<text class="level" x="{x}" y="{y}">line: {line}</text>')
    named: list[tuple[float, float]] = []
    for point, x in zip(points, xs, strict=True):
        px, py = x_of(float(x)), frame.y(point.y)
        ends = frame.y(point.y - point.error), frame.y(point.y + point.error)
        right = px > (frame.left + frame.right) / 2  # write towards the middle
        # The nearest line that no other name is on; with very many models they may overlap.
        lines = [py - 9 + 14 * k for k in sorted(range(-8, 9), key=abs)]
        free = (y for y in lines if all(abs(y - v) >= 14 or abs(px - u) >= 90 for u, v in named))
        at = next(free, py - 9)
        named.append((px, at))
        out.append(
            f'<g><line class="error" x1="{px:.1f}" x2="{px:.1f}" y1="{ends[0]:.1f}" '
            f'y2="{ends[1]:.1f}"/>'
            f'<circle class="{colours[point.group]}" cx="{px:.1f}" cy="{py:.1f}" r="6"/>'
            f'<text class="name" x="{px + (-9 if right else 9):.1f}" y="{at:.1f}" '
            f'text-anchor="{"end" if right else "start"}">{escape(point.name)}</text></g>'
        )
    return _svg(out, frame.width, frame.height, label, "scatter")


def profiles(series: Sequence[tuple[str, Values]], names: Sequence[str], label: str) -> str:
    """RDMs (15,) as lines over the pairs of stimuli, each moved and scaled to mean 0, spread 1.

    Their correlation, which is what is compared, is that of the lines as they are drawn. An RDM
    with a NaN, or of equals, has none. The first is what the others are compared with.
    """
    drawn = []
    for name, entries in series:
        values = np.asarray(entries, dtype=np.float64)
        spread = float(values.std())
        if np.isfinite(values).all() and spread > 0:
            drawn.append((name, (values - values.mean()) / spread))
    pairs = [f"{a} and {b}" for a, b in combinations(names, 2)]
    frame = PlotArea([float(v) for _, line in drawn for v in line], 960.0, 525.0, 232.0)
    out = frame.axis("dissimilarity, scaled")
    pitch = (frame.right - frame.left - 40) / max(len(pairs) - 1, 1)
    places = [frame.left + 20 + k * pitch for k in range(len(pairs))]
    for x, pair in zip(places, pairs, strict=True):
        out.append(
            '<text class="tick" text-anchor="end" transform="'
            f'translate({x + 4:.1f} {frame.bottom + 12:.1f}) rotate(-70)">{escape(pair)}</text>'
        )
    # What is compared with is drawn last, on top.
    for k, (name, line) in [*enumerate(drawn)][::-1]:
        again = " again" if k > COLOURS else ""  # colours begin anew, as dashes
        kind = f"g{(k - 1) % COLOURS}{again}" if k else "goal"
        points = [(x, frame.y(float(v))) for x, v in zip(places, line, strict=True)]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        out.append(f'<polyline class="{kind}" points="{path}"/>')
        out += [
            f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="3">'
            f"{_tip(f'{name}, {pair}: {v:.2f}')}</circle>"
            for (x, y), v, pair in zip(points, line, pairs, strict=True)
        ]
        out.append(
            f'<text class="level {kind}" x="{frame.right + 8}" y="{frame.top + 12 + 17 * k}">'
            f"{'- - ' if again else ''}{escape(name)}</text>"
        )
    return _svg(out, frame.width, frame.height, label)


def heat_map(entries: Values, names: Sequence[str], title: str, beneath: str = "") -> str:
    """An RDM (15,), darkest where it is largest; hatched throughout if it has a NaN."""
    matrix = square(entries)
    cell, left, top = 26.0, 106.0, 26.0
    size = cell * len(names)
    largest = float(np.nanmax(matrix)) if np.isfinite(matrix).any() else 1.0
    out = [f'<text class="map" x="{left}" y="16">{escape(title)}</text>']
    for i, row in enumerate(names):
        y = top + i * cell
        out.append(
            f'<text class="tick" x="{left - 6}" y="{y + 17}" text-anchor="end">{escape(row)}</text>'
        )
        for j, column in enumerate(names):
            value = float(matrix[i, j])
            where = f'x="{left + j * cell}" y="{y}" width="{cell - 1}" height="{cell - 1}"'
            said = f"{row} and {column}: {f'{value:.3f}' if math.isfinite(value) else 'no value'}"
            shade = (
                f'class="heat" fill-opacity="{value / max(largest, 1e-12):.3f}"'
                if math.isfinite(value)
                else 'class="missing"'
            )
            out.append(f'<rect class="cell" {where}/><rect {shade} {where}>{_tip(said)}</rect>')
    for j, column in enumerate(names):
        x, y = left + j * cell + 16, top + size + 10
        out.append(
            f'<text class="tick" transform="translate({x} {y}) rotate(-45)" text-anchor="end">'
            f"{escape(column)}</text>"
        )
    if beneath:
        out.append(f'<text class="tick" x="{left}" y="{top + size + 98}">{escape(beneath)}</text>')
    return _svg(out, left + size + 8, top + size + 104, f"RDM of {title}", "map")


def ticks(low: float, high: float, about: int = 6) -> list[float]:
    """Round numbers between two others."""
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough)) if rough > 0 else 1.0
    step = next(power * s for s in (1, 2, 5, 10) if power * s >= rough * 0.999)
    first = math.ceil(low / step)
    return [round(k * step, 10) for k in range(first, math.floor(high / step) + 1)]


def _line(
    xs: NDArray[np.float64],
    ys: NDArray[np.float64],
    ends: tuple[float, float],
    x_of: Callable[[float], float],
    frame: PlotArea,
    colour: str,
    out: list[str],
) -> str:
    """Draw the least-squares line of three or more models; what is said of it, else nothing."""
    if len(xs) < 3 or not np.ptp(xs) > 0:
        return ""
    slope, at_zero = np.polyfit(xs, ys, 1)
    r = float(np.corrcoef(xs, ys)[0, 1]) if np.ptp(ys) > 0 else math.nan
    (x1, y1), (x2, y2) = ((x_of(x), frame.y(slope * x + at_zero)) for x in ends)
    out.append(
        f'<line class="fit {colour}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'
    )
    return f"r = {r:.2f}, {_models(len(xs))}"


def _models(number: int) -> str:
    return f"{number} model{'s' * (number != 1)}"


def _bar(bar: Bar, frame: PlotArea, x: float, wide: float) -> list[str]:
    zero = frame.y(0)
    if math.isfinite(bar.value):
        y = frame.y(bar.value)
        said = f"{bar.name}: {bar.value:.3f}"
        shape = f'y="{min(y, zero):.1f}" height="{max(abs(y - zero), 0.5):.1f}"'
        kind = f"{bar.part}{' chosen' if bar.ring else ''}"
    else:
        said = f"{bar.name}: no value (NaN)"
        shape = f'y="{frame.top:.1f}" height="{frame.bottom - frame.top:.1f}"'
        kind = "missing"
    out = [
        f'<rect class="{kind}" x="{x - wide / 2:.1f}" width="{wide:.1f}" {shape}>'
        f"{_tip(said)}</rect>"
    ]
    finite = [(name, value) for name, value in bar.dots if math.isfinite(value)]
    for k, (name, value) in enumerate(finite):
        # Spread within the bar, always alike: an animal keeps its place from bar to bar.
        at = x + wide * 0.7 * ((k + 0.5) / len(finite) - 0.5)
        out.append(
            f'<circle class="dot" cx="{at:.1f}" cy="{frame.y(value):.1f}" r="2.6">'
            f"{_tip(f'{bar.name}, {name}: {value:.3f}')}</circle>"
        )
    if math.isfinite(bar.mark):
        out.append(
            f'<line class="control" x1="{x - wide / 2 - 3:.1f}" x2="{x + wide / 2 + 3:.1f}" '
            f"{_ys(frame.y(bar.mark))}>{_tip(f'{bar.name}, untrained: {bar.mark:.3f}')}</line>"
        )
    out.append(
        '<text class="layer" text-anchor="end" transform="'
        f'translate({x + 4:.1f} {frame.bottom + 14:.1f}) rotate(-45)">{escape(bar.name)}</text>'
    )
    return out


def _svg(parts: Sequence[str], width: float, height: float, label: str, kind: str = "") -> str:
    return (
        f'<svg class="{kind}" viewBox="0 0 {width:g} {height:g}" role="img" '
        f'aria-label="{escape(label)}">{"".join(parts)}</svg>'
    )


def _tip(text: str) -> str:
    return f"<title>{escape(text)}</title>"


def _ys(y: float) -> str:
    return f'y1="{y:.1f}" y2="{y:.1f}"'


def _count(number: float) -> str:
    for size, suffix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{suffix}"
    return f"{number:.3g}"
