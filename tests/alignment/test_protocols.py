"""Both protocols on synthetic animals whose geometry is known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tactile_rt.alignment.benchmark import load_benchmark, save_benchmark
from tactile_rt.alignment.example import Brain
from tactile_rt.alignment.neural import Animal, NeuralSession, pad, published_layout
from tactile_rt.alignment.paper_code import freeze_paper_code
from tactile_rt.alignment.scoring import score, score_rdms
from tactile_rt.alignment.strict import canonical, divide_trials, freeze_strict
from tactile_rt.core.errors import ConfigError
from tests.helpers.brains import animals, geometry, loop, padded, responses, session
from tests.helpers.refusals import refusal

BOOTSTRAPS = 200


def plain_filtered(results):
    _, r_xx, r_yy, corrected = results
    kept = (r_xx >= 0.5) & (r_yy >= 0.5) & np.isfinite(corrected)
    return corrected[kept].mean() if kept.any() else np.nan


# strict


def test_animals_of_one_geometry_agree_and_scrambled_ones_do_not():
    rng = np.random.default_rng(0)
    shared = freeze_strict(animals(rng), BOOTSTRAPS)
    assert len(shared.reliable) == 6
    assert shared.a2a.mean > 0.9
    assert np.nanmin(shared.a2a.pairwise) > 0.9
    scrambled = freeze_strict(animals(rng, number=24, scrambled=True), 50)
    assert len(scrambled.reliable) == 24
    assert abs(scrambled.a2a.mean) < 0.2
    assert abs(np.nanmean(scrambled.a2a.pairwise)) < 0.2


def test_the_error_of_a_consistency_is_that_of_its_protocol(tmp_path):
    made = animals(np.random.default_rng(1), number=5)
    published = freeze_paper_code({a.name: published_layout(a) for a in made}, 20)
    for benchmark, ddof in ((freeze_strict(made, 20), 1), (published, 0)):
        save_benchmark(benchmark, tmp_path / "b.json")
        for one in (benchmark, load_benchmark(tmp_path / "b.json")):
            pooled = one.a2a.pooled[np.isfinite(one.a2a.pooled)]
            wanted = np.std(pooled, ddof=ddof) / np.sqrt(len(pooled))
            assert one.a2a.sem == pytest.approx(wanted, rel=1e-12)


def test_the_order_of_appearance_destroys_what_animals_share():
    """The same animals, arranged as published: the consistency is gone."""
    made = animals(np.random.default_rng(1), number=8, sessions=3)
    published = freeze_paper_code({a.name: published_layout(a) for a in made}, 50)
    assert freeze_strict(made, 50).a2a.mean > 0.9
    assert all(target.reliable for target in published.targets)
    assert abs(np.nanmean(published.a2a.pairwise)) < 0.2
    assert published.a2a.mean < 0.3


def test_a_division_is_of_all_trials_and_none_twice():
    """Each trial is a power of two, so that sums of trials tell which trials were summed."""
    trials = 9
    rates = np.tile(2.0 ** np.arange(trials), 6)[:, None]
    one = NeuralSession("mouse", "s", rates, np.repeat(np.arange(6), trials))
    made = divide_trials(one, 50, np.random.default_rng(0))
    sizes = np.array([4, 5])[:, None, None]
    halves = np.round(made.halves * sizes).astype(int)
    assert (halves.sum(axis=1) == 2**trials - 1).all()
    assert (halves[:, 0] & halves[:, 1] == 0).all()
    quarters = made.quarters * np.array([[2, 2], [2, 3]])[:, :, None, None]
    np.testing.assert_allclose(quarters.sum(axis=2), made.halves * sizes)
    assert len(np.unique(halves[:, 0])) > 20


def test_a_unit_is_reliable_by_analysis_of_variance():
    """scipy's F of each half of the trials; 1 - 1/F > 0.5 is F > 2."""
    rng = np.random.default_rng(5)
    one = session(rng, "mouse", "s", geometry(rng), trials=8, noise=12, units=30, idle=1)
    key = 2.0 ** np.arange(8)  # a unit that tells which trials a mean is of
    marked = replace(one, rates=np.column_stack([one.rates, np.zeros(len(one.stimulus))]))
    for stimulus in range(6):
        marked.rates[marked.stimulus == stimulus, -1] = key
    made = divide_trials(marked, 10, np.random.default_rng(1))
    seen = set()
    for halves, reliable in zip(made.halves, made.reliable, strict=True):
        for mean, found in zip(halves, reliable, strict=True):
            groups = []
            for stimulus in range(6):
                rows = marked.rates[marked.stimulus == stimulus]
                code = round(mean[stimulus, -1] * 4)
                groups.append(rows[[k for k in range(8) if code >> k & 1]])
            expected = stats.f_oneway(*(g[:, :30] for g in groups)).statistic > 2
            np.testing.assert_array_equal(found[:30], expected)
            assert not found[30]  # idle: the same in every trial but for rounding
            seen |= set(expected.tolist())
    assert seen == {True, False}


def test_a_score_is_the_mean_over_halves_of_units_chosen_on_the_other():
    """The whole protocol as a plain loop over divisions and directions."""
    rng = np.random.default_rng(6)
    shared = geometry(rng)
    animal = animals(rng, 1, shared=shared, noise=6, trials=9)[0]
    (target,) = freeze_strict([animal], 30).targets
    model = responses(rng, shared, 50)
    made = [
        divide_trials(s, 30, np.random.default_rng([1234, key]))
        for s, key in sorted((canonical(s) for s in animal.sessions), key=lambda pair: pair[1])
    ]

    def upper(patterns):
        return (1 - np.corrcoef(patterns))[np.triu_indices(6, k=1)]

    r_xy, r_yy = [], []
    for b in range(30):
        for half in range(2):
            chosen = [m.reliable[b, 1 - half] for m in made]
            whole, first, second = (
                np.concatenate([p[:, c] for p, c in zip(parts, chosen, strict=True)], axis=1)
                for parts in (
                    [m.halves[b, half] for m in made],
                    [m.quarters[b, half, 0] for m in made],
                    [m.quarters[b, half, 1] for m in made],
                )
            )
            r_xy.append(np.corrcoef(upper(model), upper(whole))[0, 1])
            r_yy.append(np.corrcoef(upper(first), upper(second))[0, 1])
    r = np.mean(r_yy)
    expected = np.mean(r_xy) / np.sqrt(2 * r / (1 + r))
    found = np.corrcoef(upper(model), target.chosen.rdm)[0, 1] * target.chosen.factor
    assert found == pytest.approx(expected, abs=1e-10)
    assert target.chosen.reliability == pytest.approx(2 * r / (1 + r), abs=1e-10)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_neither_order_nor_scale_changes_a_score(seed, scale):
    """Sparse counts, so that many trials and units look alike: the hardest case for an order."""
    rng = np.random.default_rng(seed)
    counts = np.random.default_rng(0)
    made, changed = [], []
    for k in range(3):
        tuned = np.exp(counts.normal(size=(6, 14)))
        shown = np.repeat(np.arange(6), 6)
        sessions = [
            NeuralSession(f"m{k}", f"m{k}-{j}", counts.poisson(tuned[shown]) / 0.045, shown)
            for j in range(2)
        ]
        made.append(Animal(f"m{k}", tuple(sessions)))
        moved = []
        for one in reversed(sessions):
            rows, units = rng.permutation(len(shown)), rng.permutation(14)
            rates = one.rates[np.ix_(rows, units)] * scale
            moved.append(NeuralSession(one.animal, f"x{one.name}", rates, one.stimulus[rows]))
        changed.append(Animal(f"m{k}", tuple(moved)))
    a, b = freeze_strict(made, 12), freeze_strict(changed[::-1], 12)
    for one, other in zip(a.targets, b.targets, strict=True):
        np.testing.assert_allclose(one.chosen.rdm, other.chosen.rdm, atol=1e-12, rtol=0)
        np.testing.assert_allclose(one.chosen.factor, other.chosen.factor, rtol=1e-12)
        np.testing.assert_allclose(one.unfiltered.rdm, other.unfiltered.rdm, atol=1e-12, rtol=0)
    np.testing.assert_allclose(a.a2a.pooled, b.a2a.pooled, atol=1e-12, rtol=0)


def test_no_one_draw_decides():
    rng = np.random.default_rng(7)
    brain = Brain(mice=4, trials=20)
    made = brain.animals(rng, brain.geometry(rng))
    fits = np.array([freeze_strict(made, 100, seed=s).a2a.pooled for s in range(5)])
    assert fits.std(axis=0, ddof=1).max() < 0.02
    assert fits.mean(axis=1).std(ddof=1) < 0.005
    assert (fits[0] != fits[1]).any()


def test_choosing_units_on_noise_makes_no_reliability():
    made = animals(np.random.default_rng(4), number=8, sessions=4, shared=np.zeros((6, 8)), noise=4)
    targets = freeze_strict(made, BOOTSTRAPS).targets
    assert all(10 < t.chosen.units < 50 for t in targets)  # of 160, by chance
    assert abs(np.median([t.chosen.reliability for t in targets])) < 0.2
    assert not any(t.reliable for t in targets)


def test_an_animal_at_or_below_zero_is_not_scored():
    made = animals(np.random.default_rng(5), number=10, sessions=1, shared=np.zeros((6, 8)))
    frozen = freeze_strict(made, BOOTSTRAPS)
    below = [t for t in frozen.targets if not t.unfiltered.reliability > 0]
    assert below
    assert all(np.isnan(t.unfiltered.factor) for t in below)
    assert np.isfinite([t.unfiltered.factor for t in frozen.targets if t not in below]).all()


def test_of_two_animals_the_other_is_the_pool():
    frozen = freeze_strict(animals(np.random.default_rng(6), number=2, noise=5), BOOTSTRAPS)
    one, other = (t.chosen for t in frozen.targets)
    expected = np.corrcoef(one.rdm, other.rdm)[0, 1] * one.factor * other.factor
    assert min(one.factor, other.factor) > 1.01
    np.testing.assert_allclose(frozen.a2a.pooled, expected, rtol=1e-10)
    np.testing.assert_allclose(frozen.a2a.pairwise[[0, 1], [1, 0]], expected, rtol=1e-10)


def test_the_correction_recovers_what_noise_takes():
    """With noise r_xy falls; corrected, it is what it is for the same units without noise."""
    shared = geometry(np.random.default_rng(7))
    model = responses(np.random.default_rng(8), shared, 300)
    seen = [animals(np.random.default_rng(9), shared=shared, noise=noise) for noise in (0.01, 9)]
    quiet, loud = (score(freeze_strict(made, BOOTSTRAPS), {"layer": model}) for made in seen)
    assert sum(loud.reliable) >= 4
    assert np.mean(loud.r) < np.mean(quiet.r) - 0.1
    assert loud.score == pytest.approx(quiet.score, abs=0.05)


def test_a_session_that_lacks_a_stimulus_is_left_out_and_named():
    rng = np.random.default_rng(8)
    made = animals(rng, number=2)
    one = made[0].sessions[0]
    shown = one.stimulus != 4
    poor = NeuralSession(one.animal, "poor", one.rates[shown], one.stimulus[shown])
    frozen = freeze_strict([Animal(made[0].name, (*made[0].sessions, poor)), made[1]], 20)
    assert frozen.notes == (
        "session poor left out: it has 0 of concave-medium, "
        "and every stimulus needs 4 correct trials",
    )
    without = freeze_strict(made, 20)
    assert [t.sha256 for t in frozen.targets] == [t.sha256 for t in without.targets]
    with pytest.raises(ConfigError, match="no animal can be used: session poor left out"):
        freeze_strict([Animal("mouse", (poor,))], 20)


def test_too_few_reliable_units_make_no_rdm():
    rng = np.random.default_rng(10)
    one = session(rng, "mouse", "s", geometry(rng), units=3, idle=1)
    (target,) = freeze_strict([Animal("mouse", (one,))], 50).targets
    assert target.chosen.units <= 4
    assert not target.reliable
    assert np.isnan(target.chosen.factor)


def test_layers_are_chosen_on_the_other_animals():
    rng = np.random.default_rng(11)
    shared = geometry(rng)
    frozen = freeze_strict(animals(rng, shared=shared, number=6), BOOTSTRAPS)
    layers = {
        "random": rng.normal(size=(6, 30)),
        "constant": np.ones((6, 30)),
        "aligned": responses(rng, shared, 200),
    }
    result = score(frozen, layers)
    assert set(result.chosen) == {"aligned"}
    assert result.score > 0.8
    assert result.score == pytest.approx(np.mean(result.per_target))
    assert result.sem == pytest.approx(np.std(result.per_target, ddof=1) / np.sqrt(6))
    assert result.p < 0.01
    assert np.isnan(result.corrected[1]).all()
    assert result.null_95 < result.score
    factors = [t.chosen.factor for t in frozen.targets]
    np.testing.assert_allclose(result.corrected[0], result.r[0] * factors)


def test_one_animal_has_no_score():
    frozen = freeze_strict(animals(np.random.default_rng(12), number=1), 50)
    result = score(frozen, {"a": np.random.default_rng(0).normal(size=(6, 9))})
    assert np.isnan([result.score, result.p, result.sem]).all()
    assert result.chosen == ("",)
    assert np.isfinite(result.corrected).all()
    assert np.isnan(frozen.a2a.mean)


def test_layers_that_do_not_fit_are_refused():
    frozen = freeze_strict(animals(np.random.default_rng(13), number=2), 20)
    assert "layer fc: responses (5, 9)" in refusal(score, frozen, {"fc": np.zeros((5, 9))})
    assert "0 layers" in refusal(score, frozen, {})
    assert "do not fit" in refusal(score_rdms, frozen, ["a"], np.zeros((2, 15)))


# paper-code


def test_paper_code_is_the_plain_loop_with_the_published_aggregates():
    rng = np.random.default_rng(20)
    shared = geometry(rng)
    rates = {f"m{i}": padded(rng, (30, 24 + i), (12, 9), 7 + 2 * i, shared) for i in range(3)}
    frozen = freeze_paper_code(rates, 60)
    assert all(t.reliable for t in frozen.targets)
    layers = {"a": rng.normal(size=(6, 20)), "b": shared @ rng.normal(size=(8, 20))}
    result = score(frozen, layers)
    assert result.targets == ("m0", "m1", "m2", "concatenated")
    everything = {**rates, "concatenated": pad(list(rates.values()))}
    for j, target in enumerate(everything.values()):
        for i, layer in enumerate(layers.values()):
            expected = loop(layer, target, 60)
            assert result.corrected[i, j] == pytest.approx(plain_filtered(expected), abs=1e-10)
            assert result.unfiltered[i, j] == pytest.approx(np.nanmedian(expected[3]), abs=1e-10)
    assert result.score == pytest.approx(np.nanmax(result.corrected))
    best = np.unravel_index(np.nanargmax(result.corrected), result.corrected.shape)[0]
    assert set(result.chosen) == {tuple(layers)[best]}
    spread = result.corrected[best][np.isfinite(result.corrected[best])]
    assert result.sem == pytest.approx(spread.std() / np.sqrt(len(spread)))

    for i, name in enumerate(rates):
        others = pad([r for n, r in rates.items() if n != name])
        expected = plain_filtered(loop(others, rates[name], 60))
        assert frozen.a2a.pooled[i] == pytest.approx(expected, abs=1e-10)
    expected = plain_filtered(loop(rates["m0"], rates["m2"], 60))
    assert frozen.a2a.pairwise[0, 2] == pytest.approx(expected, abs=1e-10)


def test_the_published_layout_has_the_published_mistakes():
    rates = np.arange(1.0, 15.0).reshape(7, 2)
    first = NeuralSession("m", "first", rates, np.array([4, 0, 4, 1, 2, 3, 5]))
    second = NeuralSession("m", "second", -rates[:6, :1], np.array([5, 4, 3, 2, 1, 0]))
    made = published_layout(Animal("m", (first, second)))
    assert made.shape == (7, 6, 3)
    # By first appearance: 4 is index 0 in one session, 1 in the other.
    assert made[0, :, 0].tolist() == [1, 0, 0, 0, 0, 0]
    assert made[1, :, 1].tolist() == [0, 4, 0, 0, 0, 0]
    assert made[2, :, 0].tolist() == [5, 0, 0, 0, 0, 0]
    assert made[1, :, 2].tolist() == [0, -3, 0, 0, 0, 0]
    assert np.isnan(made[6, :, 2]).all()  # padding
    poor = NeuralSession("m", "poor", rates[:3], np.array([4, 0, 1]))
    with pytest.raises(ConfigError, match="poor has no correct trial of convex-far, concave-close"):
        published_layout(Animal("m", (poor,)))
