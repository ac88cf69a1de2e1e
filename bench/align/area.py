"""Alignment: how fast a model is scored, beside the plain loop over bootstraps that is published;
and `truth`, what score and gate find where it is known.

Times are processor time: of one thread where `OMP_NUM_THREADS=1` is set.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bench.align import oracles, truth
from tactile_rt.alignment import load_benchmark, save_benchmark, score
from tactile_rt.alignment.neural import pad
from tactile_rt.alignment.paper_code import freeze_paper_code
from tactile_rt.alignment.rdm import pearson, rdm
from tactile_rt.alignment.reliability import (
    BOOTSTRAPS,
    SEED,
    first_halves,
    noise_corrected,
    split_half,
    trial_mean,
)
from tactile_rt.alignment.statistics import highest, max_statistic
from tactile_rt.models.evaluation.records import Record

Floats = NDArray[np.float64]
# The published factor of the pooled animals: what turned r_xy 0.2835 into 0.3295.
PUBLISHED_FACTOR = 1.1623
T = TypeVar("T")

ANIMALS, LAYERS = 11, 20
# Of the recordings: a few sessions of one to two hundred correct trials and tens of units each.
SESSIONS, TRIALS, UNITS = 3, (120, 200), (20, 40)
LAYER_UNITS = 256
DRAWS = 2000


def run(quick: bool = False) -> list[Record]:
    """Measure speed on synthetic animals of the recordings' size, and errors on a made-up brain."""
    return [*_speed(quick), *oracles.run(quick), *truth.run(quick)]


def _speed(quick: bool) -> list[Record]:
    rng = np.random.default_rng(0)
    animals = {f"animal-{i}": _animal(rng) for i in range(ANIMALS)}
    layers = {f"layer-{i}": rng.normal(size=(6, LAYER_UNITS)) for i in range(LAYERS)}
    model, target = layers["layer-0"], animals["animal-0"]
    bootstraps = 100 if quick else BOOTSTRAPS

    slow_s, slow = _timed(lambda: plain_loop(model, target, bootstraps))
    first_halves.cache_clear()
    fast_s, fast = _timed(lambda: _one_call(model, target, bootstraps))
    frozen_s, benchmark = _timed(lambda: freeze_paper_code(animals, bootstraps))
    targets = ANIMALS + 1
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "benchmark.json"
        save_benchmark(benchmark, path)
        scored_s, result = _timed(lambda: score(load_benchmark(path), layers))
        size_kb = path.stat().st_size / 1e3
    everything = [*animals.values(), pad(list(animals.values()))]
    first_halves.cache_clear()
    targets_s, _ = _timed(lambda: [_one_call(model, rates, bootstraps) for rates in everything])
    # The pooled animals are as many units as all others together.
    pooled_s, _ = _timed(lambda: plain_loop(model, everything[-1], bootstraps // 10))
    grid_s = LAYERS * (ANIMALS * slow_s + 10 * pooled_s)
    tops = _chance(rng, 200 if quick else DRAWS)
    size = f"{LAYERS} layers x {targets} targets x {bootstraps} bootstraps"
    how = f"{target.shape[0]} trials, {target.shape[2]} units, {bootstraps} bootstraps"
    difference = float(np.nanmax(np.abs(slow - fast)))
    same = np.array_equal(np.isnan(slow), np.isnan(fast))
    return [
        Record("align.call", fast_s, "s", "", "one model against one animal", how),
        Record("align.call_speedup", slow_s / fast_s, "x", ">= 8", "the plain loop", how),
        Record("align.call_difference", difference if same else np.inf, "score", "<= 1e-10",
               "the plain loop; NaN in the same bootstraps", how),
        Record("align.freeze", frozen_s, "s", "", "12 targets, and a2a pooled and in pairs", size),
        Record("align.grid", frozen_s + scored_s, "s", "<= 30", "everything from rates", size),
        Record("align.grid_speedup", grid_s / (targets_s + scored_s), "x", ">= 100",
               "the plain loop on every layer and target, from one animal and a tenth of the pool",
               f"{size}; each target's reliability once, 720 relabellings included"),
        Record("align.scored", scored_s * 1e3, "ms", "", "a model from a frozen file", size),
        Record("align.file", size_kb, "kB", "", "frozen benchmark", f"{targets} targets"),
        Record("align.chance_median", float(np.median(tops)), "r", "",
               "highest score of 20 layers x 12 targets of random RDMs", f"{len(tops)} draws"),
        Record("align.chance_95", float(np.percentile(tops, 95)), "r", "", "the same", ""),
        Record("align.false_positives", 100 * _false_positives(rng, 200 if quick else 1000), "%",
               "<= 6", "random models that pass p < 0.05",
               f"{LAYERS} layers, layer chosen on held-out animals"),
        Record("align.p", result.p, "", "", "random layers on these animals, published maximum"),
    ]  # fmt: skip


def plain_loop(model: Floats, rates: Floats, bootstraps: int) -> Floats:
    """Scores (bootstrap,) of a model (6, unit) against (row, 6, unit), one after the other."""
    upper = np.triu_indices(6, k=1)

    def correlate(a: Floats, b: Floats) -> float:
        one, other = ((1 - np.asarray(np.corrcoef(x)))[upper] for x in (a, b))
        return float(np.corrcoef(one, other)[0, 1])

    scores = np.full(bootstraps, np.nan)
    for b in range(bootstraps):
        order = np.random.RandomState(SEED + b).permutation(len(rates))
        half = len(rates) // 2
        one, other = (np.nanmean(rates[rows], axis=0) for rows in (order[:half], order[half:]))
        if np.isfinite(one).all() and np.isfinite(other).all():
            r_xy = correlate(model, np.nanmean(rates, axis=0))
            r_yy = correlate(one, other)
            reliability = 2 * r_yy / (1 + r_yy)
            if reliability > 0:
                scores[b] = r_xy / np.sqrt(reliability)
    return scores


def _one_call(model: Floats, rates: Floats, bootstraps: int) -> Floats:
    r_yy = split_half(rates, first_halves(len(rates), bootstraps))
    return noise_corrected(pearson(rdm(model), rdm(trial_mean(rates))), 1.0, r_yy)


def _animal(rng: np.random.Generator) -> Floats:
    """Rates in the published layout, of units tuned weakly enough to be unreliable at times."""
    blocks = []
    for _ in range(SESSIONS):
        trials, units = int(rng.integers(*TRIALS)), int(rng.integers(*UNITS))
        tuned = rng.gamma(2, 3, units) * np.exp(0.2 * rng.normal(size=(6, units)))
        blocks.append(rng.poisson(tuned, size=(trials, 6, units)).astype(np.float64))
    return pad(blocks)


def _chance(rng: np.random.Generator, draws: int) -> Floats:
    """Highest score of random RDMs of a model against random RDMs of targets, (draw,)."""
    return PUBLISHED_FACTOR * np.array([
        highest(pearson(rng.random((LAYERS, 1, 15)), rng.random((ANIMALS + 1, 15))))
        for _ in range(draws)
    ])  # fmt: skip


def _false_positives(rng: np.random.Generator, draws: int) -> float:
    """Share of random models with p < 0.05 against animals of one geometry."""
    shared = rdm(rng.normal(size=(6, 20)))
    targets = shared + 0.1 * rng.normal(size=(ANIMALS, 15))
    factors = rng.uniform(1, 1.4, ANIMALS)
    passed = [
        max_statistic(rdm(rng.normal(size=(LAYERS, 6, 20))), targets, factors).p < 0.05
        for _ in range(draws)
    ]
    return float(np.mean(passed))


def _timed(what: Callable[[], T]) -> tuple[float, T]:
    """Processor time, which a neighbour on the machine does not lengthen."""
    begin = process_time()
    made = what()
    return process_time() - begin, made
