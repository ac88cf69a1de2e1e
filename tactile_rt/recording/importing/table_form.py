"""Detection of the form of any table of numbers in text: delimiter, decimal mark, header.

The beginning of the file is examined. Most of its lines are rows, so the delimiter is the character
that cuts most lines into the same number of cells, most of them numbers. The names are in the last
line above the rows with as many cells, which may be a remark (``# time fx fy``); lines above it are
skipped, also where they are repeated later. All lines other than remarks and blank lines are rows
of as many cells as the table. Cells that many rows lack at their end are empty; a list counts as
one cell per item. Cells between spaces may be in brackets and have units, as boards print them.
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

LOOKED_AT: Final = 200  # lines that are examined
ENOUGH: Final = 0.5  # least share of rows among the examined lines
OFTEN: Final = 0.2  # least share of rows of a width that is regular, not that of a cut row
DELIMITERS: Final = (";", "\t", ",", "|", " ")
NAMES: Final = {"tab": "\t", "space": " ", "comma": ",", "semicolon": ";"}
_REMARK: Final = re.compile(r"%|//|#(?!N/?A\b|[A-Z/0]+[!?])")  # but no spreadsheet error: #N/A
LONGEST: Final = 1 << 20  # characters of a line
_COMMA: Final = re.compile(r"\s*[+-]?\d*,\d+(?:[eE][+-]?\d+)?\s*")
_UNIT: Final = re.compile(
    r"[\[(].*[\])]||-|s|sec|min|ms|us|\u00b5s|ns|Hz|\u00b0C?|deg|degC|kgf?|lbf|psi|%|m?bar|counts?"
    r"|(?:[munkhcM\u00b5]|da)?(?:N|g|V|A|T|m|rad|Pa|Ohm|F)|[muk]?N[ .*\u00b7-]?[mc]?m"
)
_SENSOR: Final = re.compile(
    r"(?:sensor|channel|taxel|signal|variable|element|quantity|parameter)s?"
    r"(?:[ _.-]?(?:id|name|no|nr|num|number|index|idx))?|name|key|id|device|node|board|finger",
    re.IGNORECASE,
)
MOST_SENSORS: Final = 64  # sensors with numbers as names; a counter repeats later
_NAMES_LINE: Final = re.compile(
    r"[ \t\"]*[^\W\d][^:=\"]{0,40}(?:([,;\t|])[ \t\"]*[^\W\d][^:=\"]{0,40})+"
)
_GLUED: Final = re.compile(r"[+-]?\d+(?:[.,]\d+)?([a-zA-Z\u00b5]{1,3})")
LONG_ROW: Final = 16  # cells
IN_TURN: Final = 0.9  # least share of rows whose sensor repeats in a fixed order
THOUSAND: Final = " (a thousand?)"
_THOUSANDS: Final = re.compile(r"\s*[+-]?[1-9]\d{0,2}(?:\.\d{3})+\s*")
_US_THOUSANDS: Final = re.compile(r"\s*[+-]?[1-9]\d{0,2}(?:,\d{3})+\.\d+\s*")
_GERMAN_THOUSANDS: Final = re.compile(r"\s*[+-]?[1-9]\d{0,2}(?:\.\d{3})+,\d+\s*")
_POINT: Final = re.compile(r"\s*[+-]?\d*\.\d+(?:[eE][+-]?\d+)?\s*")
_DAY: Final = re.compile(r"\d{4}([-/.])\d\d?\1\d\d?|\d\d?([-/.])\d\d?\2\d{4}")
_LIST: Final = re.compile(  # two numbers or more in brackets, which may be nested once
    r"[\[(](?=[\s\[(]*(?:[-+.]*\d|nan\b))(?=[^\])]*[\s,;])"
    r"(?:[-+.\deEnNaAiIfF\s,;]|[\[(][-+.\deEnNaAiIfF\s,;]*[\])])*[\])]"
)


@dataclass(frozen=True)
class CsvForm:
    """Form of a table in text."""

    delimiter: str  # separator of cells; a space stands for any spaces and tabs
    comma: bool
    names: tuple[str, ...]
    first: int
    width: int
    lines: int = 1
    units: tuple[str, ...] = ()
    # numbers of cells that a row may have; it is filled up to `width` with empty cells
    widths: frozenset[int] = frozenset()
    heads: frozenset[str] = frozenset()  # lines above the first row
    note: str = ""  # oddity of the header


def csv_form(
    path: Path, delimiter: str = "", decimal: str = "", skip: int = 0, lines: int = 1
) -> CsvForm:
    """Detect the form of a table by its beginning.

    Args:
        path: the file; gzip is unpacked.
        delimiter: separator of cells: a character, tab or space; empty to detect it.

    Raises:
        RecordingError: the lines are no table of numbers.
        ConfigError: the rows are not samples.
    """
    with open_log_file(path) as file, _decode_text(file) as text:
        head = list(islice(_join_lines(text, skip, lines), LOOKED_AT))
    _check_cells(path, head)
    given = NAMES.get(delimiter, delimiter)
    if len(given) > 1:
        raise ConfigError(f"--delimiter must be one character, tab or space, not {delimiter!r}")
    fits: list[tuple[float, CsvForm]] = []
    for one in (given,) if given else DELIMITERS:
        for comma in (decimal == ",",) if decimal else (False, True):
            if comma and one == ",":
                cells = [c for x in head for c in _split_cells(x, one, False)]
                if not any(map(_COMMA.fullmatch, cells)):
                    continue
                if not decimal and any(map(_POINT.fullmatch, cells)):
                    continue  # 0.5,"1,000": the comma groups thousands
            between = 2 * sum(map(_has_decimal_commas, head)) > len(head)
            if not comma and not decimal and one == " " and between:
                continue  # 5,01 -7 0,25: the commas are decimal marks
            fits += _fit_form(head, one, comma)
    if not fits:
        raise RecordingError(
            f"{path} is no table of numbers: no delimiter cuts most of its lines into as many "
            "numbers (--delimiter, --skip and --lines say how it is written)"
        )
    _, form = max(fits, key=lambda fit: round(fit[0], 9))
    _check_layout(path, head, form)
    form = _compare_header(path, head[: form.first], form)
    return replace(form, first=skip + form.first * lines, lines=lines)


def _check_cells(path: Path, head: list[str]) -> None:
    """Raise ConfigError if most cells are numbers with units: 0.10N,10.00mN."""
    cells = [c.strip(' "') for x in head for c in re.split("[,;\t ]+", x.strip())]
    glued = [c for c in cells if (found := _GLUED.fullmatch(c)) and _UNIT.fullmatch(found[1])]
    if 2 * len(glued) > len(cells):
        raise ConfigError(
            f"{path}: its cells hold units ({glued[-1]}): write these behind the columns' names"
        )


def _compare_header(path: Path, above: list[str], form: CsvForm) -> CsvForm:
    """Split a header by its own delimiter; return the form with names or a note.

    Raises:
        ConfigError: the decimal mark may be the delimiter, too.
    """
    line = above[-1].strip() if above else ""
    if form.names or form.delimiter == " " or not (found := _NAMES_LINE.fullmatch(line)):
        return form
    names = [name.strip(' "') for name in line.split(found[1])]
    if len(names) == form.width:
        return replace(form, names=tuple(_make_distinct(names)))
    odd = f"its header, {line!r:.40}, names {len(names)} columns, its rows have {form.width} cells"
    if form.delimiter == "," and len(names) < form.width <= 2 * len(names):
        raise ConfigError(f"{path}: {odd}: if , is a decimal mark, too, put ; between the cells")
    return replace(form, note=f"{odd}: the columns have no names")


def _check_layout(path: Path, head: list[str], form: CsvForm) -> None:
    """Raise ConfigError if each row is a channel, or belongs to one of several sensors."""
    cells = (_split_cells(x, form.delimiter, form.comma) for x in head[form.first :])
    rows = [[c.strip(' "') for c in row] for row in cells if len(row) == form.width]
    names = list(dict.fromkeys(row[0] for row in rows if row[0][:1].isalpha()))
    wide = form.width > max(LONG_ROW, 2 * len(rows)) and len(head) < LOOKED_AT
    across = bool(_SENSOR.fullmatch(form.names[0])) if form.names else wide
    if across and len(names) == len(rows) > 1 and not any(map(_is_cell, names)):
        listed = ", ".join(names)
        raise ConfigError(
            f"{path}: each row is a channel ({listed:.40} ...), not a sample: transpose it"
        )
    for k, column in enumerate(form.names):
        of = [row[k] for row in rows]
        n = len(kinds := dict.fromkeys(of))
        if not _SENSOR.fullmatch(column) or not 1 < n <= min(len(of) / 2, MOST_SENSORS):
            continue
        turns = sum(a == b for a, b in zip(of, of[n:], strict=False)) >= IN_TURN * (len(of) - n)
        words = not any(map(_is_cell, kinds)) and 2 * sum(map(str.__ne__, of, of[1:])) > len(of)
        if words or (turns and all(map(str.isdecimal, kinds))):
            why = f"column {column!r:.40} says of which sensor a row is ({', '.join(kinds):.40})"
            raise ConfigError(f"{path}: {why}: pivot it, one row per time, a column for each")


def read_table(path: Path, form: CsvForm) -> Table:
    """Return a table whose rows are read from the file as they are iterated over."""
    table = Table(path, form.names, (), width=form.width)
    table.notes += [form.note] if form.note else []
    table.rows = _read_rows(table, form)
    return table


def _read_rows(table: Table, form: CsvForm) -> Iterator[Sequence[Any]]:
    order: list[int] = []  # of the columns, after a later header with another order
    longest, ending = (0, 0), (0, 0)  # `_measure_end` of all lines but the last; of the last
    cut: list[str] = []
    with open_log_file(table.path) as file, _decode_text(file) as text:
        for k, line in enumerate(_join_lines(text, form.first, form.lines, cut), start=1):
            if _REMARK.match(line) or not line.strip(" \t,;") or line.strip() in form.heads:
                continue
            table.line = form.first + k * form.lines
            cells = _split_cells(line, form.delimiter, form.comma)
            longest, ending = max(longest, ending), _measure_end(cells, form.width)
            words = [c.strip(' "') for c in cells]
            if len(words) == len(form.names) and set(words) == set(form.names):
                order = [words.index(name) for name in form.names]
                if order != sorted(order):
                    table.notes.append(f"columns stand in another order from line {table.line} on")
                continue
            lack = form.width - len(cells)
            ended = lack == 1 and line.rstrip(" ").endswith(form.delimiter)
            if lack and (ended or len(cells) in form.widths):
                cells = [*cells, *[""] * lack][: form.width]
            yield [cells[k] for k in order] if len(order) == len(cells) else cells
        if cut and ending < longest:
            table.notes.append(f"its last line, {cut[0]!r:.40}, has no end: it may be cut")
        if getattr(getattr(file, "raw", None), "broken", False):
            table.notes.append("it is cut short or damaged: what unpacks of it was read")


def _measure_end(cells: Sequence[str], width: int) -> tuple[int, int]:
    """Return (digits after the last cell's decimal point, its digits if it has none)."""
    whole, point, rest = cells[-1].strip().partition(".") if len(cells) == width else ("", "", "")
    return len(rest), 0 if point else len(whole)


def _decode_text(file: Any) -> TextIOWrapper:
    begins = file.peek(2)
    encoding = "utf-16" if begins[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        getincrementaldecoder(encoding)().decode(begins)
    except UnicodeDecodeError:
        encoding = "cp1252"  # of Windows in western Europe
    return TextIOWrapper(file, encoding, "replace", newline="")


def _join_lines(
    text: TextIOWrapper, skip: int, lines: int, cut: list[str] | None = None
) -> Iterator[str]:
    """Yield the text of each row, joined from ``lines`` lines, after the skipped ones.

    Args:
        cut: list to which the last line is appended if it has no line ending.
    """
    begun: list[str] = []
    # all kinds of line endings count; a line without one may be cut
    for line in islice(iter(lambda: text.readline(LONGEST), ""), skip, None):
        if cut is not None and line[-1] not in "\r\n" and len(line) < LONGEST:
            cut.append(line)
        line = re.sub(r"\u2212(?=[.,]?\d)", "-", line)  # the typographic minus
        line = re.sub(r"(?<=\d)['\u2019](?=\d{3}(?!\d))", "", line)  # Swiss grouping of thousands
        for part in line.rstrip("\r\n").split("\r"):
            begun.append(part)
            if len(begun) == lines:
                yield " ".join(begun) if lines > 1 else part
                begun = []


def _split_cells(line: str, delimiter: str, comma: bool) -> list[str]:
    lists = delimiter != " " and ("[" in line or "(" in line)
    if lists:
        line = _LIST.sub(lambda found: re.sub(r"[\s,;]+", " ", found[0]), line)
    if delimiter == " ":
        cells = fields(re.sub(r"(?<=\d),(?=\d)", ".", line) if comma else line)
    elif '"' in line:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True), [])
    else:
        cells = line.split(delimiter)
    if lists:
        cells = [x for c in cells for x in (_split_list(c) if _LIST.search(c) else (c,))]
    if len(cells) > 1 and line.rstrip(" ").endswith(delimiter):
        del cells[-1]  # a delimiter at the end of each line
    mark, grouped = (".", _GERMAN_THOUSANDS) if comma else (",", _US_THOUSANDS)
    if mark in line and (mark != delimiter or '"' in line):
        cells = [c.replace(mark, "") if grouped.fullmatch(c) else c for c in cells]
    if comma:  # 1.000 may be a thousand, or the decimal mark may be the point after all
        cells = [c + THOUSAND if _THOUSANDS.fullmatch(c) else c for c in cells]
    return [c.replace(",", ".") if comma and _COMMA.fullmatch(c) else c for c in cells]


def _split_list(cell: str) -> list[str]:
    """Split a cell that lists numbers into items; return any other cell as one."""
    plain = cell.strip().strip('"')
    return re.sub(r"[\[\](),;]", " ", plain).split() if _LIST.fullmatch(plain) else [cell]


def _is_cell(cell: str) -> bool:
    """Return whether a cell may belong to a row: a number, a time, or empty."""
    return number(cell.strip() or "nan") is not None or _is_number(cell) or THOUSAND in cell


def _is_number(cell: str) -> bool:
    plain = cell.strip()
    found = number(plain)
    return (found is not None and found == found) or (":" in plain and in_seconds(plain) != plain)


def _has_decimal_commas(line: str) -> bool:
    """Return whether spaces separate a line's cells, and all commas are decimal marks."""
    words = line.split()
    cut = [w for w in words if "," in w]
    return len(words) > 1 and bool(cut) and all(map(_COMMA.fullmatch, cut))


def _fit_form(head: list[str], delimiter: str, comma: bool) -> list[tuple[float, CsvForm]]:
    """Fit a form to the lines; return [(score, form)], empty if it does not fit."""
    rows = [
        (k, _split_cells(x, delimiter, comma))
        for k, x in enumerate(head)
        if x.strip(" \t,;") and not _REMARK.match(x)
    ]
    numeric = [(k, c) for k, c in rows if 2 * sum(map(_is_cell, c)) >= len(c) > 0]
    widths = Counter(len(c) for _, c in numeric)
    if not widths:
        return []
    width, often = max(widths.items(), key=lambda w: (w[1], w[0]))
    named = any(len(c) == width + 1 for k, c in rows if k < numeric[0][0])
    if (widths[width + 1] or named) and all(
        head[k].rstrip(" ").endswith(delimiter) for k, c in numeric if len(c) == width
    ):
        width, often = width + 1, often + widths[width + 1]  # the last column is often empty
        numeric = [(k, [*c, ""] if len(c) == width - 1 else c) for k, c in numeric]
    whole = [c for _, c in numeric if len(c) == width]
    for test in (_is_cell, _is_number):  # a header may have words above columns of empty cells
        usual = [j for j in range(width) if 2 * sum(test(c[j]) for c in whole) > len(whole)]
        first = next(
            (k for k, c in numeric if len(c) == width and all(_is_cell(c[j]) for j in usual)),
            numeric[0][0],
        )
        spans = _count_items(head[first], delimiter, comma)
        names, units, below_names = _find_names(head[:first], delimiter, comma, width, spans)
        if names:
            break
    else:  # without names, the first rows may hold words, too
        known = ((k, c) for k, c in numeric if len(c) == width)
        first = next((k for k, c in known if usual and _is_number(c[usual[0]])), first)
        begins = [k for k, _ in rows[:2]]
        if begins[1:] == [first] and len(rows[0][1]) < width and all(map(_is_number, rows[0][1])):
            first = begins[0]  # the end of a row that was cut
    lines = sum(k >= (below_names if names else first) for k, _ in rows)
    if often < ENOUGH * lines:
        return []
    share = (
        sum(sum(_is_cell(x) or bool(_DAY.fullmatch(x.strip())) for x in c) / width for c in whole)
        / often
    )
    usual = [n for n, times in widths.items() if times >= OFTEN * len(numeric)]
    if names:  # the first rows may lack usual cells, and all rows those that are rarely filled
        below = (k for k, c in rows if k >= below_names and any(map(_is_number, c)))
        first, width = next(below, first), len(names)
        usual = [n for n in usual if n <= width]
    # one cell per line is a table, too, but only if nothing else fits
    score = often / lines * share + (0.5 if width > 1 else 0.0) + (0.2 if names else 0.0)
    if delimiter == " ":  # spaces also cut lines that have another delimiter
        score -= 0.3 if 2 * sum(len(x.split()) > 1 for x in head) > len(head) else 0.6
    heads = frozenset(x.strip() for x in head[:first] if not all(map(_is_cell, x.split(delimiter))))
    form = CsvForm(delimiter, comma, names, first, width, 1, units, frozenset(usual), heads)
    return [(score, form)]


def _count_items(line: str, delimiter: str, comma: bool) -> list[int]:
    """Count the items in each cell of a line; empty without lists."""
    if delimiter == " " or not _LIST.search(line):
        return []
    packed = _LIST.sub(lambda found: "~" * len(_split_list(found[0])), line)
    return [max(1, c.count("~")) for c in _split_cells(packed, delimiter, comma)]


def _find_names(
    above: list[str], delimiter: str, comma: bool, width: int, spans: list[int]
) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Find the names of the columns and the units below them, empty if none. Also return the
    number of the line below these."""
    units: tuple[str, ...] = ()
    end, next_above = 0, True
    for k, line in reversed(list(enumerate(above, start=1))):
        text = line.removeprefix("#").removeprefix("//")
        apart = re.findall(r'"[^"]*"|[^\s,;]+', text) if delimiter == " " else None
        cells = [c.strip(' \t"') for c in apart or _split_cells(text, delimiter, comma)]
        if len(cells) != width and cells[:1] == ["%"]:
            del cells[0]
        if len(cells) == width - 1 and delimiter != " " and text.rstrip().endswith(delimiter):
            cells.append("")
        if len(cells) == len(spans):  # the names of lists
            each = zip(cells, spans, strict=True)
            cells = [f"{c}.{i}" if n > 1 else c for c, n in each for i in range(n)]
        numbers = sum(bool(_is_number(c) or _COMMA.fullmatch(c)) for c in cells)
        words = [c for c in cells if not (_is_cell(c) or _COMMA.fullmatch(c))]
        longer = next_above and delimiter != " " and width < len(cells) <= 1.5 * width
        next_above &= not line.strip() or 2 * numbers >= len(cells)
        if longer and line[:1] != "#" and len(set(words)) == len(cells):
            return tuple(cells), units, k  # the last columns are often empty
        if len(cells) != width or 2 * numbers >= width:
            continue
        known = sum(bool(_UNIT.fullmatch(c)) for c in words)
        most = 2 * known > len(words) and not units
        if 0 < known == len(words) or (
            most and 0 < k - 1 == _find_names(above[: k - 1], delimiter, comma, width, spans)[2]
        ):
            units = units or tuple(c.strip("[]() ") for c in cells)
            end = end or k
        elif 2 * len(words) >= width:
            return tuple(_make_distinct(cells)), units, end or k
    return (), (), 0


def _make_distinct(names: list[str]) -> list[str]:
    """Append the column's number to empty and repeated names; keep the others."""
    seen: set[str] = set()
    made = []
    for k, name in enumerate(names, start=1):
        made.append(name if name and name not in seen else f"{name or 'column'}.{k}")
        seen.add(made[-1])
    return made
