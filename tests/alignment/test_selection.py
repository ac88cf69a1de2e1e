"""What a benchmark is made of: by task, session, depth and cell type; and nothing twice."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.alignment import build
from tactile_rt.alignment.building import refuse_copies
from tactile_rt.alignment.neural import NeuralSession
from tactile_rt.alignment.nwb import read_nwb, read_session
from tactile_rt.alignment.selection import Selection
from tactile_rt.core.errors import ConfigError
from tests.helpers import brains
from tests.helpers.nwb_sessions import changed_copy, write_animals

h5py = pytest.importorskip("h5py", reason="h5py reads the files")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two animals of each task, a session each; 24 units from 100 to 1000 um."""
    folder = tmp_path_factory.mktemp("both")
    for task in ("discrimination", "detection"):
        (folder / task).mkdir()
        write_animals(folder / task, seed=len(task), number=2, units=24, task=task)
        for path in (folder / task).glob("sub-*"):
            path.rename(folder / f"{path.stem.replace('sub-', f'sub-{task[:3]}')}.nwb")
    for path in folder.glob("sub-det*"):
        with h5py.File(path, "r+") as file:
            name = file["general/subject/subject_id"][()].decode()
            file["general/subject/subject_id"][()] = f"{name}-detects"
    return folder


def files(folder):
    return sorted(folder.glob("*.nwb"))


def remove(name):
    return lambda file: file.__delitem__(name)


def test_by_task_session_depth_and_cells(folder):
    for asked, sessions, units in (
        ({}, 4, 24),
        ({"task": "detection"}, 2, 24),
        ({"sessions": ["sub-dis0_*"]}, 1, 24),
        ({"depth": "L4"}, 4, 5),
        ({"depth": "l23"}, 4, 8),
        ({"depth": "419-626", "cells": "inhibitory"}, 4, 1),
        ({"cells": "excitatory"}, 4, 18),
    ):
        selection = Selection.of(**asked)
        readings, notes = read_nwb(files(folder), selection=selection)
        assert len(readings) == sessions, asked
        assert {r.session.rates.shape[1] for r in readings} == {units}, asked
        whole = read_session(files(folder)[0]).session
        for reading in readings:
            assert len(reading.session.depth) == len(reading.session.inhibitory) == units
        if asked:
            assert notes[0].startswith(f"selected: {selection}: {sessions} of 4 sessions")
        if "L4" in asked.values():
            kept = (whole.depth >= 419) & (whole.depth < 626)
            made = read_session(files(folder)[0], selection=selection).session
            np.testing.assert_array_equal(made.rates, whole.rates[:, kept])


def test_the_task_is_known_without_a_description(folder, tmp_path):
    for source, task in zip(files(folder)[::2], ("detection", "discrimination"), strict=True):
        untold = changed_copy(
            source, tmp_path / source.name, remove("general/experiment_description")
        )
        assert read_session(untold).task == task


def test_two_tasks_together_are_noted(folder):
    made = build([folder], bootstraps=50)
    assert len(made.targets) == 4
    assert any("two tasks are together, 2 of detection and 2 of discrim" in n for n in made.notes)
    one = build([folder], bootstraps=50, selection=Selection.of("detection"))
    assert [t.name for t in one.targets] == ["mouse-0-detects", "mouse-1-detects"]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"task": "touch"}, "no task 'touch': there are discrimination, detection"),
        ({"cells": "pyramidal"}, "no cell type 'pyramidal'"),
        ({"depth": "L9"}, "neither a layer .* nor a range in um"),
        ({"depth": "600-400"}, "neither a layer"),
    ],
)
def test_what_cannot_be_selected(asked, said):
    with pytest.raises(ConfigError, match=said):
        Selection.of(**asked)


def test_what_nothing_is_left_of(folder, tmp_path):
    with pytest.raises(ConfigError, match="none of 4 sessions has units that match: nosuch"):
        read_nwb(files(folder), selection=Selection.of(sessions=["nosuch"]))
    path = changed_copy(files(folder)[0], tmp_path / "a.nwb", remove("units/depth"))
    with pytest.raises(ConfigError, match=r"a\.nwb: has no column units/depth to select by"):
        read_nwb([path], selection=Selection.of(depth="L4"))


@pytest.mark.parametrize("odd", [np.nan, 2.0])
def test_a_unit_that_is_neither_of_two_types_is_not_taken_for_excitatory(folder, tmp_path, odd):
    path = tmp_path / "a.nwb"
    path.write_bytes(files(folder)[0].read_bytes())
    with h5py.File(path, "r+") as file:
        kinds = file["units/inhibitory"][()].astype(float)
        kinds[2] = odd
        del file["units/inhibitory"]
        file["units/inhibitory"] = kinds
    (reading,), notes = read_nwb([path])
    assert reading.session.inhibitory is None and reading.session.rates.shape[1] == len(kinds)
    said = f"are neither 0 nor 1, unit 2 is {odd:g}"
    assert [note for note in notes if said in note] and "1 of" in " ".join(notes)
    with pytest.raises(ConfigError, match="no column units/inhibitory of 0 and 1 to select by"):
        read_nwb([path], selection=Selection.of(cells="excitatory"))


# Copies


@pytest.fixture(scope="module")
def session():
    rng = np.random.default_rng(0)
    return brains.session(rng, "a", "one", brains.geometry(rng), trials=8, units=9)


def also(session, **changes):
    return replace(session, **{"name": "two", **changes})


def test_a_copy_is_recognised_in_any_order_and_with_a_unit_less(session):
    rng = np.random.default_rng(1)
    order, units = rng.permutation(len(session.rates)), rng.permutation(9)
    shuffled = also(session, rates=session.rates[order][:, units], stimulus=session.stimulus[order])
    fewer = also(session, rates=session.rates[:, :-1])
    for copy in (also(session), shuffled, fewer):
        with pytest.raises(ConfigError, match="sessions one and two hold the same trials: give"):
            refuse_copies([session, copy])


def test_another_sorting_of_the_same_trials_is_a_copy(session):
    rng = np.random.default_rng(2)
    first = replace(session, begin=np.arange(48.0) * 7)
    sorted_again = also(first, rates=rng.uniform(0, 30, (48, 12)))
    with pytest.raises(ConfigError, match="the same trials with other units: give one"):
        refuse_copies([first, sorted_again])
    a_trial_less = also(
        sorted_again, rates=sorted_again.rates[1:], stimulus=first.stimulus[1:],
        begin=first.begin[1:],
    )  # fmt: skip
    with pytest.raises(ConfigError, match="with other units"):
        refuse_copies([first, a_trial_less])
    another = also(sorted_again, begin=first.begin + 0.1)
    refuse_copies([first, another])


def test_sessions_of_few_spikes_are_no_copies():
    """Rates that are mostly 0 and 1 of two sessions are not each other's."""
    rng = np.random.default_rng(3)
    stimulus = np.repeat(np.arange(6), 20)
    made = [
        NeuralSession("a", f"{k}", rng.poisson(0.3, (120, 30)).astype(float), stimulus)
        for k in range(4)
    ]
    refuse_copies(made)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"stimulus": np.full(48, -1)}, "stimuli must be numbers from 0 to 5"),
        ({"rates": np.full((48, 9), np.nan)}, "a rate is not finite"),
        ({"rates": np.zeros((47, 9))}, ".* rates need a stimulus"),
        ({"depth": np.zeros(3)}, r"depth is \(3,\), not \(9,\)"),
        ({"course": np.zeros((48, 22, 3))}, "course is .* not .trial, bin, unit"),
        ({"begin": np.zeros(3)}, r"begin is \(3,\), not \(48,\)"),
    ],
)
def test_a_session_that_does_not_fit_is_refused(session, changes, said):
    with pytest.raises(ConfigError, match=f"session one: {said}"):
        replace(session, **changes)
