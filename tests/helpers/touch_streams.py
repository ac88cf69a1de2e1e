"""Streams of touches for the tiny model, and what it must say of them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.testing import cut_chunks, small_spec
from tests.helpers.tiny_model import CARD, PERIOD_NS, SUBSTEPS

SPEC = small_spec()
SAME_RATE = small_spec(rate_hz=NS_PER_S / PERIOD_NS)
QUIET = 130  # samples before the first touch: more than a baseline holds
SIGMA = 2e-3
FACTS = ("onset_ns", "t_ns", "step", "final", "label", "prediction_set", "coverage")


def reordered(spec: ArraySpec, order: Sequence[int]) -> ArraySpec:
    """Put an array's elements into another order, or take some of them."""
    fields = ("elements", "grid", "positions", "orientations")
    return replace(spec, **{f: tuple(getattr(spec, f)[i] for i in order) for f in fields})


def signal(touches: list[tuple[int, int, float]], n: int, seed: int = 0) -> np.ndarray:
    """(n, element, channel): noise on an offset, with touches (from, to, size) on element 0."""
    values = np.random.default_rng(seed).normal(size=(n, *SPEC.shape)) * SIGMA + 0.25
    for start, stop, size in touches:
        values[start:stop, 0] += size
    return values.astype(np.float32)


def stream(values: np.ndarray, samples: int = 7) -> list[Chunk]:
    """Chunks at the model's own rate: they pass the resampler unchanged, but for the first."""
    return cut_chunks(values, SAME_RATE.rate_hz, samples)


def pushes(sizes: Sequence[float], seed: int = 0) -> list[Chunk]:
    """Touches of these sizes, most of a second apart."""
    begins = [QUIET + 100 * k for k in range(len(sizes))]
    touches = [(t, t + 30, size) for t, size in zip(begins, sizes, strict=True)]
    return stream(signal(touches, begins[-1] + 200, seed))


def push_all(classifier: Classifier, chunks: list[Chunk]) -> list[Classification]:
    return [decision for chunk in chunks for decision in classifier.push(chunk)]


def same(a: list[Classification], b: list[Classification]) -> bool:
    """Compare decisions bit by bit, but for how long the steps took."""
    facts = [[tuple(getattr(d, f) for f in FACTS) for d in which] for which in (a, b)]
    return facts[0] == facts[1] and all(
        np.array_equal(x.probabilities, y.probabilities) for x, y in zip(a, b, strict=True)
    )


def expected_logits(values: np.ndarray, onset: int, step: int) -> np.ndarray:
    """What the tiny model says in a step (from 1) if it was fed right; onset indexes `values`.

    The touch began one sample before the onset was certain. Nothing of it is in the baseline,
    which also leaves out the five samples before it and reaches back a hundred more.
    """
    window = values[onset : onset + step * SUBSTEPS, 0, 0].astype(np.float64)
    baseline = values[onset - 1 - 5 - 100 : onset - 1 - 5, 0, 0].astype(np.float64)
    deviation = window - baseline.mean()
    sigma = max(baseline.std(ddof=1), CARD.floor[0])
    return np.array([0, step, deviation.sum(), deviation[-1], sigma])


def fed_logits(values: np.ndarray, onset: int, step: int, within: float = 2e-6) -> Any:
    """Return `expected_logits` as a pytest.approx to compare with."""
    return pytest.approx(expected_logits(values, onset, step), abs=within)
