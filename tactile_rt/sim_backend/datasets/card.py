"""The card of a sweep set: what is in it, measured, with pictures, for whoever may use it.

README.md       for reading
card.json       the same numbers
card.png        forces, which whiskers are touched, what was drawn, what can be told apart
examples.png    a sweep of some categories
"""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.files import write_whole
from tactile_rt.sim_backend.datasets.card_survey import Card, survey
from tactile_rt.sim_backend.datasets.separability import Fit, Separability
from tactile_rt.stream import ArraySpec
from tactile_rt.sweep_set import SweepManifest

__all__ = ["write_card"]


def write_card(folder: Path, fit: Fit) -> Card:
    """Write the card of a set, or of what there is of it, into its folder.

    Args:
        folder: the set's.
        fit: fits a support vector machine, as `models.svm.fit`.

    Raises:
        RecordingError: no such set, nothing in it, or an object is damaged.
    """
    from tactile_rt.sim_backend.datasets.card_pictures import draw_card, draw_examples  # matplotlib

    manifest = SweepManifest.read(folder)
    card, examples = survey(folder, fit)
    spec, period_ms = manifest.spec, manifest.period_ns * 1e-6
    write_whole(folder / "card.png", lambda file: draw_card(card, spec, file))
    if examples:
        write_whole(
            folder / "examples.png", lambda file: draw_examples(examples, period_ms, spec, file)
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
        f"- Largest force of a touched whisker in a sweep: median {1e6 * card.median_force:.3g} "
        f"uN; the largest of all {1e3 * largest:.3g} mN ({where}).",
        f"- A sweep that touches, touches {card.whiskers_touched:.1f} whiskers on average.",
        f"- Sweeps without any touch: {card.without_touch}, of which {card.misses} pass beside "
        f"the array and {card.unstable} could not be simulated at this profile.",
        f"- Values that a limit would clip: {limits}.",
    ]
    if card.not_finite:
        lines.append(f"- **{card.not_finite} sweeps hold values that are no numbers.**")
    return "\n".join(lines)


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
