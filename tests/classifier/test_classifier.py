import itertools
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.classifier.classifier import Classification, Classifier, fuse
from tactile_rt.classifier.decision_rules import (
    MASS_ABOVE,
    POSTERIOR,
    UNKNOWN,
    OpenSetRule,
    PredictionSetRule,
)
from tactile_rt.classifier.model_card import choose_label, rated_noise
from tactile_rt.core.errors import SpecMismatch
from tactile_rt.core.stream import NS_PER_S, Chunk, concatenate
from tactile_rt.testing import cut_chunks, small_spec
from tests.helpers.tiny_model import (
    CARD,
    LABELS,
    PERIOD_NS,
    STEPS,
    SUBSTEPS,
    logits_of,
    write_model,
)
from tests.helpers.touch_streams import (
    QUIET,
    SAME_RATE,
    SIGMA,
    SPEC,
    fed_logits,
    push_all,
    same,
    signal,
    stream,
)

EPISODE = STEPS * SUBSTEPS


def test_an_episode_feeds_the_model_exactly_its_windows(model: Path) -> None:
    values = signal([(QUIET, 400, 0.1)], 400)
    decisions = push_all(Classifier(model, SAME_RATE), stream(values))
    onset = QUIET + 1  # contact is certain with its second sample
    assert [d.step for d in decisions] == [1, 2, 3, 4]
    assert [d.final for d in decisions] == [False, False, False, True]
    for d in decisions:
        assert d.onset_ns == onset * PERIOD_NS
        assert d.t_ns == (onset + d.step * SUBSTEPS - 1) * PERIOD_NS
        assert logits_of(d.probabilities) == fed_logits(values, onset, d.step)
        assert d.probabilities.dtype == np.float32
        assert d.probabilities.sum() == pytest.approx(1, abs=1e-6)
        assert d.labels == LABELS
        assert d.label == LABELS[int(d.probabilities.argmax())] == "steps"
        assert 0 < d.latency_s < 1


def test_a_decision_comes_with_the_chunk_that_completes_its_window(model: Path) -> None:
    values = signal([(QUIET, 400, 0.1)], 400)
    classifier = Classifier(model, SAME_RATE)
    for chunk in stream(values, samples=1):
        for d in classifier.push(chunk):
            # One period: the resampler's delay.
            assert chunk.t_ns[0] == d.t_ns + PERIOD_NS


@pytest.fixture(scope="module")
def uncut(model: Path) -> tuple[Chunk, list[Classification]]:
    """Two touches in one chunk, and what is decided of it."""
    whole = concatenate(stream(signal([(QUIET, 180, 0.1), (230, 300, 0.2)], 300)))
    return whole, push_all(Classifier(model, SAME_RATE), [whole])


@settings(max_examples=25)
@given(st.lists(st.integers(1, 299), max_size=20, unique=True).map(sorted))
def test_decisions_do_not_depend_on_how_the_stream_was_cut(
    model: Path, uncut: tuple[Chunk, list[Classification]], cuts: list[int]
) -> None:
    whole, expected = uncut
    edges = [0, *cuts, 300]
    chunks = [whole.select(slice(a, b)) for a, b in itertools.pairwise(edges)]
    got = push_all(Classifier(model, SAME_RATE), chunks)
    assert len(expected) == 2 * STEPS
    assert same(got, expected)


def test_both_touches_of_one_chunk_are_told_with_their_times(
    model: Path, uncut: tuple[Chunk, list[Classification]]
) -> None:
    whole, decisions = uncut
    classifier = Classifier(model, SAME_RATE)
    classifier.push(whole)
    assert [began for _, began in classifier.touches] == [True, False, True]
    begun = [t_ns for t_ns, began in classifier.touches if began]
    assert begun == sorted({d.onset_ns for d in decisions})
    # It ends with the twentieth quiet sample.
    assert classifier.touches[1][0] >= (180 + 20 - 1) * PERIOD_NS


def test_without_contact_there_is_no_decision(model: Path) -> None:
    assert push_all(Classifier(model, SAME_RATE), stream(signal([], 600))) == []


def test_state_is_zeroed_at_the_next_onset_and_the_baseline_is_the_new_one(model: Path) -> None:
    values = signal([(QUIET, QUIET + 40, 0.1), (500, 600, 0.2)], 600)
    decisions = push_all(Classifier(model, SAME_RATE), stream(values))
    assert {d.onset_ns // PERIOD_NS for d in decisions} == {QUIET + 1, 501}
    last = [d for d in decisions if d.onset_ns == 501 * PERIOD_NS]
    assert [d.step for d in last] == [1, 2, 3, 4]
    for d in last:
        assert logits_of(d.probabilities) == fed_logits(values, 501, d.step)


def test_after_the_final_step_a_touch_that_stays_is_no_new_episode(model: Path) -> None:
    decisions = push_all(Classifier(model, SAME_RATE), stream(signal([(QUIET, 800, 0.1)], 800)))
    assert len(decisions) == STEPS


def test_an_episode_goes_on_when_the_touch_ends_early(model: Path) -> None:
    values = signal([(QUIET, QUIET + 3, 0.1)], 400)
    decisions = push_all(Classifier(model, SAME_RATE), stream(values))
    assert [d.step for d in decisions] == [1, 2, 3, 4]
    assert logits_of(decisions[-1].probabilities) == fed_logits(values, QUIET + 1, STEPS)


@pytest.mark.parametrize("after", range(-1, 4))
def test_a_touch_right_after_an_episode_is_the_next_one(tmp_path: Path, after: int) -> None:
    """A short touch long released by its final step; the next begins `after` that many samples."""
    steps = 30
    path = write_model(tmp_path / "long.onnx", steps=steps)
    onset = QUIET + 1
    done = onset + steps * SUBSTEPS  # the sample after the last one used
    again = done + after - 1
    values = signal([(QUIET, QUIET + 3, 0.1), (again, again + 400, 0.1)], again + 400)
    decisions = push_all(Classifier(path, SAME_RATE), stream(values))
    first, rest = decisions[:steps], decisions[steps:]
    assert {d.onset_ns for d in first} == {onset * PERIOD_NS}
    if again + 1 >= done:  # the onset is certain when the episode is over
        assert {d.onset_ns for d in rest} == {(again + 1) * PERIOD_NS}
        assert len(rest) == steps
    else:
        assert rest == []  # the last samples of an episode are not two things at once


@pytest.mark.parametrize("temperature", [0.5, 1.0, 3.0])
def test_temperature_divides_the_logits(tmp_path: Path, temperature: float) -> None:
    path = write_model(tmp_path / "m.onnx", temperature=temperature)
    values = signal([(QUIET, 400, 0.1)], 400)
    for d in push_all(Classifier(path, SAME_RATE), stream(values)):
        logits = logits_of(d.probabilities, temperature)
        assert logits == fed_logits(values, QUIET + 1, d.step, 1e-5)


def test_large_logits_do_not_overflow(model: Path) -> None:
    decisions = push_all(Classifier(model, SAME_RATE), stream(signal([(QUIET, 400, 1e4)], 400)))
    for d in decisions:
        assert d.probabilities.sum() == pytest.approx(1)
        assert d.label == "sum"


def test_the_most_probable_classes_come_first() -> None:
    probabilities = np.array([0.1, 0.4, 0.1, 0.35, 0.05], dtype=np.float32)
    d = Classification(0, 0, 1, True, "steps", LABELS, probabilities, 0.0)
    assert [label for label, _ in d.top(3)] == ["steps", "last", "nothing"]
    assert d.top(1) == [("steps", pytest.approx(0.4))]
    assert len(d.top(99)) == 5


@pytest.mark.parametrize("options", [{}, {"mode": "sliding", "every": 1}])
def test_decisions_carry_their_own_step_s_embedding_if_asked(model: Path, options: dict) -> None:
    """Also where one push, or one run of the network, gives several."""
    values = signal([(QUIET, 300, 0.1)], 330)
    values[QUIET:, 0, 0] += np.linspace(0, 1, len(values) - QUIET, dtype=np.float32)
    whole = stream(values, samples=len(values) + 1)
    decisions = push_all(Classifier(model, SAME_RATE, embedding=True, **options), whole)
    assert len(decisions) >= STEPS
    for d in decisions:
        assert d.embedding is not None and d.embedding.dtype == np.float32
        logits = logits_of(d.probabilities)
        assert d.embedding == pytest.approx([d.step, logits[3]], abs=1e-5)
    assert len({d.embedding[1] for d in decisions}) == len(decisions)
    plain = push_all(Classifier(model, SAME_RATE, **options), whole)
    assert [d.embedding for d in plain] == [None] * len(decisions)


# Other rates


@pytest.mark.parametrize("rate_hz", [1000.0, 333.0, 60.0])
def test_another_rate_is_adapted_to(model: Path, rate_hz: float) -> None:
    """A square touch far longer than the kernel, sampled at some other rate."""
    n = round(3.5 * rate_hz)
    touch = round(2.0 * rate_hz)
    values = signal([(touch, n, 0.1)], n)
    values[:, :, 0] = 0.25
    values[touch:, 0, 0] = 0.35
    spec = small_spec(rate_hz=rate_hz)
    decisions = push_all(Classifier(model, spec), cut_chunks(values, rate_hz))
    assert [d.step for d in decisions] == [1, 2, 3, 4]
    assert abs(decisions[0].onset_ns - 2 * NS_PER_S) <= 2 * max(PERIOD_NS, NS_PER_S / rate_hz)
    for a, b in itertools.pairwise(decisions):
        assert b.t_ns - a.t_ns == SUBSTEPS * PERIOD_NS
    _, steps, total, last, sigma = logits_of(decisions[-1].probabilities)
    assert steps == pytest.approx(4, abs=1e-5)
    assert last == pytest.approx(0.1, abs=1e-5)
    assert sigma == pytest.approx(CARD.floor[0], abs=1e-5)
    assert 0.1 * (EPISODE - 3) < total < 0.1 * EPISODE + 1e-4  # the rise is part of the episode


def test_the_same_touch_at_the_model_s_rate_and_at_1_khz_gives_the_same_decisions(
    model: Path,
) -> None:
    """The resampler's output is fed to a second classifier, as a sensor of the model's rate."""
    from tactile_rt.classifier.resampler import Resampler

    fast = cut_chunks(signal([(1500, 3000, 0.1)], 3000), SPEC.rate_hz)
    resampler = Resampler(PERIOD_NS, SPEC.rate_hz)
    slow = [out for chunk in fast if (out := resampler.push(chunk)) is not None]
    a = push_all(Classifier(model, SPEC), fast)
    b = push_all(Classifier(model, SAME_RATE), slow)
    assert len(a) == STEPS
    for x, y in zip(a, b, strict=True):
        assert (x.onset_ns, x.t_ns, x.step, x.final) == (y.onset_ns, y.t_ns, y.step, y.final)
        assert x.probabilities == pytest.approx(y.probabilities, abs=1e-6)


# Elements that cannot be trusted


def test_an_untrustworthy_element_reads_as_untouched(model: Path) -> None:
    values = signal([(QUIET, 300, 0.1)], 300)
    values[QUIET:, 1] += 0.1  # another element feels the touch too: the episode begins
    chunks = stream(values)
    for chunk in chunks:
        dead = chunk.seq >= QUIET
        chunk.valid[dead, 0] = False
        chunk.values[dead, 0] = np.nan
    classifier = Classifier(model, SAME_RATE)
    decisions = push_all(classifier, chunks)
    assert len(decisions) == STEPS
    for d in decisions:
        _, _, total, last, _ = logits_of(d.probabilities)
        assert (total, last) == (pytest.approx(0, abs=1e-6), pytest.approx(0, abs=1e-6))
    assert (classifier.deviation[0] == 0).all()
    assert classifier.deviation[1] == pytest.approx(0.1, abs=6 * SIGMA)


def test_an_element_without_a_baseline_reads_as_untouched(model: Path) -> None:
    """It came to life a moment ago: its offset is not a load."""
    values = signal([], 300)
    values[:, 0] += 0.3
    values[QUIET:, 1] += 0.1
    chunks = stream(values)
    for chunk in chunks:
        chunk.valid[chunk.seq < QUIET - 3, 0] = False
    classifier = Classifier(model, SAME_RATE)
    decisions = push_all(classifier, chunks)
    assert len(decisions) == STEPS
    assert logits_of(decisions[-1].probabilities)[2] == pytest.approx(0, abs=1e-6)
    assert (classifier.deviation[0] == 0).all()


def test_the_deviation_is_the_last_sample_less_its_offset(model: Path) -> None:
    classifier = Classifier(model, SAME_RATE)
    assert (classifier.deviation == 0).all()
    values = signal([(QUIET, 200, 0.1)], 200)
    push_all(classifier, stream(values[:QUIET]))
    assert abs(classifier.deviation).max() < 6 * SIGMA
    push_all(classifier, [concatenate(stream(values)[QUIET // 7 + 1 :])])
    assert classifier.deviation[0] == pytest.approx(0.1, abs=6 * SIGMA)


# Which array


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"channels": ("fx", "mz")}, "channels[0] is 'fx', not 'fy'"),
        ({"units": ("mN", "N m")}, "units[0] is 'mN', not 'N'"),
        ({"grid": ((0, 0), (0, 1), (1, 0))}, "grid[2] is (1, 0), not (0, 2)"),
        (
            {"frame": "base", "elements": ("A0", "A1", "B7")},
            "lacks A2; B7 unknown to the model and 1 more",
        ),
    ],
)
def test_another_array_is_refused_by_where_it_differs(model: Path, change: dict, said: str) -> None:
    with pytest.raises(SpecMismatch) as caught:
        Classifier(model, replace(SPEC, name="mine", **change))
    message = str(caught.value)
    assert message.startswith(f"{model} was made for another array than 'mine': {said}")


# Several sweeps of one object

posteriors = st.lists(st.floats(1e-3, 1), min_size=4, max_size=4).map(
    lambda p: (np.array(p) / sum(p)).astype(np.float32)
)


@given(st.lists(posteriors, min_size=1, max_size=6), st.randoms())
def test_fused_posteriors_are_bayes_rule_with_equal_priors(several, random) -> None:
    belief = np.full(4, 0.25)  # updated by one sweep after the other, in float64
    for posterior in several:
        belief = belief * posterior / (belief * posterior).sum()
    fused = fuse(several)
    assert fused.dtype == np.float32
    assert fused == pytest.approx(belief, rel=1e-4, abs=1e-6)
    shuffled = list(several)
    random.shuffle(shuffled)
    assert fuse(shuffled) == pytest.approx(fused, rel=1e-5)


def test_fusing_never_divides_by_zero() -> None:
    certain = [np.eye(3, dtype=np.float32)[i] for i in (0, 1, 1)]
    assert fuse(certain).argmax() == 1
    assert np.isfinite(fuse(certain * 300)).all()
    with pytest.raises(ValueError):
        fuse([])


# what it does not know

NAMES = ("cup", "mug", "jar", UNKNOWN, "wrong gain")
REFUSALS = (UNKNOWN, "wrong gain")


def refusing(tmp_path: Path, **changes: object) -> Classifier:
    """The tiny model with other names: `unknown` is most probable of a touch of 0.1."""
    path = write_model(tmp_path / "m.onnx", labels=NAMES, refusals=REFUSALS, **changes)
    return Classifier(path, SAME_RATE)


def test_what_no_class_fits_is_unknown_and_a_refusal_is_a_decision_like_any_other(
    tmp_path: Path,
) -> None:
    # the posteriors of the last step are known from the logits: 0, 4, the sum, 0.1, the noise
    values = stream(signal([(QUIET, 400, 0.1)], 400))
    probable = push_all(refusing(tmp_path), values)[-1]
    assert (probable.label, probable.probability) == ("mug", max(probable.probabilities))
    unknown = float(probable.probabilities[NAMES.index(UNKNOWN)])
    for threshold, label in ((unknown + 1e-3, "mug"), (unknown - 1e-3, UNKNOWN)):
        rule = OpenSetRule(POSTERIOR, "logits", (1.0, 1.0, 1.0, threshold))
        decisions = push_all(refusing(tmp_path, unknown=rule), values)
        assert [d.label for d in decisions] == ["mug", "mug", "mug", label]
        assert decisions[-1].labels == NAMES
        assert np.array_equal(decisions[-1].probabilities, probable.probabilities)
    assert decisions[-1].probability == pytest.approx(unknown)


def test_below_its_threshold_unknown_is_not_decided_however_probable(tmp_path: Path) -> None:
    names = ("cup", UNKNOWN)
    card = {"unknown": OpenSetRule(POSTERIOR, "logits", (0.9,))}
    card = msgspec.structs.replace(CARD, labels=names, refusals=(UNKNOWN,), **card)
    assert choose_label(card, np.array([0.2, 0.8], dtype=np.float32), 1) == 0
    assert choose_label(card, np.array([0.05, 0.95], dtype=np.float32), 1) == 1
    # a score that this release does not know cannot be applied
    other = msgspec.structs.replace(card, unknown=OpenSetRule("entropy", "logits", (0.1,)))
    assert choose_label(other, np.array([0.8, 0.2], dtype=np.float32), 1) == 0


def test_the_prediction_set_is_that_of_the_rule_for_the_noise_that_is_measured(
    tmp_path: Path,
) -> None:
    values = stream(signal([(QUIET, 400, 0.1)], 400))
    assert push_all(refusing(tmp_path), values)[-1].prediction_set == ()
    rated = float(np.median(SIGMA / rated_noise(CARD)))
    quiet = PredictionSetRule(MASS_ABOVE, 0.9, (0.5, 0.6, 0.7, 0.99), 80, noise=0.5 * rated)
    noisy = PredictionSetRule(MASS_ABOVE, 0.8, (0.0, 1.0, 0.9, 0.5), 80, noise=4 * rated)
    decisions = push_all(refusing(tmp_path, candidates=(noisy, quiet)), values)
    for d, quantile in zip(decisions, noisy.quantiles, strict=True):
        own = d.probabilities[:3] / d.probabilities[:3].sum()
        order = np.argsort(-own)
        above = np.cumsum(own[order]) - own[order]
        assert d.prediction_set == tuple(NAMES[k] for k in order[above <= quantile])
        assert d.coverage == 0.8
    assert len({len(d.prediction_set) for d in decisions}) > 1
    none = push_all(refusing(tmp_path, candidates=(quiet,)), values)[-1]
    assert (none.prediction_set, none.coverage) == ((), None), "too noisy for the rule"
