"""What is told as degraded: facts at the end of each promise, and nothing else."""

import itertools
import re
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.daemon.fault_kinds import KINDS
from tactile_rt.core.stream import Chunk
from tactile_rt.core.stream.sensor_spec import ChannelSpec, SensorSpec
from tactile_rt.daemon import diagnostics as module
from tactile_rt.daemon.advice import ADVICE, DiagnosticOnsets
from tactile_rt.daemon.config import LimitsConfig
from tactile_rt.daemon.diagnostics import LossWindow, diagnose
from tactile_rt.daemon.states import (
    ConsumerState,
    Diagnostic,
    Losses,
    ModelState,
    OnDisk,
    PartState,
    SourceState,
)
from tactile_rt.daemon.stuck_at import StuckAtDetector, derive_stuck_at_s
from tactile_rt.drivers.health import Health, State
from tactile_rt.testing import cut_chunks, small_spec

NOW = 1_000_000_000_000
S = 1_000_000_000
LIMITS = LimitsConfig(sample_age_s=0.5, behind_s=0.75, record_age_s=1.0)


def part(name, state="running", reason="", failures=0, since_ns=1):
    return PartState(name, state, reason, since_ns, 1, failures)


SOURCE = SourceState(
    part("source.a"), "serial:x", rate_hz=1000.0, device=Health(State.STREAMING, 1), samples=5,
    newest_ns=NOW - S // 100, read_ns=NOW - S // 100, live=True,
)  # fmt: skip
MODEL = ModelState(part("model.a"), "a", "m.onnx")
DISK = OnDisk(NOW - S // 2, NOW - S, 99, open=True, meant_ns=1)
RECORDER = ConsumerState(part("recorder"), "recorder", on_disk={"a": DISK})
ZMQ = ConsumerState(part("publisher.zmq"), "zmq")


def told(sources=(SOURCE,), models=(MODEL,), consumers=(RECORDER, ZMQ), **more):
    return [t.line for t in diagnose(sources, models, consumers, LIMITS, NOW, **more)]


def test_who_does_what_it_should_is_not_named():
    assert told() == []


@pytest.mark.parametrize(
    "changes, line",
    [
        ({"newest_ns": NOW - S, "read_ns": NOW - S},
         "no samples: source.a: none has come for 0.5 s"),
        ({"newest_ns": NOW - 9 * S},
         "late samples: source.a: when they come they are older than 0.5 s"),
        ({"losses": Losses(1, 7)}, "lost samples: source.a: some did not come, or came damaged"),
        ({"bad": Losses(1, 1)},
         "bad samples: source.a: some values are no numbers, or absurd, or none is valid"),
        ({"device": Health(State.LOST, 1, "unplugged")},
         "no samples: source.a: the device is lost"),
        ({"part": part("source.a", "waiting", "no such port")},
         "no samples: source.a fails: no such port"),
        ({"slow": True, "measured_hz": 500.0},
         "slow: source.a: it measures less often than nine tenths of the 1000 Hz that it has"),
        ({"measured_hz": 1200.0},
         "fast: source.a: it measures more often than ten ninths of the 1000 Hz that it has"),
        ({"slow": True, "measured_hz": 6.0, "newest_ns": NOW - S // 2, "read_ns": NOW - S // 2},
         "slow: source.a: it measures less often than nine tenths of the 1000 Hz that it has"),
        ({"another": "it has 4 elements, not 3"},
         "another array: source.a: it has 4 elements, not 3; nothing is decided of it until a "
         "reload (SIGHUP) accepts it"),
        ({"device": Health(State.STREAMING, 1, faults=("a sensor fails",)), "bad": Losses(1, 1)},
         "device fault: source.a: it says: a sensor fails"),
        ({"device": Health(State.STREAMING, 1, counts=False)},
         "no counter: source.a: its counter does not go on: what is lost cannot be seen"),
        ({"clock_off": True}, "device clock: source.a: its clock runs at another speed than the "
         "host's: rates by it are as wrong"),
        ({"restarts": Losses(1, 1)},
         "restarted: source.a: its counter began anew: what was lost meanwhile is not counted"),
        ({"repeats": Losses(11, 11)},
         "repeated samples: source.a: more than one in a hundred comes twice"),
        ({"stuck_at_s": 0.4}, "stuck-at fault: source.a: no value changes: the device hangs"),
        ({"part": part("source.a", "stalled")}, "no samples: source.a stalls"),
        ({"part": part("source.a", "failed", "another array")},
         "no samples: source.a has failed: another array"),
    ],
)  # fmt: skip
def test_a_source_is_named_by_what_came_of_its_samples(changes, line):
    assert told([replace(SOURCE, **changes)]) == [line]


@pytest.mark.parametrize(
    "changes",
    [
        {"measured_hz": 5000.0, "device": None},  # a recording, replayed quickly
        {"rate_hz": 900.0, "measured_hz": 1000.0},
        {"repeats": Losses(10, 50_000)},  # a copy now and then
        {"losses": Losses(0, 50_000)},  # lost within the minute, and no longer
        {"part": part("source.a", "ended"), "newest_ns": 1, "read_ns": 1},
        {"part": part("source.a", "stopped"), "newest_ns": 1, "read_ns": 1},
        {"part": part("source.a", "starting")},
        {"live": False, "newest_ns": 1, "read_ns": 1},  # a recording waits for its reader
        {"newest_ns": 0, "read_ns": 0},  # none has come yet: the device says how it is
        {"rate_hz": 0.5, "newest_ns": NOW - 5 * S, "read_ns": NOW - 5 * S},  # three periods are 6 s
        {"device": Health(State.STREAMING, 1, status=("a channel is at the end of its range",))},
    ],
)
def test_what_is_no_fault_of_a_source_is_not_told(changes):
    assert told([replace(SOURCE, **changes)]) == []


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"behind_s": 0.76}, "late decisions: model.a: it is more than 0.75 s behind"),
        ({"skips": Losses(1, 1)}, "missing decisions: model.a: it cannot keep up"),
        ({"lost": Losses(9, 9)}, "missing decisions: model.a: it was too slow"),
        ({"implausible": True}, "implausible loads: model.a: loads are far beyond those"),
        ({"undecided": True}, "no decisions: model.a: its answer to the newest touch is no number"),
        ({"part": part("model.a", "waiting", "no file")}, "no decisions: model.a fails: no file"),
        (
            {"part": part("model.a", "starting", "no file", 1)},
            "no decisions: model.a fails: no file",
        ),
        (
            {"part": part("model.a", "starting", since_ns=NOW - S)},
            "no decisions: model.a: it is still being tried",
        ),
    ],
)
def test_a_model_is_named_by_what_it_did_not_decide(changes, words):
    (line,) = told(models=[replace(MODEL, **changes)])
    assert line.startswith(words) and line.endswith("; recording goes on")
    waits = replace(RECORDER, part=part("recorder", "starting"))
    (line,) = told(models=[replace(MODEL, **changes)], consumers=[waits, ZMQ])
    assert line.endswith("; acquisition goes on")
    (line,) = told(models=[replace(MODEL, **changes)], consumers=[])
    assert line.endswith("; acquisition goes on")


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"behind_s": 0.76}, "not published: publisher.zmq: it is more than 0.75 s behind"),
        ({"losses": Losses(1, 1)}, "not published: publisher.zmq: it was too slow"),
        ({"diagnostic": "all 64 are taken"}, "not published: publisher.zmq: all 64 are taken"),
        ({"part": part("publisher.zmq", "stalled")}, "not published: publisher.zmq stalls"),
        ({"part": part("publisher.zmq", "starting", "no port", 3)},
         "not published: publisher.zmq fails: no port"),
    ],
)  # fmt: skip
def test_a_consumer_is_named_by_what_it_did_not_hand_on(changes, words):
    (line,) = told(consumers=[RECORDER, replace(ZMQ, **changes)])
    assert line.startswith(words)


@pytest.mark.parametrize(
    "disk, source, words",
    [
        (replace(DISK, written_ns=NOW - 2 * S), {}, "samples of a are not on the disk after 1 s"),
        (replace(DISK, written_ns=0, open=False), {}, "samples of a are not on the disk after 1 s"),
        (replace(DISK, lost_ns=NOW - S // 2, lost_why="no room"), {},
         "samples of a are lost: no room"),
        (replace(DISK, lost_ns=NOW - 2 * S, lost_why="no room"), {}, ""),
        (replace(DISK, written_ns=NOW - 9 * S, meant_ns=0), {}, ""),  # nobody asks for it now
        # somebody asks for it only now, or they come again only now
        (replace(DISK, written_ns=NOW - 9 * S, meant_ns=NOW - S // 2), {}, ""),
        (replace(DISK, written_ns=NOW - 9 * S), {"flowing_ns": NOW - S // 2}, ""),
        (replace(DISK, written_ns=NOW - 2 * S), {"flowing_ns": NOW - 2 * S},
         "samples of a are not on the disk after 1 s"),
        (replace(DISK, written_ns=NOW - 2 * S), {"rate_hz": 1.0}, ""),
        (replace(DISK, waits_ns=NOW - 5 * S, slow_s=4.0), {},
         "a power cut would take more than 4 s of a: a slow disk"),
        (replace(DISK, waits_ns=NOW - 3 * S, slow_s=4.0), {}, ""),
        # nothing came that could be written
        (replace(DISK, written_ns=NOW - 9 * S), {"newest_ns": NOW - 9 * S, "read_ns": NOW - 9 * S},
         ""),
    ],
)  # fmt: skip
def test_the_recorder_is_named_by_what_is_not_on_the_disk(disk, source, words):
    lines = told([replace(SOURCE, **source)], consumers=[replace(RECORDER, on_disk={"a": disk})])
    found = [line for line in lines if line.startswith("no recording")]
    assert found == ([f"no recording: recorder: {words}; acquisition goes on"] if words else [])


def test_what_is_as_old_as_it_may_be_is_well():
    young = part("model.a", "starting", since_ns=NOW - 3 * S // 4)
    assert told(models=[replace(MODEL, part=young)]) == []
    assert told(models=[replace(MODEL, behind_s=0.75)]) == []
    assert told(consumers=[RECORDER, replace(ZMQ, behind_s=0.75)]) == []
    lost = replace(DISK, lost_ns=NOW - S, lost_why="no room")
    assert told(consumers=[replace(RECORDER, on_disk={"a": lost})]) == []
    slow = {"rate_hz": 0.5, "newest_ns": NOW - 6 * S, "read_ns": NOW - 6 * S}  # three periods
    assert told([replace(SOURCE, **slow)]) == []
    (line,) = told([replace(SOURCE, **{**slow, "read_ns": NOW - 6 * S - 1})])
    assert line.startswith("no samples: source.a: none has come for 6 s")


def test_a_process_without_a_turn_blames_none_of_its_parts():
    stalled = [
        [replace(SOURCE, part=part("source.a", "stalled"))],
        [replace(MODEL, behind_s=9.0)],
        [replace(RECORDER, part=part("recorder", "stalled")), replace(ZMQ, behind_s=9.0)],
    ]
    (line,) = told(*stalled, starved_s=9.0)
    assert line.startswith("late: daemon: it had no turn")
    assert len(told(*stalled)) == 4
    stale = [replace(SOURCE, device=Health(State.STALE, 1))]
    assert len(told(stale)) == 1 and len(told(stale, starved_s=9.0)) == 1
    # but what was lost meanwhile was lost
    assert len(told([replace(SOURCE, losses=Losses(5, 5))], starved_s=9.0)) == 2


def test_a_line_does_not_change_as_long_as_what_it_says_is_true():
    a = told([replace(SOURCE, newest_ns=NOW - S, read_ns=NOW - S)])
    assert a == told([replace(SOURCE, newest_ns=NOW - 7 * S, read_ns=NOW - 7 * S)])
    few, many = (told([replace(SOURCE, losses=Losses(*n))]) for n in ((1, 7), (80, 90)))
    assert few == many


def test_what_is_wrong_with_the_daemon_itself_is_told():
    assert told(clock_stepped=True) == ["UTC has jumped: daemon: the wall clock was set"]
    (line,) = told(refused="no such codec")
    assert line.startswith("old configuration: daemon: ") and "no such codec" in line


def test_a_diagnostic_says_since_when_it_lasts_and_what_to_do():
    onsets, utc = DiagnosticOnsets(), 1_700_000_000 * S
    lost = Diagnostic("source.a", "no samples", "fails: no port", "recording goes on")
    (first,) = onsets.explain([lost], 5 * S, utc)
    (later,) = onsets.explain([replace(lost, why="the device is lost")], 9 * S, utc + 4 * S)
    assert (first.since_ns, later.since_ns) == (5 * S, 5 * S) and first.do
    said = (
        "source.a: no samples since 2023-11-14 22:13:20 UTC: it fails: no port; recording goes on."
    )
    assert first.says == said
    assert onsets.explain([], 10 * S, utc + 5 * S) == ()
    assert onsets.explain([lost], 11 * S, utc + 6 * S)[0].since_ns == 11 * S


def test_there_is_advice_for_every_kind_of_diagnostic():
    made = re.findall(r'Diagnostic\([^,()]+, "([^"]+)"', Path(module.__file__).read_text())
    rig = {what for kind in KINDS.values() for _, what in kind.named + kind.also}
    assert {*made, *rig, "no systemd", "no metrics"} <= ADVICE.keys() and len(made) > 9


class Hand:
    """A clock that a test sets."""

    def __init__(self):
        self.s = 1000.0

    def monotonic(self):
        return self.s


@given(
    steps=st.lists(
        st.tuples(st.floats(0.01, 20.0), st.integers(0, 100)), min_size=1, max_size=60
    )
)  # fmt: skip
def test_losses_are_those_of_the_newest_second_and_minute(steps):
    """Against a list of all that was ever lost; to a look's length, as nobody looks in between."""
    hand = Hand()
    with mock.patch.object(module, "time", hand):
        window, count, all_lost = LossWindow(), 0, []
        for after_s, lost in steps:
            hand.s += after_s
            count += lost
            all_lost.append((hand.s, lost))
            found = window.add(count)
            for length, got in ((1.0, found.second), (60.0, found.minute)):
                least = sum(n for t, n in all_lost if t > hand.s - length)
                # what was lost since the look before that time may be counted too
                earlier = [t for t, _ in all_lost if t <= hand.s - length]
                last = earlier[-1] if earlier else 1000.0
                most = sum(n for t, n in all_lost if t > last - module.LOOK_S)
                assert least <= got <= max(most, least)


def test_whoever_looks_often_does_not_fill_the_window():
    window = LossWindow()
    for n in range(2000):
        window.add(n)
    assert len(window._seen) < 100


def chunks(values):
    return cut_chunks(np.asarray(values, np.float32), 1000.0, 7)


def detector(after_s):
    made = StuckAtDetector()
    made.after_s = after_s
    return made


def test_no_number_is_equal_to_itself_and_zero_to_less_than_zero():
    for two, same in (((np.nan, np.nan), True), ((0.0, -0.0), True), ((0.0, 1e-9), False)):
        judge = detector(0.05)
        judge.add(*chunks(np.resize(two, (2100, 3, 1))))
        assert bool(judge.seconds) == same and judge.zeros == (two == (0.0, -0.0))


@given(
    values=st.lists(st.integers(0, 1), min_size=2, max_size=40),
    useless=st.lists(st.booleans(), min_size=40, max_size=40),
    cuts=st.lists(st.integers(1, 39), max_size=8, unique=True).map(sorted),
    start=st.integers(0, 9),
    after=st.sampled_from([0, 2, 5]),
)
def test_how_long_nothing_changes_is_counted_sample_by_sample(values, useless, cuts, start, after):
    """By the plainest way to count it, however the stream is cut."""
    n, judge = len(values), detector(after / 1000)
    loads = np.zeros((n, 3, 2), np.float32)
    loads[:, 1, 1] = values
    valid = ~np.array(useless[:n])[:, None] & np.ones((n, 3), np.bool_)
    t_ns = 1_000_000 * (start + np.arange(n))
    edges = [0, *(c for c in cuts if c < n), n]
    since = 0
    for a, b in itertools.pairwise(edges):
        judge.add(Chunk(np.arange(a, b), t_ns[a:b], loads[a:b], valid[a:b]))
        for k in range(a, b):
            if k == 0 or useless[k] or values[k] != values[k - 1]:
                since = k
        same = b - 1 - since
        assert judge.seconds == pytest.approx(same / 1000 if same > after else 0.0)


def test_an_element_that_does_not_change_while_others_do_is_named():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(900, 3, 2))
    values[200:700, 1] = values[200, 1]
    judge, found = detector(0.3), []
    judge.each_after_s = 0.1
    for chunk in chunks(values):
        chunk.valid[:, 2] = False  # who is known to be of no use is not named
        judge.add(chunk)
        found.append(judge.elements)
        assert not judge.seconds
    times = (np.arange(len(found)) * 7 + 6) / 1000.0
    stuck = np.array([one == (1,) for one in found])
    assert stuck[(times > 0.31) & (times < 0.69)].all() and not stuck[times < 0.3].any()
    assert not any(one for one, at in zip(found, times, strict=True) if not 0.3 <= at < 0.708)
    (said,) = told([replace(SOURCE, stuck=("B1", "B2", "C1", "C2", "C3"))])
    assert said.startswith("stuck-at fault: source.a: no value of B1, B2, C1 and 2 more changes: ")


def test_another_array_is_not_stuck():
    judge = detector(0.005)
    for at, elements in ((0, 3), (1, 4)):
        chunk = cut_chunks(np.zeros((9, elements, 2), np.float32), 1000.0, 9)[0]
        judge.add(replace(chunk, t_ns=chunk.t_ns + at * 9_000_000))
        assert judge.seconds == pytest.approx(0.008)


@pytest.mark.parametrize("rate, shape, noise, drift", [
    (80.0, (9, 1), 50.0, 1.0), (80.0, (9, 1), 0.1, 0.3), (80.0, (9, 1), 0.6, 0.0),  # HX711
    (100.0, (1, 6), 10.0, 0.0), (100.0, (1, 6), 0.2, 0.1),  # FT 300
    (100.0, (5, 3), 3.0, 0.3), (100.0, (5, 3), 0.2, 0.3),  # AnySkin
])  # fmt: skip
def test_nothing_is_stuck_in_an_hour_of_rest_until_noise_stops(rate, shape, noise, drift):
    """Noise, and what it wanders by in a second, in steps that it is rounded to."""
    rng, size, fine = np.random.default_rng(0), (int(3600 * rate), *shape), noise > 1
    wander = np.cumsum(rng.normal(scale=drift / np.sqrt(rate), size=size), axis=0)
    rounded = np.round(rng.normal(scale=noise, size=size) + wander).astype(np.float32)
    spec, judge = small_spec(shape[0], rate_hz=rate), StuckAtDetector(rate)
    for chunk in cut_chunks(np.concatenate([rounded, rounded[-1:].repeat(4 * rate, 0)]), rate, 20):
        judge.expect(spec, None, changes=0.9 * fine)
        judge.add(chunk)
        assert not (judge.seconds or judge.elements) or (fine and chunk.seq[-1] > len(rounded))
    assert bool(judge.seconds) == judge.noisy == fine


def test_an_element_that_hangs_is_told_where_rest_is_known_to_change():
    values = np.random.default_rng(0).normal(size=(12_000, 3, 2))
    values[4000:9000, 1] = values[4000, 1]
    for changes, expected in ((0.9, (6.0, 9.0)), (0.0, (np.inf, -np.inf))):
        judge, told = StuckAtDetector(1000.0), []
        judge.expect(small_spec(elements=3), None, changes)
        for chunk in chunks(values):
            judge.add(chunk)
            told += [chunk.t_ns[-1] / 1e9] if judge.elements == (1,) else []
        found = min(told, default=np.inf), max(told, default=-np.inf)
        assert found == pytest.approx(expected, abs=0.2)


@pytest.mark.parametrize(("changing", "noisy"), [(1500, False), (1501, True)])
def test_readings_that_differ_in_three_of_four_of_a_whole_window_are_noise(changing, noisy):
    judge = StuckAtDetector(1.0)  # a window of 2000 samples
    values = np.cumsum(np.arange(6000) % 2000 < np.repeat((2000, changing, 2000), 2000))
    said = []
    for chunk in cut_chunks(values.astype(np.float32)[:, None, None], 1.0, 1):
        judge.add(chunk)
        said.append(judge.noisy)
    assert said == [2000 <= k < 4000 or (noisy and k >= 4000) for k in range(1, 6001)]
    judge = StuckAtDetector()
    judge.add(*cut_chunks(np.arange(30_000, dtype=np.float32)[:, None, None], 1000.0, 10_000))
    assert judge.noisy


def test_a_device_that_gives_nothing_but_zeros_is_told_after_two_seconds():
    judge, later = StuckAtDetector(), StuckAtDetector()
    zeros = cut_chunks(np.zeros((2002, 3, 2), np.float32), 1000.0, 1)
    told = [judge.zeros] + [judge.add(chunk) or judge.zeros for chunk in zeros]
    assert told == [False] * 2002 + [True]
    zeros[0].values[:] = 1.0  # it has said something
    later.add(*zeros)
    assert not later.zeros


@pytest.mark.parametrize(("moved", "rested"), [(1, True), (2, True), (3, False)])
def test_who_hangs_again_and_again_is_told_until_it_turns_out_to_be_at_rest(moved, rested):
    values = np.random.default_rng(0).normal(size=(70_000, 3, 2))
    for k in range(31_000, 70_000, 1000):
        values[k : k + 500] = values[k]
    values[-500] = values[-501]
    values[-500:].reshape(500, 6)[:, :moved] += 1.0  # of six, at the last time
    judge, told = StuckAtDetector(1000.0), []
    for chunk in chunks(values):
        judge.after_s = 0.25 if judge.noisy else float("inf")
        judge.add(chunk)
        assert chunk.seq[-1] > 29_000 or not judge.noisy
        told.append(judge.seconds > 0)
    assert np.diff(told).sum() == 78 and judge.noisy != rested and not judge.zeros
    judge.expect(small_spec(elements=3), None, changes=0.9)  # in a tare, while motors ran
    assert np.isinf(judge.after_s) == rested


def sensor(noise, resolution):
    fy = ChannelSpec(name="fy", unit="N", range=1.0, noise_density=noise, resolution=resolution)
    return SensorSpec(channels=(fy,))


def test_from_when_on_equal_samples_are_impossible_follows_from_the_noise():
    spec = small_spec(rate_hz=1000.0)
    fine, coarse = sensor(1e-3, 1e-6), sensor(1e-6, 1e-2)
    assert derive_stuck_at_s(spec, fine) == 0.25
    assert derive_stuck_at_s(spec, coarse) == float("inf")
    assert derive_stuck_at_s(spec, fine, each=True) == 2.0
    assert derive_stuck_at_s(spec, sensor(0.0, 1e-3)) == float("inf")
    assert derive_stuck_at_s(spec, sensor(1e-3, 0.0)) == 0.25
    assert derive_stuck_at_s(spec, None, noisy=True) == 0.263


def test_from_when_on_is_as_many_pairs_as_make_it_impossible():
    """At one sample a second a pair takes a second, and 0.25 s are no matter."""
    spec = small_spec(elements=1, rate_hz=1.0)
    # s = 1 sqrt(1/2), p = q / (2 s sqrt(pi)) = 0.2821 for q = s: 0.2821^22 = 8e-13
    assert derive_stuck_at_s(spec, sensor(1.0, np.sqrt(0.5))) == 22.0
    # twice the elements, half the pairs; and never fewer than three
    assert derive_stuck_at_s(small_spec(elements=2, rate_hz=1.0), sensor(1.0, np.sqrt(0.5))) == 11.0
    assert derive_stuck_at_s(spec, sensor(1.0, 1e-15)) == 3.0


@pytest.mark.parametrize("resolution", [0.25, 0.5, 1.0])  # standard deviations of the noise
def test_the_chance_of_equal_readings_is_that_of_noise_that_is_rounded(resolution):
    spec = small_spec(elements=2, rate_hz=2.0)
    drawn = np.round(np.random.default_rng(0).normal(size=2_000_000) / resolution)
    chance = float((drawn[1:] == drawn[:-1]).mean()) ** 2  # both elements
    pairs = derive_stuck_at_s(spec, sensor(1.0, resolution)) * spec.rate_hz
    assert chance**pairs <= 1e-12 * 1.2
    assert chance ** (pairs - 1) >= 1e-12 / 1.2
