"""Recordings of named stimuli: rates in an .npz, or tables of spikes and events.

An ``.npz`` has for every session ``ANIMAL/SESSION/rates`` (trial, unit) in spikes per second and
``ANIMAL/SESSION/stimulus`` (trial,), the name shown in each trial; optional are ``depth`` (unit,)
in um below the pia and ``type`` (unit,), ``excitatory`` or ``inhibitory``.

The two ``.csv`` tables are on one clock. One has the columns animal, session, unit, time_s (a row
for every spike), the other animal, session, stimulus, start_s, stop_s (a row for every trial).
"""

import csv
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.benchmark import FEWEST, MOST
from tactile_rt.alignment.neural import LARGEST, NeuralSession
from tactile_rt.alignment.selection import CELLS, Selection
from tactile_rt.core.errors import ConfigError, explain_errors, name_some
from tactile_rt.core.files import refuse_lfs_pointer
from tactile_rt.core.stream.stimuli import STIMULI

SPIKES = ("animal", "session", "unit", "time_s")
EVENTS = ("animal", "session", "stimulus", "start_s", "stop_s")
Arrays = Mapping[str, NDArray[Any]]


def has_named_stimuli(path: Path) -> bool:
    """Return whether an ``.npz`` has named stimuli by session, not the published layout."""
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith("/rates.npy") for name in archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False  # the reader reports the error


def read_named_npz(path: Path, selection: Selection | None = None) -> list[NeuralSession]:
    """Read the sessions of an ``.npz`` in the format of the module's docstring.

    Raises:
        ConfigError: an array is missing or has a wrong shape, or there are not 3 to 50 stimuli.
    """
    refuse_lfs_pointer(path)
    with explain_errors(ConfigError, f"{path}: not an npz file of arrays (", most=80):
        with zipfile.ZipFile(path) as archive:
            if (size := sum(member.file_size for member in archive.infolist())) > LARGEST:
                raise ValueError(f"it unpacks to {size} bytes")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    sessions: dict[tuple[str, str], dict[str, NDArray[Any]]] = defaultdict(dict)
    for name, array in arrays.items():
        parts = name.split("/")
        if len(parts) != 3 or parts[2] not in ("rates", "stimulus", "depth", "type"):
            raise ConfigError(
                f"{path}: array {name} is none of ANIMAL/SESSION/rates, stimulus, ..."
            )
        sessions[parts[0], parts[1]][parts[2]] = array
    for (animal, session), found in sessions.items():
        where = f"{path}: {animal}/{session}"
        for what in ("rates", "stimulus"):
            if what not in found:
                raise ConfigError(f"{where} has no {what}")
        shape = found["rates"].shape
        if found["rates"].dtype.kind not in "fiu" or len(shape) != 2 or 0 in shape:
            raise ConfigError(f"{where}/rates is {found['rates'].dtype} {shape}, not (trial, unit)")
        if (found["rates"] < 0).any():
            raise ConfigError(f"{where}/rates has rates below 0: they are spikes per second")
        expected = {"stimulus": shape[0], "depth": shape[1], "type": shape[1]}
        for what, number in expected.items():
            if what in found and found[what].shape != (number,):
                raise ConfigError(f"{where}/{what} is {found[what].shape}, not ({number},)")
        kinds = set(found.get("type", np.array([])).tolist())
        if unknown := kinds - {*CELLS, ""}:
            raise ConfigError(f"{where}/type: {name_some(map(str, unknown))} is none of {CELLS}")
    return _make_sessions(path, sessions, selection or Selection())


def read_spike_tables(
    paths: Sequence[Path], selection: Selection | None = None
) -> list[NeuralSession]:
    """Read sessions from a table of spikes and a table of events.

    Rates count from an event's start to its stop.

    Raises:
        ConfigError: a column is missing, a value is invalid (the message names the row), or a
            session has no spike within its events.
    """
    tables = {columns: path for path in paths if (columns := _identify_table(path))}
    if len(paths) != 2 or set(tables) != {SPIKES, EVENTS}:
        raise ConfigError(f"name two tables, of {', '.join(SPIKES)} and of {', '.join(EVENTS)}")
    spikes: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for number, row in _read_rows(tables[SPIKES], SPIKES):
        time = _read_time(tables[SPIKES], number, row, "time_s")
        spikes[row["animal"], row["session"]][row["unit"]].append(time)
    shown: dict[tuple[str, str], list[tuple[str, float, float]]] = defaultdict(list)
    for number, row in _read_rows(tables[EVENTS], EVENTS):
        start, stop = (_read_time(tables[EVENTS], number, row, n) for n in ("start_s", "stop_s"))
        if stop <= start:
            raise ConfigError(f"{tables[EVENTS]}:{number}: stop_s {stop:g} is not after start_s")
        shown[row["animal"], row["session"]].append((row["stimulus"], start, stop))
    if alone := sorted(map("/".join, spikes.keys() ^ shown.keys())):
        raise ConfigError(f"{tables[EVENTS]}: session {alone[0]} needs both spikes and events")
    sessions: dict[tuple[str, str], dict[str, NDArray[Any]]] = {}
    for key, events in shown.items():
        names, starts, stops = (np.array(column) for column in zip(*events, strict=True))
        times = [np.sort(np.array(spikes[key][unit])) for unit in sorted(spikes[key])]
        counts = [np.searchsorted(t, stops) - np.searchsorted(t, starts) for t in times]
        rates = np.stack(counts, axis=1) / (stops - starts)[:, None]
        if not rates.any():
            raise ConfigError(
                f"{tables[SPIKES]}: no spike of {'/'.join(key)} falls within its events: are both "
                "tables in s, on one clock?"
            )
        sessions[key] = {"rates": rates, "stimulus": names}
    return _make_sessions(tables[EVENTS], sessions, selection or Selection())


def _make_sessions(
    path: Path, sessions: Mapping[tuple[str, str], Arrays], selection: Selection
) -> list[NeuralSession]:
    """Make the selected sessions, with stimuli in one order, that of `STIMULI` if possible."""
    if selection.task:
        raise ConfigError(f"{path}: has no tasks to select by")
    shown = {key: found["stimulus"].astype(str) for key, found in sessions.items()}
    names = tuple(sorted({name for each in shown.values() for name in each.tolist()}))
    names = STIMULI if set(names) == set(STIMULI) else names
    if not FEWEST <= len(names) <= MOST:
        raise ConfigError(f"{path}: {len(names)} stimuli ({name_some(names)}), not 3 to 50")
    made = []
    for (animal, session), found in sessions.items():
        if not selection.takes(session):
            continue
        depth, types = found.get("depth"), found.get("type")
        inhibitory = None if types is None else types == "inhibitory"
        with explain_errors(ConfigError, f"{path}: {animal}/{session} ("):
            kept = selection.units(depth, inhibitory, found["rates"].shape[1])
        place = {name: k for k, name in enumerate(names)}
        made.append(
            NeuralSession(
                animal, f"{animal}/{session}", found["rates"].astype(np.float64)[:, kept],
                np.array([place[name] for name in shown[animal, session].tolist()]),
                depth=None if depth is None else depth[kept].astype(np.float64),
                inhibitory=None if inhibitory is None else inhibitory[kept], stimuli=names,
            )
        )  # fmt: skip
    if not made:
        raise ConfigError(f"{path}: no session matches: {selection}")
    return made


def _identify_table(path: Path) -> tuple[str, ...]:
    """Return the columns of the table in a file: `SPIKES`, `EVENTS`, or () if neither."""
    refuse_lfs_pointer(path)
    with explain_errors(ConfigError, f"{path}: cannot be read (", most=80):
        with path.open(newline="", encoding="utf-8-sig") as file:
            head = set(next(csv.reader(file), []))
    return next((columns for columns in (SPIKES, EVENTS) if set(columns) <= head), ())


def _read_rows(path: Path, columns: Sequence[str]) -> Iterable[tuple[int, dict[str, str]]]:
    with path.open(newline="", encoding="utf-8-sig") as file:
        rows = csv.DictReader(file)
        for row in rows:
            if missing := [name for name in columns if not row[name]]:
                raise ConfigError(f"{path}:{rows.line_num}: {missing[0]} is empty")
            yield rows.line_num, row


def _read_time(path: Path, line: int, row: Mapping[str, str], column: str) -> float:
    try:
        value = float(row[column])
    except ValueError:
        value = float("nan")
    if not isfinite(value) or value < 0:
        raise ConfigError(f"{path}:{line}: {column} is {row[column][:40]!r}, not a time in s")
    return value
