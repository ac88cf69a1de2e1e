"""Scores at rest and the page that is drawn from them."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import msgspec
import numpy as np
import pytest

from tactile_rt.errors import ConfigError
from tactile_rt.models.alignment.gate import neural_checks
from tactile_rt.models.alignment.layers import Layers
from tactile_rt.models.alignment.pictures import (
    Bar,
    Level,
    Point,
    bars,
    heat_map,
    profiles,
    scatter,
    ticks,
)
from tactile_rt.models.alignment.rdm import STIMULI
from tactile_rt.models.alignment.report import page
from tactile_rt.models.alignment.results import (
    baseline_of,
    model_result,
    read_results,
    results_of,
    write_results,
)
from tactile_rt.models.alignment.stimuli_input import read_stimuli
from tactile_rt.models.alignment.strict import freeze_strict
from tests.helpers import brains

ALONE = {"meta", "line", "rect", "circle", "polyline", "br"}


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
        model_result(benchmark, network(rng, f"model <{i}>"), network(rng, "before"), (p, "told"))
        for i, p in enumerate((0.4, 0.5, 0.7))
    ]
    return results_of(benchmark, read_stimuli(), [m for m, _ in models])


class Balanced(HTMLParser):
    """Every element that is opened is closed, in order."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], []

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, dict(attributes)))
        if tag not in ALONE:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in ALONE:
            assert self.open.pop() == tag


def parsed(text):
    parser = Balanced()
    parser.feed(text)
    assert parser.open == []
    return parser.seen


def test_the_page_stands_alone_and_is_well_formed(results):
    text = page(results)
    elements = parsed(text)
    assert not {"script", "link", "img", "iframe"} & {tag for tag, _ in elements}
    for _, attributes in elements:
        assert not {"src", "href"} & set(attributes)
    assert "http" not in text and "@import" not in text
    assert re.findall(r"url\(([^)]*)\)", text) == ["#hatch"]
    assert "prefers-color-scheme:dark" in text
    assert "model &lt;0&gt;" in text and "model <0>" not in text
    assert not re.search(r"\bnan\b", text)


def test_everything_is_on_the_page(results):
    text = page(results)
    for part in ("encoder", "attender", "decoder", "raw", "missing"):
        assert f'<rect class="{part}' in text, part
    assert text.count("<title>dead: no value (NaN)</title>") == 3
    for said in ("animal to animal", "all that noise permits", "chance, 95th percentile",
                 "Neural fit against task performance", "Neural fit against size", "3 models",
                 "mouse-4", "raw sensor input", *STIMULI):  # fmt: skip
        assert said in text, said
    # One dot per reliable animal and layer that has a value, in each of three models' figures.
    dots = re.findall(r"<title>conv1, mouse-\d: ", text)
    assert len(dots) == 3 * sum(results.benchmark.reliable)


def test_the_verdict_is_the_gates_and_its_power_stands_beside_it(results, benchmark, tmp_path):
    rng = np.random.default_rng(0)
    model, made = model_result(benchmark, network(rng, "model"))
    (test,) = (c for c in neural_checks(made, benchmark) if c.name == "turing")
    assert (model.turing, model.turing_why) == (test.verdict, test.why) and "Power: " in test.why
    said = {"pass": ">passes<", "fail": ">fails<", "inconclusive": ">cannot tell<"}
    for verdict, word in said.items():
        one = msgspec.structs.replace(model, turing=verdict)
        text = page(msgspec.structs.replace(results, models=(one,)))
        assert [w for w in said.values() if w in text] == [word]
        assert f"model: {test.why}".replace("<", "&lt;") in text
    old = msgspec.structs.replace(model, turing="", turing_why="")  # written without one
    assert not any(
        word in page(msgspec.structs.replace(results, models=(old,))) for word in said.values()
    )


def test_one_model_is_not_compared(results):
    text = page(msgspec.structs.replace(results, models=results.models[:1]))
    assert "side by side" not in text and "task performance" not in text


def test_a_benchmark_without_reliable_animals_says_so(benchmark):
    targets = tuple(replace(t, reliable=False) for t in benchmark.targets)
    bad = replace(benchmark, targets=targets)
    model, _ = model_result(bad, network(np.random.default_rng(0), "model"))
    text = page(results_of(bad, read_stimuli(), [model]))
    assert "cannot tell" in text and "the benchmark is not valid" in text
    parsed(text)


def test_bars_are_where_their_values_are():
    drawn = bars(
        [Bar("a", 0.5, "encoder", (("x", 0.7),), 0.2), Bar("b", float("nan"), "decoder")],
        [Level("one", 1.0, "one"), Level("none", float("nan"), "null"), Level("z", 0.0, "a2a")],
        "r", "figure",
    )  # fmt: skip
    lines = {
        k: float(y)
        for k, y in re.findall(r'<line class="(one|a2a|control)"[^>]*y1="([^"]*)"', drawn)
    }
    top, height = re.search(r'class="encoder"[^>]*y="([\d.]+)" height="([\d.]+)"', drawn).groups()
    dot = float(re.search(r'class="dot"[^>]*cy="([\d.]+)"', drawn)[1])
    unit = lines["a2a"] - lines["one"]  # pixels of 1
    assert float(height) == pytest.approx(0.5 * unit, abs=0.2)
    assert float(top) == pytest.approx(lines["a2a"] - 0.5 * unit, abs=0.2)
    assert dot == pytest.approx(lines["a2a"] - 0.7 * unit, abs=0.2)
    assert lines["control"] == pytest.approx(lines["a2a"] - 0.2 * unit, abs=0.2)
    assert 'class="missing"' in drawn and ">none<" not in drawn


def test_the_fitted_line_and_its_correlation():
    points = [Point("a", 1e4, 0.1), Point("b", 1e5, 0.3), Point("c", 1e6, 0.2)]
    r = np.corrcoef([4, 5, 6], [0.1, 0.3, 0.2])[0, 1]
    assert f"r = {r:.2f}" in scatter(points, "x", "y", "figure", log=True)
    assert "fit" not in scatter(points[:2], "x", "y", "a picture")
    assert "fit" not in scatter([Point(n, 0.5, 0.1) for n in "abc"], "x", "y", "a picture")


def test_names_of_models_that_lie_on_each_other_are_all_written():
    drawn = scatter([Point(f"m{i}", 0.5, 0.3) for i in range(30)], "x", "y", "a picture")
    heights = re.findall(r'class="name" x="[^"]*" y="([^"]*)"', drawn)
    assert len(heights) == 30 and len(set(heights)) >= 17


def test_the_largest_dissimilarity_is_the_darkest():
    drawn = heat_map(np.arange(1, 16) / 15, STIMULI, "map")
    shades = [float(s) for s in re.findall(r'fill-opacity="([\d.]+)"', drawn)]
    assert len(shades) == 36 and max(shades) == 1 and shades.count(0) == 6
    assert heat_map([float("nan")] * 15, STIMULI, "map").count('class="missing"') == 30


def test_ticks():
    assert ticks(0, 1) == [0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert ticks(-0.13, 0.31) == [-0.1, 0, 0.1, 0.2, 0.3]


def test_scores_come_back_as_they_went(results, tmp_path):
    path = tmp_path / "scores.json"
    write_results(results, path)
    assert read_results(path) == results


def test_scores_are_those_of_the_layers(results, benchmark):
    model = results.models[0]
    assert model.rdms[model.layers.index("encoder.dead")] == (None,) * 15
    assert len(model.per_target) == len(benchmark.targets)
    assert model.performance == 0.4 and model.untrained.layers == model.layers


@pytest.mark.parametrize(
    "text, said",
    [
        (b"{}", "has no scores"),
        (b"\xff", "is damaged"),
        (b'{"kind": "tactile_rt alignment scores", "version": 9}', "version 9"),
        (b'{"kind": "tactile_rt alignment scores", "version": 1}', "is damaged"),
    ],
)
def test_damaged_scores(tmp_path, text, said):
    path = tmp_path / "scores.json"
    path.write_bytes(text)
    with pytest.raises(ConfigError, match=said):
        read_results(path)


def test_tables_that_do_not_fit(results, tmp_path):
    path = tmp_path / "scores.json"
    short = msgspec.structs.replace(results.models[0], corrected=())
    write_results(msgspec.structs.replace(results, models=(short,)), path)
    with pytest.raises(ConfigError, match="do not fit"):
        read_results(path)


def test_layers_that_take_no_part_are_told_with_the_stimuli_that_they_are_silent_to(benchmark):
    """As those of a single whisker, which one stimulus does not touch."""
    rng = np.random.default_rng(2)
    traces = {f"encoder.{i}": rng.normal(size=(6, 1, 5)).astype(np.float32) for i in range(3)}
    traces |= {"encoder.one": rng.normal(size=(6, 1, 1)).astype(np.float32)}
    for name in ("encoder.0", "encoder.2"):
        traces[name][2] = 0
    layers = Layers("m", traces, dict.fromkeys(traces, 0), np.zeros((6, 1, 2), np.float32), 1)
    result, _ = model_result(benchmark, layers)
    assert [row[0] is None for row in result.rdms] == [False, False, False, True]
    assert [None in row for row in result.rdms] == [True, False, True, True]
    why = "layers have no RDM and take no part, for all units of each answer"
    assert result.notes == (
        f"2 of 4 {why} convex-far alike: encoder.0, encoder.2",
        f"1 of 4 {why} every stimulus alike: encoder.one",
    )
    touched = read_stimuli()
    alone = replace(touched, samples=touched.samples[..., :1, 5:], sigma=touched.sigma[:, :1, 5:])
    raw = results_of(benchmark, alone, [result]).raw
    assert raw.score is None and alone.raw().shape == (6, 1)


def test_a_baseline_is_one_model_on_the_same_benchmark_and_stimuli(results, benchmark, tmp_path):
    path, felt = tmp_path / "scores.json", read_stimuli()
    write_results(results, path)
    with pytest.raises(ConfigError, match="has 3 models"):
        baseline_of(path, benchmark, felt)
    one = msgspec.structs.replace(results, models=results.models[:1])
    write_results(one, path)
    before = baseline_of(path, benchmark, felt)
    np.testing.assert_array_equal(before, np.array(one.models[0].rdms, dtype=float))
    with pytest.raises(ConfigError, match="another benchmark"):
        baseline_of(path, replace(benchmark, seed=1), felt)
    other = replace(felt, name="mine.npz", sha256="0" * 64)
    with pytest.raises(ConfigError, match=r"on other stimuli \(six_stimuli.npz\) than mine.npz"):
        baseline_of(path, benchmark, other)


def test_an_rdm_as_a_line_is_moved_and_scaled():
    rng = np.random.default_rng(1)
    one, other = rng.normal(size=15), rng.normal(size=15)
    series = [("one", one), ("again", 3 * one + 2), ("other", other), ("none", np.full(15, np.nan))]
    drawn = profiles(series, STIMULI, "lines")
    lines = [
        np.array([[float(v) for v in point.split(",")] for point in points.split()])
        for points in re.findall(r'<polyline[^>]*points="([^"]*)"', drawn)[::-1]  # the first on top
    ]
    assert len(lines) == 3 and all(line.shape == (15, 2) for line in lines)
    np.testing.assert_allclose(lines[0], lines[1], atol=0.11)
    # Downwards is positive on a page; what is compared is what is seen.
    seen = np.corrcoef(-lines[0][:, 1], -lines[2][:, 1])[0, 1]
    assert seen == pytest.approx(np.corrcoef(one, other)[0, 1], abs=2e-3)
    assert "convex-close and concave-far" in drawn and ">none<" not in drawn


def test_groups_have_colours_and_lines_of_their_own():
    points = [Point(f"{g}{k}", 0.1 * k, y, 0.0, g) for g, ys in
              (("simclr", (0.1, 0.3, 0.2)), ("supervised", (0.5, 0.4)), ("", (0.9,)))
              for k, y in enumerate(ys)]  # fmt: skip
    drawn = scatter(points, "x", "y", "figure")
    r = np.corrcoef([0, 1, 2], [0.1, 0.3, 0.2])[0, 1]
    assert f"r = {r:.2f}, 3 models" in drawn
    assert drawn.count('<line class="fit') == 1, "two points make no line"
    assert [drawn.count(f'circle class="g{k}"') for k in range(3)] == [3, 2, 1]
    for said in (">simclr<", ">supervised<", "2 models", ">others<", "1 model<"):
        assert said in drawn


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
    text = page(msgspec.structs.replace(results, models=tuple(models)))
    parsed(text)
    for said in ("The same by loss", "The same by augmentation", "Task performance against size, "
                 "by loss", ">simclr<", ">image<", "The same as lines"):  # fmt: skip
        assert said in text, said
    assert "masking of steps" not in text, "the third differs in its augmentation, too"
    models[2] = msgspec.structs.replace(models[2], groups=groups[1] | {"masking": "0.75"})
    text = page(msgspec.structs.replace(results, models=tuple(models)))
    assert "With and without masking of steps" in text
    rows = re.findall(r"<td>(model &lt;\d&gt;)</td><td>([\d.]+ %)</td><td>([\d.]+)</td>", text)
    assert rows == [("model &lt;1&gt;", "0 %", "0.50"), ("model &lt;2&gt;", "75 %", "0.70")]


def test_the_groups_are_what_the_file_says(benchmark):
    layers = replace(
        network(np.random.default_rng(2), "m"),
        network={"encoder": "gru", "attender": "none", "width": 1.0},
        training={"objective": "simclr", "augmentation": "tactile", "masking": 0.75, "seed": 1},
    )
    made, _ = model_result(benchmark, layers)
    assert made.groups == GROUPS | {"objective": "simclr", "masking": "0.75"}
    assert model_result(benchmark, network(np.random.default_rng(2), "m"))[0].groups == {}


def test_the_highest_of_the_animals_is_on_the_page(results):
    highest = results.benchmark.a2a_highest
    assert highest is not None and f"highest {highest:.2f}" in page(results)
