"""Self-contained HTML pages without scripts or network access, in light or dark colours."""

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from tactile_rt.core.files import write_whole

STYLE = """
:root{color-scheme:light dark;--page:#fcfcfa;--ink:#22252a;--soft:#666b73;--rule:#dfe1e4;
--model:#3a6fb8;--untrained:#8fa3bf;--input:#8a8f98;--animal:#b98a1a;--good:#2f8a58;--bad:#c4523a}
@media(prefers-color-scheme:dark){:root{--page:#15171a;--ink:#e6e7e9;--soft:#9aa0a8;--rule:#33373d;
--model:#6f9fe0;--untrained:#55657d;--input:#6a7079;--animal:#dcb04a;--good:#58b881;--bad:#e07a62}
svg{filter:invert(.9) hue-rotate(180deg)}}
body{background:var(--page);color:var(--ink);font:16px/1.5 system-ui,sans-serif;margin:0 auto;
max-width:64rem;padding:1.5rem}
h1{font-size:1.7rem;margin:.2rem 0}h2{font-size:1.25rem;margin:2.2rem 0 .4rem}
h3{font-size:1rem;margin:1.4rem 0 .2rem}p,dl,dd{margin:.4rem 0;max-width:50rem}
.soft,small{color:var(--soft)}.scroll{overflow-x:auto}
.good{color:var(--good);font-weight:600}.bad{color:var(--bad);font-weight:600}
table{border-collapse:collapse;font-size:.9rem;margin:.5rem 0}
th,td{padding:.3rem .7rem;border-bottom:1px solid var(--rule);text-align:right;vertical-align:top}
th:first-child,td:first-child{text-align:left}th,dt{font-weight:600}
svg{max-width:100%;height:auto;display:block}summary{cursor:pointer}
"""


def make_page(title: str, body: str, style: str = "") -> str:
    """Return an HTML page with a given body; `style` is CSS in addition to `STYLE`."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{STYLE}{style}</style></head>"
        f"<body>{body}</body></html>\n"
    )


def make_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Make an HTML table; titles and cells must already be HTML."""
    lines = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    titles = "".join(f"<th>{title}</th>" for title in head)
    return f'<div class="scroll"><table><tr>{titles}</tr>{lines}</table></div>'


def join_notes(notes: Iterable[str]) -> str:
    """Format each note as an HTML paragraph."""
    return "".join(f'<p class="soft">{escape(note)}</p>' for note in notes)


def format_number(value: float, digits: int = 2) -> str:
    """Format a number with the given decimal places; a dash if it is not finite."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "-"


def write_page(text: str, path: Path) -> None:
    """Write the text of a page to a file, atomically."""
    write_whole(path, lambda file: file.write(text.encode()))
