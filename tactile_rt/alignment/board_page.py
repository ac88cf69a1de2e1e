"""Formatting of an alignment board as one HTML page."""

from html import escape

from tactile_rt.alignment.board import ANOTHER, Alignments, BoardCell, BoardDataset, BoardRow
from tactile_rt.alignment.html_page import format_number, join_notes, make_page, make_table
from tactile_rt.alignment.metrics import MINIMUM_CEILING

STYLE = """
td small{display:block;white-space:nowrap}
.bar{display:block;height:5px;border-radius:2px;margin:.2rem 0 .1rem;background:var(--rule)}
.bar i{display:block;height:5px;border-radius:2px}
.key i{width:1.1rem;height:6px;border-radius:2px;display:inline-block;margin:0 .4rem 0 1rem}
"""
KINDS = {
    "model": "model",
    "untrained": "the same network, random weights",
    "input": "the sensors' readings",
    "animal": "another animal, its own noise included",
}


def board_page(board: Alignments) -> str:
    """Format a board as an HTML page; return its text."""
    key = "".join(
        f'<i style="background:var(--{kind})"></i>{escape(what)}'
        for kind, what in KINDS.items()
        if any(row.kind == kind for row in board.rows)
    )
    tables = "".join(
        _show_part(board, dataset, part)
        for dataset, part in dict.fromkeys((c.dataset, c.part) for c in board.columns)
    )
    metrics = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(what)}</dd>" for name, what in board.metrics.items()
    )
    notes = [note for one in board.datasets for note in one.notes]
    notes += [f"{row.name}: {note}" for row in board.rows for note in row.notes]
    notes.append("; ".join(f"{row.name} {row.sha256[:12]}" for row in board.rows if row.sha256))
    return make_page(
        "Alignment board",
        "<h1>Which model represents touch as cortex does?</h1>"
        "<p>Each number is how like a model and an animal are, as a share of what the noise of the "
        "recordings permits: 1 is all that a perfect model is expected to reach, 0 is what a "
        "model earns that knows nothing. Mean over animals ± its standard error; the model's layer "
        "is chosen on the other animals, never on the one that it is scored on.</p>"
        f'<p class="key">{key}</p>{tables}<h2>What the metrics ask</h2><dl>{metrics}</dl>'
        f"<h2>Recordings</h2>{''.join(map(_show_dataset, board.datasets))}"
        f"<h2>What this cannot say</h2>{LIMITS}{join_notes(filter(None, notes))}",
        STYLE,
    )


def _show_part(board: Alignments, dataset: str, part: str) -> str:
    places = [k for k, c in enumerate(board.columns) if (c.dataset, c.part) == (dataset, part)]
    columns = [board.columns[k] for k in places]
    rows = [
        [_show_name(row), *(_show_cell(cells[k], row.kind) for k in places)]
        for row, cells in zip(board.rows, board.cells, strict=True)
    ]
    ceiling = ["ceiling<small>animals that count</small>"]
    ceiling += [
        f"{format_number(c.ceiling)}<small>{c.usable} of {c.animals}</small>" for c in columns
    ]
    table = make_table(["", *(escape(c.metric) for c in columns)], [*rows, ceiling])
    return f"<h2>{escape(dataset)}, {escape('all units' if part == 'all' else part)}</h2>{table}"


def _show_name(row: BoardRow) -> str:
    name = escape(row.name)
    if row.kind == "model" and row.parameters:
        return f"{name}<small>{row.parameters:,} parameters</small>"
    return f"&emsp;{name}" if row.kind == "untrained" else name


def _show_cell(cell: BoardCell, kind: str) -> str:
    score = format_number(cell.score)
    if score == "-":
        return score
    sem = "" if cell.sem != cell.sem else f" ± {cell.sem:.2f}"
    wide = 100 * min(max(cell.score, 0.0), 1.0)
    return (
        f'<b>{score}</b>{sem}<span class="bar"><i style="width:{wide:.0f}%;'
        f'background:var(--{kind})"></i></span><small>{escape(cell.layer)}</small>'
    )


def _show_dataset(one: BoardDataset) -> str:
    licensed = f" License: {escape(one.license)}." if one.license else ""
    return (
        f"<h3>{escape(one.name)}: {escape(one.title)}</h3><p>{escape(one.about)}</p>"
        f'<p class="soft">{escape(one.citation)}.{licensed} Size: {escape(one.size)}. '
        f"Read here: {len(one.animals)} targets, {one.units} units.</p>"
    )


LIMITS = (
    "<p>Six conditions are few: models that differ a great deal can order them alike, and a "
    "network that was never trained may, too. Read a model against its own untrained network "
    "and against the sensors' readings; where these are as high, it is not training that made "
    f"it fit. The row “{ANOTHER}” is what one recorded animal, noise and all, says of the "
    "others: a bar that is too low, for a model has no noise. An animal counts where its "
    f"ceiling is at least {MINIMUM_CEILING} (a share of variance {MINIMUM_CEILING**2}); a dash "
    "means that fewer than two do, or that the model distinguishes nothing. Metrics are not on one "
    "scale: compare down a column, not along a row.</p>"
)
