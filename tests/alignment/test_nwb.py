"""The h5py reader against pynwb, on files that pynwb wrote, and every way a file can be wrong."""

import re
from datetime import UTC, datetime
from functools import partial

import numpy as np
import pynwb
import pytest

from tactile_rt.alignment import build, nwb
from tactile_rt.alignment.clock import CLOCKS
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI
from tests.helpers.nwb_sessions import changed_copy
from tests.helpers.refusals import refusal

ORIGIN = 10.03  # s, when the electrical recording began
STRINGS = ("outcome", "stimulus", "servo_position")


def write(path, rng, trials=60, units=5, animal="mouse", tuned=None):
    """A session in the layout of the published files."""
    file = pynwb.NWBFile(
        session_description="a session",
        identifier=str(path),
        session_start_time=datetime(2020, 1, 1, tzinfo=UTC),
        experiment_description="whisker-based shape discrimination",
    )
    file.subject = pynwb.file.Subject(subject_id=animal, species="Mus musculus", age="P90D")
    device = file.create_device("probe")
    group = file.create_electrode_group("shank", "one", "S1", device)
    file.add_electrode(group=group, location="S1")
    file.add_acquisition(
        pynwb.ecephys.ElectricalSeries(
            name="extracellular array recording",
            data=np.zeros((10, 1)),
            electrodes=file.create_electrode_table_region([0], "all"),
            starting_time=ORIGIN,
            rate=30000.0,
        )
    )
    for name in ("choice_time", "outcome", "stimulus", "servo_position", "ignore_trial"):
        file.add_trial_column(name, name)
    shown = rng.permutation(np.resize(np.arange(6), trials))
    begin = 5 + 10.0 * np.arange(trials)
    choice = begin + rng.uniform(1.5, 3, trials)
    contact = begin + rng.uniform(0.2, 1, trials)
    written = contact.copy()
    written[3] = begin[3] - 0.4  # before the trial: it has none of its own
    written[6] = choice[6] + 0.01  # too late
    for k, (s, b, c) in enumerate(zip(shown, begin, choice, strict=True)):
        shape, place = STIMULI[s].split("-")
        file.add_trial(
            start_time=b,
            stop_time=b + 10,
            choice_time=c,
            outcome="error" if k == 1 else "spoil" if k == 2 else "correct",
            stimulus="nothing" if k == 4 else shape,
            servo_position=place,
            ignore_trial=k == 5,
        )
    for name in ("depth", "inhibitory"):
        file.add_unit_column(name, name)
    for unit in range(units):
        rate = rng.uniform(2, 20, 6) if tuned is None else tuned[:, unit]
        spikes = [
            np.concatenate(
                [
                    rng.uniform(c, b, rng.poisson((b - c) * rate[s])),
                    rng.uniform(c + 0.005, c + 0.03, rng.poisson(0.25 * rate[s])),
                    rng.uniform(b, e, rng.poisson((e - b) * rate.mean() / 3)),
                ]
            )
            for s, c, b, e in zip(shown, contact, choice, begin + 9, strict=True)
        ]
        # Ragged, and one unit that never fires. The recording begins late, and spikes with it.
        times = np.sort(np.concatenate(spikes)) if unit != 1 else np.empty(0)
        file.add_unit(
            spike_times=times[times > ORIGIN],
            depth=100.0 + 100 * unit,
            inhibitory=unit % 4 == 3,
        )
    behavior = file.create_processing_module("behavior", "whiskers")
    for w in range(2):
        angle = pynwb.behavior.SpatialSeries(
            name="angle",
            data=np.zeros(4),
            timestamps=[0.0, 1.0, 2.0, begin[-1] + 20],
            reference_frame="face",
            unit="degrees",
        )
        behavior.add(
            pynwb.behavior.CompassDirection(
                spatial_series=angle, name=f"processed_position_whisker_C{w}"
            )
        )
        table = pynwb.epoch.TimeIntervals(name=f"contacts_by_whisker_C{w}", description="touches")
        for t in written[w::2]:
            table.add_interval(start_time=t, stop_time=t + 0.02)
            table.add_interval(start_time=t + 0.1, stop_time=t + 0.12)
        behavior.add(table)
    with pynwb.NWBHDF5IO(path, "w") as io:
        io.write(file)
    return path


def through_pynwb(path, window, clock):
    """Rates and stimuli as section 'Definitions' has them, from what pynwb reads."""
    with pynwb.NWBHDF5IO(path, "r") as io:
        file = io.read()
        trials = file.trials.to_dataframe()
        tables = file.processing["behavior"].data_interfaces.items()
        touches = [t["start_time"][:] for name, t in tables if name.startswith("contacts")]
        touches = np.sort(np.concatenate(touches))
        origin = file.acquisition["extracellular array recording"].starting_time
        origin = origin if clock == "recording" else 0.0
        spikes = [np.asarray(t) - origin for t in file.units.to_dataframe()["spike_times"]]
    rates, shown = [], []
    for _, trial in trials.iterrows():
        if trial.ignore_trial or trial.outcome != "correct" or trial.stimulus == "nothing":
            continue
        start, stop = trial.start_time, trial.choice_time
        if window == "contact":
            own = [t for t in touches if start <= t < stop]
            if not own:
                continue
            start = own[0]
        bins = len(np.arange(start, stop + 0.045, 0.045)) - 1
        rates.append([((t >= start) & (t < stop)).sum() / (bins * 0.045) for t in spikes])
        shown.append(STIMULI.index(f"{trial.stimulus}-{trial.servo_position}"))
    return np.array(rates), np.array(shown)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nwb")
    return write(folder / "sub-7_ses-1_behavior+ecephys+image.nwb", np.random.default_rng(0))


@pytest.fixture
def broken(session, tmp_path):
    """A copy to break: `broken(change)` gives its path after `change(h5py file)`."""
    return partial(changed_copy, session, tmp_path / "broken.nwb")


@pytest.mark.parametrize("clock", CLOCKS)
@pytest.mark.parametrize("window", nwb.WINDOWS)
def test_rates_are_those_of_what_pynwb_reads(session, window, clock):
    made, notes, *_ = nwb.read_session(session, window, clock=clock)
    rates, shown = through_pynwb(session, window, clock)
    assert not rates[:, 1].any()
    rates = np.delete(rates, 1, axis=1)
    np.testing.assert_allclose(made.rates, rates, rtol=0, atol=1e-12)
    assert made.stimulus.tolist() == shown.tolist()
    assert (made.animal, made.name) == ("mouse", session.stem)
    assert len(rates) == {"contact": 54, "start": 56}[window]
    assert made.rates[:, 0].mean() > 1
    assert notes[-1].endswith("1 of 5 units left out (1): no spikes")
    assert len(notes) == 1 + (window == "contact")
    assert all("2 of 56 correct trials left out (3, 6): no contact before" in n for n in notes[:-1])


def replace(file, name, values, **kwargs):
    attributes = dict(file[name].attrs)
    del file[name]
    file.create_dataset(name, data=values, **kwargs).attrs.update(attributes)


def test_strings_may_be_bytes(session, broken):
    def as_bytes(file):
        for name in STRINGS:
            column = f"intervals/trials/{name}"
            replace(file, column, np.array(file[column][()].tolist(), dtype="S10"))
        replace(file, "intervals/trials/ignore_trial",
                file["intervals/trials/ignore_trial"][()].astype(np.uint8))  # fmt: skip

    expected, made = (nwb.read_session(p).session for p in (session, broken(as_bytes)))
    np.testing.assert_array_equal(made.rates, expected.rates)
    np.testing.assert_array_equal(made.stimulus, expected.stimulus)


def test_a_file_without_a_subject_is_named_by_its_file(broken):
    path = broken(lambda f: f.__delitem__("general/subject"))
    assert nwb.read_session(path).session.animal == "broken"


def test_spikes_that_a_sorter_left_out_of_order_count_alike(session, broken):
    def shuffle(file):
        times, ends = file["units/spike_times"], file["units/spike_times_index"][()]
        values = times[()]
        near = np.flatnonzero(np.diff(values[: ends[0]]) < 0.009)[::2]
        near = near[np.diff(near, prepend=-2) > 1]
        values[near], values[near + 1] = values[near + 1], values[near]
        assert (np.diff(values[: ends[0]]) < 0).sum() > 9
        times[...] = values

    made, whole = nwb.read_session(broken(shuffle)), nwb.read_session(session)
    np.testing.assert_array_equal(made.session.rates, whole.session.rates)
    assert len(made.notes) == len(whole.notes)


def late_contact(file):
    file["processing/behavior/contacts_by_whisker_C1/start_time"][-1] = 5000.0


def late_without_timestamps(file):
    late_contact(file)
    angle = file["processing/behavior/processed_position_whisker_C1/angle"]
    del angle["timestamps"]
    angle["starting_time"] = 0.0
    angle["starting_time"].attrs["rate"] = 2.0


def no_contacts(file):
    for w in range(2):
        del file[f"processing/behavior/contacts_by_whisker_C{w}"]


def set_column(name, row, value):
    def change(file):
        values = file[f"intervals/trials/{name}"][()]
        values[row] = value
        replace(file, f"intervals/trials/{name}", values)

    return change


def drop(*names):
    def change(file):
        for name in names:
            del file[name]

    return change


PITFALLS = {
    "columns": (
        drop("intervals/trials/servo_position", "intervals/trials/choice_time"),
        r"intervals/trials lacks the columns choice_time, servo_position \(it has .*outcome",
    ),
    "no trials": (drop("intervals/trials"), "has no intervals/trials"),
    "no units": (drop("units"), "has no units/spike_times: is this a session with spikes"),
    "no index": (drop("units/spike_times_index"), "has no units/spike_times_index"),
    "ragged": (
        lambda f: replace(f, "units/spike_times_index", f["units/spike_times_index"][()] + 9),
        "spike_times_index does not divide the .* spike times: it has 5 units and ends at",
    ),
    "index of text": (
        lambda f: replace(f, "units/spike_times_index", np.array([b"a"] * 5)),
        "does not divide",
    ),
    "lengths": (
        lambda f: replace(f, "intervals/trials/outcome", f["intervals/trials/outcome"][:-1]),
        "columns of intervals/trials differ in length: .*'outcome': 59",
    ),
    "a column that is none": (
        lambda f: replace(f, "intervals/trials/outcome", np.zeros((60, 2))),
        "outcome is not a column of values",
    ),
    "a column without end": (
        lambda f: (
            drop("units/spike_times")(f),
            f.create_dataset("units/spike_times", (1 << 40,), "f8", chunks=(1024,)),
        ),
        "has 1099511627776 values, more than a session can have",
    ),
    "no contacts": (no_contacts, "without them, use protocol paper-code"),
    "contacts without times": (
        drop("processing/behavior/contacts_by_whisker_C0/start_time"),
        "contacts_by_whisker_C0 lacks the column start_time",
    ),
    "text for times": (
        lambda f: replace(f, "intervals/trials/choice_time", f["intervals/trials/outcome"][()]),
        "choice_time is object, not times in seconds",
    ),
    "ignore": (
        lambda f: replace(f, "intervals/trials/ignore_trial", np.full(60, 0.5)),
        "ignore_trial is float64, not true or false",
    ),
    "nothing left": (
        lambda f: replace(f, "intervals/trials/ignore_trial", np.full(60, True)),
        "no trial is left in intervals/trials: correct, not ignored, convex or concave",
    ),
}


@pytest.mark.parametrize(("change", "message"), PITFALLS.values(), ids=PITFALLS.keys())
def test_a_wrong_file_is_named_in_one_line(broken, change, message):
    said = refusal(nwb.read_session, broken(change))
    assert "broken.nwb" in said and re.search(message, said)


def test_the_published_shift_needs_a_starting_time(broken):
    path = broken(drop("acquisition"))
    assert len(nwb.read_session(path).session.rates) == 54
    with pytest.raises(ConfigError, match="no electrical recording with a starting_time"):
        nwb.read_session(path, clock="recording")


SMALL_FAULTS = {  # and how many of 54 trials are left
    "late contact": (
        late_contact,
        r"1 of 60 contacts in contacts_by_whisker_C1 left out: 5000\.000 s .* 615\.000 s",
        54,
    ),
    "late contact, rate": (late_without_timestamps, r"60 of 60 .* whiskers, 1\.500 s", 27),
    "servo": (set_column("servo_position", 9, b"afar"), r"1 of 56 .*\(9\): servo_position", 53),
    "choice": (set_column("choice_time", 9, 0.0), r"\(9\): choice_time is not after start", 53),
    "a choice years later": (set_column("choice_time", 9, 1e200), r"\(9\): choice_time is not", 53),
    "ignore": (
        lambda f: replace(f, "intervals/trials/ignore_trial", np.r_[np.zeros(59, int), 7]),
        r"1 of 57 correct trials left out \(59\): ignore_trial is neither true nor false",
        54,
    ),
    "no spike": (
        lambda f: f["units/spike_times"].__setitem__(0, np.nan),
        r"1 of .* spikes left out: their times are no times \(unit 0\)",
        54,
    ),
    "depth": (
        lambda f: replace(f, "units/depth", np.zeros(4)),
        "units/depth left out: it is not a number for each of 5 units",
        54,
    ),
}


@pytest.mark.parametrize(("change", "message", "left"), SMALL_FAULTS.values(), ids=SMALL_FAULTS)
def test_a_trial_a_contact_or_a_spike_is_left_out_alone(broken, change, message, left):
    made = nwb.read_session(broken(change))
    assert len(made.session.rates) == left
    notes = [note for note in made.notes if re.search(message, note)]
    assert len(notes) == 1, made.notes
    assert notes[0].startswith("session broken: ")


def test_a_session_that_cannot_be_read_is_left_out_alone(folder, tmp_path):
    files = sorted(folder.glob("*.nwb"))
    (tmp_path / "text.nwb").write_text("hello")
    made = build([*files, tmp_path / "text.nwb"], bootstraps=50)
    assert [t.name for t in made.targets] == ["a", "b"]
    assert any(re.match(r"session text left out: text\.nwb: cannot be", n) for n in made.notes)


def test_units_have_their_columns_and_rates_their_course(session):
    made = nwb.read_session(session).session
    assert made.depth.tolist() == [100, 300, 400, 500]  # the second has no spikes
    assert made.inhibitory.tolist() == [False, False, True, False]
    assert made.course.shape == (54, 22, 4)
    # The course of a trial adds up to its rate, but for the bin that the choice falls into.
    there = np.isfinite(made.course[:, :, 0])
    assert (np.diff(there.astype(int), axis=1) <= 0).all()
    spikes = np.nansum(made.course[:, :, 0], axis=1) * nwb.BIN_S
    whole = ~there[:, -1]  # the choice is within the course
    all_spikes = made.rates[:, 0] * (there.sum(axis=1) + 1) * nwb.BIN_S
    assert whole.any()
    missing = (all_spikes - spikes)[whole]
    assert (missing > -1e-9).all()
    np.testing.assert_allclose(missing, np.round(missing), atol=1e-9)


def test_the_last_contact_may_be_on_the_last_timestamp(broken):
    contacts = "processing/behavior/contacts_by_whisker_C1/start_time"
    nwb.read_session(broken(lambda f: f[contacts].__setitem__(-1, 615.0)))


def test_a_folder_gives_the_files_with_spikes(tmp_path):
    for name in ("b_behavior+ecephys+image.nwb", "a_behavior+image.nwb", "notes.txt"):
        (tmp_path / name).touch()
    assert [f.name for f in nwb.find_nwb([tmp_path])] == ["b_behavior+ecephys+image.nwb"]
    with pytest.raises(ConfigError, match=r"no \.nwb file"):
        (tmp_path / "empty").mkdir()
        nwb.find_nwb([tmp_path / "empty"])
    with pytest.raises(ConfigError, match="no file or folder"):
        nwb.find_nwb([tmp_path / "none"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two animals of one geometry; one has two sessions."""
    folder = tmp_path_factory.mktemp("animals")
    rng = np.random.default_rng(1)
    shared = rng.normal(size=(6, 6))
    for name, animal in (("a_1", "a"), ("a_2", "a"), ("b_1", "b")):
        tuned = np.exp(shared @ rng.normal(size=(6, 10)) / 2.5 + 2.3)
        write(folder / f"{name}_ecephys.nwb", rng, trials=72, units=10, animal=animal, tuned=tuned)
    return folder


def test_files_that_a_folder_has_beside_those_with_spikes_are_told(folder, tmp_path):
    for file in folder.glob("*.nwb"):
        (tmp_path / file.name).symlink_to(file)
    (tmp_path / "a_behavior.nwb").write_text("no session at all")
    said = "passed over, without `ecephys` in their names: a_behavior.nwb"
    assert said in build([tmp_path], bootstraps=50).notes


@pytest.mark.parametrize("protocol", ["strict", "paper-code"])
def test_a_folder_builds_a_benchmark(folder, protocol):
    shares = []
    made = build([folder], protocol, bootstraps=100, progress=shares.append)
    assert [t.name for t in made.targets] == ["a", "b"]
    assert made.sources == ("a_1_ecephys.nwb", "a_2_ecephys.nwb", "b_1_ecephys.nwb")
    assert made.targets[0].unfiltered.units == 18  # one of ten never fires
    assert len(shares) > 30
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert (made.pooled is None) == (protocol == "strict")
    if protocol == "strict":
        assert made.targets[0].reliable
        assert sum("no contact" in note for note in made.notes) == 3


def test_the_same_file_twice_is_refused(folder):
    with pytest.raises(ConfigError, match="hold the same trials"):
        build([folder, folder / "a_1_ecephys.nwb"], bootstraps=5)
