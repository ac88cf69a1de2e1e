"""Decision modes: windows that slide, episodes that end early, elements in another order."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.decision_rules import Lanes
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import NS_PER_S, Chunk
from tactile_rt.testing import cut_chunks
from tests.helpers.refusals import refusal
from tests.helpers.tiny_model import GRAPH, PERIOD_NS, STEPS, SUBSTEPS, logits_of, write_model
from tests.helpers.touch_streams import (
    QUIET,
    SAME_RATE,
    expected_logits,
    fed_logits,
    push_all,
    reordered,
    signal,
    stream,
)

ONSET = QUIET + 1


# Windows that slide


@pytest.mark.parametrize("steps", [1, 4, 7, 22])
def test_each_window_has_a_lane_of_its_own_from_its_beginning_to_its_end(steps: int) -> None:
    for every in range(1, steps + 1):
        lanes = Lanes(steps, every)
        assert lanes.count == -(-steps // every)
        begun: dict[int, int] = {}  # lane: step at which its window began
        ended = []
        for step in range(5 * steps):
            if (lane := lanes.beginning(step)) is not None:
                begun[lane] = step
            asked = lanes.choose_lane(step)
            if asked is None:
                continue
            lane, own = asked
            assert own == step + 1 - begun[lane] <= steps
            if own == steps:
                ended.append(begun[lane])
            else:
                assert begun[lane] == 0
        assert ended == list(range(0, 4 * steps + 1, every))


@pytest.mark.parametrize("every", [1, 2, 3, 4])
def test_a_sliding_decision_is_that_of_an_episode_from_the_window_s_start(
    model: Path, every: int
) -> None:
    values = signal([(QUIET, 300, 0.1)], 330)
    values[QUIET:, 0, 0] += np.linspace(0, 1, len(values) - QUIET, dtype=np.float32)
    classifier = Classifier(model, SAME_RATE, mode="sliding", every=every)
    decisions = push_all(classifier, stream(values))
    first, windows = decisions[: STEPS - 1], decisions[STEPS - 1 :]
    assert [(d.step, d.final) for d in first] == [(1, False), (2, False), (3, False)]
    assert len(windows) > 10
    for n, d in enumerate(windows):
        begin = ONSET + n * every * SUBSTEPS
        assert (d.step, d.final, d.onset_ns) == (STEPS, True, ONSET * PERIOD_NS)
        assert d.t_ns == (begin + STEPS * SUBSTEPS - 1) * PERIOD_NS
        _, steps, total, last, sigma = logits_of(d.probabilities)
        window = values[begin : begin + STEPS * SUBSTEPS, 0, 0].astype(np.float64)
        offset = values[ONSET - 106 : ONSET - 6, 0, 0].mean(dtype=np.float64)
        assert steps == pytest.approx(STEPS, abs=1e-4)
        assert total == pytest.approx((window - offset).sum(), abs=1e-4)
        assert last == pytest.approx(window[-1] - offset, abs=1e-4)
        assert sigma == pytest.approx(expected_logits(values, ONSET, 1)[4], abs=1e-4)


def test_windows_slide_only_while_the_contact_lasts(model: Path) -> None:
    values = signal([(QUIET, 200, 0.1), (400, 403, 0.1)], 600)
    classifier = Classifier(model, SAME_RATE, mode="sliding", every=1)
    decisions = push_all(classifier, stream(values))
    long = [d for d in decisions if d.onset_ns == ONSET * PERIOD_NS]
    short = [d for d in decisions if d.onset_ns == 401 * PERIOD_NS]
    assert len(long) + len(short) == len(decisions)
    assert 200 <= long[-1].t_ns // PERIOD_NS < 200 + 45  # release takes twenty quiet samples
    # A touch gone before the first window is complete still gets its decision.
    assert [d.step for d in short][:STEPS] == [1, 2, 3, 4]
    assert {d.final for d in short[STEPS:]} <= {True}
    for d in short[:STEPS]:
        assert logits_of(d.probabilities) == fed_logits(values, 401, d.step)


def test_the_shipped_model_slides_as_it_decides_episodes() -> None:
    """Against plain runs of the graph, window by window, each from a zero state."""
    session, card = load_model(shipped_model())
    spec = replace(card.array, rate_hz=NS_PER_S / card.period_ns)
    rng = np.random.default_rng(1)
    values = (rng.normal(size=(400, *spec.shape)) * card.floor).astype(np.float32)
    values[150:] += (rng.normal(size=(250, *spec.shape)) * np.array(card.scale)).astype(np.float32)
    classifier = Classifier(shipped_model(), spec, mode="sliding", every=5)
    decisions = push_all(classifier, cut_chunks(values, spec.rate_hz, 11))
    offset, sigma = classifier.detector.offset, classifier.detector.sigma  # contact lasts
    names = [o.name for o in session.get_outputs()]
    finals = [d for d in decisions if d.final]
    assert len(finals) == 6
    assert [d.t_ns - finals[0].t_ns for d in finals] == [
        n * 5 * card.substeps * card.period_ns for n in range(6)
    ]
    for d in finals:
        end = d.t_ns // card.period_ns + 1
        feed = {s.name: np.zeros((1, *s.shape), dtype=s.dtype) for s in card.state}
        for step in range(card.steps):
            begin = end - (card.steps - step) * card.substeps
            feed |= {
                "samples": values[None, begin : begin + card.substeps],
                "offset": offset[None],
                "sigma": sigma[None],
            }
            out = dict(zip(names, session.run(names, feed), strict=True))
            feed |= {s.name: out[f"{s.name}_next"] for s in card.state}
        logits = out["logits"][0].astype(np.float64) / card.temperature
        posterior = np.exp(logits - logits.max())
        assert d.probabilities == pytest.approx(posterior / posterior.sum(), abs=2e-6)


# Episodes that end early


def test_a_decision_that_is_sure_ends_the_episode(model: Path) -> None:
    touches = [(QUIET, QUIET + 40, 0.1), (300, 340, 0.1)]
    values = signal(touches, 400)
    whole = push_all(Classifier(model, SAME_RATE), stream(values))
    rising = [float(d.probabilities.max()) for d in whole[:STEPS]]
    assert rising == sorted(rising)
    for step, in_a_row in ((1, 1), (2, 1), (3, 1), (4, 1), (2, 2), (3, 2), (4, 2), (3, 3)):
        sure = rising[step - in_a_row]
        early = push_all(Classifier(model, SAME_RATE, sure=sure, in_a_row=in_a_row), stream(values))
        expected = [d for d in whole if d.onset_ns == ONSET * PERIOD_NS and d.step <= step]
        got = [d for d in early if d.onset_ns == ONSET * PERIOD_NS]
        assert [d.final for d in got] == [False] * (step - 1) + [True]
        for a, b in zip(got, expected, strict=True):
            assert np.array_equal(a.probabilities, b.probabilities)
        again = [d for d in early if d.onset_ns == 301 * PERIOD_NS]
        assert again and again[-1].final and again[0].step == 1
    never = push_all(Classifier(model, SAME_RATE, sure=1.0), stream(values))
    assert [d.step for d in never] == [1, 2, 3, 4] * 2


# Options that cannot be, and arrays in another order


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"mode": "windows"}, "mode must be one of episode, sliding, not 'windows'"),
        ({"mode": "sliding", "every": 0}, "every: 0 steps; windows of 4 take 1 to 4"),
        ({"mode": "sliding", "every": 5}, "every: 5 steps; windows of 4 take 1 to 4"),
        ({"mode": "sliding", "sure": 0.9}, "sure needs mode episode: sliding windows"),
        ({"sure": 0.0}, "sure must be above 0, at most 1, not 0.0"),
        ({"sure": 90}, "sure must be above 0, at most 1, not 90"),
        ({"sure": 0.9, "in_a_row": 0}, "in_a_row must be at least 1 step, not 0"),
        ({"deadline_s": 0.0}, "deadline_s must be positive, not 0.0"),
        ({"late": "panic"}, "late must be one of count, report, skip, not 'panic'"),
        ({"providers": ()}, "providers: name at least one of cpu, cuda"),
        ({"providers": ("tpu",)}, "no execution provider 'tpu'; there are cpu, cuda"),
    ],
)
def test_an_option_that_cannot_be_says_why(model: Path, options: dict, said: str) -> None:
    assert refusal(Classifier, model, SAME_RATE, **options).startswith(said)


def test_a_provider_that_is_not_installed_names_those_that_are(
    model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(ConfigError, match=r"'cuda' is not in .*\(it has cpu\).* onnxruntime-gpu"):
        Classifier(model, SAME_RATE, providers=("cuda", "cpu"))
    assert Classifier(model, SAME_RATE).providers == ("CPUExecutionProvider",)


def test_a_graph_for_one_stream_cannot_slide(tmp_path: Path) -> None:
    path = write_model(tmp_path / "one.onnx", GRAPH.replace("[B", "[1"))
    values = signal([(QUIET, 300, 0.1)], 300)
    assert len(push_all(Classifier(path, SAME_RATE), stream(values))) == STEPS
    with pytest.raises(ConfigError, match="batch fixed to 1, and 2 lanes are needed"):
        Classifier(path, SAME_RATE, mode="sliding", every=2)


def test_elements_in_another_order_are_put_in_the_model_s(model: Path) -> None:
    order = [2, 0, 1]
    chunks = stream(signal([(QUIET, 300, 0.1)], 300))
    for chunk in chunks:
        chunk.valid[chunk.seq > ONSET + 4, 0] = False
    moved = [Chunk(c.seq, c.t_ns, c.values[:, order], c.valid[:, order]) for c in chunks]
    expected = push_all(Classifier(model, SAME_RATE), chunks)
    classifier = Classifier(model, reordered(SAME_RATE, order))
    got = push_all(classifier, moved)
    assert len(got) == STEPS
    for a, b in zip(got, expected, strict=True):
        assert np.array_equal(a.probabilities, b.probabilities)
    assert classifier.detector.offset[1, 0] == pytest.approx(0.25, abs=1e-3)  # the array's order
