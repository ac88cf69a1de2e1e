"""The clock of the spikes: contacts say which is right, whichever way a file is wrong."""

import numpy as np
import pytest

from tactile_rt.alignment import build
from tactile_rt.alignment.clock import AFTER, BEFORE, contact_response
from tactile_rt.alignment.neural import by_animal
from tactile_rt.alignment.nwb import find_nwb, read_nwb
from tactile_rt.alignment.strict import freeze_strict
from tests.helpers.nwb_sessions import ORIGIN_S, write_animals
from tests.helpers.refusals import refusal

pytest.importorskip("h5py", reason="h5py reads the files")


@pytest.fixture(scope="module")
def as_published(tmp_path_factory):
    """Spikes on the session's clock, none before the recording begins."""
    return write_animals(tmp_path_factory.mktemp("as_published"), seed=3, number=4)


@pytest.fixture(scope="module")
def mistaken(tmp_path_factory):
    """Spikes late by what the published analysis subtracts."""
    return write_animals(tmp_path_factory.mktemp("mistaken"), seed=3, number=4, late=ORIGIN_S)


def reliable(folder, clock):
    readings, _ = read_nwb(find_nwb([folder]), clock=clock)
    made = freeze_strict(by_animal([r.session for r in readings]), 50)
    return len(made.reliable)


def test_animals_are_reliable_on_the_right_clock_alone(as_published):
    assert reliable(as_published, "session") == 4
    assert reliable(as_published, "recording") == 0


def test_a_build_says_what_it_found(as_published):
    note = build([as_published], bootstraps=50).notes[0]
    assert note.startswith("spikes on the session's clock (offset 0 s): ")
    assert "they rise in 4 of 4 sessions" in note
    latency = float(note.split("latency ")[1].split(" ms")[0])
    assert latency == pytest.approx(6, abs=1.5)


def test_strict_refuses_the_wrong_clock_and_names_the_right_offset(as_published, mistaken):
    for folder, clock, right in ((as_published, "recording", 0.0), (mistaken, "session", ORIGIN_S)):
        said = refusal(build, [folder], bootstraps=5, clock=clock)
        assert "rates do not rise after contact" in said
        assert "in 4 of 4 sessions another offset fits contacts better" in said
        offset = float(said.split(") if ")[1].split(" s is subtracted")[0])
        assert offset == pytest.approx(right, abs=0.02)
    assert len(build([mistaken], bootstraps=50, clock="recording").reliable) == 4


def test_paper_code_keeps_the_published_shift_and_says_so_loudly(as_published):
    made = build([as_published], "paper-code", bootstraps=50)
    first, second = made.notes[:2]
    assert first.startswith("WARNING: spikes shifted by the starting time (10.03 s), as published")
    assert second.startswith("WARNING: in 4 of 4 sessions another offset fits contacts better")
    right = build([as_published], "paper-code", bootstraps=50, clock="session")
    assert not right.notes[0].startswith("WARNING")


def test_one_session_on_another_clock_leaves_itself_out(as_published, mistaken):
    files = [*sorted(as_published.glob("*.nwb"))[:3], sorted(mistaken.glob("*.nwb"))[3]]
    made = build(files, bootstraps=50)
    assert [t.name for t in made.targets] == ["mouse-0", "mouse-1", "mouse-2"]
    assert made.notes[1].endswith("left out: sub-3_ses-0_behavior+ecephys")


@pytest.mark.parametrize("seed", range(20))
def test_chance_is_no_rise(seed):
    """Spikes that know nothing of contacts, at rates that change with the trials."""
    rng = np.random.default_rng(seed)
    begin = 10 * np.arange(60) + rng.uniform(2, 4, 60)
    contacts = np.sort(np.concatenate([begin, rng.uniform(0, 600, 40)]))
    busy = [np.sort(rng.uniform(0, 600, 3000)) for _ in range(10)]
    busy = [t[rng.random(len(t)) < 0.5 + 0.4 * np.sin(2 * np.pi * t / 10)] for t in busy]
    found = contact_response("s", busy, contacts)
    assert not found.rises
    assert not found.elsewhere


def test_the_figures_are_those_of_a_plain_count():
    rng = np.random.default_rng(0)
    contacts = 1 + 0.7 * np.arange(50) + rng.uniform(0, 0.4, 50)
    spikes = [np.sort(np.append(rng.uniform(0, 37, 200), contacts + 0.0105)) for _ in range(3)]
    found = contact_response("s", spikes, contacts)

    def rate(low, high):
        n = sum(((t >= c + low) & (t < c + high)).sum() for t in spikes for c in contacts)
        return n / (3 * 50 * (high - low))

    assert found.rate_hz(BEFORE) == pytest.approx(rate(-0.040, -0.003), abs=0.2)
    assert found.rate_hz(AFTER) == pytest.approx(rate(0.003, 0.040), abs=0.2)
    assert found.latency_s == pytest.approx(0.0105, abs=0.0015)
    assert found.rises and not found.elsewhere


def test_without_contacts_or_spikes_there_is_nothing_to_tell_by():
    some = np.array([1.0, 2.0])
    assert contact_response("s", [some], np.empty(0)) is None
    assert contact_response("s", [], some) is None
    assert contact_response("s", [some], np.array([1.0, 1e9])) is None
