"""What a robot meets: bad samples, dead whiskers, saturation, late steps, days of running."""

import gc
import itertools
import logging
import tracemalloc
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.classifier import runtime, stepper
from tactile_rt.classifier.classifier import Classification, Classifier, without_bad_samples
from tactile_rt.classifier.decision_rules import Deadline
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.classifier.skips import Skip
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.core.stream import NS_PER_S, Chunk, concatenate
from tactile_rt.testing import cut_chunks, small_spec
from tests.helpers.tiny_model import CARD, GRAPH, PERIOD_NS, STEPS, SUBSTEPS, logits_of, write_model
from tests.helpers.touch_streams import QUIET, SAME_RATE, fed_logits, push_all, same, signal, stream

ONSET = QUIET + 1
SHIPPED = load_model(shipped_model())
FAST = SHIPPED[1].array


def loads(n: int, seed: int = 0) -> np.ndarray:
    """(n, element, channel) of the shipped array: quiet for the first third, then loads."""
    card = SHIPPED[1]
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(n, *FAST.shape)) * card.floor
    values[n // 3 :] += rng.normal(size=FAST.shape) * np.array(card.scale) * 3
    return values.astype(np.float32)


# The network's step


def test_any_episode_after_any_other_is_as_a_fresh_one() -> None:
    """The shipped model, begun anew after every number of steps."""
    session, card = SHIPPED
    rng = np.random.default_rng(0)
    shape = (card.steps, card.substeps, *FAST.shape)
    samples = (rng.standard_cauchy(shape) * np.array(card.scale)).astype(np.float32)
    sigma = np.broadcast_to(np.array(card.floor, np.float32), FAST.shape)
    offset = 10 * sigma

    def episode(stepper: Stepper, steps: int) -> np.ndarray:
        stepper.begin(offset, sigma)
        logits = []
        for step in range(steps):
            stepper.samples[0] = samples[step]
            logits.append(stepper.run().copy())
        return np.array(logits)

    expected = episode(Stepper(session, card), card.steps)
    used = Stepper(session, card)
    for steps in range(card.steps + 1):
        episode(used, steps)
        assert np.array_equal(episode(used, 3), expected[:3])
    assert np.array_equal(episode(used, card.steps), expected)


def test_state_is_explicit_and_a_lane_is_reset_alone(tmp_path: Path) -> None:
    session, card = load_model(write_model(tmp_path / "m.onnx"))
    used = Stepper(session, card, lanes=2)
    zeros = np.zeros(card.array.shape, np.float32)
    used.begin(zeros, zeros)
    counted = []
    for step in range(STEPS):
        if step == 2:
            used.reset(1)
        counted.append(used.run()[:, 1].copy())  # steps so far
        assert np.array_equal(used.embedding[:, 0], counted[-1])
    assert np.array_equal(counted, [[1, 1], [2, 2], [3, 1], [4, 2]])


def test_a_step_allocates_nothing() -> None:
    session, card = SHIPPED
    used = Stepper(session, card)
    tracemalloc.start()
    try:
        used.run()
        peaks = []
        for _ in range(50):
            before = tracemalloc.get_traced_memory()[0]
            tracemalloc.reset_peak()
            used.run()
            peaks.append(tracemalloc.get_traced_memory()[1] - before)
    finally:
        tracemalloc.stop()
    # A few Python objects of the call; the smallest tensor of this model's state has 512 bytes.
    assert np.median(peaks) < 1000


def test_a_device_apart_from_the_cpu_gets_and_gives_the_same(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As with a GPU: onnxruntime's tensors are copies, which only `send` renews."""
    options = {"mode": "sliding", "every": 1}
    chunks = stream(signal([(QUIET, 260, 0.1), (300, 360, 0.2)], 360))
    expected = push_all(Classifier(model, SAME_RATE, **options), chunks)
    made = stepper.ort.OrtValue.ortvalue_from_numpy
    init = stepper.Tensor.__init__

    def apart(self, shape, dtype, device) -> None:
        init(self, shape, dtype, device)
        if shape[-1:] != (5,):  # not the logits, which come to the CPU in any case
            self.copy = self.array.copy()
            self.value = made(self.copy, "cpu", 0)
            self._on_device = True

    monkeypatch.setattr(stepper.Tensor, "__init__", apart)
    assert same(push_all(Classifier(model, SAME_RATE, **options), chunks), expected)


DECAY = GRAPH.replace("total_next = Add(total, sum)", "total_next = Mul(sum, tiny)").replace(
    "int64[1] tail = {2}", "int64[1] tail = {2}, float tiny = {1e-30}"
)


@pytest.mark.skipif(runtime.LIBRARY is None, reason="not on this system")
def test_denormals_are_zero_in_the_network_and_nowhere_else(tmp_path: Path) -> None:
    used = Stepper(*load_model(write_model(tmp_path / "m.onnx", DECAY)))
    smallest_normal, quarter = np.full(3, 1.2e-38, dtype=np.float32), np.float32(0.25)
    for size, expected in ((1e-7, 3e-37), (1e-9, 0.0)):
        used.samples[:] = size
        assert used.run()[0, 2] == pytest.approx(expected, rel=1e-3, abs=0)
        assert (smallest_normal * quarter > 0).all()


# Bad samples


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38, -1e10])
def test_a_bad_sample_is_an_invalid_one_and_counted(model: Path, bad: float) -> None:
    values = signal([(QUIET, 170, 0.1), (500, 560, 0.1)], 600)
    struck = [20, 21, QUIET + 3, QUIET + 7, 171, 250]
    marked, spoilt = stream(values), stream(values)
    for chunk in marked:
        chunk.valid[np.isin(chunk.seq, struck), 0] = False
    for chunk in spoilt:
        chunk.values[np.isin(chunk.seq, struck), 0, 1] = bad
    classifier = Classifier(model, SAME_RATE)
    got = push_all(classifier, spoilt)
    assert same(got, push_all(Classifier(model, SAME_RATE), marked))
    assert len(got) == 2 * STEPS
    assert classifier.stats.bad_samples == len(struck)
    for chunk in spoilt:  # what a source gave stays as it was
        assert (chunk.values[np.isin(chunk.seq, struck), 0, 1] != 0).all()
    assert logits_of(got[-1].probabilities) == fed_logits(values, 501, STEPS, 1e-4)


def test_loads_in_another_unit_are_told_once_and_counted(model: Path, caplog) -> None:
    touches = signal([(500, 900, 0.1), (2000, 2400, 0.1)], 3000)
    sound, spoilt = Classifier(model, SAME_RATE), Classifier(model, SAME_RATE)
    decisions = push_all(sound, stream(touches))
    assert sound.stats.implausible == 0 and not caplog.text
    found = push_all(spoilt, stream(1000 * touches))
    assert spoilt.stats.implausible == len([d for d in decisions if d.final]) == 2
    assert spoilt.implausible and len(found) == len(decisions)
    assert caplog.text.count("another unit, gain or sensor?") == 1


@pytest.mark.parametrize(("load", "implausible"), [(9.5, 0), (10.5, 1)])
def test_ten_times_the_largest_load_of_its_card_is_implausible(model, caplog, load, implausible):
    classifier = Classifier(model, SAME_RATE)
    push_all(classifier, stream(signal([(QUIET, 300, load)], 400)))
    assert classifier.stats.implausible == implausible
    assert caplog.text.count("another unit, gain or sensor?") == implausible


@pytest.mark.parametrize(("seconds", "told"), [(9.5, 0), (25.0, 1)])
def test_a_contact_without_an_end_is_told_once(model, caplog, seconds, told):
    held = round(seconds * SAME_RATE.rate_hz)
    values = signal([(QUIET, QUIET + held, 0.1)], QUIET + held + 200)
    assert push_all(Classifier(model, SAME_RATE), stream(values))
    assert caplog.text.count("contact for 10 s without an end") == told


@pytest.mark.parametrize(("seconds", "joined"), [(0, True), (4.5, True), (6, False)])
def test_a_baseline_that_moves_is_put_off_for_five_seconds(model, seconds, joined):
    """A stream that is joined within a touch, which is on its way out, and touched again."""
    dead, way = round(seconds * SAME_RATE.rate_hz), 70
    values = signal([(dead + 300, dead + 350, 0.1)], dead + 500)
    values[dead : dead + way, 0] += np.linspace(1, 0, way, dtype=np.float32)[:, None]
    classifier, chunks = Classifier(model, SAME_RATE), stream(values)
    for chunk in chunks:
        chunk.valid[chunk.seq < dead] = False
    push_all(classifier, chunks)
    found = [t_ns // PERIOD_NS - dead for t_ns, began in classifier.touches if began]
    assert (found == [301]) == joined, found


def test_a_stream_that_begins_with_a_skip_has_one(model):
    classifier = Classifier(model, SAME_RATE, skips=[Skip(0, 20 * PERIOD_NS)])
    assert not any(vars(classifier.stats).values())
    decision = push_all(classifier, stream(signal([(QUIET, 300, 0.1)], 400)))[-1]
    assert classifier.stats.skips == 1
    seven = replace(decision, labels=tuple("abcdefg"), probabilities=np.arange(7.0) / 21)
    assert [label for label, _ in seven.top()] == list("gfedc")


@pytest.mark.parametrize("rate_hz", [1000.0, 111.0])
def test_no_decision_is_ever_no_number(rate_hz: float) -> None:
    """The shipped model through seconds of everything at once, then a plain touch."""
    rng = np.random.default_rng(5)
    n = round(6 * rate_hz)
    spec = replace(FAST, rate_hz=rate_hz)
    values = loads(n)
    values[:, 0] = 0  # dead from the beginning
    values[n // 2 :, 1] = values[n // 2, 1]  # stuck
    values[n // 2 :, 2] = 1e8  # saturated
    values[n // 2 :, 3] *= 1e-40  # denormal
    hit = rng.random((n, FAST.shape[0])) < 0.05
    values[hit] = rng.choice([np.nan, np.inf, -np.inf, 3.4e38, -3.4e38, 1e9], hit.sum())[:, None]
    values[round(0.7 * n) : round(0.72 * n)] = np.nan
    classifier = Classifier(shipped_model(), spec, mode="sliding", every=8)
    decisions = push_all(classifier, cut_chunks(values, rate_hz))
    assert decisions
    assert classifier.stats.bad_samples > 0.04 * values[..., 0].size
    assert classifier.stats.bad_steps == 0
    for d in decisions:
        assert np.isfinite(d.probabilities).all()
        assert d.probabilities.sum() == pytest.approx(1, abs=1e-5)
    assert np.isfinite(classifier.deviation).all()


# inf - inf for a last sample of more than 3.4
OVERFLOWS = GRAPH.replace("zero = Sub(last, last)", "big = Mul(last, huge)\nzero = Sub(big, big)")
OVERFLOWS = OVERFLOWS.replace("int64[1] tail = {2}", "int64[1] tail = {2}, float huge = {1e38}")


def test_a_network_that_says_no_number_ends_the_episode_and_recovers(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx", OVERFLOWS)
    values = signal([(QUIET, 180, 0.1), (QUIET + 5, 180, 9.0), (500, 560, 0.1)], 600)
    classifier = Classifier(path, SAME_RATE)
    chunks, early = stream(values), (QUIET + 60) // 7
    decisions = push_all(classifier, chunks[:early])
    assert classifier.undecided  # until another touch is decided on
    decisions += push_all(classifier, chunks[early:])
    assert classifier.stats.bad_steps == 1 and not classifier.undecided
    assert [d.step for d in decisions] == [1, 1, 2, 3, 4]
    assert logits_of(decisions[-1].probabilities) == fed_logits(values, 501, STEPS, 1e-4)
    sliding = Classifier(path, SAME_RATE, mode="sliding", every=2)
    values = signal([(QUIET, 300, 0.1), (QUIET + 5, QUIET + 40, 9.0)], 300)
    decisions = push_all(sliding, stream(values))
    assert sliding.stats.bad_steps > 0
    # The touch goes on, and windows begin anew when the network can take it again.
    assert sum(d.final for d in decisions) > 10
    assert all(np.isfinite(d.probabilities).all() for d in decisions)


# The same stream, however it comes


@cache
def uncut(sliding: bool) -> tuple[Chunk, list[Classification]]:
    """A stream of the shipped array in one chunk, and what is decided of it."""
    values = loads(1200)
    values[500:540] = np.nan
    whole = concatenate(cut_chunks(values, FAST.rate_hz))
    options = {"mode": "sliding", "every": 11} if sliding else {}
    return whole, push_all(Classifier(shipped_model(), FAST, **options), [whole])


@settings(max_examples=5, deadline=None)
@given(cuts=st.sets(st.integers(1, 1199), max_size=60), sliding=st.booleans())
def test_the_shipped_model_does_not_mind_how_the_stream_was_cut(cuts: set, sliding: bool) -> None:
    whole, expected = uncut(sliding)
    edges = [0, *sorted(cuts), 1200]
    chunks = [whole.select(slice(a, b)) for a, b in itertools.pairwise(edges)]
    options = {"mode": "sliding", "every": 11} if sliding else {}
    classifier = Classifier(shipped_model(), FAST, **options)
    assert len(expected) >= 14
    assert same(push_all(classifier, chunks), expected)
    assert classifier.stats.bad_samples == 40 * FAST.shape[0]


def test_five_hundred_episodes_in_a_row_equal_the_first(model: Path) -> None:
    """Noise-free, with numbers that floats hold exactly."""
    period = 50
    values = np.full((QUIET + 500 * period, *SAME_RATE.shape), 0.25, dtype=np.float32)
    ramp = np.arange(13, dtype=np.float32) / 64 + 0.25
    for k in range(500):
        begin = QUIET + k * period
        values[begin : begin + 13, 0, 0] += ramp
    decisions = push_all(Classifier(model, SAME_RATE), stream(values, samples=50))
    assert len(decisions) == 500 * STEPS
    first = np.array([d.probabilities for d in decisions[:STEPS]])
    total, last = (ramp[1:].sum(), ramp[12])
    assert logits_of(first[-1]) == pytest.approx([0, 4, total, last, CARD.floor[0]], abs=1e-5)
    for k in range(500):
        episode = decisions[k * STEPS : (k + 1) * STEPS]
        assert episode[-1].final
        assert np.array_equal(np.array([d.probabilities for d in episode]), first)


@pytest.mark.parametrize("samples", range(0, STEPS * SUBSTEPS + 1, 2))
def test_an_episode_cut_short_anywhere_leaves_nothing_behind(model: Path, samples: int) -> None:
    """A silence after some samples of it, of no whole number of steps as well."""
    stop = ONSET + samples
    values = signal([(QUIET, stop, 0.1), (500, 600, 0.1)], 600)
    chunks = stream(values, samples=1)
    late = [replace(c, t_ns=c.t_ns + 600 * PERIOD_NS) if c.seq[0] >= stop else c for c in chunks]
    decisions = push_all(Classifier(model, SAME_RATE), late)
    decisions = [d for d in decisions if d.t_ns > 700 * PERIOD_NS]
    assert [d.step for d in decisions] == [1, 2, 3, 4]
    for d in decisions:
        assert logits_of(d.probabilities) == fed_logits(values, 501, d.step, 1e-5)


# Memory


def resident() -> int:
    """Bytes of this process in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc here")
def test_memory_does_not_grow(tmp_path: Path) -> None:
    """20,000 steps of the network, and a long contact with windows that slide."""
    path = write_model(tmp_path / "m.onnx")
    used = Stepper(*load_model(path), lanes=2)
    for _ in range(2000):
        used.run()
    gc.collect()
    before = resident()
    for k in range(20_000):
        used.reset(k % 2)
        used.run()
    assert resident() - before < 300_000  # 15 bytes a step

    classifier = Classifier(path, SAME_RATE, mode="sliding", every=2)
    chunks = stream(signal([(QUIET, 10_000, 0.1)], 5400), samples=9)
    push_all(classifier, chunks[:100])
    tracemalloc.start()
    try:
        held = []
        for stretch in (chunks[100:300], chunks[300:600]):
            push_all(classifier, stretch)
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert classifier.stats.steps > 1700
    # onnxruntime's own count of handles fills up to 20 kB in some thousand steps, and then stays.
    assert held[1] - held[0] < 20_000


# Late steps


def test_late_is_what_would_have_been_late_live() -> None:
    def missed(limit_ms: float, took_ms: float, period_ms: int = 45) -> list[bool]:
        deadline = Deadline(limit_ms / 1e3)
        return [deadline.add_step(k * period_ms * 1_000_000, took_ms / 1e3) for k in range(8)]

    assert not any(missed(45, 44))
    assert all(missed(45, 46))
    assert not any(missed(100, 44))
    # 15 ms are left over from every step: 60, 75, 90, 105 of work
    assert missed(100, 60) == [False] * 3 + [True] * 5


def test_a_pause_makes_up_for_what_was_late() -> None:
    deadline = Deadline(0.1)
    ms = 1_000_000
    assert not deadline.add_step(0, 0.05)
    assert deadline.add_step(45 * ms, 0.3)
    assert deadline.add_step(90 * ms, 0.001)
    assert deadline.behind_s == pytest.approx(0.05 - 0.045 + 0.3 - 0.045 + 0.001)
    assert not deadline.add_step(1000 * ms, 0.001)
    assert (deadline.behind_s, deadline.late) == (pytest.approx(0.001), 2)


def test_late_decisions_are_marked_reported_or_withheld(
    model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    chunks = stream(signal([(QUIET, 180, 0.1), (500, 560, 0.1)], 600))
    in_time = Classifier(model, SAME_RATE, deadline_s=60.0)
    expected = push_all(in_time, chunks)
    assert not any(d.late for d in expected)
    assert (in_time.stats.steps, in_time.stats.late) == (2 * STEPS, 0)
    with caplog.at_level(logging.WARNING):
        count = Classifier(model, SAME_RATE, deadline_s=1e-9)
        assert same(got := push_all(count, chunks), expected)
        assert all(d.late for d in got)
        assert (count.stats.late, count.stats.withheld) == (2 * STEPS, 0)
        skip = Classifier(model, SAME_RATE, deadline_s=1e-9, late="skip")
        assert push_all(skip, chunks) == []
        assert (skip.stats.late, skip.stats.withheld) == (2 * STEPS, 2 * STEPS)
        assert caplog.records == []
        report = Classifier(model, SAME_RATE, deadline_s=1e-9, late="report")
        assert same(push_all(report, chunks), expected)
    assert [r.name for r in caplog.records] == ["tactile_rt.classifier"] * 2  # one an episode
    assert "5 late steps so far" in caplog.messages[1]


def test_another_array_size_has_its_own_buffers(tmp_path: Path) -> None:
    """Two classifiers side by side share nothing."""
    path = write_model(tmp_path / "m.onnx")
    chunks = stream(signal([(QUIET, 300, 0.1)], 300))
    expected = push_all(Classifier(path, small_spec(rate_hz=NS_PER_S / PERIOD_NS)), chunks)
    a, b = Classifier(path, SAME_RATE), Classifier(path, SAME_RATE)
    pairs = [(a.push(chunk), b.push(chunk)) for chunk in chunks]
    assert same([d for x, _ in pairs for d in x], expected)
    assert same([d for _, y in pairs for d in y], expected)


def test_what_no_sensor_measures_is_zero_and_not_valid() -> None:
    values = np.ones((2, *SAME_RATE.shape), dtype=np.float32)
    values[0, 1, 0], values[1, 2, 1] = np.nan, 1e12
    good, bad = without_bad_samples(Chunk(np.arange(2), np.arange(2), values, values[..., 0] == 1))
    assert bad == 1  # the other was not marked as valid
    assert not good.values[0, 1].any() and not good.values[1, 2].any() and not good.valid[1, 2]
    assert good.values.sum() == values.shape[1] * values.shape[2] * 2 - 4
