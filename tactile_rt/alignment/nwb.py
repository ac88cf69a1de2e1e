"""Reader of NWB files of barrel-cortex recordings (Rodgers 2022, DANDI 000231), with h5py alone.

    general/subject/subject_id                            animal
    general/experiment_description                        task
    intervals/trials/...                                  one column per dataset
    units/spike_times, units/spike_times_index            ragged: unit k ends at index[k]
    units/depth, units/inhibitory                         um, putative cell type
    acquisition/<electrical series>/starting_time         see below
    processing/*/contacts_by_whisker_*/start_time         touches
    processing/*/processed_position_whisker_*/angle/...   the clock of the touches

NWB defines all times, also of spikes, on the session's clock. The published analysis assumes spike
times on the recording's clock, and subtracts its starting time. `clock` selects one of the two, and
the module of that name checks it. Rates are spike counts over the bins of 45 ms that cover the
window, as published.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment import nwb_parts as parts
from tactile_rt.alignment.clock import CLOCKS, ContactResponse, contact_response
from tactile_rt.alignment.neural import NeuralSession
from tactile_rt.alignment.rdm import Floats, stimulus_index
from tactile_rt.alignment.selection import Selection
from tactile_rt.core.errors import ConfigError, explain_errors, name_some
from tactile_rt.core.files import refuse_lfs_pointer
from tactile_rt.core.packages import require_extra
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES

if TYPE_CHECKING:
    import h5py

Progress = Callable[[float], None]

BIN_S = 0.045
COURSE_BINS = 22  # the number of steps of the compared models
WINDOWS = ("contact", "start")  # events that begin a trial's window; it ends with the choice
LONGEST_TRIAL_S, LONGEST_SESSION_S = 600.0, 1e6
SILENT_S = 60.0  # trials without any unit's spike within this time were not recorded


class Reading(NamedTuple):
    """A session read from an NWB file; its contact `response` is None if not measurable."""

    session: NeuralSession
    notes: list[str]
    task: str
    response: ContactResponse | None


def find_nwb(paths: Iterable[Path]) -> list[Path]:
    """Find NWB files in files and folders; in a folder, prefer names with ``ecephys``."""
    found = []
    for path in paths:
        if not (path.is_dir() or path.is_file()):
            raise ConfigError(f"no file or folder {path}")
        files = sorted(path.rglob("*.nwb")) if path.is_dir() else [path]
        if not files:
            raise ConfigError(f"no .nwb file in {path}")
        found += [f for f in files if "ecephys" in f.name] or files
    return found


def read_nwb(
    files: Iterable[Path],
    window: str = "contact",
    progress: Progress = lambda share: None,
    clock: str = "session",
    selection: Selection | None = None,
) -> tuple[list[Reading], list[str]]:
    """Read the selected sessions of NWB files.

    Args:
        window: rates count from first ``contact`` or from the ``start`` of the trial, to choice.

    Returns:
        Readings of the selected sessions, and notes on what was left out, including sessions that
        cannot be read.
    """
    _import_h5py()
    chosen = selection or Selection()
    every = list(files)
    files = [path for path in every if chosen.takes(path.stem)]
    readings: list[Reading] = []
    spoilt: list[str] = []
    for i, path in enumerate(files):

        def read(share: float, i: int = i) -> None:
            progress((i + share) / len(files))

        try:
            reading = read_session(path, window, read, clock, chosen)
        except ConfigError as error:
            why = str(error).replace(str(path), path.name)
            spoilt.append(f"session {path.stem} left out: {why}")
        else:
            if chosen.task in (None, reading.task) and reading.session.rates.shape[1]:
                readings.append(reading)
        read(1.0)
    if not readings:
        raise ConfigError(
            name_some(spoilt, 1) or f"none of {len(every)} sessions has units that match: {chosen}"
        )
    notes = [*spoilt, *(note for reading in readings for note in reading.notes)]
    if str(chosen):
        units = sum(r.session.rates.shape[1] for r in readings)
        notes.insert(
            0, f"selected: {chosen}: {len(readings)} of {len(every)} sessions, {units} units"
        )
    return readings, notes


def read_session(
    path: Path,
    window: str = "contact",
    progress: Progress = lambda share: None,
    clock: str = "session",
    selection: Selection | None = None,
) -> Reading:
    """Read the session of one NWB file; arguments as for `read_nwb`."""
    for what, value, known in (("window", window, WINDOWS), ("clock", clock, CLOCKS)):
        if value not in known:
            raise ConfigError(f"no {what} {value!r}: there are {name_some(known, 8)}")
    h5py = _import_h5py()
    refuse_lfs_pointer(path)
    with explain_errors(ConfigError, f"{path}: cannot be read as NWB ("):
        try:
            with h5py.File(path, "r") as file:
                return _assemble(file, path.stem, window, progress, clock, selection or Selection())
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None


def _import_h5py() -> Any:
    with require_extra("reading NWB needs", "align"):
        import h5py
    return h5py


def _assemble(
    file: "h5py.File", name: str, window: str, progress: Progress, clock: str, selection: Selection
) -> Reading:
    """Assemble a session from parts of its file, without bad trials and units."""
    notes: list[str] = []
    trials = parts.trial_columns(file)
    shapes, places = parts.text(trials["stimulus"]), parts.text(trials["servo_position"])
    ignored = parts.flags(trials["ignore_trial"], "ignore_trial")
    begin, stop = (parts.numbers(trials[c], c) for c in ("start_time", "choice_time"))
    kept = (ignored != 1) & (parts.text(trials["outcome"]) == "correct") & np.isin(shapes, SHAPES)
    task = parts.task_of(file, shapes[ignored == 0])

    def drop(bad: NDArray[np.bool_], why: str) -> None:
        nonlocal kept
        rows = np.flatnonzero(bad & kept)
        if rows.size:
            few, whole = parts.name_rows(rows.tolist()), kept.sum()
            notes.append(f"{rows.size} of {whole} correct trials left out ({few}): {why}")
        kept = kept & ~bad
        if not kept.any():
            left = f"no trial is left in {parts.TRIALS}: correct, not ignored, convex or concave"
            raise ConfigError(name_some([left, *notes], 2, "; "))

    drop(ignored == -1, "ignore_trial is neither true nor false")
    drop(~np.isin(places, DISTANCES), f"servo_position is not one of {', '.join(DISTANCES)}")
    with np.errstate(invalid="ignore", over="ignore"):
        lasts = stop - begin
        good = (lasts > 0) & (lasts < LONGEST_TRIAL_S) & (np.abs(begin) < LONGEST_SESSION_S)
    drop(~good, f"choice_time is not after start_time, by {LONGEST_TRIAL_S:g} s at most")
    twice = np.zeros_like(kept)
    twice[kept] = parts.mark_overlaps(begin[kept], stop[kept])
    drop(twice, "start_time goes back, or trials overlap")
    units = parts.spike_times(file, notes)
    origin = parts.starting_time(file)
    if clock == "recording" and origin is None:
        raise ConfigError(
            "acquisition has no electrical recording with a starting_time, which the published "
            "analysis counts spike times from"
        )
    shift = origin or 0.0 if clock == "recording" else 0.0
    try:
        contacts = parts.contact_times(file, notes)
    except ConfigError:
        if window == "contact":
            raise
        contacts = np.empty(0)
    start = begin
    if window == "contact":
        touched = np.append(contacts, np.inf)[np.searchsorted(contacts, begin)]
        start = np.where(touched < stop, touched, np.nan)
        drop(~np.isfinite(start), "no contact before the choice")
    first, last = begin[kept].min(), stop[kept].max()
    units, usable = parts.usable_units(units, first, last, notes)
    trains = [times for times, good in zip(units, usable, strict=True) if good]
    if not trains:
        raise ConfigError(name_some(["no unit can be used", *notes[::-1]], 2, "; "))
    near = [start - SILENT_S, stop + SILENT_S]
    before = np.searchsorted(np.sort(np.concatenate(trains)), near)
    drop(before[0] == before[1], f"no unit has a spike within {SILENT_S:g} s")
    rows = np.flatnonzero(kept)
    response = contact_response(name, trains, contacts, shift, origin or 0.0)
    depth = parts.unit_column(file, "depth", len(units), notes)
    inhibitory = parts.unit_column(file, "inhibitory", len(units), notes, (0, 1))
    chosen = selection.units(depth, inhibitory, len(units)) & usable
    spikes = [times - shift for times, keep in zip(units, chosen, strict=True) if keep]
    rates, course = _compute_rates(spikes, start[rows], stop[rows], progress)
    if rates.size and not rates.any():
        raise ConfigError(f"no spike of {len(spikes)} units falls within any of {len(rows)} trials")
    session = NeuralSession(
        animal=parts.animal_name(file, name),
        name=name,
        rates=rates,
        stimulus=np.array([stimulus_index(shapes[r], places[r]) for r in rows], dtype=np.int64),
        course=course,
        depth=None if depth is None else depth[chosen],
        inhibitory=None if inhibitory is None else inhibitory[chosen] == 1,
        begin=begin[rows],
    )
    return Reading(session, [f"session {name}: {note}" for note in notes], task, response)


def _compute_rates(
    spikes: list[Floats], start: Floats, stop: Floats, progress: Progress
) -> tuple[Floats, Floats]:
    """Compute rates in spikes/s in [start, stop), (trial, unit), and by bin, (trial, bin, unit)."""
    bins = np.array(
        [len(np.arange(a, b + BIN_S, BIN_S)) - 1 for a, b in zip(start, stop, strict=True)]
    )
    edges = start[:, None] + BIN_S * np.arange(COURSE_BINS + 1)
    rates = np.empty((len(start), len(spikes)))
    course = np.empty((len(start), COURSE_BINS, len(spikes)))
    for unit, times in enumerate(spikes):
        before = np.searchsorted(times, [start, stop])  # spikes before each edge
        rates[:, unit] = (before[1] - before[0]) / (bins * BIN_S)
        course[:, :, unit] = np.diff(np.searchsorted(times, edges), axis=1) / BIN_S
        progress((unit + 1) / len(spikes))
    course[edges[:, 1:] > stop[:, None]] = np.nan
    return rates, course
