"""The board as one page that stands alone, without scripts or a network, light or dark."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

from tactile_rt.files import write_whole
from tactile_rt.models.alignment.board import ANOTHER, Alignments, BoardCell, BoardColumn, BoardRow
from tactile_rt.models.alignment.metrics import MINIMUM_CEILING

__all__ = ["board_page", "write_board_page"]

STYLE = """
:root{color-scheme:light dark;--page:#fcfcfa;--ink:#22252a;--soft:#666b73;--rule:#dfe1e4;
--model:#3a6fb8;--untrained:#8fa3bf;--input:#8a8f98;--animal:#b98a1a}
@media(prefers-color-scheme:dark){:root{--page:#15171a;--ink:#e6e7e9;--soft:#9aa0a8;--rule:#33373d;
--model:#6f9fe0;--untrained:#55657d;--input:#6a7079;--animal:#dcb04a}}
body{background:var(--page);color:var(--ink);font:16px/1.5 system-ui,sans-serif;margin:0 auto;
max-width:64rem;padding:1.5rem}
h1{font-size:1.7rem;margin:.2rem 0}h2{font-size:1.25rem;margin:2.2rem 0 .4rem}
h3{font-size:1rem;margin:1.4rem 0 .2rem}p,dl{margin:.4rem 0;max-width:50rem}
.soft,small{color:var(--soft)}.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:.9rem;margin:.5rem 0}
th,td{padding:.35rem .7rem;border-bottom:1px solid var(--rule);text-align:right;min-width:6.2rem;
vertical-align:top}
th:first-child,td:first-child{text-align:left;min-width:9rem}th{font-weight:600}
td b{font-size:1rem}td small{display:block;white-space:nowrap}
.bar{display:block;height:5px;border-radius:2px;margin:.15rem 0 .1rem auto}
tr.model .bar{background:var(--model)}tr.untrained .bar{background:var(--untrained)}
tr.input .bar{background:var(--input)}tr.animal .bar{background:var(--animal)}
tr.untrained td:first-child{padding-left:1.8rem}tr.ceiling td{border-top:2px solid var(--rule)}
.key{display:flex;flex-wrap:wrap;gap:.3rem 1.1rem;font-size:.86rem;padding:0}
.key span{display:inline-flex;align-items:center;gap:.4rem}
.key i{width:1.1rem;height:6px;border-radius:2px;display:inline-block}
dt{font-weight:600;margin-top:.5rem}dd{margin:0}
"""
KINDS = {
    "model": "model",
    "untrained": "the same network, random weights",
    "input": "the sensors' readings",
    "animal": "another animal, its own noise included",
}


def write_board_page(board: Alignments, path: Path) -> None:
    """Write the page whole or not at all."""
    text = board_page(board).encode()
    write_whole(path, lambda file: file.write(text))


def board_page(board: Alignments) -> str:
    """The page as HTML."""
    key = "".join(
        f'<span><i style="background:var(--{kind})"></i>{escape(said)}</span>'
        for kind, said in KINDS.items()
        if any(row.kind == kind for row in board.rows)
    )
    tables = "".join(
        _table(board, dataset.name, part)
        for dataset in board.datasets
        for part in dict.fromkeys(c.part for c in board.columns if c.dataset == dataset.name)
    )
    body = (
        "<h1>Which model represents touch as cortex does?</h1>"
        "<p>Each number is how like a model and an animal are, as a share of what the noise of the "
        "recordings permits: 1 is all that a perfect model is expected to reach, 0 is what a "
        "model earns that knows nothing. Mean over animals ± its standard error; the model's layer "
        "is chosen on the other animals, never on the one that it is scored on.</p>"
        f'<p class="key">{key}</p>{tables}'
        f"<h2>What the metrics ask</h2><dl>{_metrics(board)}</dl>"
        f"<h2>Recordings</h2>{_datasets(board)}"
        f"<h2>What this cannot say</h2>{_limits()}"
        f"{_notes(board)}"
    )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Alignment board</title><style>{STYLE}</style></head><body>{body}</body></html>\n"
    )


def _table(board: Alignments, dataset: str, part: str) -> str:
    places = [k for k, c in enumerate(board.columns) if c.dataset == dataset and c.part == part]
    columns = [board.columns[k] for k in places]
    head = "".join(f"<th>{escape(c.metric)}</th>" for c in columns)
    rows = [
        f'<tr class="{row.kind}"><td>{_named(row)}</td>'
        + "".join(_value(board.cell(r, k)) for k in places)
        + "</tr>"
        for r, row in enumerate(board.rows)
    ]
    what = "all units" if part == "all" else part
    return (
        f"<h2>{escape(dataset)}, {escape(what)}</h2>"
        f'<div class="scroll"><table><tr><th></th>{head}</tr>{"".join(rows)}'
        f'<tr class="ceiling"><td class="soft">ceiling<small>animals that count</small></td>'
        f"{''.join(_ceiling(c) for c in columns)}</tr></table></div>"
    )


def _named(row: BoardRow) -> str:
    size = f"<small>{row.parameters:,} parameters</small>" if row.parameters else ""
    return f"{escape(row.name)}{size if row.kind == 'model' else ''}"


def _value(cell: BoardCell) -> str:
    if cell.score is None:
        return '<td class="soft">-</td>'
    sem = "" if cell.sem is None else f" ± {cell.sem:.2f}"
    wide = 100 * min(max(cell.score, 0.0), 1.0)
    return (
        f'<td><b>{cell.score:.2f}</b>{sem}<span class="bar" style="width:{wide:.0f}%"></span>'
        f"<small>{escape(cell.layer)}</small></td>"
    )


def _ceiling(column: BoardColumn) -> str:
    said = "-" if column.ceiling is None else f"{column.ceiling:.2f}"
    return f'<td class="soft">{said}<small>{column.usable} of {column.animals}</small></td>'


def _metrics(board: Alignments) -> str:
    return "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(said)}</dd>" for name, said in board.metrics.items()
    )


def _datasets(board: Alignments) -> str:
    out = []
    for one in board.datasets:
        licensed = f" License: {escape(one.license)}." if one.license else ""
        out.append(
            f"<h3>{escape(one.name)}: {escape(one.title)}</h3><p>{escape(one.about)}</p>"
            f'<p class="soft">{escape(one.citation)}.{licensed} Size: {escape(one.size)}. '
            f"Read here: {len(one.animals)} targets, {one.units} units.</p>"
        )
    return "".join(out)


def _limits() -> str:
    return (
        "<p>Six conditions are few: models that differ a great deal can order them alike, and a "
        "network that was never trained may, too. Read a model against its own untrained network "
        "and against the sensors' readings; where these are as high, it is not training that made "
        f"it fit. The row “{ANOTHER}” is what one recorded animal, noise and all, says of the "
        "others: a bar that is too low, for a model has no noise. An animal counts where its "
        f"ceiling is at least {MINIMUM_CEILING} (a share of variance {MINIMUM_CEILING**2}); a dash "
        "means that fewer than two do, or that the "
        "model tells nothing apart. Metrics are not on one scale: compare down a column, not "
        "along a row.</p>"
    )


def _notes(board: Alignments) -> str:
    notes: list[str] = [note for one in board.datasets for note in one.notes]
    notes += [f"{row.name}: {note}" for row in board.rows for note in row.notes]
    files: Sequence[str] = [f"{r.name} {r.sha256[:12]}" for r in board.rows if r.sha256]
    said = "".join(f"<p class='soft'>{escape(note)}</p>" for note in notes)
    return f"{said}<p class='soft'>{escape('; '.join(files))}</p>" if files else said
