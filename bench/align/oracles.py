"""Alignment beside others who compute the same: rsatoolbox, scikit-learn, equations as they are
printed, and the results that were published.

Each metric measures random layers of a network on a made-up mouse; the figure is the largest
difference. The tests compare with the same functions.
"""

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.metrics import find_metric
from tactile_rt.alignment.metrics.linear import PENALTIES
from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.reliability import filtered_mean, noise_corrected
from tactile_rt.models.evaluation.records import Record

Floats = NDArray[np.float64]

# Per-bootstrap results for raw sensor input, from the paper's published analysis.
PUBLISHED = Path(__file__).parents[2] / "tests/alignment/data/published_model_input.npz"
# The mean of r_xy; the paper's 0.46; what it is as models are scored.
AGGREGATES = (0.283455, 0.457738, 0.329451)
BINS, TRIALS, UNITS, LAYER_UNITS = 8, 9, 20, 40


def run(quick: bool = False) -> list[Record]:
    """Measure the largest differences from other implementations."""
    rng = np.random.default_rng(40_000)
    session = _session(rng)
    animal = Animal("mouse", (session,))
    number = 3 if quick else 20
    layers = [rng.normal(size=(6, BINS, LAYER_UNITS)) for _ in range(number)]
    how = f"{number} layers, {TRIALS} trials of each stimulus, {UNITS} units, {BINS} bins"
    others: dict[str, tuple[Callable[[NeuralSession, Floats], float], str]] = {
        "rsa": (by_rsa, "rsatoolbox: correlation distance, compared by r"),
        "rsa-time": (by_rsa_time, "rsatoolbox in each bin of 45 ms, mean over bins"),
        "crossnobis": (by_crossnobis, "rsatoolbox: all pairs of different trials, shrunk noise"),
        "cka": (by_cka, "HSIC of Song et al. 2012, equation 5, as it is printed"),
        "linear": (by_linear, "scikit-learn's ridge regression, one stimulus held out"),
    }
    records = []
    for name, (other, anchor) in others.items():
        measure = find_metric(name)(animal)
        difference = max(abs(measure.fit(one) - other(session, one)) for one in layers)
        records.append(Record(f"align.metric.{name}", difference, "", "<= 1e-10", anchor, how))
    with np.load(PUBLISHED) as file:
        r_xy, r_yy = file["r_xy"], file["r_yy"]
    score = noise_corrected(r_xy, 1.0, r_yy)
    ours = (r_xy.mean(), np.nanmedian(score), filtered_mean(score, r_yy))
    records.append(
        Record("align.paper_code", float(np.abs(np.subtract(ours, AGGREGATES)).max()), "score",
               "<= 1e-6", "the published aggregates " + ", ".join(map(str, AGGREGATES)),
               f"from its {len(r_xy)} bootstraps of raw sensor input")
    )  # fmt: skip
    return records


def by_rsa(session: NeuralSession, layer: Floats) -> float:
    """The metric ``rsa`` of a layer (6, step, unit), by rsatoolbox."""
    return _compared(_means(session, session.rates), layer.mean(axis=1))


def by_rsa_time(session: NeuralSession, layer: Floats) -> float:
    """The metric ``rsa-time``, in bins in which the animal is reliable, by rsatoolbox."""
    from tactile_rt.alignment.metrics.rsa_cka import time_course

    assert session.course is not None
    found = time_course(Animal("mouse", (session,)))
    assert found is not None
    there = np.flatnonzero(np.isfinite(found[1]))
    means = _means(session, session.course)
    return float(np.mean([_compared(means[:, b], layer[:, b]) for b in there]))


def by_crossnobis(session: NeuralSession, layer: Floats) -> float:
    """The metric ``crossnobis``, by rsatoolbox."""
    import rsatoolbox
    from rsatoolbox.data.noise import prec_from_residuals

    order = np.argsort(session.stimulus, kind="stable")  # theirs is by first appearance
    rates, stimulus = session.rates[order], session.stimulus[order]
    residuals = rates - _means(session, session.rates)[stimulus]
    data = rsatoolbox.data.Dataset(
        rates, obs_descriptors={"stimulus": stimulus, "trial": np.arange(len(stimulus))}
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = rsatoolbox.rdm.calc_rdm_unbalanced(
            data, method="crossnobis", descriptor="stimulus", cv_descriptor="trial",
            noise=prec_from_residuals(residuals, len(rates) - 6),
        ).get_vectors()[0]  # fmt: skip
    euclidean = _rdm(layer.mean(axis=1), "euclidean")
    return float(np.corrcoef(euclidean, theirs)[0, 1])


def by_cka(session: NeuralSession, layer: Floats) -> float:
    """The metric ``cka``: a ratio of unbiased HSICs."""
    x, y = layer.mean(axis=1), _means(session, session.rates)
    return by_hsic(x @ x.T, y @ y.T)


def by_hsic(k: Floats, m: Floats) -> float:
    """CKA of two kernels by Song et al. 2012, equation 5, as it is printed."""

    def hsic(k: Floats, m: Floats) -> float:
        k, m, n = k - np.diag(np.diag(k)), m - np.diag(np.diag(m)), len(k)
        one = np.ones(n)
        return float(
            np.trace(k @ m)
            + one @ k @ one * (one @ m @ one) / ((n - 1) * (n - 2))
            - 2 / (n - 2) * (one @ k @ m @ one)
        ) / (n * (n - 3))

    return float(hsic(k, m) / np.sqrt(hsic(k, k) * hsic(m, m)))


def by_linear(session: NeuralSession, layer: Floats) -> float:
    """The metric ``linear``: the share of variance, in units of each unit's noise, that
    scikit-learn's ridge predicts."""
    assert session.course is not None
    goal = _means(session, session.course)
    trials = [session.course[session.stimulus == k] for k in range(6)]
    noise = np.stack([t.var(axis=0, ddof=1) / len(t) for t in trials])  # of a mean
    goal = goal / np.sqrt(noise.mean(axis=(0, 1)))
    level = np.stack([goal[[k for k in range(6) if k != i]].mean(axis=0) for i in range(6)])
    error = ((predicted_by_ridge(layer, goal) - goal) ** 2).sum()
    return float(1 - error / ((goal - level) ** 2).sum())


def predicted_by_ridge(layer: Floats, goal: Floats) -> Floats:
    """Responses (6, bin, unit) to each stimulus from a layer (6, bin, layer unit), the penalty
    chosen by leaving out one more, by scikit-learn."""
    from sklearn.linear_model import Ridge

    def regress(known: list[int], held: int, penalty: float) -> Any:
        x = (layer[known] - layer[known].mean(axis=0)).reshape(-1, layer.shape[-1])
        y = (goal[known] - goal[known].mean(axis=0)).reshape(-1, goal.shape[-1])
        alpha = penalty * np.trace(x @ x.T) / len(x)
        machine = Ridge(alpha=alpha, fit_intercept=False, solver="svd").fit(x, y)
        return goal[known].mean(axis=0) + machine.predict(layer[held] - layer[known].mean(axis=0))

    found = np.empty_like(goal)
    for i in range(6):
        rest = [k for k in range(6) if k != i]
        errors = [
            sum(((regress([k for k in rest if k != j], j, p) - goal[j]) ** 2).sum() for j in rest)
            for p in PENALTIES
        ]
        found[i] = regress(rest, i, PENALTIES[int(np.argmin(errors))])
    return found


def _session(rng: np.random.Generator) -> NeuralSession:
    """Trials of units that mix features that change over time, with noise."""
    features = rng.normal(size=(6, BINS, 5)) + rng.normal(size=(6, 1, 5))
    tuned = 20 + 3 * features @ rng.normal(size=(5, UNITS))
    stimulus = rng.permutation(np.repeat(np.arange(6), TRIALS))
    course = tuned[stimulus] + 3 * rng.normal(size=(len(stimulus), BINS, UNITS))
    return NeuralSession("mouse", "mouse-1", course.mean(axis=1), stimulus, course)


def _means(session: NeuralSession, values: Floats) -> Floats:
    return np.stack([values[session.stimulus == k].mean(axis=0) for k in range(6)])


def _rdm(patterns: Floats, method: str) -> Any:
    import rsatoolbox

    return rsatoolbox.rdm.calc_rdm(rsatoolbox.data.Dataset(patterns), method=method).get_vectors()[
        0
    ]


def _compared(one: Floats, other: Floats) -> float:
    return float(np.corrcoef(_rdm(one, "correlation"), _rdm(other, "correlation"))[0, 1])
