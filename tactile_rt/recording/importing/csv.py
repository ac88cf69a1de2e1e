"""Tables of numbers in text, whoever wrote them: delimiter, decimal comma, header found by looking.

What is looked at is the beginning. Most of its lines are rows, so the delimiter is that which cuts
most lines into one number of cells, most of them numbers. Names stand in the last line above the
rows that has as many cells, a remark (``# time fx fy``) as well as not; what is above that is told
and passed over. Cells between spaces may stand in brackets and have units, as boards print them.
"""

import csv
import re
from codecs import getincrementaldecoder
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from io import TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import Any, Final

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.drivers.codecs.ascii_text import fields, in_seconds, number
from tactile_rt.drivers.logs import open_log_file
from tactile_rt.recording.importing.table import Table

__all__ = ["CsvForm", "csv_form", "read_table"]

LOOKED_AT: Final = 200  # lines
ENOUGH: Final = 0.5  # of the lines that are looked at are rows
DELIMITERS: Final = (";", "\t", ",", "|", " ")
NAMES: Final = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";"}
REMARKS: Final = ("#", "%", "//")
LONGEST: Final = 1 << 20  # characters of a line
_COMMA: Final = re.compile(r"\s*[+-]?\d+,\d+(?:[eE][+-]?\d+)?\s*")
_UNIT: Final = re.compile(
    r"[\[(].*[\])]||-|s|sec|ms|us|\u00b5s|ns|Hz|\u00b0C?|[munk\u00b5]?(?:N|g|V|A|T|m|rad|Pa|Ohm|F)"
    r"|[mu]?N[ .*\u00b7-]?m{1,2}|deg|degC|kgf?|%|bar|counts?"
)
_POINT: Final = re.compile(r"\s*[+-]?\d*\.\d+(?:[eE][+-]?\d+)?\s*")
_NUMBER_COMMA: Final = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")


@dataclass(frozen=True)
class CsvForm:
    """How a table is written.

    Attributes:
        delimiter: What stands between cells; a space stands for any of spaces and tabs.
    """

    delimiter: str
    comma: bool
    names: tuple[str, ...]
    first: int
    width: int
    lines: int = 1
    units: tuple[str, ...] = ()


def csv_form(
    path: Path, delimiter: str = "", decimal: str = "", skip: int = 0, lines: int = 1
) -> CsvForm:
    """How a table is written, as its beginning shows.

    Args:
        path: the file; gzip is unpacked.
        delimiter: what stands between cells, if it is told: a character, tab or space.

    Raises:
        RecordingError: its lines are no table of numbers.
    """
    with open_log_file(path) as file, _text(file) as text:
        head = list(islice(_joined(text, skip, lines), LOOKED_AT))
    told = NAMES.get(delimiter, delimiter)
    if len(told) > 1:
        raise ConfigError(f"--delimiter is one character, tab or space, not {delimiter!r}")
    best: tuple[float, CsvForm] | None = None
    for one in (told,) if told else DELIMITERS:
        for comma in (decimal == ",",) if decimal else (False, True):
            if comma and one == ",":
                cells = [c for x in head for c in _cells(x, one, False)]
                if not any(map(_COMMA.fullmatch, cells)):
                    continue
                if not decimal and any(map(_POINT.fullmatch, cells)):
                    continue  # 0.5,"1,000": a thousand
            between = 2 * sum(map(_between_digits, head)) > len(head)
            if not comma and not decimal and one == " " and between:
                continue  # 5,01 -7 0,25
            found = _tried(head, one, comma)
            if found is not None and (best is None or found[0] > best[0] + 1e-9):
                best = found
    if best is None:
        raise RecordingError(
            f"{path} is no table of numbers: no delimiter cuts most of its lines into as many "
            "numbers (--delimiter, --skip and --lines tell how it is written)"
        )
    form = best[1]
    return replace(form, first=skip + form.first * lines, lines=lines)


def read_table(path: Path, form: CsvForm) -> Table:
    """The rows of a table."""
    table = Table(path, form.names, ())
    table.rows = _rows(table, form)
    return table


def _rows(table: Table, form: CsvForm) -> Iterator[Sequence[Any]]:
    with open_log_file(table.path) as file, _text(file) as text:
        for line in _joined(text, form.first, form.lines):
            if line.startswith(REMARKS) or not line.strip(" \t,;"):
                continue
            cells = _cells(line, form.delimiter, form.comma)
            if len(cells) == form.width - 1 and line.rstrip(" ").endswith(form.delimiter):
                cells.append("")
            if form.names and all(number(c.strip()) is None for c in cells):
                continue  # units below the names, or names once more
            yield cells
        if getattr(getattr(file, "raw", None), "broken", False):
            table.notes.append("it is cut short or damaged: what unpacks of it was read")


def _text(file: Any) -> TextIOWrapper:
    begins = file.peek(2)
    encoding = "utf-16" if begins[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        getincrementaldecoder(encoding)().decode(begins)
    except UnicodeDecodeError:
        encoding = "cp1252"  # of Windows in Europe
    return TextIOWrapper(file, encoding, "replace", newline="")


def _joined(text: TextIOWrapper, skip: int, lines: int) -> Iterator[str]:
    """The rows' texts, ``lines`` of the file each, after those that are skipped."""
    begun: list[str] = []
    # a line ends as anybody ends lines; one that does not end is cut
    for line in islice(iter(lambda: text.readline(LONGEST), ""), skip, None):
        for part in line.rstrip("\r\n").split("\r"):
            begun.append(part)
            if len(begun) == lines:
                yield " ".join(begun) if lines > 1 else part
                begun = []


def _cells(line: str, delimiter: str, comma: bool) -> list[str]:
    if delimiter == " ":
        cells = fields(re.sub(r"(?<=\d),(?=\d)", ".", line) if comma else line)
    elif '"' in line:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    else:
        cells = line.split(delimiter)
    if len(cells) > 1 and line.rstrip(" ").endswith(delimiter):
        del cells[-1]  # a delimiter at the end of each line
    return [c.replace(",", ".") if _NUMBER_COMMA.fullmatch(c.strip()) else c for c in cells] \
        if comma else cells  # fmt: skip


def _is_there(cell: str) -> bool:
    """Whether this may stand where numbers do."""
    return not cell.strip() or number(cell.strip()) is not None or _is_number(cell)


def _is_number(cell: str) -> bool:
    plain = cell.strip()
    found = number(plain)
    return (found is not None and found == found) or (":" in plain and in_seconds(plain) != plain)


def _between_digits(line: str) -> bool:
    """Whether a line has commas, all of them in numbers, and spaces between these."""
    words = line.split()
    cut = [w for w in words if "," in w]
    return len(words) > 1 and bool(cut) and all(map(_COMMA.fullmatch, cut))


def _tried(head: list[str], delimiter: str, comma: bool) -> tuple[float, CsvForm] | None:
    """How well this fits, and the form that it gives."""
    rows = [
        (k, _cells(x, delimiter, comma))
        for k, x in enumerate(head)
        if x.strip(" \t,;") and not x.startswith(REMARKS)
    ]
    numeric = [(k, c) for k, c in rows if 2 * sum(map(_is_there, c)) >= len(c) > 0]
    widths = Counter(len(c) for _, c in numeric)
    if not widths:
        return None
    width, often = max(widths.items(), key=lambda w: (w[1], w[0]))
    named = any(len(c) == width + 1 for k, c in rows if k < numeric[0][0])
    if (widths[width + 1] or named) and all(
        head[k].rstrip(" ").endswith(delimiter) for k, c in numeric if len(c) == width
    ):
        width, often = width + 1, often + widths[width + 1]  # its last column is seldom there
        numeric = [(k, [*c, ""] if len(c) == width - 1 else c) for k, c in numeric]
    whole = [c for _, c in numeric if len(c) == width]
    usual = [j for j in range(width) if 2 * sum(_is_number(c[j]) for c in whole) > len(whole)]
    first = next(
        (k for k, c in numeric if len(c) == width and all(_is_there(c[j]) for j in usual)),
        numeric[0][0],
    )
    lines = sum(k >= first for k, _ in rows)
    if often < ENOUGH * lines:
        return None
    share = sum(sum(map(_is_there, c)) / width for _, c in numeric if len(c) == width) / often
    names, units, below_names = _names(head[:first], delimiter, width)
    if names:  # the first rows may lack what is usual
        below = (k for k, c in numeric if k >= below_names and any(map(_is_number, c)))
        first = next(below, first)
    # one cell a line is a table, too, but only if nothing else is
    score = often / lines * share + (0.5 if width > 1 else 0.0) + (0.2 if names else 0.0)
    if delimiter == " ":  # which cuts what all others cut, too
        score -= 0.3 if 2 * sum(len(x.split()) > 1 for x in head) > len(head) else 0.6
    return score, CsvForm(delimiter, comma, names, first, width, units=units)


def _names(
    above: list[str], delimiter: str, width: int
) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """The names of the columns, and the units below them; empty: there are none. The line after
    these."""
    units: tuple[str, ...] = ()
    end = 0
    for k, line in reversed(list(enumerate(above, start=1))):
        text = line
        for mark in ("#", "//"):
            text = text.removeprefix(mark)
        if delimiter == " ":
            cells = re.findall(r'"[^"]*"|[^\s,;]+', text)
        else:
            cells = _cells(text, delimiter, False)
        cells = [c.strip().strip('"').strip() for c in cells]
        if line.startswith("%") and len(cells) != width:
            cells = cells[1:] if cells[:1] == ["%"] else cells
        if len(cells) == width - 1 and delimiter != " " and text.rstrip().endswith(delimiter):
            cells.append("")
        words = [c for c in cells if c and not _is_number(c)]
        numbers = sum(map(_is_number, cells))
        if len(cells) != width or 2 * len(words) < width or 2 * numbers >= width:
            continue
        if all(_UNIT.fullmatch(c) for c in cells):
            units = units or tuple(c.strip("[]() ") for c in cells)
            end = end or k
        else:
            return tuple(_distinct(cells)), units, end or k
    return (), (), 0


def _distinct(names: list[str]) -> list[str]:
    """Names as they are; one that is not there, or was there before, is called by its place."""
    seen: set[str] = set()
    told = []
    for k, name in enumerate(names, start=1):
        told.append(name if name and name not in seen else f"{name or 'column'}.{k}")
        seen.add(told[-1])
    return told
