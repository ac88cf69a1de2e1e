"""Formatting of models' scores as one HTML page."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from tactile_rt.alignment import pictures
from tactile_rt.alignment.html_page import format_number, join_notes, make_page, make_table
from tactile_rt.alignment.rdm import relabellings
from tactile_rt.alignment.results import ModelResult, Results
from tactile_rt.alignment.scoring import Score

VERDICTS = {
    "pass": '<span class="good">passes</span>',
    "fail": '<span class="bad">fails</span>',
    "inconclusive": "cannot tell",
}
STRICT = (
    "The score is the mean over animals of the fit of one layer, which is chosen on the other "
    "animals: it is not the highest bar."
)
PAPER = (
    "This is the published analysis, reproduced: the score is the highest of all layers and "
    "targets, filtered and uncorrected as in the published code. Random models reach high values "
    "of such a maximum too, so compare it with the dashed line, not with 0."
)
LIMITS = (
    "<p>{} stimuli give {} dissimilarities, and few of them let many models that differ a lot fit "
    "alike; the smallest p that can be had is 1/{}.{}</p>"
)
LIMITS_OF_SIX = (
    " The highest of 20 layers on 12 targets has, for <em>random</em> dissimilarities, a median of "
    "0.68 before and 0.79 after the noise correction: a high maximum alone is weak evidence. The "
    "stimuli were whisked in simulation, the animals' choices, licks and movements were not."
)
WHISKED = (
    "An array of whiskers whisks six objects: convex or concave, close, at a medium distance or "
    "far. "
)
KEY = (
    "<p>Bars: mean over reliable animals; dots: animals; framed: layers that count in the score; "
    "thick lines: the same layer, untrained; hatched: no value, for the layer does not tell the "
    "stimuli apart, or no animal is reliable. Grey: raw sensor input, red: encoder, green: "
    "attender, blue: decoder.</p>"
)
RAW = "raw sensor input"
PERFORMANCE, SIZE, SCORE = "task performance", "parameters", "score ± s.e.m."


def report_page(results: Results) -> str:
    """Format scores as an HTML report; return its text."""
    stimuli = len(results.benchmark.stimuli)
    ways = relabellings(stimuli)
    limits = LIMITS.format(stimuli, ways.shape[1], len(ways), LIMITS_OF_SIX if results.raw else "")
    used = [f"benchmark of {', '.join(results.benchmark.sources) or 'no named files'}"]
    if results.raw:
        named = (results.input.get(key, "") for key in ("file", "sha256"))
        used.append("input {} {:.12}".format(*named))
    used += [f"{m.name} {m.sha256[:12]} ({m.precision})" for m in results.models]
    return make_page(
        "Alignment with barrel cortex",
        "<h1>Does the model represent touch as barrel cortex does?</h1>"
        f"<p>{_introduce(results)}</p>{_summarise(results)}"
        f"<h2>Fit of every layer</h2>{KEY}"
        + "".join(_show_layers(results, model) for model in results.models)
        + (_compare(results) if len(results.models) > 1 else "")
        + f"<h2>What is compared: dissimilarities between the stimuli</h2>{_show_rdms(results)}"
        f"<h2>Every animal</h2>{_show_animals(results)}"
        f"<h2>What this cannot say</h2>{limits}{join_notes(['; '.join(used)])}",
    )


def _introduce(results: Results) -> str:
    benchmark = results.benchmark
    return (
        f"{WHISKED if results.raw else ''}For a model's layer and for an animal's neurons alike, "
        "every two stimuli are more or less <em>dissimilar</em>. How well these dissimilarities "
        "agree, corrected for the "
        "noise of the recordings, is the <em>fit</em>: 0 is none, 1 is all that noise permits. "
        f"Protocol <b>{escape(benchmark.protocol)}</b>, {len(benchmark.reliable)} reliable animals "
        f"of {len(benchmark.targets)}. {STRICT if benchmark.protocol == 'strict' else PAPER}"
    )


def _summarise(results: Results) -> str:
    rows = [
        [
            escape(model.name), f"<b>{_format_score(model)}</b>", format_number(model.p, 4),
            format_number(model.null_95),
            format_number(model.untrained.score) if model.untrained else "",
            f"{model.parameters:,}" if model.parameters else "", VERDICTS.get(model.turing, ""),
        ]
        for model in results.models
    ]  # fmt: skip
    a2a = results.benchmark.a2a
    between = (
        f"{format_number(a2a.mean)} ± {format_number(a2a.sem)}"
        f"<br><small>highest {format_number(a2a.highest)}</small>"
    )
    if results.raw:
        rows.append([RAW, _format_score(results.raw), format_number(results.raw.p, 4), *[""] * 4])
    rows.append(["an animal, from the others", between, *[""] * 5])
    head = ["model", SCORE, "p", "chance, 95th percentile", "untrained", SIZE]
    why = [f"{model.name}: {model.turing_why}" for model in results.models if model.turing_why]
    return (
        make_table([*head, "NeuroAI Turing test"], rows)
        + '<p class="soft">p: share of the relabellings of the stimuli that score as high, the '
        "layer chosen anew each time. Where the raw input or the untrained network scores as high, "
        "it is not training that made it fit. The Turing test asks whether a model fits single "
        "animals as another animal would: it fails what is worse, and passes what is shown to be "
        "near. Its fits weigh dissimilarities by how they vary together: they are not the scores "
        "above. <em>Power</em>: what it finds among these animals themselves.</p>" + join_notes(why)
    )


def _show_layers(results: Results, model: ModelResult) -> str:
    untrained = model.untrained
    control = dict(zip(untrained.layers, _mean_fits(untrained), strict=True)) if untrained else {}
    columns = _raw_bars(results)
    for layer, fit, row in zip(model.layers, _mean_fits(model), model.corrected, strict=True):
        part, _, name = layer.partition(".")
        columns.append(
            pictures.Bar(name or layer, fit, part, row[list(model.reliable)],
                control.get(layer, math.nan), layer in model.chosen)
        )  # fmt: skip
    chance = pictures.Level("chance, 95th percentile", model.null_95, "#9a5bb5", dash="--")
    drawn = pictures.draw_bars(columns, [*_levels(results), chance], "fit (noise-corrected r)")
    return (
        f"<h3>{escape(model.name)} <small>score {_format_score(model)}, "
        f"p {format_number(model.p, 4)}</small></h3>{drawn}{join_notes(model.notes)}"
    )


def _compare(results: Results) -> str:
    columns = _raw_bars(results)
    for model in results.models:
        mark = model.untrained.score if model.untrained else math.nan
        columns.append(pictures.Bar(model.name, model.score, "decoder", model.per_target, mark))
    out = ["<h2>Models side by side</h2>", pictures.draw_bars(columns, _levels(results), "score")]
    known = [m for m in results.models if math.isfinite(m.performance)]
    fits = [m for m in known if math.isfinite(m.score)]
    what = ", ".join(sorted({m.performance_of for m in known if m.performance_of}))
    title = f"{PERFORMANCE} ({what})" if what else PERFORMANCE
    for by, word in (("", ""), ("objective", ", by loss"), ("augmentation", ", by augmentation")):
        if len(fits) > 1 and (not by or _differ(fits, by)):
            points = [_make_point(m, m.performance, by) for m in fits]
            out.append(f"<h3>Neural fit against task performance{word}</h3>")
            out.append(pictures.draw_scatter(points, title, SCORE))
    sized = [m for m in results.models if m.parameters > 0 and math.isfinite(m.score)]
    if len(sized) > 1:
        by = "encoder" if _differ(sized, "encoder") else ""
        out.append(f"<h3>Neural fit against size{', by encoder' * bool(by)}</h3>")
        points = [_make_point(m, m.parameters, by) for m in sized]
        out.append(pictures.draw_scatter(points, SIZE, SCORE, log=True))
    both = [m for m in known if m.parameters > 0]
    if len(both) > 1:
        by = "objective" if _differ(both, "objective") else ""
        out.append(f"<h3>Task performance against size{', by loss' * bool(by)}</h3>")
        named = [(m.name, m.parameters, m.performance, m.groups.get(by, "")) for m in both]
        points = [pictures.Point(name, x, y, group=group) for name, x, y, group in named]
        out.append(pictures.draw_scatter(points, SIZE, PERFORMANCE, log=True))
    return "".join([*out, _compare_masking(results)])


def _differ(models: Sequence[ModelResult], by: str) -> bool:
    return len({m.groups.get(by) for m in models}) > 1


def _make_point(model: ModelResult, x: float, by: str) -> pictures.Point:
    error = model.sem if math.isfinite(model.sem) else 0.0
    return pictures.Point(model.name, x, model.score, error, model.groups.get(by, ""))


def _compare_masking(results: Results) -> str:
    """Format an HTML table of models that differ only in the masking of steps."""
    families: dict[tuple[tuple[str, str], ...], list[tuple[float, ModelResult]]] = {}
    for model in results.models:
        try:
            share = float(model.groups.get("masking", ""))
        except ValueError:
            continue
        rest = tuple(sorted((k, v) for k, v in model.groups.items() if k != "masking"))
        families.setdefault(rest, []).append((share, model))
    rows = [
        [escape(m.name), f"{100 * share:g} %", format_number(m.performance), _format_score(m)]
        for models in families.values()
        if len({share for share, _ in models}) > 1
        for share, m in sorted(models, key=lambda pair: pair[0])
    ]
    if not rows:
        return ""
    return (
        "<h3>With and without masking of steps</h3><p>Networks of the same kind, trained alike but "
        "for the share of steps that was blanked.</p>"
        + make_table(["model", "steps masked", PERFORMANCE, SCORE], rows)
    )


def _show_rdms(results: Results) -> str:
    targets, stimuli = results.benchmark.all_targets, results.benchmark.stimuli
    maps, rest = [(RAW, results.raw.rdms[0])] if results.raw else [], []
    for model in results.models:
        counted = [name for name in model.chosen if name]
        best = max(set(counted), key=counted.count) if counted else ""
        for layer, row in zip(model.layers, model.rdms, strict=True):
            if layer == best:
                maps.append((model.name, row))
            else:
                rest.append((f"{model.name}: {layer}", row))
    reliable = [t.chosen.rdm for t in targets if t.reliable]
    lines = list(maps)
    if reliable:
        lines.insert(0, ("mean animal", np.mean(reliable, axis=0)))
    animals = [
        (f"{t.name}, reliability {format_number(t.chosen.reliability)}", t.chosen.rdm)
        for t in targets
    ]
    return (
        "<p>1 - correlation over units of the responses to two stimuli. Each map has its own "
        "scale, for fits do not depend on it: the darker, the more dissimilar. Shown are the mean "
        "of the reliable animals, the input, and the layer of each model that is chosen most "
        f"often.</p>{pictures.draw_heat_maps(lines, stimuli)}"
        "<h3>The same as lines</h3><p>Each line moved and scaled, for a fit depends on neither: "
        f"lines that rise and fall together fit.</p>{pictures.draw_profiles(lines, stimuli)}"
        f"<details><summary>every animal ({len(animals)})</summary>"
        f"{pictures.draw_heat_maps(animals, stimuli)}</details>"
        f"<details><summary>every other layer ({len(rest)})</summary>"
        f"{pictures.draw_heat_maps(rest, stimuli) if rest else ''}</details>"
    )


def _show_animals(results: Results) -> str:
    benchmark = results.benchmark
    others = dict(zip(benchmark.a2a.animals, benchmark.a2a.pooled.tolist(), strict=True))
    rows = [
        [
            escape(target.name), format_number(target.chosen.reliability),
            "yes" if target.reliable else "no: not in the score",
            format_number(others.get(target.name, math.nan)),
            *(
                f"{format_number(m.per_target[k])}<br><small>{escape(m.chosen[k])}</small>"
                for m in results.models
            ),
        ]
        for k, target in enumerate(benchmark.all_targets)
    ]  # fmt: skip
    head = ["animal", "reliability of its RDM", "reliable", "from the other animals"]
    names = [escape(m.name) for m in results.models]
    return make_table([*head, *names], rows) + join_notes(benchmark.notes)


def _levels(results: Results) -> list[pictures.Level]:
    """Make the lines and bands of a bar plot: noise limit and consistency between animals."""
    a2a = results.benchmark.a2a
    half = a2a.sem if math.isfinite(a2a.sem) else 0.0
    return [
        pictures.Level("all that noise permits", 1.0, "black", dash=":"),
        pictures.Level("animal to animal ± s.e.m.", a2a.mean, "#b98a1a", half),
    ]


def _raw_bars(results: Results) -> list[pictures.Bar]:
    """Make the bar of the raw sensor input; an empty list without a score."""
    if (raw := results.raw) is None:
        return []
    fits = raw.corrected[0][list(raw.reliable)]
    return [pictures.Bar("raw input", _mean_fits(raw)[0], "raw", fits)]


def _mean_fits(made: Score) -> list[float]:
    """Average each layer's fit over the reliable targets; NaN without a fit."""
    rows = made.corrected[:, list(made.reliable)]
    return [float(row.mean()) if (row := r[np.isfinite(r)]).size else math.nan for r in rows]


def _format_score(made: Score) -> str:
    return f"{format_number(made.score)} ± {format_number(made.sem)}"
