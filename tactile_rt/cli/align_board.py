"""`tactile-rt align board`, `datasets`, `fetch`: models by datasets by metrics."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Column, Table

from tactile_rt.cli.align import Page, Sessions, Stimuli, align
from tactile_rt.cli.app import check_output, needing
from tactile_rt.cli.options import Json, Seed, argument, option
from tactile_rt.cli.tables import print_table, progress_bar, share_bar, told_as_json
from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.alignment.board import Alignments, BoardRow
    from tactile_rt.alignment.layers import Layers
    from tactile_rt.alignment.stimuli_input import StimuliInput


@align.command("datasets", epilog="tactile-rt align datasets")
def list_datasets(json: Json = None) -> None:
    """List the neural recordings that models can be compared with."""
    from tactile_rt.alignment.datasets import dataset_names, find_dataset

    found = [find_dataset(name) for name in dataset_names()]
    keys = ("name", "title", "about", "citation", "url", "license", "size")
    if told_as_json([{key: getattr(one, key) for key in keys} for one in found], json):
        return
    console = Console(soft_wrap=True)
    for one in found:
        console.print(f"[bold]{one.name}[/]  {one.title}", highlight=False)
        licensed = f"license {one.license}, " if one.license else ""
        for line in filter(None, (one.about, one.citation, one.url, f"{licensed}{one.size}")):
            console.print(f"    {line}", highlight=False, markup=False)


@align.command("fetch", epilog="tactile-rt align fetch 000231 recordings")
def fetch_recordings(
    name: Annotated[str, argument("Name of a dataset: see `align datasets`.")],
    folder: Annotated[Path | None, argument("Folder for small NWB files, one per session.")] = None,
    sessions: Sessions = None,
    listed: Annotated[
        bool, option("Only list sizes in bytes, SHA-256 and names.", "--list")
    ] = False,
    json: Json = None,
) -> None:
    """Download the needed part of published neural recordings."""
    from tactile_rt.alignment.datasets import find_dataset
    from tactile_rt.alignment.datasets.fetching import count_recorded, fetch, published_files
    from tactile_rt.alignment.selection import Selection

    dataset = find_dataset(name)
    if not dataset.listing:
        raise ConfigError(f"{name} cannot be fetched: download it, see `align datasets`")
    every = published_files(dataset.listing)
    selection = Selection(sessions=tuple(sessions or ()))
    files = [file for file in every if selection.takes(file.name)]
    if not files:
        raise ConfigError(f"none of {len(every)} sessions matches {selection}: --list names them")
    if listed:
        if not told_as_json(files, json):
            for file in files:
                typer.echo(f"{file.size:11} {file.sha256} {file.path}")
        return
    if folder is None:
        raise ConfigError("name a folder to write to, or give --list")
    with needing("align"):
        with share_bar("fetching") as tell:
            new, transferred = fetch(files, folder, tell)
        mice, units, notes = count_recorded([folder / file.name for file in files])
    for note in notes:
        typer.echo(note, err=True)
    size = sum(file.size for file in files)
    typer.echo(
        f"{folder}: {len(files)} sessions ({new} new), {mice} mice, {units} units with valid "
        f"trials; {transferred / 1e6:.0f} MB of {size / 1e9:.0f} GB were read",
        err=True,
    )
    told_as_json({"mice": mice, "units": units, "transferred": transferred, "files": files}, json)
    if len(files) == len(every) and dataset.counts not in (None, (mice, units)):
        other = "WARNING: the published analysis is of {} mice and {} units".format(*dataset.counts)
        typer.secho(other, err=True, fg="red", bold=True)


@align.command("board", epilog="tactile-rt align board run/best.pt --data 000231=recordings")
def write_board(
    models: Annotated[
        list[Path] | None, argument("Checkpoints (best.pt), .onnx files, and responses (.npz).")
    ] = None,
    data: Annotated[
        list[str] | None, option("Recordings, DATASET=PATH, e.g. 000231=FOLDER; may be repeated.")
    ] = None,
    metric: Annotated[list[str] | None, option("Metric; may be repeated. Default: all.")] = None,
    part: Annotated[
        list[str] | None,
        option("Units: all, L1, L2/3, L4, L5, L6, excitatory or inhibitory; may be repeated."),
    ] = None,
    json: Json = None,
    page: Page = None,
    stimuli: Stimuli = None,
    seed: Seed = 0,
) -> None:
    """Compare models with recordings by every metric.

    Figures are shares of what the noise of the recordings permits.
    """
    check_output(page)
    if not data:
        raise ConfigError("name recordings: --data DATASET=PATH, see `tactile-rt align datasets`")
    parts, models = list(dict.fromkeys(part or ["all"])), models or []
    with needing("train"):
        from tactile_rt.alignment.board import compute_board, join_boards
        from tactile_rt.alignment.datasets import find_dataset
        from tactile_rt.alignment.loading import check_models, name_apart
        from tactile_rt.alignment.metrics import find_metric, metric_names
        from tactile_rt.alignment.selection import part_of
        from tactile_rt.alignment.stimuli_input import read_stimuli

        metrics = list(dict.fromkeys(metric or metric_names()))
        for name in metrics:
            find_metric(name)
        for name in parts:
            part_of((), name)
        sources = [_parse_data(text) for text in data]
        distinct = name_apart([name for name, _ in sources], [path for _, path in sources])
        datasets = [
            (replace(find_dataset(name), name=own), path)
            for (name, path), own in zip(sources, distinct, strict=True)
        ]
        felt = read_stimuli(stimuli)
        files = list(zip(models, check_models(models), strict=True))
        boards: list[Alignments] = []
        first: tuple[str, ...] = ()
        for dataset, path in datasets:
            with share_bar(f"reading {dataset.name}") as tell:
                read = dataset.read([path], felt, tell)
            with progress_bar(f"models on {dataset.name}", max(len(files), 1)) as update:
                names = read.animals[0].sessions[0].stimuli
                if names != (first := first or names):
                    raise ConfigError(
                        f"{path} has other stimuli than {sources[0][1]}: make a board for each"
                    )
                rows = _make_rows(files, read.stimuli or felt, seed, update, names)
            with share_bar(f"scoring on {dataset.name}") as tell:
                made = compute_board(rows, dataset, read.animals, parts, metrics, read.notes, tell)
            boards.append(made)
        made = join_boards(boards)
    if page:
        from tactile_rt.alignment.board_page import board_page
        from tactile_rt.alignment.html_page import write_page

        write_page(board_page(made), page)
    if not told_as_json(made, json):
        _show(made)


def _make_rows(
    files: list[tuple[Path, str]],
    felt: "StimuliInput",
    seed: int,
    update: Any,
    stimuli: tuple[str, ...],
) -> list[tuple["BoardRow", Any]]:
    from tactile_rt.alignment.board import BoardRow, traces_of, traces_of_stimuli
    from tactile_rt.alignment.loading import load_layers, load_untrained
    from tactile_rt.core.stream.stimuli import STIMULI

    rows: list[tuple[BoardRow, Any]] = []
    for path, name in files:
        update(description=name)
        layers: Layers = load_layers(path, felt, names=stimuli)[0]
        before = load_untrained(path, felt, seed)
        # The same network: an exported file stores some parameters elsewhere than a checkpoint.
        size = before.parameters if before else layers.parameters
        row = BoardRow(name, "model", layers.sha256, size, layers.notes)
        rows.append((row, traces_of(layers)))
        if before is not None:
            rows.append((BoardRow(before.name, "untrained", "", size), traces_of(before)))
        update(advance=1)
    if stimuli == STIMULI:
        rows.append((BoardRow("raw sensor input", "input"), traces_of_stimuli(felt)))
    return rows


def _parse_data(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not equals or not name or not path:
        raise ConfigError(f"--data must be DATASET=PATH, not {text!r}")
    return name, Path(path)


def _show(board: "Alignments") -> None:
    from tactile_rt.alignment.html_page import format_number

    places = dict.fromkeys((c.dataset, c.part) for c in board.columns)
    for dataset, part in places:
        columns = [k for k, c in enumerate(board.columns) if (c.dataset, c.part) == (dataset, part)]
        heads = [board.columns[k].metric for k in columns]
        table = Table(Column("", overflow="fold"), *heads, title=f"{dataset}, {part}: shares of "
                      "what noise permits")  # fmt: skip
        for row, cells in zip(board.rows, board.cells, strict=True):
            name = f"  {row.name}" if row.kind == "untrained" else row.name
            table.add_row(name, *(format_number(cells[k].score) for k in columns))
        table.add_section()
        table.add_row("ceiling", *(format_number(board.columns[k].ceiling) for k in columns))
        table.add_row(
            "animals", *(f"{board.columns[k].usable}/{board.columns[k].animals}" for k in columns)
        )
        print_table(table)
