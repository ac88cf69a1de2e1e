"""The report card of a project: one page, with pictures, on how far to trust the model."""

import base64
from collections.abc import Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.files import write_whole
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.pictures import draw_confusion
from tactile_rt.models.evaluation.records import Record
from tactile_rt.project.folder import Project
from tactile_rt.sets.manifest import SPLITS, SweepManifest, has_object
from tactile_rt.sim_backend.datasets.inventory import tally
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set

HEADLINES = {
    "top-1": "right on objects it never met, no sensor noise",
    "top-1 at rated noise": "the same, with the noise that the sensor is rated at",
    "top-1, macro": "right on objects it never met, every kind counted alike",
    "two sweeps fused": "two sweeps of one object taken together",
    "RBF SVM top-1": "a support vector machine on the same windows",
    "points above the SVM": "the network above that machine",
    "calibration error": "how far its probabilities are from what they promise",
    "time to the final decision": "from the first touch until the decision stands",
}
CONFUSED = 0.05  # least share of a kind's sweeps decided as another kind that is reported


def write_report(project: Project, sweeps: Path, records: Sequence[Record]) -> Path:
    """Write ``report/report.html`` and its confusion.png; return the path of the page."""
    session, card = load_model(project.model)
    test = SweepSet.read(sweeps, "test")
    run = measures.run_steps(session, card)
    labels, objects = test.sweeps.labels, test.sweeps.objects
    step_ms = card.period_ns * card.substeps * 1e-6
    noisy = measures.predict(test, run, 1.0)
    table = measures.confusion(noisy[:, -1], labels, len(card.classes))
    draw_confusion(table, card.classes, project.report / "confusion.png")
    found = {r.name.removeprefix("models."): r for r in records}
    robust = [r for n, r in found.items() if n.startswith("top-1, ") and n not in HEADLINES]
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
        swept=_describe_sweeps(sweeps),
        kinds=escape(", ".join(card.classes)),
        headlines=_format_rows([(found[n], words) for n, words in HEADLINES.items() if n in found]),
        robust=_format_rows([(r, r.name.removeprefix("models.top-1, ")) for r in robust]),
        confused=_format_confusions(list_confusions(table, card.classes)),
        over_time=_embed_picture(project.report / "accuracy_over_time.png"),
        confusion=_embed_picture(project.report / "confusion.png"),
    )
    path = project.report / "report.html"
    write_whole(path, lambda file: file.write(text.encode()))
    return path


def list_confusions(
    table: NDArray[np.int64], labels: Sequence[str], share: float = CONFUSED
) -> list[tuple[str, str, float]]:
    """List frequent confusions, worst first: (true kind, decided kind, share of true kind).

    Args:
        table: counts of sweeps, shape (true, decided).
    """
    shares = table / np.maximum(table.sum(axis=1, keepdims=True), 1)
    pairs = [
        (labels[i], labels[j], float(shares[i, j]))
        for i, j in zip(*np.nonzero(shares >= share), strict=True)
        if i != j
    ]
    return sorted(pairs, key=lambda pair: -pair[2])


def _describe_sweeps(folder: Path) -> str:
    manifest = SweepManifest.read(folder)
    stored = {s: [n for n in manifest.split[s] if has_object(folder, n)] for s in SPLITS}
    every = tally(
        folder, manifest.names(SPLITS), draws := len(recipe_of_set(manifest.recipe).sweeps)
    )
    learnt, chosen, tested = (
        f"{draws * len(stored[split])} sweeps of {len(stored[split])}" for split in SPLITS
    )
    touching, beyond = every.shares
    return (
        f"It learnt from {learnt} objects. By {chosen} others it was chosen which of its states in "
        f"training is kept. {tested} further ones, of which nothing was known until then, are the "
        f"test. {100 * touching:.0f} % of all touch a whisker; in {100 * beyond:.0f} % "
        "a reading is beyond the sensor's range."
    )


def _format_rows(records: Sequence[tuple[Record, str]]) -> str:
    return "\n".join(
        f"<tr><td>{escape(words)}</td><td class=n>{r.value:.1f} {escape(r.unit)}</td>"
        f"<td>{escape(r.anchor.partition(',')[0].replace('95 % interval ', ''))}</td></tr>"
        for r, words in records
    )


def _format_confusions(pairs: Sequence[tuple[str, str, float]]) -> str:
    if not pairs:
        return "<p>Nothing: no kind is taken for another in more than one sweep of twenty.</p>"
    items = "".join(
        f"<li>{escape(what)} is taken for {escape(other)} in {100 * share:.0f} % of its sweeps</li>"
        for what, other, share in pairs
    )
    return f"<ul>{items}</ul>"


def _embed_picture(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()
