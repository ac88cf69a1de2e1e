"""Metrics against rsatoolbox, scikit-learn and plain loops, and on animals whose truth is known."""

from importlib import metadata
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from bench.align import oracles
from tactile_rt.alignment.metrics import METRICS, MINIMUM_CEILING, find_metric, metric_names
from tactile_rt.alignment.metrics.crossnobis import distances
from tactile_rt.alignment.metrics.noise_ceiling import bins_of, divisions, half_means
from tactile_rt.alignment.metrics.rsa_cka import cka, rsa, time_course
from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.selection import LAYERS_UM, part_of
from tactile_rt.core.errors import ConfigError
from tests.helpers import brains

NAMES = tuple(METRICS)


@pytest.fixture(scope="module")
def scene():
    """Features (6, bin, 8) that two mice read out linearly, with noise on every trial."""
    rng = np.random.default_rng(7)
    features = rng.normal(size=(6, 10, 8)) + rng.normal(size=(6, 1, 8))
    return features, brains.courses(rng, features, 2)


@pytest.mark.parametrize("name", NAMES)
def test_a_perfect_model_reaches_the_ceiling_and_noise_does_not(scene, name):
    features, animals = scene
    rng = np.random.default_rng(1)
    # Random mixtures of what the animals read out keep its geometry, as units do.
    perfect = features @ rng.normal(size=(8, 4000))
    for animal in animals:
        measure = find_metric(name)(animal)
        assert measure.usable and MINIMUM_CEILING <= measure.ceiling <= 1
        assert measure.fit(perfect) / measure.ceiling == pytest.approx(1, abs=0.12)
        others = [measure.fit(rng.normal(size=(6, 10, 200))) for _ in range(8)]
        assert np.mean(others) / measure.ceiling < 0.35
        assert np.isnan(measure.fit(np.ones((6, 10, 5))))


@pytest.mark.parametrize("name", NAMES)
def test_a_metric_knows_no_order_of_units_and_no_scale(scene, name):
    features, animals = scene
    animal = animals[0]
    order = np.random.default_rng(2).permutation(animal.sessions[0].rates.shape[1])
    changed = Animal("a", tuple(
        NeuralSession("a", s.name, 7 * s.rates[:, order], s.stimulus, 7 * s.course[..., order])
        for s in animal.sessions
    ))  # fmt: skip
    one, other = find_metric(name)(animal), find_metric(name)(changed)
    assert other.ceiling == pytest.approx(one.ceiling, abs=1e-10)
    assert other.fit(features) == pytest.approx(one.fit(features), abs=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_steps_that_input_cannot_reach_do_not_count(scene, name):
    features, animals = scene
    measure = find_metric(name)(animals[0])
    late = features.copy()
    late[:, :3] = np.nan
    assert np.isfinite(measure.fit(late))
    assert np.isnan(measure.fit(np.full_like(features, np.nan)))


@pytest.mark.parametrize("name", NAMES)
def test_an_animal_with_too_little_has_no_ceiling(name):
    rng = np.random.default_rng(3)
    few = brains.session(rng, "a", "s", brains.geometry(rng), trials=3)
    small = brains.session(rng, "a", "s", brains.geometry(rng), units=4)
    for session in (few, small):
        measure = find_metric(name)(Animal("a", (session,)))
        assert np.isnan(measure.ceiling) and not measure.usable
        assert np.isnan(measure.fit(rng.normal(size=(6, 4, 9))))


def test_without_a_time_course_there_are_whole_trials():
    rng = np.random.default_rng(4)
    animal = Animal("a", (brains.session(rng, "a", "s", brains.geometry(rng)),))
    assert time_course(animal) is None
    assert np.isnan(find_metric("rsa-time")(animal).ceiling)
    for name in ("rsa", "crossnobis", "cka", "linear"):
        assert find_metric(name)(animal).usable, name


def test_a_bin_that_few_trials_reach_is_left_out(scene):
    session = scene[1][0].sessions[0]
    course = session.course.copy()
    course[np.flatnonzero(session.stimulus == 2)[3:], 6:] = np.nan
    cut = NeuralSession("a", "s", session.rates, session.stimulus, course)
    assert bins_of((session,)) == 10
    assert bins_of((cut,)) == 6
    course[np.flatnonzero(session.stimulus == 2)[:4], 6:] = 1.0
    assert bins_of((NeuralSession("a", "s", session.rates, session.stimulus, course),)) == 10


def test_halves_are_means_of_half_of_the_trials_of_every_stimulus(scene):
    session = scene[1][0].sessions[0]
    first, means = divisions(session, 3), half_means(session, 10, 3)
    for d in range(3):
        for k in range(6):
            rows = session.stimulus == k
            assert first[d, rows].sum() == rows.sum() // 2
            for half, chosen in enumerate((first[d], ~first[d])):
                wanted = session.course[rows & chosen].mean(axis=0)
                np.testing.assert_allclose(means[d, half, k], wanted, atol=1e-12)


def test_metrics_are_those_of_rsatoolbox_scikit_learn_and_printed_equations():
    pytest.importorskip("rsatoolbox")
    pytest.importorskip("sklearn")
    records = oracles.run(quick=True)
    assert len(records) == len(METRICS) + 1 and all(record.met for record in records)


def test_noise_lengthens_no_crossnobis_distance():
    rng = np.random.default_rng(6)
    stimulus = np.repeat(np.arange(6), 8)
    every = np.ones((1, 48), dtype=bool)
    found = [distances(rng.normal(size=(48, 30)), stimulus, every)[0] for _ in range(300)]
    # The standard error of this mean is 0.05; distances with the bias are 30 * 2 / 8 = 7.5.
    assert np.abs(np.mean(found, axis=0)).max() < 0.25


def test_cka_of_noise_is_nought_on_average():
    rng = np.random.default_rng(9)
    animal = Animal("a", (brains.session(rng, "a", "s", brains.geometry(rng)),))
    measure = cka(animal)
    found = [measure.fit(rng.normal(size=(6, 1, 300))) for _ in range(200)]
    assert abs(np.mean(found)) < 0.1  # 9 numbers each: a standard error of 0.024


def test_what_all_stimuli_share_earns_nothing():
    rng = np.random.default_rng(11)
    onset = np.exp(-np.arange(10))[:, None] * rng.normal(size=(1, 8))
    features = 20 * onset[None] + 0.0 * rng.normal(size=(6, 10, 8))
    animal = brains.courses(rng, features + 0.3 * rng.normal(size=(6, 10, 8)), 1)[0]
    layer = features + 1e-6 * rng.normal(size=(6, 10, 8))
    assert find_metric("linear")(animal).fit(layer) < 0.1


def test_parts_of_cortex():
    rng = np.random.default_rng(12)
    plain = brains.session(rng, "a", "s", brains.geometry(rng), units=12)
    depth = np.array([50, 128, 418, 419, 500, 626, 700, 1006, 1100, 1366, np.nan, 200.0])
    inhibitory = np.arange(12) % 3 == 0
    session = NeuralSession(
        "a", "s", plain.rates, plain.stimulus, plain.rates[:, None].repeat(2, 1), depth, inhibitory
    )
    animal, unknown = Animal("a", (session,)), Animal("b", (plain,))
    found = {
        name: part_of([animal, unknown], name) for name in (*LAYERS_UM, "inhibitory", "excitatory")
    }
    assert all([a.name for a in animals] == ["a"] for animals in found.values())
    units = {name: animals[0].sessions[0].rates.shape[1] for name, animals in found.items()}
    layers = {"L1": 1, "L2/3": 3, "L4": 2, "L5": 2, "L6": 2}
    assert units == {**layers, "inhibitory": 4, "excitatory": 8}
    cut = found["L4"][0].sessions[0]
    np.testing.assert_array_equal(cut.rates, plain.rates[:, 3:5])
    np.testing.assert_array_equal(cut.course[:, 1], plain.rates[:, 3:5])
    assert cut.depth.tolist() == [419, 500]
    assert part_of([animal, unknown], "all") == (animal, unknown)
    with pytest.raises(ConfigError, match="no part of cortex 'L9'"):
        part_of([animal], "L9")


def test_a_layer_of_cortex_is_measured_by_itself():
    """What L4 shares with a model is found in L4, not in L5, which has a geometry of its own."""
    rng = np.random.default_rng(13)
    mine, theirs = brains.geometry(rng), brains.geometry(rng)
    four, five = (brains.session(rng, "a", "s", g, units=400) for g in (mine, theirs))
    order = [np.argsort(s.stimulus, kind="stable") for s in (four, five)]
    session = NeuralSession(
        "a", "s",
        np.concatenate([s.rates[o] for s, o in zip((four, five), order, strict=True)], axis=1),
        four.stimulus[order[0]],
        depth=np.repeat([500.0, 700.0], 400),
    )  # fmt: skip
    layer = brains.responses(rng, mine, 2000)[:, None]
    fits = {
        name: rsa(part_of([Animal("a", (session,))], name)[0]).fit(layer) for name in ("L4", "L5")
    }
    assert fits["L4"] > 0.85 and fits["L5"] < 0.6


def test_metrics_of_others(monkeypatch):
    mine = EntryPoint("mine", f"{rsa.__module__}:rsa", "tactile_rt.alignment_metrics")
    monkeypatch.setattr(metadata, "entry_points", lambda group: EntryPoints([mine]))
    assert metric_names() == (*NAMES, "mine")
    assert find_metric("mine") is rsa
    with pytest.raises(ConfigError, match="no metric 'rda'; did you mean rsa"):
        find_metric("rda")
