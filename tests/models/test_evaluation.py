"""Figures of merit against an independent implementation."""

import numpy as np
import pytest

pytest.importorskip("torch")

from sklearn.metrics import roc_auc_score

from tactile_rt.models.evaluation import auroc


def test_auroc_is_scikit_learns() -> None:
    rng = np.random.default_rng(0)
    # rounded, so that there are ties
    known = np.round(rng.normal(1.0, 1.0, 300), 1).astype(np.float32)
    unknown = np.round(rng.normal(0.0, 1.0, 120), 1).astype(np.float32)
    truth = np.repeat([1, 0], [300, 120])
    wanted = roc_auc_score(truth, np.concatenate([known, unknown]))
    assert auroc(known, unknown) == pytest.approx(wanted, abs=1e-12)


def test_a_sweep_without_contact_scores_lowest() -> None:
    some = np.array([0.2, 0.9], dtype=np.float32)
    none = np.full(2, np.nan, dtype=np.float32)
    assert auroc(some, none) == 1.0
    assert auroc(none, some) == 0.0
    assert auroc(none, none) == 0.5
