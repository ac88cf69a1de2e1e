"""Readers of parts of an NWB file of the barrel-cortex recordings, with checks.

An error that makes a session useless raises a `ConfigError` that names the place in the file; the
caller adds the file's name. A faulty trial, contact, spike or unit is left out, with a note.
"""

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.rdm import Floats
from tactile_rt.alignment.selection import TASKS
from tactile_rt.core.errors import ConfigError, name_some

if TYPE_CHECKING:
    import h5py

COLUMNS = ("start_time", "choice_time", "outcome", "stimulus", "servo_position", "ignore_trial")
TRIALS = "intervals/trials"
RECORDING = "extracellular array recording"  # in published files; else the only electrical series
CONTACTS = "contacts_by_whisker_"
WHISKER = "processed_position_whisker_"
SUBJECT = "general/subject/subject_id"
EXPERIMENT = "general/experiment_description"  # names the task
LARGEST = 1 << 30  # most bytes in a column; the longest, of spike times, have some millions
NAMED = 5  # most trials or units that a note lists
BACK_S = 0.01  # disorder of spike times that sorters may leave; a larger step is another clock
FAR_S = 3600.0  # spikes are far if outside the trials by more than this and the trials' duration
FAR_SHARE, SAME_SHARE = 0.01, 0.05  # of a unit's spikes; smaller shares are mistakes or chance


def read_column(file: Any, name: str) -> NDArray[Any]:
    """Read a column as stored; check that it is one-dimensional and not too large."""
    data = file[name]
    if getattr(data, "ndim", None) != 1:
        raise ConfigError(f"{name} is not a column of values")
    if data.size * max(data.dtype.itemsize, 1) > LARGEST:
        raise ConfigError(f"{name} has {data.size} values, more than a session can have")
    return np.asarray(data[()])


def trial_columns(file: "h5py.File") -> dict[str, NDArray[Any]]:
    """Read the needed columns of the trials as stored; check that their lengths are equal."""
    if TRIALS not in file:
        raise ConfigError(f"has no {TRIALS}")
    table = file[TRIALS]
    missing = [name for name in COLUMNS if name not in table]
    if missing:
        lacks = f"lacks the column{'s' * (len(missing) > 1)} {name_some(missing)}"
        raise ConfigError(f"{TRIALS} {lacks} (it has {', '.join(sorted(table))})")
    columns = {name: read_column(table, name) for name in COLUMNS}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ConfigError(f"columns of {TRIALS} differ in length: {lengths}")
    return columns


def contact_times(file: "h5py.File", notes: list[str]) -> Floats:
    """Read the sorted start times of all contacts, s; append omissions to `notes`."""
    found = {k: v for module in file.get("processing", {}).values() for k, v in module.items()}
    clocks = {name: last_time(found[name]) for name in found if name.startswith(WHISKER)}
    last = {name: end for name, end in clocks.items() if end is not None}
    times = []
    for name in (name for name in found if name.startswith(CONTACTS)):
        table = found[name]
        if "start_time" not in table:
            raise ConfigError(f"{table.name} lacks the column start_time")
        starts = numbers(read_column(table, "start_time"), f"{name} start_time")
        end = last.get(WHISKER + name.removeprefix(CONTACTS), max(last.values(), default=np.inf))
        good = np.isfinite(starts) & (starts <= end)
        if not good.all():
            k = int(np.flatnonzero(~good)[0])
            notes.append(
                f"{(~good).sum()} of {len(starts)} contacts in {name} left out: {starts[k]:.3f} s "
                f"is no time, or after the last timestamp of the whiskers, {end:.3f} s"
            )
        times.append(starts[good])
    if not sum(map(len, times)):
        raise ConfigError(
            f"has no contacts (processing/*/{CONTACTS}*): without them, use protocol paper-code"
        )
    return np.sort(np.concatenate(times))


def last_time(clock: Any) -> float | None:
    """Return the last timestamp of a whisker's angle, s; None without a clock."""
    angle = clock.get("angle", {}) if hasattr(clock, "get") else {}
    if "timestamps" in angle and len(angle["timestamps"]):
        return float(angle["timestamps"][-1])
    if "starting_time" in angle and "data" in angle:
        begin, rate = angle["starting_time"], float(angle["starting_time"].attrs["rate"])
        return float(begin[()]) + (len(angle["data"]) - 1) / rate
    return None


def spike_times(file: "h5py.File", notes: list[str]) -> list[Floats]:
    """Read each unit's finite spike times, s, in stored order; append omissions to `notes`."""
    for name in ("units/spike_times", "units/spike_times_index"):
        if name not in file:
            raise ConfigError(f"has no {name}: is this a session with spikes?")
    times = numbers(read_column(file, "units/spike_times"), "units/spike_times")
    index = read_column(file, "units/spike_times_index")
    edges = np.concatenate([[0], index.astype(np.int64) if index.dtype.kind in "iu" else [-1]])
    if index.size == 0 or (np.diff(edges) < 0).any() or edges[-1] != len(times):
        raise ConfigError(
            f"units/spike_times_index does not divide the {len(times)} spike times: "
            f"it has {index.size} units and ends at {index[-1] if index.size else 0}"
        )
    finite = np.isfinite(times)
    if not finite.all():
        spoilt = [k for k, (a, b) in enumerate(pairwise(edges)) if not finite[a:b].all()]
        notes.append(
            f"{(~finite).sum()} of {len(times)} spikes left out: their times are no times "
            f"(unit {name_rows(spoilt)})"
        )
    return [times[a:b][finite[a:b]] for a, b in pairwise(edges)]


def usable_units(
    units: list[Floats], begin: float, end: float, notes: list[str]
) -> tuple[list[Floats], NDArray[np.bool_]]:
    """Sort each unit's spike times, and return them with a mask of usable units.

    Args:
        units: each unit's times in s, in stored order.
        begin, end: start of the first trial and end of the last trial, in s.
        notes: list to which omissions are appended, with the reason.
    """
    far, usable = max(FAR_S, end - begin), np.ones(len(units), dtype=np.bool_)
    kept, seen, faults = [], dict[bytes, int](), defaultdict[str, list[int]](list)
    strange, doubled = list[int](), list[int]()
    for k, given in enumerate(units):
        times = np.sort(given)
        away = (times < begin - far) | (times > end + far)
        early, late = (times < begin).all(), (times > end).all()
        back, again = np.maximum.accumulate(given) - given, np.diff(times, prepend=-np.inf) == 0
        first = seen.setdefault(times.tobytes(), k)
        found = {
            "no spikes": not times.size,
            "their spike times go back, as of a clock that began anew": (back > BACK_S).any(),
            f"their spikes end before the first trial begins, at {begin:.3f} s": early,
            "their spikes lie outside the trials (another clock, or ms for s?)": (
                late or away.sum() > FAR_SHARE * len(times)
            ),
            f"the spikes of unit {first} again": first < k and len(times) > 2,
        }
        usable[k] = not any(found.values())
        if not usable[k]:
            faults[next(fault for fault, holds in found.items() if holds)].append(k)
        else:
            strange += [k] * int((away | (times < 0)).sum())
            if again.mean() > SAME_SHARE:
                doubled += [k] * int(again.sum())
                times = times[~again]
        kept.append(times)
    odd = {"counted once, stored twice": doubled, "far from the trials, or before 0 s": strange}
    notes += [f"{len(r)} spikes {what} (unit {name_rows(r)})" for what, r in odd.items() if r]
    for fault, rows in faults.items():
        notes.append(f"{len(rows)} of {len(units)} units left out ({name_rows(rows)}): {fault}")
    return kept, usable


def mark_overlaps(start: Floats, stop: Floats) -> NDArray[np.bool_]:
    """Return a mask of trials on another clock, stored twice, or overlapping the next."""
    bad = np.zeros(len(start), dtype=np.bool_)
    for again in range(2):
        order = np.lexsort((stop, start, bad))[: (~bad).sum()]
        one, two = order[:-1], order[1:]
        same = (start[one] == start[two]) & (bool(again) | (stop[one] == stop[two]))
        bad[two[same]] = True
        runs = stop[one] > start[two]
        if again:
            bad[one[runs]] = True
        elif runs[~bad[two]].any():
            back = np.maximum.accumulate(start) > start
            if back.sum() > NAMED:  # not single mistakes
                back[int(np.argmax(back)) :] = True
            bad |= back
    return bad


def name_rows(rows: Sequence[int]) -> str:
    """Format the first few distinct row numbers for a note."""
    rows = sorted(set(rows))
    return ", ".join(map(str, rows[:NAMED])) + (", ..." if len(rows) > NAMED else "")


def unit_column(
    file: "h5py.File", name: str, units: int, notes: list[str], among: Sequence[float] = ()
) -> Floats | None:
    """Read a numeric column of the units; None if missing or not all in `among`."""
    if name not in file.get("units", {}):
        return None
    values = read_column(file["units"], name)
    if len(values) != units or values.dtype.kind not in "fiub":
        why = f"it is not a number for each of {units} units"
    elif among and (odd := np.flatnonzero(~np.isin(values, among))).size:
        known = " nor ".join(map(str, among))
        why = f"{odd.size} of {units} are neither {known}, unit {odd[0]} is {values[odd[0]]:g}"
    else:
        return values.astype(np.float64)
    notes.append(f"column units/{name} left out: {why}")
    return None


def starting_time(file: "h5py.File") -> float | None:
    """Read the start of the electrical recording on the session's clock, s; None if missing."""
    series = file.get("acquisition", {})
    timed = [name for name in series if "starting_time" in series[name]]
    electrical = [n for n in timed if series[n].attrs.get("neurodata_type") == "ElectricalSeries"]
    name = RECORDING if RECORDING in timed else electrical[0] if len(electrical) == 1 else None
    if name is None:
        return None
    time = float(series[name]["starting_time"][()])
    return time if np.isfinite(time) else None


def animal_name(file: "h5py.File", stem: str) -> str:
    """Return the subject's name or, as published, the first part of the file's name."""
    if SUBJECT in file:
        return _read_text(file, SUBJECT)
    return stem.partition("_")[0].removeprefix("sub-")


def task_of(file: "h5py.File", shown: NDArray[np.str_]) -> str:
    """Return the mouse's task: named in the file, or inferred from trials without a shape."""
    if EXPERIMENT in file:
        named = [task for task in TASKS if task in _read_text(file, EXPERIMENT)]
        if len(named) == 1:
            return named[0]
    return TASKS[1] if (shown == "nothing").any() else TASKS[0]


def _read_text(file: "h5py.File", name: str) -> str:
    return str(text(np.atleast_1d(file[name][()]))[0])


def text(column: NDArray[Any]) -> NDArray[np.str_]:
    """Convert a column of text or bytes to text."""
    decoded = [v.decode(errors="replace") if isinstance(v, bytes) else str(v) for v in column]
    return np.array(decoded, dtype=np.str_)


def flags(column: NDArray[Any], what: str) -> NDArray[np.int64]:
    """Convert truth values of any type to 1 (true), 0 (false) or -1 (neither)."""
    if column.dtype.kind not in "biu":
        raise ConfigError(f"{TRIALS} column {what} is {column.dtype}, not true or false")
    return np.where(np.isin(column, (0, 1)), column, -1).astype(np.int64)


def numbers(values: NDArray[Any], what: str) -> Floats:
    """Convert a column of times in seconds to floats; `what` names it in an error."""
    if values.dtype.kind not in "fiu":
        raise ConfigError(f"{what} is {values.dtype}, not times in seconds")
    return values.astype(np.float64)
