"""Parts of an NWB file of the barrel-cortex recordings, each checked as it is read.

Whatever cannot be used raises a `ConfigError` that names the file and the place in it.
"""

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.stream import ConfigError

if TYPE_CHECKING:
    import h5py

__all__ = [
    "TRIALS",
    "animal_name",
    "booleans",
    "contact_times",
    "numbers",
    "spike_times",
    "starting_time",
    "text",
    "trial_columns",
]

Floats = NDArray[np.float64]

COLUMNS = ("start_time", "choice_time", "outcome", "stimulus", "servo_position", "ignore_trial")
TRIALS = "intervals/trials"
RECORDING = "extracellular array recording"  # of the published files; else the only one there is
CONTACTS = "contacts_by_whisker_"
WHISKER = "processed_position_whisker_"


def trial_columns(file: "h5py.File", path: Path) -> dict[str, NDArray[Any]]:
    """The columns of the trials that are needed, as stored, of one length."""
    if TRIALS not in file:
        raise ConfigError(f"{path}: has no {TRIALS}")
    table = file[TRIALS]
    missing = [name for name in COLUMNS if name not in table]
    if missing:
        there = ", ".join(sorted(table))
        raise ConfigError(
            f"{path}: {TRIALS} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)} "
            f"(it has {there})"
        )
    columns = {name: table[name][()] for name in COLUMNS}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ConfigError(f"{path}: columns of {TRIALS} differ in length: {lengths}")
    return columns


def contact_times(file: "h5py.File", path: Path) -> Floats:
    """Start times of all contacts, sorted, s."""
    modules = [file["processing"][name] for name in file.get("processing", {})]
    found = {name: module[name] for module in modules for name in module}
    clocks = {name: _last(group) for name, group in found.items() if name.startswith(WHISKER)}
    last = {name: end for name, end in clocks.items() if end is not None}
    times = []
    for name, table in found.items():
        if not name.startswith(CONTACTS):
            continue
        if "start_time" not in table:
            raise ConfigError(f"{path}: {table.name} lacks the column start_time")
        starts = numbers(table["start_time"][()], path, f"{name} start_time")
        times.append(starts)
        end = last.get(WHISKER + name.removeprefix(CONTACTS), max(last.values(), default=np.inf))
        if starts.size and starts.max() > end:
            raise ConfigError(
                f"{path}: {name}: a contact at {starts.max():.3f} s comes after the last "
                f"timestamp of the whiskers, {end:.3f} s: is the file whole?"
            )
    if not times:
        raise ConfigError(
            f"{path}: has no processing/*/{CONTACTS}*: without contacts only protocol paper-code "
            "can use it"
        )
    return np.sort(np.concatenate(times))


def _last(clock: Any) -> float | None:
    """Last timestamp of a whisker's angle, s; None where it has no clock."""
    angle = clock.get("angle") if hasattr(clock, "get") else None
    if angle is None:
        return None
    if "timestamps" in angle and len(angle["timestamps"]):
        return float(angle["timestamps"][-1])
    if "starting_time" in angle and "data" in angle:
        begin, rate = angle["starting_time"], float(angle["starting_time"].attrs["rate"])
        return float(begin[()]) + (len(angle["data"]) - 1) / rate
    return None


def spike_times(file: "h5py.File", path: Path) -> list[Floats]:
    """Spike times of every unit, s, sorted."""
    for name in ("units/spike_times", "units/spike_times_index"):
        if name not in file:
            raise ConfigError(f"{path}: has no {name}: is this a session with spikes?")
    times = numbers(file["units/spike_times"][()], path, "units/spike_times")
    ends = np.asarray(file["units/spike_times_index"][()], dtype=np.int64)
    edges = np.concatenate([[0], ends])
    if ends.size == 0 or (np.diff(edges) < 0).any() or ends[-1] != len(times):
        raise ConfigError(
            f"{path}: units/spike_times_index does not divide the {len(times)} spike times: "
            f"it has {ends.size} units and ends at {ends[-1] if ends.size else 0}"
        )
    return [np.sort(times[a:b]) for a, b in pairwise(edges)]


def starting_time(file: "h5py.File", path: Path) -> float:
    """When the electrical recording began, s."""
    series = file.get("acquisition", {})
    timed = [name for name in series if "starting_time" in series[name]]
    electrical = [n for n in timed if series[n].attrs.get("neurodata_type") == "ElectricalSeries"]
    name = RECORDING if RECORDING in timed else electrical[0] if len(electrical) == 1 else None
    if name is None:
        raise ConfigError(
            f"{path}: acquisition has no {RECORDING!r} with a starting_time, "
            "which spike times are counted from"
        )
    return float(series[name]["starting_time"][()])


def animal_name(file: "h5py.File", path: Path) -> str:
    """The subject; without one, the first part of the file's name, as published."""
    if "general/subject/subject_id" in file:
        return str(text(np.atleast_1d(file["general/subject/subject_id"][()]))[0])
    return path.stem.partition("_")[0].removeprefix("sub-")


def text(column: NDArray[Any]) -> NDArray[np.str_]:
    """Text, whether it was stored as text or as bytes."""
    decoded = [v.decode() if isinstance(v, bytes) else str(v) for v in column.tolist()]
    return np.array(decoded, dtype=np.str_)


def booleans(column: NDArray[Any], path: Path) -> NDArray[np.bool_]:
    """A column of trials that is true or false, whatever type stores it."""
    if column.dtype.kind not in "biu" or not np.isin(column, (0, 1)).all():
        raise ConfigError(
            f"{path}: {TRIALS} column ignore_trial is {column.dtype}, not true or false"
        )
    return column.astype(np.bool_)


def numbers(values: NDArray[Any], path: Path, what: str) -> Floats:
    """Times in seconds; `what` names them if they are something else."""
    if values.dtype.kind not in "fiu":
        raise ConfigError(f"{path}: {what} is {values.dtype}, not times in seconds")
    times: Floats = values.astype(np.float64)
    return times
