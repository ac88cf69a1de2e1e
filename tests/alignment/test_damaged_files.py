"""Recordings of which something is wrong: left out and named, or refused in a line."""

import json
import re
from collections import Counter
from datetime import datetime

import msgspec
import numpy as np
import pytest

from tactile_rt.alignment import load_benchmark
from tactile_rt.alignment.clock import CLOCKS
from tactile_rt.alignment.json_file import write_json
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.neural import read_published
from tactile_rt.alignment.nwb import WINDOWS, read_nwb, read_session
from tactile_rt.alignment.report import report_page
from tactile_rt.alignment.results import read_results, results_of, score_model
from tactile_rt.alignment.stimuli_input import SHIPPED, read_stimuli
from tactile_rt.alignment.strict import freeze_strict
from tactile_rt.core.errors import ConfigError
from tests.helpers import brains
from tests.helpers.nwb_sessions import changed_copy, write_session
from tests.helpers.refusals import refusal

h5py = pytest.importorskip("h5py", reason="h5py reads the files")


def nwb_bytes(folder):
    rng = np.random.default_rng(0)
    return write_session(folder / "a.nwb", rng, rng.uniform(1, 9, (6, 4)), trials=18).read_bytes()


def npz_bytes(folder):
    rng = np.random.default_rng(0)
    np.savez_compressed(folder / "a.npz", m=rng.uniform(0, 9, (8, 6, 5)), n=np.ones((9, 6, 3)))
    return (folder / "a.npz").read_bytes()


def read_nwb_file(path, k):
    read_session(path, WINDOWS[k % 2], clock=CLOCKS[k // 2 % 2])


def flips(folder, whole, read, name, number):
    """A file with a bit flipped, so many times."""
    rng = np.random.default_rng(0)
    path = folder / name
    for k in range(number):
        damaged = bytearray(whole)
        # HDF5 keeps what it says of its data in little of the file: every other flip is there.
        end = len(whole) if k % 2 else min(len(whole), 8192)
        damaged[rng.integers(end)] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        yield lambda k=k: read(path, k)


def outcome(read, name):
    """How reading ends, where a line that names the file is the only error allowed."""
    try:
        read()
    except ConfigError as error:
        return "refused" if name in str(error) and "\n" not in str(error) else "many lines"
    except BaseException as error:
        return repr(error)
    return "read"


FILES = pytest.mark.parametrize(
    ("made", "read", "name"),
    [
        (nwb_bytes, read_nwb_file, "b.nwb"),
        (npz_bytes, lambda path, k: read_published(path), "b.npz"),
    ],
)


@FILES
def test_a_flipped_bit_is_read_or_refused_in_a_line(tmp_path, made, read, name):
    found = Counter(outcome(one, name) for one in flips(tmp_path, made(tmp_path), read, name, 60))
    assert set(found) == {"read", "refused"}, found


@FILES
def test_a_file_that_ends_early_is_refused_in_a_line(tmp_path, made, read, name):
    whole = made(tmp_path)
    for length in np.linspace(0, len(whole) - 1, 25, dtype=int):
        (tmp_path / name).write_bytes(whole[:length])
        assert name in refusal(read, tmp_path / name, 0)


UNITS, TRIALS = 4, 30


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("spikes") / "whole.nwb"
    rng = np.random.default_rng(4)
    return write_session(path, rng, rng.uniform(4, 12, (6, UNITS)), trials=TRIALS)


def units_of(change, *which):
    """Change the spike times of some units, whose number of spikes may change."""

    def changed(file):
        ends = file["units/spike_times_index"][()]
        parts = np.split(file["units/spike_times"][()], ends[:-1])
        parts = [change(t) if k in which else t for k, t in enumerate(parts)]
        del file["units/spike_times"], file["units/spike_times_index"]
        file["units/spike_times"] = np.concatenate(parts)
        file["units/spike_times_index"] = np.cumsum([len(t) for t in parts])

    return changed


def trials(**columns):
    def changed(file):
        for name, change in columns.items():
            data = file[f"intervals/trials/{name}"]
            data[:TRIALS] = change(data[:TRIALS])

    return changed


def same_as_first(file):
    first = file["units/spike_times"][: file["units/spike_times_index"][0]]
    units_of(lambda t: first, 2)(file)


def put(index, value):
    def changed(values):
        values[index] = value
        return values

    return changed


def reset(times):
    half = len(times) // 2
    return np.r_[times[:half], times[half:] - times[half] + 0.01]


UNUSABLE = {  # what the note says, and the units and trials that are left
    "reset": (units_of(reset, 1), r"1 of 4 units left out \(1\): their spike times go back", 3, 30),
    "backwards": (units_of(lambda t: t[::-1], 0, 3), r"2 of 4 .*\(0, 3\).*go back", 2, 30),
    "negative": (units_of(lambda t: t - 5000, 0, 1), r"\(0, 1\): their spikes end before", 2, 30),
    "late": (units_of(lambda t: t + 5000, 2), r"\(2\): their spikes lie outside", 3, 30),
    "ms": (units_of(lambda t: 1e3 * t, 2), r"\(2\): their spikes lie .* ms", 3, 30),
    "half away": (
        units_of(lambda t: np.where(np.arange(len(t)) < len(t) / 2, t - 5000, t), 3),
        r"\(3\): their spikes lie outside", 3, 30,
    ),
    "a spike away": (
        units_of(lambda t: np.r_[t, 1e6], 1), r"1 spikes far from .* \(unit 1\)", 4, 30
    ),
    "a few before": (
        units_of(lambda t: np.r_[-0.5, -0.3, t], 1), r"2 spikes .* before 0 s \(unit 1\)", 4, 30
    ),
    "doubled": (units_of(lambda t: np.repeat(t, 2), 1), r"spikes counted once.* \(unit 1\)", 4, 30),
    "no spikes": (units_of(lambda t: t[:0], 1, 2), r"2 of 4 units left out \(1, 2\): no sp", 2, 30),
    "no times": (
        units_of(lambda t: t * np.nan, 1), r"spikes left out: .* no times \(unit 1\)", 3, 30
    ),
    "the same unit": (same_as_first, r"1 of 4 .*\(2\): the spikes of unit 0 again", 3, 30),
    "spikes end": (
        units_of(lambda t: t[t < 100], *range(UNITS)), r"\(24, .*\): no unit has a", 4, 24
    ),
    "a trial at 0": (trials(start_time=put(20, 0.0)), r"1 of 30 .*\(20\): start_time goes", 4, 29),
    "a trial early": (
        trials(start_time=put(20, 5.0), choice_time=put(20, 7.0)), r"\(20\): start_time goes", 4, 29
    ),
    "a trial too long": (
        trials(choice_time=put(7, 190.0)), r"\(7\): start_time goes", 4, 29
    ),
    "no length": (
        trials(choice_time=lambda t: put(4, t[4] - 3)(t)), r"\(4\): (no contact|choice)", 4, 29
    ),
    "no time": (trials(start_time=put([3, 9], np.nan)), r"\(3, 9\): choice_time is not", 4, 28),
    "trials reset": (
        trials(start_time=lambda t: np.r_[t[:15], t[15:] - t[15] + 7],
               choice_time=lambda t: np.r_[t[:15], t[15:] - 6.5 * 15 + 1]),
        r"\(15, 16, 17, 18, 19, \.\.\.\): start_time goes back", 4, 15,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", UNUSABLE)
def test_what_cannot_be_averaged_is_left_out_and_named(session, tmp_path, name):
    change, note, units, left = UNUSABLE[name]
    made = read_session(changed_copy(session, tmp_path / "odd.nwb", change))
    whole = read_session(session)
    assert not whole.notes and whole.session.rates.shape == (TRIALS, UNITS)
    assert [n for n in made.notes if re.search("^session odd: .*" + note, n)], made.notes
    assert made.session.rates.shape == (left, units)
    rows = np.isin(whole.session.begin, made.session.begin)
    kept = np.isin(whole.session.depth, made.session.depth)
    if rows.sum() == left and name not in ("spikes end", "a few before"):
        np.testing.assert_array_equal(made.session.rates, whole.session.rates[rows][:, kept])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (units_of(reset, *range(UNITS)), "no unit can be used; .*4 of 4 .* go back"),
        (units_of(lambda t: 1e3 * t, *range(UNITS)), "no unit can be used; .* ms"),
        (units_of(lambda t: t[:0], *range(UNITS)), "no unit can be used; .* no spikes"),
        (units_of(lambda t: t[(t - 5.91) % 6.5 > 4], *range(UNITS)), "no spike of 4 units falls"),
        (trials(start_time=lambda t: 0 * t), "no trial is left .* start_time goes back|choice"),
        (trials(choice_time=lambda t: t * np.nan), "no trial is left .* choice_time is not"),
    ],
)
def test_a_session_of_which_nothing_is_left_is_refused(session, tmp_path, change, why):
    path = changed_copy(session, tmp_path / "odd.nwb", change)
    said = refusal(read_session, path)
    assert re.search(why, said) and len(said.removeprefix(str(path))) < 220
    readings, notes = read_nwb([session, path])
    assert len(readings) == 1 and notes[0].startswith("session odd left out: ")


FELT = read_stimuli()
DEEP = 100_000


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """A file of scores of two models."""
    rng = np.random.default_rng(1)
    shared = brains.geometry(rng)
    benchmark = freeze_strict(brains.animals(rng, 3, shared=shared), 10)
    made = []
    for masking in (0.0, 0.5):
        traces = {"encoder.0": brains.responses(rng, shared, 20)[:, None].astype(np.float32)}
        logits = np.zeros((6, 1, 2), np.float32)
        of = {"masking": masking}
        layers = Layers("model", traces, {"encoder.0": 0}, logits, 1, training=of)
        made.append(score_model(benchmark, layers, layers))
    path = tmp_path_factory.mktemp("scores") / "scores.json"
    write_json(results_of(benchmark, FELT, made), path)
    assert "0.5" in report_page(read_results(path))
    return path


@pytest.mark.parametrize("read", [load_benchmark, read_results])
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe{}",
        b'{"kind": "\xff", "schema": 2, "protocol": "\xff"}',
        b"[" * DEEP,
        b'{"schema": 2, "x": ' + b"[" * DEEP + b"]" * DEEP + b"}",
    ],
    ids=["nothing", "no UTF-8", "no UTF-8 in a text", "deep", "deep within"],
)
def test_what_is_no_json_of_ours_is_refused_in_a_line(tmp_path, read, content):
    path = tmp_path / "odd.json"
    path.write_bytes(content)
    assert "odd.json" in refusal(read, path)


@pytest.mark.parametrize(
    "place, value",
    [
        (("kind",), "tactile_rt alignment scores 1"),
        (("benchmark", "targets", 0, "chosen", "rdm"), []),
        (("benchmark", "a2a", "animals"), ["nobody"]),
        (("benchmark", "a2a", "pooled", 0), 1e308),
        (("benchmark", "stimuli"), ["a"]),
        (("raw", "layers"), ["x"]),
        (("raw", "corrected"), []),
        (("raw", "rdms"), [0.5]),
        (("models", 0, "chosen"), []),
        (("models", 1, "units"), []),
        (("models", 1, "untrained", "corrected"), [[]]),
    ],
)
def test_scores_whose_tables_cannot_be_drawn_are_refused(scores, tmp_path, place, value):
    found = json.loads(scores.read_bytes())
    inside = found
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    (tmp_path / "odd.json").write_text(json.dumps(found))
    assert "odd.json" in refusal(read_results, tmp_path / "odd.json")


def test_a_share_of_masking_that_is_no_number_is_not_compared(scores):
    read = read_results(scores)
    odd = [msgspec.structs.replace(m, groups={"masking": "much"}) for m in read.models]
    drawn = report_page(msgspec.structs.replace(read, models=(*odd, read.models[0])))
    assert "With and without masking" not in drawn


@pytest.mark.parametrize(
    "name, value",
    [
        ("stimuli", np.array("convex-close")),
        ("channels", np.zeros((2, 3))),
        ("values", np.full((6, 110, 30, 6), "a")),
        ("values", np.full((6, 110, 30, 6), 1e300)),
        ("values", np.full((6, 110, 30, 6), datetime(2020, 1, 1), "M8[s]")),
    ],
)
def test_an_input_of_other_types_is_refused_in_a_line(tmp_path, name, value):
    np.savez(tmp_path / "odd.npz", **dict(np.load(SHIPPED)) | {name: value})
    assert "odd.npz" in refusal(read_stimuli, tmp_path / "odd.npz")
