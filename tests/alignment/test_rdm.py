"""RDMs against numpy's own, rsatoolbox's, and what relabelling stimuli must do."""

import numpy as np
import pytest

from tactile_rt.alignment.rdm import pearson, rdm, relabellings, rsa, stimulus_index, to_matrices
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI


def test_an_rdm_is_one_minus_the_correlations_above_the_diagonal():
    patterns = np.random.default_rng(0).normal(3, 2, size=(4, 6, 17))
    for one, made in zip(patterns, rdm(patterns), strict=True):
        expected = (1 - np.corrcoef(one))[np.triu_indices(6, k=1)]
        np.testing.assert_allclose(made, expected, rtol=0, atol=1e-14)


def test_rsatoolbox_agrees_on_rdms_and_on_their_comparison():
    toolbox = pytest.importorskip("rsatoolbox", reason="rsatoolbox is the oracle")
    rng = np.random.default_rng(1)
    one, other = rng.gamma(2, 5, size=(6, 40)), rng.gamma(2, 5, size=(6, 25))
    theirs = [
        toolbox.rdm.calc_rdm(toolbox.data.Dataset(p), method="correlation") for p in (one, other)
    ]
    for patterns, made in zip((one, other), theirs, strict=True):
        np.testing.assert_allclose(rdm(patterns), made.dissimilarities[0], rtol=0, atol=1e-12)
    expected = toolbox.rdm.compare(*theirs, method="corr").item()
    assert rsa(one, other) == pytest.approx(expected, abs=1e-12)


def test_a_response_that_is_the_same_in_all_units_has_no_dissimilarity():
    patterns = np.random.default_rng(2).normal(size=(6, 9))
    patterns[3] = 0.1 + 0.2  # not exactly represented: its mean differs from it by rounding
    missing = np.isnan(rdm(patterns))
    assert missing.tolist() == [3 in pair for pair in zip(*np.triu_indices(6, k=1), strict=True)]
    patterns[3, 2] = np.inf
    assert np.isnan(rdm(patterns)).sum() == 5


def test_correlations_of_nothing_are_nan():
    assert np.isnan(pearson(np.ones(15), np.arange(15)))
    assert np.isnan(pearson(np.full(15, np.nan), np.arange(15)))


def test_every_relabelling_is_the_rdm_of_relabelled_stimuli():
    from itertools import permutations

    patterns = np.random.default_rng(3).normal(size=(6, 11))
    made = rdm(patterns)[relabellings(6)]
    assert made.shape == (720, 15)
    for order, entries in zip(permutations(range(6)), made, strict=True):
        np.testing.assert_allclose(entries, rdm(patterns[list(order)]), rtol=0, atol=1e-14)


def test_squares_are_symmetric():
    matrix = to_matrices(np.arange(1.0, 16.0))
    assert (matrix == matrix.T).all()
    assert not matrix.diagonal().any()
    assert matrix[0, 5] == 5
    assert matrix[4, 5] == 15


def test_near_in_simulation_is_close_in_the_recordings():
    assert STIMULI[stimulus_index("concave", "near")] == "concave-close"
    assert [stimulus_index(*name.split("-")) for name in STIMULI] == list(range(6))
    with pytest.raises(ConfigError, match="no distance 'nearby'"):
        stimulus_index("convex", "nearby")
    with pytest.raises(ConfigError, match="no shape 'nothing'"):
        stimulus_index("nothing", "far")
