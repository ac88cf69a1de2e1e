"""`tactile-rt align`: compare a model's representation of touch with barrel cortex."""

from dataclasses import asdict, replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Column, Table

from tactile_rt.cli.app import add_group, check_output, needing
from tactile_rt.cli.options import Json, Seed, argument, option, set_option
from tactile_rt.cli.tables import print_table, progress_bar, share_bar, told_as_json
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import take_sets

if TYPE_CHECKING:
    from tactile_rt.alignment.results import Results

align = add_group("align", "Compare models with recordings of barrel cortex.")

Page = Annotated[Path | None, option("Also write an HTML page here.", "--out")]
Stimuli = Annotated[
    Path | None, option("File of `tactile-rt whisk`. Default: the shipped file of the mouse array.")
]
Sessions = Annotated[
    list[str] | None,
    option("Only sessions with this in their name; wildcards * and ?.", "--session"),
]
Models = Annotated[
    list[Path], argument("Checkpoints, any .onnx, torch as module:function, or responses (.npz).")
]
Benchmark = Annotated[Path, option("Benchmark of `align build`.")]


@align.command("example", epilog="tactile-rt align example brain --set mice=4")
def write_brain(
    folder: Annotated[Path, argument("Folder to make.")],
    seed: Seed = 0,
    sets: Annotated[
        list[str] | None, set_option("An option of the brain: mice=6, trials=60, private=0.3")
    ] = None,
) -> None:
    """Write made-up recordings and models to try the commands on."""
    from tactile_rt.alignment.example import Brain
    from tactile_rt.alignment.example_files import write_example

    (brain,) = take_sets("align example", sets or (), Brain)
    with share_bar("recording") as tell, needing("align"):
        recordings, models = write_example(folder, brain, seed, tell)
    names = ", ".join(sorted(path.name for path in models.iterdir()))
    typer.echo(f"{recordings}: {brain.mice} mice; {models}: {names}", err=True)
    typer.echo(f"next: tactile-rt align build {recordings} --out benchmark.json", err=True)


@align.command("build", epilog="tactile-rt align build brain/recordings --out benchmark.json")
def build_benchmark(
    recordings: Annotated[
        list[Path], argument("NWB files, folders of them, one .npz, or two .csv (see the docs).")
    ],
    out: Annotated[Path, option("Benchmark to write, .json.")],
    protocol: Annotated[str, option("Protocol: strict or paper-code.")] = "strict",
    task: Annotated[str | None, option("Only sessions of discrimination or detection.")] = None,
    sessions: Sessions = None,
    depth: Annotated[
        str | None, option("Only units of a layer, e.g. L4, or a range in um.")
    ] = None,
    cells: Annotated[str | None, option("Only excitatory or inhibitory units.")] = None,
    clock: Annotated[
        str | None,
        option("Zero of the spike times: session (as in NWB) or recording (as published)."),
    ] = None,
    bootstraps: Annotated[int, option("Number of random splits of the trials.")] = 1000,
    seed: Seed = 1234,
    json: Json = None,
) -> None:
    """Make a small benchmark file from neural recordings."""
    from tactile_rt.alignment import build, save_benchmark
    from tactile_rt.alignment.selection import Selection

    check_output(out)
    selection = Selection.of(task, sessions or (), depth, cells)
    with share_bar("building") as tell, needing("align"):
        made = build(recordings, protocol, bootstraps, seed, tell, selection, clock)
    save_benchmark(made, out)
    results = {
        "benchmark": out, "animals": len(made.targets), "reliable": len(made.reliable),
        "animal_to_animal": made.a2a.mean, "sem": made.a2a.sem, "notes": made.notes,
    }  # fmt: skip
    told_as_json(results, json)
    for note in made.notes:
        warning = note.startswith("WARNING")
        typer.secho(note, err=True, fg="red" if warning else None, bold=warning)
    typer.echo(
        f"{out}: {len(made.reliable)} of {len(made.targets)} animals are reliable; animal to "
        f"animal {made.a2a.mean:.3f} ± {made.a2a.sem:.3f}",
        err=True,
    )


@align.command("score", epilog="tactile-rt align score run/best.pt --benchmark benchmark.json")
def score_models(
    models: Models,
    benchmark: Benchmark,
    json: Json = None,
    page: Page = None,
    stimuli: Stimuli = None,
    input_name: Annotated[
        str, option("Input that takes the loads, of an ONNX file with several.", "--input")
    ] = "",
    seed: Seed = 0,
) -> None:
    """Score every layer of models against a benchmark."""
    check_output(page)
    with needing("train"):
        if page:
            import matplotlib  # noqa: F401
        from tactile_rt.alignment.benchmark import load_benchmark
        from tactile_rt.alignment.loading import check_models, load_layers, load_untrained
        from tactile_rt.alignment.results import ModelResult, results_of, score_model
        from tactile_rt.alignment.stimuli_input import read_stimuli

        felt, frozen = read_stimuli(stimuli), load_benchmark(benchmark)
        names = check_models(models)
        done: list[ModelResult] = []
        with progress_bar("scoring", len(models)) as update:
            for path, name in zip(models, names, strict=True):
                update(description=name)
                layers, own = load_layers(path, felt, input_name, frozen.stimuli)
                layers = replace(layers, name=name)
                before = load_untrained(path, felt, seed)
                done.append(score_model(frozen, layers, before, own))
                update(advance=1)
    results = results_of(frozen, felt, done)
    if page:
        _write_report(results, page)
    for model in done:
        if not isfinite(model.score):
            typer.echo(f"{model.name}: no score: {_explain_no_score(results)}", err=True)
    if not told_as_json(results, json):
        _show_scores(results)


@align.command("report", epilog="tactile-rt align report scores.json --out report.html")
def write_report(
    scores: Annotated[list[Path], argument("Files of `align score --json`.")],
    out: Annotated[Path, option("Page to write, .html.")],
) -> None:
    """Write one HTML page of scores on the same benchmark."""
    import msgspec

    from tactile_rt.alignment.benchmark import benchmark_sha256
    from tactile_rt.alignment.loading import name_apart
    from tactile_rt.alignment.results import read_results

    check_output(out)
    read = [read_results(path) for path in scores]
    of = [(benchmark_sha256(one.benchmark), one.input) for one in read]
    for path, used in zip(scores, of, strict=True):
        if used != of[0]:
            raise ConfigError(
                f"{path} was scored on another benchmark or other stimuli than {scores[0]}"
            )
    found = [(model, path) for path, one in zip(scores, read, strict=True) for model in one.models]
    names = name_apart([model.name for model, _ in found], [path for _, path in found])
    models = tuple(
        msgspec.structs.replace(model, name=name)
        for (model, _), name in zip(found, names, strict=True)
    )
    _write_report(msgspec.structs.replace(read[0], models=models), out)
    typer.echo(out, err=True)


@align.command("decode", epilog="tactile-rt align decode run/best.pt --paper")
def decode_stimuli(
    models: Models,
    benchmark: Annotated[
        Path | None, option("Also decode the mean responses of its animals.")
    ] = None,
    animals: Annotated[
        Path | None, option("Also decode recorded animals: a published .npz, or NWB.")
    ] = None,
    stimuli: Stimuli = None,
    paper: Annotated[
        bool, option("Also hold out one stimulus at a time, as the paper does.", "--paper")
    ] = False,
    json: Json = None,
) -> None:
    """Decode shape and distance of the stimuli from every layer.

    Each figure stands beside its chance level by permutation.
    """
    with needing("train"):
        from tactile_rt.alignment.benchmark import load_strict
        from tactile_rt.alignment.building import animal_means
        from tactile_rt.alignment.decoding import decode, decode_paper, decode_rdm, mean_decoded
        from tactile_rt.alignment.loading import check_models, load_layers
        from tactile_rt.alignment.stimuli_input import read_stimuli
        from tactile_rt.core.stream.stimuli import STIMULI

        felt = read_stimuli(stimuli)
        frozen = load_strict(benchmark) if benchmark else None
        if frozen and frozen.stimuli != STIMULI:
            raise ConfigError(f"{benchmark}: shape and distance exist only for the six stimuli")
        targets = frozen.targets if frozen else ()
        recorded, notes = animal_means(animals) if animals else ({}, [])
        names = check_models(models)
        rows: list[tuple[str, str, Any]] = []

        def add(name: str, patterns: Any) -> None:
            rows.append((name, "", decode(patterns)))
            if paper:
                rows.append((name, "paper", decode_paper(patterns)))

        add("raw sensor input", felt.raw())
        for path, own in zip(models, names, strict=True):
            layers, _ = load_layers(path, felt)
            for layer, patterns in layers.patterns.items():
                add(f"{own}: {layer}" if len(models) > 1 else layer, patterns)
        for name, patterns in recorded.items():
            add(name, patterns)
        for variant in ("", "paper"):
            found = [d for name, v, d in rows if name in recorded and v == variant]
            if found:
                rows.append((f"animals, mean of {len(found)}", variant, mean_decoded(found)))
    for note in notes:
        typer.echo(note, err=True)
    for target in targets:
        rows.append((target.name, "", decode_rdm(target.chosen.rdm)))
    records = [{"name": n, "variant": v or "balanced", **asdict(d)} for n, v, d in rows]
    if not told_as_json(records, json):
        _show_decoded(rows)


def _write_report(results: "Results", path: Path) -> None:
    with needing("train"):
        from tactile_rt.alignment.html_page import write_page
        from tactile_rt.alignment.report import report_page

        write_page(report_page(results), path)


def _explain_no_score(results: Any) -> str:
    b = results.benchmark
    reliable = len(b.reliable)
    if b.protocol == "strict" and reliable < 2:
        return (
            f"the benchmark has {reliable} reliable animal, and a layer is chosen on the others: "
            "two are needed"
        )
    return "in no layer do its responses differ between stimuli"


def _show_scores(results: Any) -> None:
    widest = max(len(model.name) for model in results.models)
    name = Column("model", min_width=min(widest, 13), overflow="fold")
    layer = Column("layer", overflow="fold")
    table = Table(name, "score", "p", "95 % chance", "untrained", layer)
    for model in results.models:
        chosen = [name for name in model.chosen if name]
        table.add_row(
            model.name,
            f"{_format(model.score)} ± {_format(model.sem)}",
            _format(model.p, 4),
            _format(model.null_95),
            _format(model.untrained.score) if model.untrained else "",
            max(set(chosen), key=chosen.count) if chosen else "-",
        )
    raw, a2a = results.raw, results.benchmark.a2a
    if raw:
        table.add_row(
            "raw sensor input", f"{_format(raw.score)} ± {_format(raw.sem)}", _format(raw.p, 4)
        )
    table.add_row("animal to animal", f"{_format(a2a.mean)} ± {_format(a2a.sem)}")
    table.add_row("best pair of animals", _format(a2a.highest))
    print_table(table)


def _show_decoded(rows: list[tuple[str, str, Any]]) -> None:
    layer = Column("layer", overflow="fold")
    table = Table(layer, "shape", "chance", "p", "distance", "chance", "p")
    for name, variant, d in rows:
        table.add_row(
            f"{name} ({variant})" if variant else name,
            *(_format(v) for v in (d.shape, d.shape_chance)), _format(d.shape_p, 3),
            *(_format(v) for v in (d.distance, d.distance_chance)), _format(d.distance_p, 3),
        )  # fmt: skip
    print_table(table)


def _format(value: float, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if isfinite(value) else "-"
