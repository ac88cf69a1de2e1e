"""Vectorised split halves against the plain loop, and the published aggregates."""

from pathlib import Path

import numpy as np
import pytest

from tactile_rt.alignment.benchmark import Consistency
from tactile_rt.alignment.rdm import pearson, rdm
from tactile_rt.alignment.reliability import (
    filtered_mean,
    first_halves,
    half_rdms,
    noise_corrected,
    spearman_brown,
    split_half,
    trial_mean,
)
from tactile_rt.core.errors import ConfigError
from tests.helpers.brains import geometry, loop, padded

PUBLISHED = Path(__file__).parent / "data" / "published_model_input.npz"
BOOTSTRAPS = 120


def vectorised(source, target, bootstraps):
    model = source.ndim == 2
    r_yy = split_half(target, first_halves(len(target), bootstraps))
    r_xx = (
        np.ones(bootstraps) if model else split_half(source, first_halves(len(source), bootstraps))
    )
    r_xy = pearson(rdm(source if model else trial_mean(source)), rdm(trial_mean(target)))
    return r_xy, r_xx, r_yy, noise_corrected(r_xy, r_xx, r_yy)


def cases():
    rng = np.random.default_rng(7)
    shared = geometry(rng)
    yield "model", rng.normal(size=(6, 30)), padded(rng, patterns=shared, noise=6)
    yield "noise", rng.normal(size=(6, 30)), padded(rng)
    yield "animals", padded(rng, (40, 17, 31), (5, 8, 6), 6, shared), padded(rng, patterns=shared)
    yield "noisy animals", padded(rng, (20, 20), (6, 6)), padded(rng)
    # A session of four trials is often wholly in one half, which then has no mean.
    yield "short", rng.normal(size=(6, 30)), padded(rng, (12, 4), (6, 5), 3, shared)
    # Few units, mostly silent: half-means of nothing but zeros.
    yield "silent", rng.normal(size=(6, 30)), padded(rng, (8,), (3,), silent=0.8)
    yield "odd rows", rng.normal(size=(6, 30)), padded(rng, (13, 13), (6, 5), 6, shared)


@pytest.mark.parametrize(
    ("source", "target"), [c[1:] for c in cases()], ids=[c[0] for c in cases()]
)
def test_the_plain_loop_gives_the_same(source, target):
    expected = loop(source, target, BOOTSTRAPS)
    kept = ~np.isnan(expected[2])
    r_xy, r_xx, r_yy, score = vectorised(source, target, BOOTSTRAPS)
    assert (np.isnan(r_yy) == ~kept).all()
    np.testing.assert_allclose(r_yy, expected[2], rtol=0, atol=1e-10)
    np.testing.assert_allclose(r_xx[kept], expected[1, kept], rtol=0, atol=1e-10)
    np.testing.assert_allclose(expected[0, kept], r_xy, rtol=0, atol=1e-10)
    assert (np.isnan(score) == np.isnan(expected[3])).all()
    np.testing.assert_allclose(score, expected[3], rtol=1e-9, atol=1e-10)


def test_the_cases_cover_what_can_go_wrong():
    found = {name: loop(source, target, BOOTSTRAPS) for name, source, target in cases()}
    assert 0 < np.isnan(found["short"][2]).sum() < BOOTSTRAPS  # dropped
    assert 0 < np.isnan(found["silent"][2]).sum() < BOOTSTRAPS
    assert np.isnan(found["noise"][3]).any()  # negative reliability
    both = (found["noisy animals"][1] < 0) & (found["noisy animals"][2] < 0)
    assert np.isfinite(found["noisy animals"][3][both]).any()  # the trap: finite all the same


def test_the_published_aggregates_follow_from_the_published_bootstraps():
    with np.load(PUBLISHED) as file:
        r_xy, r_yy, published = (file[k] for k in ("r_xy", "r_yy", "r_xy_n_sb"))
    score = noise_corrected(r_xy, 1.0, r_yy)
    np.testing.assert_allclose(score, published, rtol=1e-9)
    assert r_xy.mean() == pytest.approx(0.283455, abs=1e-6)
    assert np.isnan(score).sum() == 286
    assert np.nanmedian(score) == pytest.approx(0.457738, abs=1e-6)  # the paper's 0.46
    assert filtered_mean(score, r_yy) == pytest.approx(0.329451, abs=1e-6)  # as models are scored
    assert (r_yy >= 0.5).sum() == 75


def test_the_published_standard_error_takes_off_no_degree_of_freedom():
    with np.load(PUBLISHED) as file:
        scores = file["r_xy_n_sb"]
    nothing = np.empty((0, 0))
    one, other = (Consistency((), scores, nothing, ddof).sem for ddof in (0, 1))
    assert one == pytest.approx(0.017570933160905067, abs=1e-15)  # as saved with the results
    assert other > one + 1e-5
    assert np.isnan(Consistency((), scores[:0], nothing, 0).sem)


def test_halves_are_those_of_the_published_code():
    first = first_halves(7, 3)
    for b, mask in enumerate(first):
        order = list(range(7))
        np.random.RandomState(1234 + b).shuffle(order)
        assert sorted(order[:3]) == np.flatnonzero(mask).tolist()


def test_spearman_brown_and_the_correction():
    np.testing.assert_allclose(spearman_brown([0, 0.5, 1, -0.5]), [0, 2 / 3, 1, -2])
    assert noise_corrected(0.3, 1.0, 1.0) == pytest.approx(0.3)
    assert noise_corrected(0.3, 1.0, 0.5) == pytest.approx(0.3 / np.sqrt(2 / 3))
    assert np.isnan(noise_corrected(0.3, 1.0, [-0.2, 0.0, 1e-9, -1.0, np.nan])).all()
    assert np.isnan(noise_corrected(0.3, 0.0, -1.0))  # nought times infinity
    assert np.isfinite(noise_corrected(0.3, -0.5, -0.5))


def test_nothing_passes_the_filter():
    assert np.isnan(filtered_mean([0.4, np.nan], [0.3, 0.9]))
    assert filtered_mean([1.0, 2.0, 6.0], [0.9, 0.9, 0.9], [0.9, 0.1, 0.5]) == 3.5
    assert filtered_mean([1.0, 2.0, 6.0], [0.5, 0.9, 0.4]) == 1.5


def test_halves_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="do not fit"):
        half_rdms(np.zeros((5, 6, 3)), first_halves(6, 2))
