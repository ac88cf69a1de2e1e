"""Scores at rest and the page that is drawn from them."""

import re
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace as change

from tactile_rt.alignment.gate import neural_checks
from tactile_rt.alignment.json_file import encode, write_json
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.pictures import Point, draw_profiles, draw_scatter
from tactile_rt.alignment.report import report_page
from tactile_rt.alignment.results import baseline_of, read_results, results_of, score_model
from tactile_rt.alignment.stimuli_input import read_stimuli
from tactile_rt.alignment.strict import freeze_strict
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI
from tests.helpers import brains
from tests.helpers.pages import check_page


@pytest.fixture(scope="module")
def benchmark():
    rng = np.random.default_rng(4)
    return freeze_strict(brains.animals(rng, 5, shared=brains.geometry(rng)), 20)


def network(rng, name, units=30):
    def trace():
        return rng.normal(size=(6, 22, units)).astype(np.float32)

    traces = {"encoder.conv1": trace(), "attender.block0": trace(), "decoder.logits": trace()}
    traces["encoder.dead"] = np.ones((6, 22, units), dtype=np.float32)
    return Layers(name, traces, dict.fromkeys(traces, 0), traces["decoder.logits"], 12_345)


@pytest.fixture(scope="module")
def results(benchmark):
    rng = np.random.default_rng(0)
    models = [
        score_model(benchmark, network(rng, f"model <{i}>"), network(rng, "before"), (p, "told"))
        for i, p in enumerate((0.4, 0.5, 0.7))
    ]
    return results_of(benchmark, read_stimuli(), models)


def test_the_page_stands_alone_and_everything_is_on_it(results, benchmark):
    text = report_page(results)
    check_page(text)
    assert report_page(results) == text, "drawn alike again"
    assert "model &lt;0&gt;" in text and "model <0>" not in text
    for said in ("animal to animal", "all that noise permits", "chance, 95th percentile",
                 "Neural fit against task performance", "Neural fit against size", "3 models",
                 f"highest {benchmark.a2a.highest:.2f}", "mouse-4", "raw sensor input",
                 *STIMULI):  # fmt: skip
        assert said in text, said
    one = report_page(msgspec.structs.replace(results, models=results.models[:1]))
    assert "side by side" not in one and "task performance" not in one


def test_the_verdict_is_the_gates_and_its_power_stands_beside_it(results, benchmark, tmp_path):
    rng = np.random.default_rng(0)
    model = score_model(benchmark, network(rng, "model"))
    (test,) = (c for c in neural_checks(model, benchmark) if c.name == "turing")
    assert (model.turing, model.turing_why) == (test.verdict, test.why) and "Power: " in test.why
    said = {"pass": ">passes<", "fail": ">fails<", "inconclusive": ">cannot tell<"}
    for verdict, word in said.items():
        one = msgspec.structs.replace(model, turing=verdict)
        text = report_page(msgspec.structs.replace(results, models=(one,)))
        assert [w for w in said.values() if w in text] == [word]
        assert f"model: {test.why}".replace("<", "&lt;") in text


def test_a_benchmark_without_reliable_animals_says_so(benchmark):
    targets = tuple(change(t, reliable=False) for t in benchmark.targets)
    bad = change(benchmark, targets=targets)
    model = score_model(bad, network(np.random.default_rng(0), "model"))
    text = report_page(results_of(bad, read_stimuli(), [model]))
    assert "cannot tell" in text and "the benchmark is not valid" in text
    check_page(text)


def axes_of(monkeypatch, draw, *arguments, **more):
    """What a figure is made of, instead of its SVG."""
    monkeypatch.setattr("tactile_rt.alignment.pictures._finish_figure", lambda figure: figure)
    return draw(*arguments, **more).axes


@pytest.mark.parametrize(
    ("points", "log", "said"),
    [
        ([("a", 1e4, 0.1), ("b", 1e5, 0.3), ("c", 1e6, 0.2)], True, ["others: 3 models, r = 0.50"]),
        ([("a", 1e4, 0.1), ("b", 1e5, 0.3)], True, ["others: 2 models"]),
        ([(n, 0.5, 0.1) for n in "abc"], False, ["others: 3 models"]),
        (
            [(f"s{k}", 0.1 * k, y, 0, "simclr") for k, y in enumerate((0.1, 0.3, 0.2))]
            + [("$x$", 0.2, 0.5, 0, "supervised")],
            False,
            ["simclr: 3 models, r = 0.50", "supervised: 1 model"],
        ),
    ],
)
def test_three_models_of_a_group_have_a_line_and_its_correlation(monkeypatch, points, log, said):
    (axes,) = axes_of(monkeypatch, draw_scatter, [Point(*p) for p in points], "x", "y", log=log)
    assert axes.get_legend_handles_labels()[1] == said
    lines = [line for line in axes.lines if line.get_linestyle() == "--"]
    assert len(lines) == sum("r =" in one for one in said)
    assert [text.get_text().replace("\\", "") for text in axes.texts] == [p[0] for p in points]


def test_an_rdm_as_a_line_is_moved_and_scaled(monkeypatch):
    rng = np.random.default_rng(1)
    one, other = rng.normal(size=15), rng.normal(size=15)
    series = [("one", one), ("again", 3 * one + 2), ("other", other), ("none", np.full(15, np.nan))]
    (axes,) = axes_of(monkeypatch, draw_profiles, series, STIMULI)
    lines = [line.get_ydata() for line in axes.lines]
    assert len(lines) == 3
    np.testing.assert_allclose(lines[0], lines[1])
    assert np.corrcoef(lines[0], lines[2])[0, 1] == pytest.approx(np.corrcoef(one, other)[0, 1])
    assert axes.get_xticklabels()[2].get_text() == "convex-close and concave-close"


def test_scores_come_back_as_they_went(results, tmp_path):
    path = tmp_path / "scores.json"
    write_json(results, path)
    assert encode(read_results(path)) == encode(results)


def test_scores_are_those_of_the_layers(results, benchmark):
    model = results.models[0]
    assert np.isnan(model.rdms[model.layers.index("encoder.dead")]).all()
    assert len(model.per_target) == len(benchmark.targets)
    assert model.performance == 0.4 and model.untrained.layers == model.layers


def test_layers_that_take_no_part_are_told_with_the_stimuli_that_they_are_silent_to(benchmark):
    """As those of a single whisker, which one stimulus does not touch."""
    rng = np.random.default_rng(2)
    traces = {f"encoder.{i}": rng.normal(size=(6, 1, 5)).astype(np.float32) for i in range(3)}
    traces |= {"encoder.one": rng.normal(size=(6, 1, 1)).astype(np.float32)}
    for name in ("encoder.0", "encoder.2"):
        traces[name][2] = 0
    layers = Layers("m", traces, dict.fromkeys(traces, 0), np.zeros((6, 1, 2), np.float32), 1)
    result = score_model(benchmark, layers)
    assert np.isnan(result.rdms).all(axis=1).tolist() == [False, False, False, True]
    assert np.isnan(result.rdms).any(axis=1).tolist() == [True, False, True, True]
    why = "layers have no RDM and take no part, for all units of each answer"
    assert result.notes == (
        f"2 of 4 {why} convex-far alike: encoder.0, encoder.2",
        f"1 of 4 {why} every stimulus alike: encoder.one",
    )
    touched = read_stimuli()
    alone = replace(touched, samples=touched.samples[..., :1, 5:], sigma=touched.sigma[:, :1, 5:])
    raw = results_of(benchmark, alone, [result]).raw
    assert np.isnan(raw.score) and alone.raw().shape == (6, 1)


def test_a_baseline_is_one_model_on_the_same_benchmark_and_stimuli(results, benchmark, tmp_path):
    path, felt = tmp_path / "scores.json", read_stimuli()
    write_json(results, path)
    with pytest.raises(ConfigError, match="has 3 models"):
        baseline_of(path, benchmark, felt)
    one = msgspec.structs.replace(results, models=results.models[:1])
    write_json(one, path)
    before = baseline_of(path, benchmark, felt)
    np.testing.assert_array_equal(before, one.models[0].rdms)
    with pytest.raises(ConfigError, match="another benchmark"):
        baseline_of(path, change(benchmark, seed=1), felt)
    other = replace(felt, name="mine.npz", sha256="0" * 64)
    with pytest.raises(ConfigError, match=r"on other stimuli \(six_stimuli.npz\) than mine.npz"):
        baseline_of(path, benchmark, other)


GROUPS = {"encoder": "gru", "attender": "none", "augmentation": "tactile"}


def test_models_are_compared_by_how_they_were_trained(results):
    groups = [
        GROUPS | {"objective": "supervised", "masking": "0"},
        GROUPS | {"objective": "simclr", "masking": "0"},
        GROUPS | {"objective": "simclr", "masking": "0.75", "augmentation": "image"},
    ]
    models = [
        msgspec.structs.replace(m, groups=g) for m, g in zip(results.models, groups, strict=True)
    ]
    text = report_page(msgspec.structs.replace(results, models=tuple(models)))
    check_page(text)
    for said in ("performance, by loss", "performance, by augmentation", "against size, by loss",
                 ">simclr: 2 models<", ">image: 1 model<", "The same as lines"):  # fmt: skip
        assert said in text, said
    assert "masking of steps" not in text, "the third differs in its augmentation, too"
    models[2] = msgspec.structs.replace(models[2], groups=groups[1] | {"masking": "0.75"})
    text = report_page(msgspec.structs.replace(results, models=tuple(models)))
    assert "With and without masking of steps" in text
    rows = re.findall(r"<td>(model &lt;\d&gt;)</td><td>([\d.]+ %)</td><td>([\d.]+)</td>", text)
    assert rows == [("model &lt;1&gt;", "0 %", "0.50"), ("model &lt;2&gt;", "75 %", "0.70")]


def test_the_groups_are_what_the_file_says(benchmark):
    layers = replace(
        network(np.random.default_rng(2), "m"),
        network={"encoder": "gru", "attender": "none", "width": 1.0},
        training={"objective": "simclr", "augmentation": "tactile", "masking": 0.75, "seed": 1},
    )
    made = score_model(benchmark, layers)
    assert made.groups == GROUPS | {"objective": "simclr", "masking": "0.75"}
    assert score_model(benchmark, network(np.random.default_rng(2), "m")).groups == {}
