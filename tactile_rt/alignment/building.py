"""Construction of a frozen benchmark from recordings."""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from tactile_rt.alignment.benchmark import PROTOCOLS, Benchmark
from tactile_rt.alignment.clock import CLOCKS, WARNING, said_of
from tactile_rt.alignment.named_recordings import (
    has_named_stimuli,
    read_named_npz,
    read_spike_tables,
)
from tactile_rt.alignment.neural import NeuralSession, by_animal, published_layout, read_published
from tactile_rt.alignment.nwb import Reading, find_nwb, read_nwb
from tactile_rt.alignment.paper_code import freeze_paper_code
from tactile_rt.alignment.reliability import BOOTSTRAPS, SEED, trial_mean
from tactile_rt.alignment.selection import Selection
from tactile_rt.alignment.strict import freeze_strict
from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream.stimuli import STIMULI

READING = 0.8  # share of a build's time; the rest is bootstraps
# Two sessions are copies if they share more than `MOST` of the trials or units of the smaller.
MOST = 0.5
FEWEST = 3  # trials or units needed to compare sessions, and different rates to compare units


def build(
    inputs: Sequence[Path],
    protocol: str = "strict",
    bootstraps: int = BOOTSTRAPS,
    seed: int = SEED,
    progress: Callable[[float], None] = lambda share: None,
    selection: Selection | None = None,
    clock: str | None = None,
) -> Benchmark:
    """Compute a benchmark from recordings; scoring models needs only the result.

    Args:
        inputs: NWB files and folders of them; or, for stimuli of any names, one ``.npz`` or two
            tables (`named_recordings`); or, for paper-code, the published ``.npz``.
        progress: called with the share done, 0 to 1.
        selection: the sessions and units to keep; None for all.
        clock: the clock of spike times: ``session``, as in NWB and by default for strict, or
            ``recording``, as in the published analysis and by default for paper-code.

    Returns:
        A benchmark with at least one reliable animal. Its notes begin with the result of the clock
        check, and list sessions, trials and units that were left out.

    Raises:
        ConfigError: the recordings cannot be used: no animal is reliable, a session is given
            twice, or, under strict, contacts show that spikes are on another clock.
    """
    if protocol not in PROTOCOLS:
        raise ConfigError(f"no protocol {protocol!r}: there are {', '.join(PROTOCOLS)}")
    if clock is not None and clock not in CLOCKS:
        raise ConfigError(f"no clock {clock!r}: there are {', '.join(CLOCKS)}")
    if not inputs:
        raise ConfigError("name NWB files or a folder of them to build from")
    if bootstraps < 1:
        raise ConfigError(f"bootstraps must be 1 or more, not {bootstraps}")
    strict = protocol == "strict"
    tables = [path for path in inputs if path.suffix == ".csv"]
    archives = [path for path in inputs if path.suffix == ".npz"]
    named = bool(tables) or any(map(has_named_stimuli, archives))
    if archives and len(inputs) > 1:
        raise ConfigError(f"{archives[0]}: an .npz holds all animals: give no other file")
    if named and (not strict or clock):
        raise ConfigError(f"{inputs[0]}: named stimuli need protocol strict and no --clock")
    if archives and strict and not named:
        raise ConfigError(
            f"{archives[0]}: its stimuli have no names, and trials that did not show a stimulus "
            "count as zero: build with protocol paper-code, or strict from the NWB files"
        )
    if archives and not named and (clock or str(selection or "")):
        raise ConfigError(
            f"{archives[0]}: holds rates, not spikes: neither a clock nor a selection of sessions "
            "or units applies to it"
        )

    def report_bootstraps(share: float) -> None:
        progress(READING + (1 - READING) * share)

    if named:
        files, notes = list(inputs), []
        if tables:
            sessions = read_spike_tables(inputs, selection)
        else:
            sessions = read_named_npz(archives[0], selection)
        refuse_copies(sessions)
    elif archives:
        files, rates = archives, read_published(archives[0])
        units = sum(array.shape[2] for array in rates.values())
        notes = [f"{archives[0].name}: {len(rates)} animals, {units} units"]
    else:
        files = find_nwb(inputs)
        sessions, notes = checked_sessions(
            files, strict, lambda share: progress(READING * share), clock, selection
        )
        folders = (path for path in inputs if path.is_dir())
        others = {file for path in folders for file in path.rglob("*.nwb")} - {*files}
        if others:
            names = name_some(sorted(file.name for file in others))
            notes.append(f"passed over, without `ecephys` in their names: {names}")
        if not strict:
            animals = by_animal(_keep_complete(sessions, notes))
            rates = {animal.name: published_layout(animal) for animal in animals}
    if strict:
        made = freeze_strict(by_animal(sessions), bootstraps, seed, report_bootstraps)
    else:
        made = freeze_paper_code(rates, bootstraps, seed, report_bootstraps)
    if not made.reliable:
        found = name_some(
            f"{t.name} {t.chosen.reliability:.2f} ({t.chosen.units} of {t.unfiltered.units} units)"
            for t in made.targets
        )
        raise ConfigError(f"no animal is reliable enough to score on; reliabilities: {found}")
    sources = tuple(sorted(file.name for file in files))
    return replace(made, sources=sources, notes=(*notes, *made.notes))


def checked_sessions(
    files: Sequence[Path],
    strict: bool = True,
    progress: Callable[[float], None] = lambda share: None,
    clock: str | None = None,
    selection: Selection | None = None,
) -> tuple[list[NeuralSession], list[str]]:
    """Read sessions of NWB files, check clocks and copies; return sessions and notes.

    Args:
        strict: True to count rates from first contact, and leave out sessions whose contacts show
            another clock; False to count from the start of the trial, and only note such sessions.
    """
    clock = clock or ("session" if strict else "recording")
    window = "contact" if strict else "start"
    readings, notes = read_nwb(files, window, progress, clock, selection or Selection())
    readings, warnings = _check_clock(readings, clock, strict)
    tasks = {
        task: len({r.session.animal for r in readings if r.task == task})
        for task in sorted({r.task for r in readings})
    }
    if len(tasks) > 1:
        pooled = " and ".join(f"{n} of {task}" for task, n in tasks.items())
        notes.append(f"animals of two tasks are together, {pooled}: --task keeps one")
    sessions = [reading.session for reading in readings]
    refuse_copies(sessions)
    return sessions, [*warnings, *notes]


def _check_clock(
    readings: list[Reading], clock: str, strict: bool
) -> tuple[list[Reading], list[str]]:
    """Check spikes' clock by contacts; return readings to keep, and notes on the check."""
    responses = [r.response for r in readings if r.response is not None]
    if not responses:
        return readings, [
            WARNING + "the clock of the spikes is unchecked: no contacts, or no spikes"
        ]
    found = [said_of(responses, clock)]
    wrong = [response for response in responses if response.elsewhere]
    if not wrong:
        return readings, found
    first = wrong[0]
    why = (
        f"in {len(wrong)} of {len(readings)} sessions another offset fits contacts better: in "
        f"{first.session} rates rise most (z = {first.other_z:.1f}) if {first.other_s:.3f} s is "
        f"subtracted from spike times, and not {first.shift_s:.3f} s (z = {first.z:.1f})"
    )
    if strict and 2 * len(wrong) > len(responses):
        raise ConfigError(f"{found[0].removeprefix(WARNING)}; {why}: see --clock")
    if not strict:
        return readings, [*found, WARNING + why]
    names = {response.session for response in wrong}
    kept = [r for r in readings if r.session.name not in names]
    return kept, [*found, f"{WARNING}{why}: left out: {', '.join(sorted(names))}"]


def _keep_complete(sessions: Sequence[NeuralSession], notes: list[str]) -> list[NeuralSession]:
    """Return the sessions with every stimulus, which paper-code needs; note the others."""
    kept = []
    for session in sessions:
        missing = [name for name, n in zip(STIMULI, session.trials, strict=True) if not n]
        if missing:
            notes.append(
                f"session {session.name} left out: it has no correct trial of {', '.join(missing)}"
            )
        else:
            kept.append(session)
    if not kept:
        raise ConfigError(f"no session can be used: {name_some(notes, 1)}")
    return kept


def refuse_copies(sessions: Sequence[NeuralSession]) -> None:
    """Check that no session is given twice, even with another spike sorting or order.

    Two copies of a session would be split into the same halves and agree with each other perfectly.
    Two sessions are copies if they share, in any order, most of their trials (start time and
    stimulus), or most of their units (the sorted rates for each stimulus).
    """
    trials = [_count_trials(session) for session in sessions]
    units = [_count_units(session) for session in sessions]
    for j, later in enumerate(sessions):
        for i, earlier in enumerate(sessions[:j]):
            same_units = _share_most(units[i], units[j])
            if same_units or _share_most(trials[i], trials[j]):
                how = "" if same_units else " with other units"
                raise ConfigError(
                    f"sessions {earlier.name} and {later.name} hold the same trials{how}: "
                    "give one of them"
                )


def _share_most(one: Counter[bytes], other: Counter[bytes]) -> bool:
    """Return whether two counters share most items of the smaller counter."""
    fewer = min(one.total(), other.total())
    return fewer >= FEWEST and (one & other).total() > MOST * fewer


def _count_trials(session: NeuralSession) -> Counter[bytes]:
    """Count trials by start time, rounded to 1 ms, and stimulus; empty without times."""
    if session.begin is None:
        return Counter()
    began = np.round(session.begin * 1e3).astype(np.int64)
    return Counter(row.tobytes() for row in np.stack([began, session.stimulus], axis=1))


def _count_units(session: NeuralSession) -> Counter[bytes]:
    """Count units by their rates, sorted within stimuli; skip units with few distinct rates."""
    found: Counter[bytes] = Counter()
    for rates in session.rates.T:
        if len(np.unique(rates)) >= FEWEST:
            order = np.lexsort((rates, session.stimulus))
            found[session.stimulus[order].tobytes() + rates[order].tobytes()] += 1
    return found


def animal_means(path: Path) -> tuple[dict[str, NDArray[np.float64]], list[str]]:
    """Read the mean responses (6, unit) by animal, and notes on what was left out.

    Args:
        path: an NWB file, or a folder of NWB files; or an ``.npz`` of rates in the published
            layout, mistakes included (`neural.published_layout`).
    """
    if path.suffix == ".npz":
        return {name: trial_mean(rates) for name, rates in read_published(path).items()}, []
    sessions, notes = checked_sessions(find_nwb([path]))
    means = {}
    for animal in by_animal(sessions):
        whole = [s for s in animal.sessions if s.trials.min() > 0]
        if not whole:
            notes.append(f"animal {animal.name} left out: no session has every stimulus")
            continue
        means[animal.name] = np.concatenate(
            [
                np.stack([s.rates[s.stimulus == k].mean(axis=0) for k in range(len(STIMULI))])
                for s in whole
            ],
            axis=1,
        )
    return means, notes
