"""A project's report card: one page that says how far the model can be trusted, with pictures."""

import base64
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.files import write_whole
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.pictures import draw_confusion
from tactile_rt.models.evaluation.records import Record
from tactile_rt.models.evaluation.windows import stepped
from tactile_rt.project.folder import Project

__all__ = ["confused", "draw_over_time", "write_report"]

HEADLINES = {
    "top-1": "right on objects it never met, no sensor noise",
    "top-1 at rated noise": "the same, with the noise that the sensor is rated at",
    "two sweeps fused": "two sweeps of one object taken together",
    "RBF SVM top-1": "a support vector machine on the same windows",
    "points above the SVM": "the network above that machine",
    "calibration error": "how far its probabilities are from what they promise",
    "time to the final decision": "from the first touch until the decision stands",
}
CONFUSED = 0.05  # share of a kind's sweeps that are taken for another: more is told


def write_report(project: Project, sweeps: Path, records: Sequence[Record]) -> Path:
    """Write ``report/report.html`` and the pictures on it."""
    session, card = load_model(project.model)
    test = SweepSet.read(sweeps, "test")
    run = stepped(session, card)
    labels, objects = test.sweeps.labels, test.sweeps.objects
    curves = {
        "no sensor noise": measures.predict(test, run),
        "rated noise": measures.predict(test, run, 1.0),
    }
    step_ms = card.period_ns * card.substeps * 1e-6
    draw_over_time(curves, labels, objects, step_ms, project.report / "over_time.png")
    table = measures.confusion(curves["rated noise"][:, -1], labels, len(card.classes))
    draw_confusion(table, card.classes, project.report / "confusion.png")
    found = {r.name.removeprefix("models."): r for r in records}
    robust = [r for name, r in found.items() if name.startswith("top-1, ")]
    page = resources.files("tactile_rt.project") / "templates" / "report.html.txt"
    text = Template(page.read_text("utf-8")).substitute(
        name=escape(project.folder.resolve().name),
        array=f"{len(card.array.elements)} whiskers, "
        + ", ".join(
            f"{channel} ({unit})"
            for channel, unit in zip(card.array.channels, card.array.units, strict=True)
        ),
        step=f"{step_ms:.3g}",
        sample=f"{len(set(objects.tolist()))} objects, {len(labels)} sweeps",
        kinds=escape(", ".join(card.classes)),
        headlines=_rows([(found[n], words) for n, words in HEADLINES.items() if n in found]),
        robust=_rows([(r, r.name.removeprefix("models.top-1, ")) for r in robust]),
        confused=_confusions(confused(table, card.classes)),
        over_time=_picture(project.report / "over_time.png"),
        confusion=_picture(project.report / "confusion.png"),
    )
    path = project.report / "report.html"
    write_whole(path, lambda file: file.write(text.encode()))
    return path


def confused(
    table: NDArray[np.int64], labels: Sequence[str], share: float = CONFUSED
) -> list[tuple[str, str, float]]:
    """What is taken for what, worst first: kind, what it is taken for, share of its sweeps.

    Args:
        table: (true, decided) counts.
    """
    shares = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    pairs = [
        (labels[i], labels[j], float(shares[i, j]))
        for i, j in zip(*np.nonzero(shares >= share), strict=True)
        if i != j
    ]
    return sorted(pairs, key=lambda pair: -pair[2])


def draw_over_time(
    curves: dict[str, NDArray[np.float32]],
    labels: NDArray[np.int64],
    objects: NDArray[np.str_],
    step_ms: float,
    path: Path,
) -> None:
    """Draw top-1 against the time since the first touch, with 95 % intervals by object.

    Args:
        curves: (sweep, step, class) posteriors by name.
        labels: (sweep,).
        objects: (sweep,) names.
        step_ms: the time that a step takes, ms.
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


def _rows(records: Sequence[tuple[Record, str]]) -> str:
    return "\n".join(
        f"<tr><td>{escape(words)}</td><td class=n>{r.value:.1f} {escape(r.unit)}</td>"
        f"<td>{escape(r.anchor.partition(',')[0].replace('95 % interval ', ''))}</td></tr>"
        for r, words in records
    )


def _confusions(pairs: Sequence[tuple[str, str, float]]) -> str:
    if not pairs:
        return "<p>Nothing: no kind is taken for another in more than one sweep of twenty.</p>"
    items = "".join(
        f"<li>{escape(what)} is taken for {escape(other)} in {100 * share:.0f} % of its sweeps</li>"
        for what, other, share in pairs
    )
    return f"<ul>{items}</ul>"


def _picture(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
