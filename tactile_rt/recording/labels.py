"""Labelled intervals of recordings, in a CSV file beside them.

    recording,start_s,end_s,label,object
    night.mcap,12.5,31,mug,red mug
    night.mcap,35,52.25,plate,

Times are seconds since the recording's first sample, file names are relative to the CSV. The column
``object`` (which of the mugs it was) may be left out, and ``recording`` if there is only one.
A program that labels during recording appends line by line; each line is written at once.
"""

import csv
import io
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import open_regular, refuse_lfs_pointer, sync_folder, write_whole
from tactile_rt.core.settings import check_columns, convert, nearest, read_csv, refusal

LABELS = "labels.csv"  # beside the recordings
NEEDED = ("start_s", "end_s", "label")
COLUMNS = ("recording", *NEEDED, "object")
# Limits of a name: label and object become parts of a file's name, which has at most 255 bytes.
LONGEST, MOST_BYTES = 60, 120  # characters, and bytes in UTF-8
LONGEST_LINE = 10_000  # bytes of a line that are parsed
# A model's refusals, and an unlabelled touch.
RESERVED = ("unknown", "none of these", "unlabelled")


class LabelledInterval(msgspec.Struct, frozen=True, kw_only=True):
    """Part of a recording in which one thing is touched.

    Attributes:
        start_s, end_s: Seconds since the recording's first sample; the end is not included.
        object: The name of the individual object; empty if not labelled.
        recording: The file name in the table of labels; empty for the only recording.
        where: File and line, for messages; empty if not read from a file.
    """

    label: str
    start_s: float = 0.0
    end_s: float = math.inf
    object: str = ""
    recording: str = ""
    where: str = ""

    @property
    def thing(self) -> tuple[str, str]:
        """Label and object of the touched thing."""
        return self.label, self.object


def read_labels(path: Path, recordings: Sequence[Path]) -> dict[Path, list[LabelledInterval]]:
    """Read all intervals of a file of labels; return them by recording.

    Args:
        recordings: recordings whose paths, as given here, are keys, even without intervals.

    Raises:
        ConfigError: the file cannot be read, or a line is wrong; names file, line and column, and
            what to do.
    """
    refuse_lfs_pointer(path)
    table = read_csv(path)
    check_columns(table, COLUMNS, NEEDED)
    if "recording" not in table.columns and len(recordings) > 1:
        raise ConfigError(
            f"{table.where}: no column recording, which {len(recordings)} recordings need; add it"
        )
    known = {one.resolve(): one for one in recordings}
    found: dict[Path, list[LabelledInterval]] = {one: [] for one in recordings}
    for node in table.rows:
        row = convert(node, LabelledInterval, lax=True)
        for column, name in (("label", row.label), ("object", row.object)):
            if why := check_name(name, empty=column == "object"):
                raise refusal(node, [column], why)
        if row.start_s < 0:
            raise refusal(node, ["start_s"], f"must be 0 or more, not {row.start_s:g}")
        if row.end_s <= row.start_s:
            raise refusal(node, ["end_s"], f"must be after start_s, {row.start_s:g} s")
        if not row.recording.isprintable():  # refused before it becomes a path
            raise refusal(node, ["recording"], f"{row.recording!r} is not a file name")
        file = path.parent / row.recording
        if not row.recording and len(recordings) > 1:
            raise refusal(node, ["recording"], "is empty; name one of several recordings")
        one = known.get(file.resolve()) if row.recording else recordings[0]
        if one is None and not file.is_file():
            names = sorted(r.name for r in recordings)
            why = f"no file {row.recording!r} beside {path.name}; {nearest(row.recording, names)}"
            raise refusal(node, ["recording"], why)
        found.setdefault(one or file, []).append(msgspec.structs.replace(row, where=node.where))
    return found


def append_label(path: Path, recording: str, interval: LabelledInterval) -> str:
    """Append a labelled interval to a file, and sync it; create the file if necessary.

    A line is written at once. If an interruption has left part of an earlier line, a line break is
    added first, so that the new line stays intact.

    Args:
        recording: name of the recording, relative to the file's folder.

    Returns:
        The line, without its line break.

    Raises:
        ConfigError: an invalid name, times out of order, or a file with other columns.
    """
    for what, name in (("label", interval.label), ("object", interval.object)):
        if why := check_name(name, empty=what == "object"):
            raise ConfigError(f"{what} {name!r}: {why}")
    if not recording.isprintable() or recording.startswith("#"):  # a # begins a remark
        raise ConfigError(f"recording {recording!r} cannot be written in {path.name}: rename it")
    if not 0 <= interval.start_s < interval.end_s < math.inf:
        raise ConfigError(f"start_s must be 0 or more and before end_s: {interval}")
    new = not path.exists() or not path.stat().st_size
    if not new:
        check_appendable(path)
    times = (f"{t:.6f}".rstrip("0").rstrip(".") for t in (interval.start_s, interval.end_s))
    line = text = _format_line(recording, *times, interval.label, interval.object)
    with path.open("ab+") as file:
        if new:
            text = _format_line(*COLUMNS) + text
        else:
            file.seek(-1, os.SEEK_END)
            text = text if file.read(1) == b"\n" else "\n" + text
        file.write(text.encode())  # a single write, at the end of the file
        file.flush()
        os.fsync(file.fileno())
    if new:
        sync_folder(path.parent)  # for the file's name
    return line.rstrip("\n")


def check_appendable(path: Path) -> None:
    """Raise a ConfigError if a file's columns are not those of `append_label`."""
    with open_regular(path) as file:
        columns = _split(file.readline(LONGEST_LINE))
    if columns != COLUMNS:
        raise ConfigError(
            f"{path}:1: columns are {','.join(columns)}, not {','.join(COLUMNS)}: nothing can be "
            "added; name another file, or change them"
        )


def drop_torn_label(path: Path) -> bool:
    """Remove an incomplete last line, left by an interruption; return whether one was found.

    A line that lacks only its line break stays, as an editor may have left it. So does a line that
    `append_label` cannot have written: `read_labels` reports it.
    """
    with open_regular(path) as file:
        data = file.read()
    end = data.rfind(b"\n") + 1
    whole, last = data[:end], data[end:]
    if whole:
        torn = _split(whole.partition(b"\n")[0]) == COLUMNS and len(_split(last)) < len(COLUMNS)
    else:
        torn = _format_line(*COLUMNS).encode().startswith(last)
    if not last or not torn:
        return False
    write_whole(path, lambda file: file.write(whole))
    return True


def lines_of(path: Path) -> list[str]:
    """Return a file's lines with line breaks, split as by `read_labels`; all bytes are kept."""
    return path.read_bytes().decode(errors="surrogateescape").splitlines(keepends=True)


def remove_label(path: Path, line: str) -> None:
    """Remove a line of a file, the last of several equal lines. The rewrite is atomic.

    Args:
        line: without its line break, from `append_label` or `lines_of`; if the file lacks it,
            nothing is removed.
    """
    lines = lines_of(path)
    found = [k for k, text in enumerate(lines) if text.rstrip("\r\n") == line]
    if found:
        del lines[found[-1]]
        data = "".join(lines).encode(errors="surrogateescape")
        write_whole(path, lambda file: file.write(data))


def relabel(path: Path, old: str, new: str) -> None:
    """Replace a label in a file by an atomic rewrite. An empty new label removes its lines."""
    lines = "".join(relabel_line(line, old, new) for line in lines_of(path))
    data = lines.encode(errors="surrogateescape")
    write_whole(path, lambda file: file.write(data))


def relabel_line(line: str, old: str, new: str) -> str:
    """Replace the label of a line if it is `old`. Return an empty line if `new` is empty."""
    cells = [cell.strip() for cell in next(csv.reader([line]), [])]
    at = COLUMNS.index("label")
    if len(cells) != len(COLUMNS) or cells[at] != old or tuple(cells) == COLUMNS:
        return line
    cells[at] = new
    return _format_line(*cells) if new else ""


def _split(line: bytes) -> tuple[str, ...]:
    """Split a line of CSV, maybe incomplete, into its cells."""
    text = line[:LONGEST_LINE].decode("utf-8-sig", errors="replace")
    return tuple(cell.strip() for cell in next(csv.reader([text]), []))


def check_name(name: str, empty: bool = False) -> str:
    """Return why a text cannot name a label or object; empty if it can.

    Args:
        empty: whether the name may be empty.
    """
    if not name:
        return "" if empty else "is empty; name what is touched"
    if name in RESERVED:
        return f"{name!r} is reserved; choose another name"
    if not name.isprintable() or name.startswith(".") or set(name) & set('/\\@:*?"<>|'):
        return f"{name!r} cannot be part of a file's name; use letters, digits, -, _ and spaces"
    if len(name) > LONGEST:
        return f"{name!r} is too long: {len(name)} characters, {LONGEST} at most"
    if len(name.encode()) > MOST_BYTES:
        return f"{name!r} is too long: {len(name.encode())} bytes, {MOST_BYTES} at most"
    return ""


def label_of_file(path: Path) -> str:
    """Return the label in a recording's name: `mug` of ``mug.mcap``, ``mug-3.mcap``, ``mug_3``.

    Raises:
        ConfigError: the name contains no label.
    """
    stem = re.sub(r"-\d{8}T\d{6}Z$", "", path.stem)  # time in the name of a rotated file
    label = re.sub(r"[-_ ]\d+$", "", stem)
    if why := check_name(label):
        raise ConfigError(f"{path}: its name holds no label: {why}")
    return label


def _format_line(*cells: str) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
