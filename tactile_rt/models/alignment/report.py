"""The report: one page that stands alone, without a network, in the reader's light or dark."""

import math
from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from tactile_rt.files import write_whole
from tactile_rt.models.alignment.pictures import (
    Bar,
    Level,
    Point,
    bars,
    heat_map,
    profiles,
    scatter,
)
from tactile_rt.models.alignment.results import AlignmentControl, ModelResult, Number, Results

__all__ = ["page", "write_page"]

STYLE = """
:root{color-scheme:light dark;--page:#fcfcfa;--ink:#22252a;--soft:#666b73;--rule:#dfe1e4;
--panel:#f2f3f1;--encoder:#c4523a;--attender:#2f8a58;--decoder:#3a6fb8;--raw:#8a8f98;
--heat:#123b6d;--null:#9a5bb5;--a2a:#b98a1a;--good:#2f8a58;--bad:#c4523a}
@media(prefers-color-scheme:dark){:root{--page:#15171a;--ink:#e6e7e9;--soft:#9aa0a8;--rule:#33373d;
--panel:#1e2125;--encoder:#e07a62;--attender:#58b881;--decoder:#6f9fe0;--raw:#858b94;
--heat:#8fc1ff;--null:#c08ad8;--a2a:#dcb04a;--good:#58b881;--bad:#e07a62}}
body{background:var(--page);color:var(--ink);font:16px/1.5 system-ui,sans-serif;margin:0 auto;
max-width:62rem;padding:1.5rem}
h1{font-size:1.7rem;margin:.2rem 0}h2{font-size:1.25rem;margin:2.2rem 0 .4rem}
h3{font-size:1rem;margin:1.4rem 0 .2rem}p{margin:.4rem 0;max-width:50rem}
.soft{color:var(--soft)}small{color:var(--soft)}
.key{display:flex;flex-wrap:wrap;gap:.3rem 1.1rem;font-size:.86rem;margin:.3rem 0;padding:0}
.key span{display:inline-flex;align-items:center;gap:.4rem}
.key i{display:inline-block;width:.9rem;height:.9rem;border-radius:2px}
.key i.dotkey{width:.5rem;height:.5rem;border-radius:50%;border:1.5px solid var(--ink)}
.key i.linekey{height:0;width:1.2rem;border-top:3px solid var(--ink)}
.key i.hatch{background:repeating-linear-gradient(45deg,var(--soft) 0 1px,transparent 1px 5px);
border:1px dashed var(--soft)}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-size:.9rem;margin:.5rem 0}
th,td{padding:.25rem .7rem;border-bottom:1px solid var(--rule);text-align:right}
th:first-child,td:first-child{text-align:left}th{font-weight:600}
.good{color:var(--good);font-weight:600}.bad{color:var(--bad);font-weight:600}
svg{width:100%;height:auto;display:block}svg.map{width:270px;flex:none}svg.scatter{max-width:46rem}
.maps{display:flex;flex-wrap:wrap;gap:.2rem 1rem}
svg text{fill:var(--ink);font:12px system-ui,sans-serif}svg .tick{fill:var(--soft);font-size:11.5px}
svg .title{font-size:13px}svg .map{font-weight:600;font-size:13px}svg .layer{font-size:12px}
.grid{stroke:var(--rule)}.zero{stroke:var(--soft)}
rect.encoder{fill:var(--encoder)}rect.attender{fill:var(--attender)}
rect.decoder{fill:var(--decoder)}rect.raw{fill:var(--raw)}
rect.chosen{stroke:var(--ink);stroke-width:2.5}
rect.missing{fill:url(#hatch);stroke:var(--soft);stroke-dasharray:3 3;opacity:.6}
.dot{fill:var(--page);stroke:var(--ink);stroke-width:1.1}
.control{stroke:var(--ink);stroke-width:3}
rect.a2a{fill:var(--a2a);opacity:.2}line.a2a{stroke:var(--a2a);stroke-width:1.5}
line.one{stroke:var(--ink);stroke-width:1.6;stroke-dasharray:2 3}
line.null{stroke:var(--null);stroke-dasharray:7 4;stroke-width:1.8}
svg text.a2a{fill:var(--a2a)}svg text.null{fill:var(--null)}svg text.one{fill:var(--ink)}
.cell{fill:var(--panel)}.heat{fill:var(--heat)}
.fit{stroke:var(--soft);stroke-width:1.5;stroke-dasharray:6 4}
.error{stroke:var(--ink);opacity:.5}.model{fill:var(--decoder)}
.g0{--own:#3a6fb8}.g1{--own:#c4523a}.g2{--own:#2f8a58}.g3{--own:#b98a1a}.g4{--own:#9a5bb5}
.g5{--own:#4f9aa8}@media(prefers-color-scheme:dark){.g0{--own:#6f9fe0}.g1{--own:#e07a62}
.g2{--own:#58b881}.g3{--own:#dcb04a}.g4{--own:#c08ad8}.g5{--own:#79c2cf}}
circle.g0,circle.g1,circle.g2,circle.g3,circle.g4,circle.g5{fill:var(--own)}
polyline{fill:none;stroke:var(--own);stroke-width:2}line.fit[class*=g]{stroke:var(--own)}
svg text.level[class*=g]{fill:var(--own);font-weight:600}.goal{--own:var(--ink)}
polyline.goal{stroke-width:4}circle.goal{fill:var(--own)}polyline.again{stroke-dasharray:6 4}
details{margin:.6rem 0}summary{cursor:pointer}
.scale{width:120px;height:12px;display:inline-block;vertical-align:middle;margin:0 .5rem;
background:linear-gradient(90deg,var(--panel),var(--heat));border:1px solid var(--rule)}
"""
# One hatch for all figures of the page.
HATCH = (
    '<svg width="0" height="0" style="position:absolute"><defs><pattern id="hatch" width="6" '
    'height="6" patternUnits="userSpaceOnUse" patternTransform="rotate(45)"><line x1="0" y1="0" '
    'x2="0" y2="6" stroke="var(--soft)" stroke-width="1.5"/></pattern></defs></svg>'
)
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


def write_page(results: Results, path: Path) -> None:
    """Write the page whole or not at all."""
    text = page(results).encode()
    write_whole(path, lambda file: file.write(text))


def page(results: Results) -> str:
    """The page as HTML."""
    several = len(results.models) > 1
    sections = [
        "<h1>Does the model represent touch as barrel cortex does?</h1>",
        f"<p>{_introduction(results)}</p>",
        _summary(results),
        "<h2>Fit of every layer</h2>",
        _layer_key(results),
        *(_layers(results, model) for model in results.models),
        *([_comparison(results)] if several else []),
        "<h2>What is compared: dissimilarities between the six stimuli</h2>",
        _maps(results),
        "<h2>Every animal</h2>",
        _animals(results),
        "<h2>What this cannot say</h2>",
        _limits(results),
    ]
    body = "\n".join(sections)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Alignment with barrel cortex</title><style>{STYLE}</style></head>"
        f"<body>{HATCH}{body}</body></html>\n"
    )


def _introduction(results: Results) -> str:
    benchmark = results.benchmark
    number = sum(benchmark.reliable[: len(benchmark.a2a)])
    return (
        "An array of whiskers whisks six objects: convex or concave, close, at a medium distance "
        "or far. For a model's layer and for an animal's neurons alike, every two objects are more "
        "or less <em>dissimilar</em>. How well these 15 dissimilarities agree, corrected for the "
        "noise of the recordings, is the <em>fit</em>: 0 is none, 1 is all that noise permits. "
        f"Protocol <b>{escape(benchmark.protocol)}</b>, {number} reliable animals of "
        f"{len(benchmark.a2a)}. {STRICT if benchmark.protocol == 'strict' else PAPER}"
    )


def _summary(results: Results) -> str:
    b = results.benchmark
    rows = []
    for model in results.models:
        untrained = model.untrained
        rows.append(
            f"<tr><td>{escape(model.name)}</td><td><b>{_said(model.score)}</b> ± {_said(model.sem)}"
            f"</td><td>{_p(model.p)}</td><td>{_said(model.null_95)}</td>"
            f"<td>{_said(untrained.score) if untrained else ''}</td>"
            f"<td>{f'{model.parameters:,}' if model.parameters else ''}</td>"
            f"<td>{_verdict(model)}</td></tr>"
        )
    return (
        '<div class="scroll"><table><tr><th>model</th><th>score ± s.e.m.</th><th>p</th>'
        "<th>chance, 95th percentile</th><th>untrained</th><th>parameters</th>"
        "<th>NeuroAI Turing test</th></tr>"
        f"{''.join(rows)}<tr><td>raw sensor input</td><td>{_said(results.raw.score)} ± "
        f"{_said(results.raw.sem)}</td><td>{_p(results.raw.p)}</td><td></td><td></td><td></td>"
        "<td></td></tr>"
        f"<tr><td>an animal, from the others</td><td>{_said(b.a2a_mean)} ± {_said(b.a2a_sem)}"
        f"<br><small>highest {_said(b.a2a_highest)}</small></td>"
        "<td></td><td></td><td></td><td></td><td></td></tr></table></div>"
        '<p class="soft">p: share of the 720 relabellings of the stimuli that score as high, the '
        "layer chosen anew each time. Where the raw input or the untrained network scores as high, "
        "it is not training that made it fit. The Turing test asks whether a model fits single "
        "animals as another animal would: it fails what is worse, and passes what is shown to be "
        "near. Its fits weigh dissimilarities by how they vary together: they are not the scores "
        "above. <em>Power</em>: what it finds among these animals themselves.</p>"
        f"{_reasons(results)}"
    )


def _verdict(model: ModelResult) -> str:
    return VERDICTS.get(model.turing, "")


def _reasons(results: Results) -> str:
    """The figures behind each verdict, a line for every model that has one."""
    lines = [
        f"<li>{escape(model.name)}: {escape(model.turing_why)}</li>"
        for model in results.models
        if model.turing_why
    ]
    return f'<ul class="soft">{"".join(lines)}</ul>' if lines else ""


def _layer_key(results: Results) -> str:
    hollow = "<span><i class='linekey'></i>the same layer, untrained</span>"
    untrained = hollow if any(m.untrained for m in results.models) else ""
    ring = "chosen for at least one animal" if results.benchmark.protocol == "strict" else "scored"
    return (
        '<p class="key"><span><i style="background:var(--raw)"></i>raw sensor input</span>'
        '<span><i style="background:var(--encoder)"></i>encoder</span>'
        '<span><i style="background:var(--attender)"></i>attender</span>'
        '<span><i style="background:var(--decoder)"></i>decoder</span>'
        "<span><i style='border:2.5px solid var(--ink);box-sizing:border-box'></i>"
        f"layer {ring}</span><span><i class='dotkey'></i>one animal</span>{untrained}"
        "<span><i class='hatch'></i>no value: the layer does not tell the stimuli apart, or no "
        "animal is reliable</span></p>"
    )


def _layers(results: Results, model: ModelResult) -> str:
    b = results.benchmark
    columns = [_raw_bar(results)]
    control = _means(results, model.untrained) if model.untrained else {}
    means = _means(results, model)
    for layer, row in zip(model.layers, model.corrected, strict=True):
        part, _, name = layer.partition(".")
        columns.append(
            Bar(name or layer, means[layer], part, _dots(results, row),
                control.get(layer, math.nan), layer in model.chosen)
        )  # fmt: skip
    levels = (
        Level("all that noise permits", 1.0, "one"),
        Level("animal to animal ± s.e.m.", _float(b.a2a_mean), "a2a", max(_float(b.a2a_sem), 0)),
        Level("chance, 95th percentile", _float(model.null_95), "null"),
    )
    notes = "".join(f'<p class="soft">{escape(note)}</p>' for note in model.notes)
    drawn = bars(columns, levels, "fit (noise-corrected r)", f"Fit of the layers of {model.name}")
    return (
        f"<h3>{escape(model.name)} <small>score {_said(model.score)} ± {_said(model.sem)}, "
        f"p {_p(model.p)}</small></h3><div class='scroll'>{drawn}</div>{notes}"
    )


def _comparison(results: Results) -> str:
    b = results.benchmark
    columns = [_raw_bar(results)]
    for model in results.models:
        dots = tuple(
            (name, _float(value)) for name, value in zip(b.targets, model.per_target, strict=True)
        )
        mark = _float(model.untrained.score) if model.untrained else math.nan
        columns.append(Bar(model.name, _float(model.score), "decoder", dots, mark))
    levels = (
        Level("all that noise permits", 1.0, "one"),
        Level("animal to animal ± s.e.m.", _float(b.a2a_mean), "a2a", max(_float(b.a2a_sem), 0)),
    )
    out = ["<h2>Models side by side</h2>",
           "<p>Dots: animals. Thick line: the same network before training.</p>",
           bars(columns, levels, "score", "Scores of the models")]  # fmt: skip
    scored = [m for m in results.models if m.score is not None]
    known = [m for m in scored if m.performance is not None]
    if len(known) > 1:
        points = [_point(m, _float(m.performance)) for m in known]
        what = ", ".join(sorted({m.performance_of for m in known if m.performance_of}))
        out += [
            "<h3>Neural fit against task performance</h3>",
            scatter(points, f"task performance{f' ({what})' if what else ''}", "score ± s.e.m.",
                    "Neural fit against task performance"),
        ]  # fmt: skip
        for by, word in (("objective", "loss"), ("augmentation", "augmentation")):
            if len(known) > 1 and len({m.groups.get(by) for m in known}) > 1:
                grouped = [_point(m, _float(m.performance), by) for m in known]
                out += [
                    f"<h3>The same by {word}</h3>",
                    scatter(grouped, f"task performance{f' ({what})' if what else ''}",
                            "score ± s.e.m.", f"Neural fit against task performance by {word}"),
                ]  # fmt: skip
    sized = [m for m in scored if m.parameters > 0]
    if len(sized) > 1:
        by = "encoder" if len({m.groups.get("encoder") for m in sized}) > 1 else ""
        out += [
            f"<h3>Neural fit against size{', by encoder' if by else ''}</h3>",
            scatter([_point(m, float(m.parameters), by) for m in sized], "parameters",
                    "score ± s.e.m.", "Neural fit against parameters", log=True),
        ]  # fmt: skip
    both = [m for m in sized if m.performance is not None]
    if len(both) > 1:
        by = "objective" if len({m.groups.get("objective") for m in both}) > 1 else ""
        points = [
            Point(m.name, float(m.parameters), _float(m.performance), 0.0, m.groups.get(by, ""))
            for m in both
        ]
        out += [
            f"<h3>Task performance against size{', by loss' if by else ''}</h3>",
            scatter(points, "parameters", "task performance", "Task performance against parameters",
                    log=True),
        ]  # fmt: skip
    return "".join([*out, _masking(results)])


def _masking(results: Results) -> str:
    """Models that differ in the masking of steps alone, beside each other."""
    families: dict[tuple[tuple[str, str], ...], list[ModelResult]] = {}
    for model in results.models:
        if _is_number(model.groups.get("masking", "")):
            rest = tuple(sorted((k, v) for k, v in model.groups.items() if k != "masking"))
            families.setdefault(rest, []).append(model)
    rows = [
        f"<tr><td>{escape(m.name)}</td><td>{escape(_percent(m.groups['masking']))}</td>"
        f"<td>{_said(m.performance)}</td><td>{_said(m.score)} ± {_said(m.sem)}</td></tr>"
        for models in families.values()
        if len({m.groups["masking"] for m in models}) > 1
        for m in sorted(models, key=lambda m: float(m.groups["masking"]))
    ]
    if not rows:
        return ""
    return (
        "<h3>With and without masking of steps</h3><p>Networks of the same kind, trained alike but "
        'for the share of steps that was blanked.</p><div class="scroll"><table><tr><th>model</th>'
        "<th>steps masked</th><th>task performance</th><th>score ± s.e.m.</th></tr>"
        f"{''.join(rows)}</table></div>"
    )


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _percent(share: str) -> str:
    return f"{100 * float(share):g} %"


def _point(model: ModelResult, x: float, by: str = "") -> Point:
    sem = _float(model.sem)
    error = sem if math.isfinite(sem) else 0.0
    return Point(model.name, x, _float(model.score), error, model.groups.get(by, ""))


def _maps(results: Results) -> str:
    b = results.benchmark
    maps = [heat_map(_floats(results.raw_rdm), results.stimuli, "raw sensor input")]
    rest: list[str] = []
    lines = [("raw sensor input", _floats(results.raw_rdm))]
    for model in results.models:
        counted = [name for name in model.chosen if name]
        best = max(set(counted), key=counted.count) if counted else ""
        for layer, row in zip(model.layers, model.rdms, strict=True):
            drawn = heat_map(_floats(row), results.stimuli, layer, model.name)
            (maps if layer == best else rest).append(drawn)
            if layer == best:
                lines.append((model.name, _floats(row)))
    animals = [
        heat_map(_floats(row), results.stimuli, name, f"reliability {_said(reliability)}")
        for name, row, reliability in zip(b.targets, b.rdms, b.reliabilities, strict=True)
    ]
    reliable = [_floats(row) for row, good in zip(b.rdms, b.reliable, strict=True) if good]
    if reliable:
        mean = np.mean(reliable, axis=0).tolist()
        maps.append(heat_map(mean, results.stimuli, "mean animal"))
        lines.insert(0, ("mean animal", mean))
    return (
        "<p>1 - correlation over units of the responses to two stimuli. Each map has its own "
        'scale, for fits do not depend on it: alike<span class="scale"></span>most dissimilar. '
        "Shown are the input, the layer that is chosen most often and the mean of the reliable "
        f'animals.</p><div class="maps">{"".join(maps)}</div>'
        "<h3>The same as lines</h3><p>Each line moved and scaled, for a fit depends on neither: "
        "lines that rise and fall together fit.</p>"
        f"<div class='scroll'>{profiles(lines, results.stimuli, 'Dissimilarities as lines')}</div>"
        f'<details><summary>every animal ({len(animals)})</summary><div class="maps">'
        f"{''.join(animals)}</div></details><details><summary>every other layer ({len(rest)})"
        f'</summary><div class="maps">{"".join(rest)}</div></details>'
    )


def _animals(results: Results) -> str:
    b = results.benchmark
    head = "".join(f"<th>{escape(m.name)}</th><th>layer</th>" for m in results.models)
    rows = []
    for i, name in enumerate(b.targets):
        cells = "".join(
            f"<td>{_said(m.per_target[i])}</td><td>{escape(m.chosen[i])}</td>"
            for m in results.models
        )
        reliable = "yes" if b.reliable[i] else "no: not in the score"
        rows.append(
            f"<tr><td>{escape(name)}</td><td>{_said(b.reliabilities[i])}</td><td>{reliable}</td>"
            f"<td>{_said(b.a2a.get(name))}</td>{cells}</tr>"
        )
    return (
        '<div class="scroll"><table><tr><th>animal</th><th>reliability of its RDM</th>'
        f"<th>reliable</th><th>from the other animals</th>{head}</tr>{''.join(rows)}</table></div>"
        + "".join(f'<p class="soft">{escape(note)}</p>' for note in b.notes)
    )


def _limits(results: Results) -> str:
    return (
        "<p>Six stimuli give 15 dissimilarities, so many models that differ a lot fit alike, and "
        "the smallest p that can be had is 1/720. The highest of 20 layers on 12 targets has, for "
        "<em>random</em> dissimilarities, a median of 0.68 before and 0.79 after the noise "
        "correction: a high maximum alone is weak evidence. The stimuli were whisked in "
        "simulation, the animals' choices, licks and movements were not.</p>"
        f'<p class="soft">Benchmark {escape(results.benchmark.sha256[:12])}, input '
        f"{escape(results.input.get('file', ''))} {escape(results.input.get('sha256', '')[:12])}; "
        + "; ".join(
            f"{escape(m.name)} {escape(m.sha256[:12])} ({escape(m.precision)})"
            for m in results.models
        )
        + ".</p>"
    )


def _raw_bar(results: Results) -> Bar:
    row = results.raw.corrected[0]
    return Bar("raw input", _means(results, results.raw)["raw"], "raw", _dots(results, row))


def _means(results: Results, of: ModelResult | AlignmentControl) -> dict[str, float]:
    """By layer, mean over the reliable targets; NaN without any."""
    out = {}
    for layer, row in zip(of.layers, of.corrected, strict=True):
        values = [v for _, v in _dots(results, row)]
        out[layer] = float(np.mean(values)) if values else math.nan
    return out


def _dots(results: Results, row: Sequence[Number]) -> tuple[tuple[str, float], ...]:
    b = results.benchmark
    return tuple(
        (name, value)
        for name, value, reliable in zip(b.targets, row, b.reliable, strict=True)
        if reliable and value is not None
    )


def _float(value: Number) -> float:
    return math.nan if value is None else value


def _floats(values: Sequence[Number]) -> list[float]:
    return [_float(v) for v in values]


def _said(value: Number) -> str:
    return "-" if value is None else f"{value:.2f}"


def _p(value: Number) -> str:
    return "-" if value is None else f"{value:.4f}"
