"""NWB files of the barrel-cortex recordings (Rodgers 2022, DANDI 000231), read with h5py alone.

    general/subject/subject_id                            animal
    intervals/trials/...                                  one column per dataset
    units/spike_times, units/spike_times_index            ragged: unit k ends at index[k]
    acquisition/<electrical series>/starting_time         subtracted from spike times
    processing/*/contacts_by_whisker_*/start_time         touches
    processing/*/processed_position_whisker_*/angle/...   the clock that touches are read on

A rate is a number of spikes over the bins of 45 ms that cover the window, as published.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.neural import NeuralSession
from tactile_rt.models.alignment.nwb_parts import (
    TRIALS,
    animal_name,
    booleans,
    contact_times,
    numbers,
    spike_times,
    starting_time,
    text,
    trial_columns,
)
from tactile_rt.models.alignment.rdm import DISTANCES, SHAPES, stimulus_index
from tactile_rt.stream import ConfigError

if TYPE_CHECKING:
    import h5py

__all__ = ["BIN_S", "WINDOWS", "find_nwb", "read_nwb", "read_session"]

Floats = NDArray[np.float64]

BIN_S = 0.045
WINDOWS = ("contact", "start")  # where a trial's window begins; it ends with the choice


def find_nwb(paths: Iterable[Path]) -> list[Path]:
    """Files named, and those in folders named.

    Of a folder, files with ``ecephys`` in their names if there are any: others have no spikes.

    Raises:
        ConfigError: nothing there.
    """
    found = []
    for path in paths:
        if path.is_dir():
            files = sorted(path.rglob("*.nwb"))
            files = [f for f in files if "ecephys" in f.name] or files
            if not files:
                raise ConfigError(f"no .nwb file in {path}")
            found += files
        elif path.is_file():
            found.append(path)
        else:
            raise ConfigError(f"no file or folder {path}")
    return found


def read_nwb(
    files: Iterable[Path],
    window: str = "contact",
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[list[NeuralSession], list[str]]:
    """Sessions of NWB files.

    Args:
        files: one per session.
        window: rates count from first ``contact`` or from the ``start`` of the trial, to choice.
        progress: called with the share done, 0 to 1, after every unit.

    Returns:
        Sessions, and notes on trials that were left out.

    Raises:
        ConfigError: a file that cannot be read as one of these recordings, and why.
    """
    files, sessions, notes = list(files), [], []
    for i, path in enumerate(files):
        session, said = read_session(
            path,
            window,
            lambda share, i=i: progress((i + share) / len(files)),  # type: ignore[misc]
        )
        sessions.append(session)
        notes += said
    return sessions, notes


def read_session(
    path: Path, window: str = "contact", progress: Callable[[float], None] = lambda share: None
) -> tuple[NeuralSession, list[str]]:
    """One NWB file; see `read_nwb`."""
    if window not in WINDOWS:
        raise ConfigError(f"no window {window!r}: there are {', '.join(WINDOWS)}")
    try:
        import h5py
    except ModuleNotFoundError:
        raise ConfigError(
            "reading NWB needs h5py, which is not installed: pip install 'tactile-rt[align]'"
        ) from None
    try:
        with h5py.File(path, "r") as file:
            return _session(file, path, window, progress)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read as NWB ({error})") from None


def _session(
    file: "h5py.File", path: Path, window: str, progress: Callable[[float], None]
) -> tuple[NeuralSession, list[str]]:
    trials = trial_columns(file, path)
    kept = (
        ~booleans(trials["ignore_trial"], path)
        & (text(trials["outcome"]) == "correct")
        & np.isin(text(trials["stimulus"]), SHAPES)
    )
    rows = np.flatnonzero(kept)
    start, stop = (numbers(trials[c], path, c)[rows] for c in ("start_time", "choice_time"))
    bad = np.flatnonzero(~(stop > start))
    if bad.size:
        k = bad[0]
        raise ConfigError(
            f"{path}: {TRIALS} row {rows[k]}: choice_time {stop[k]:g} s is not after "
            f"start_time {start[k]:g} s"
        )
    shapes, places = text(trials["stimulus"]), text(trials["servo_position"])
    for row in rows:
        if places[row] not in DISTANCES:
            raise ConfigError(
                f"{path}: {TRIALS} row {row}: servo_position {str(places[row])!r}, "
                f"not one of {', '.join(DISTANCES)}"
            )
    notes = []
    if window == "contact":
        first = _first_contacts(contact_times(file, path), start, stop)
        touched = np.isfinite(first)
        if not touched.all():
            notes.append(
                f"session {path.stem}: {(~touched).sum()} of {len(rows)} correct trials left out: "
                "no contact before the choice"
            )
        rows, start, stop = rows[touched], first[touched], stop[touched]
    if not rows.size:
        raise ConfigError(
            f"{path}: no trial is left: correct, not ignored, convex or concave"
            + (", with a contact before the choice" if window == "contact" else "")
        )
    stimulus = np.array([stimulus_index(shapes[r], places[r]) for r in rows], dtype=np.int64)
    rates = _rates(spike_times(file, path), starting_time(file, path), start, stop, progress)
    return NeuralSession(animal_name(file, path), path.stem, rates, stimulus), notes


def _first_contacts(contacts: Floats, start: Floats, stop: Floats) -> Floats:
    """Time of the first contact in [start, stop), NaN without one."""
    padded = np.append(contacts, np.inf)
    first = padded[np.searchsorted(contacts, start)]
    return np.where(first < stop, first, np.nan)


def _rates(
    spikes: list[Floats],
    origin: float,
    start: Floats,
    stop: Floats,
    progress: Callable[[float], None],
) -> Floats:
    """Spikes per second in [start, stop), (trial, unit)."""
    bins = np.array(
        [len(np.arange(a, b + BIN_S, BIN_S)) - 1 for a, b in zip(start, stop, strict=True)]
    )
    rates = np.empty((len(start), len(spikes)))
    for unit, times in enumerate(spikes):
        before = np.searchsorted(times - origin, [start, stop])  # spikes before each edge
        rates[:, unit] = (before[1] - before[0]) / (bins * BIN_S)
        progress((unit + 1) / len(spikes))
    return rates
