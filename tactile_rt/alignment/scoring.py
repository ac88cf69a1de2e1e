"""Scoring of a model's layers against a frozen benchmark."""

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from tactile_rt.alignment import statistics
from tactile_rt.alignment.benchmark import Benchmark
from tactile_rt.alignment.json_file import Number
from tactile_rt.alignment.rdm import Floats, pearson, rdm, upper_indices
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI


class Score(msgspec.Struct, frozen=True, eq=False):
    """The score of a model on a benchmark, with its layers' fits to all targets.

    Attributes:
        targets: The names of the targets; for paper-code the pooled animals are the last.
        rdms: (layer, pair) The RDM of each layer.
        r: (layer, target) Correlations before the correction for noise.
        corrected: (layer, target) Correlations after the correction for noise; NaN where a layer
            has no RDM or a target is too noisy.
        unfiltered: (layer, target) Corrected correlations without the protocol's filter of units.
        reliable: (target,) True for targets that count in the score.
        chosen: (target,) The names of the chosen layers: for strict, the layer that is best on all
            other animals, "" if none can be chosen; for paper-code, the layer of the score.
        per_target: (target,) The chosen layer's corrected correlation; NaN for unreliable targets.
        score: The score: for strict, the mean of `per_target`; for paper-code, the highest of
            `corrected`.
        p: The share of relabellings of the stimuli, with layers chosen anew for each, that reach
            the score; for six stimuli at least 1/720.
        null_95: The 95th percentile of the score over relabellings.
    """

    protocol: str
    layers: tuple[str, ...]
    targets: tuple[str, ...]
    rdms: Floats
    r: Floats
    corrected: Floats
    unfiltered: Floats
    reliable: tuple[bool, ...]
    chosen: tuple[str, ...]
    per_target: Floats
    score: Number
    sem: Number
    p: Number
    null_95: Number


def layer_rdms(layers: Mapping[str, ArrayLike], stimuli: int = len(STIMULI)) -> Floats:
    """Compute RDMs (layer, pair) from layers' responses (stimulus, unit)."""
    rdms = np.empty((len(layers), len(upper_indices(stimuli)[0])))
    for i, (name, values) in enumerate(layers.items()):
        patterns = np.asarray(values, dtype=np.float64)
        if patterns.ndim != 2 or patterns.shape[0] != stimuli or patterns.shape[1] < 1:
            raise ConfigError(
                f"layer {name}: responses {patterns.shape}, not ({stimuli} stimuli, units)"
            )
        rdms[i] = rdm(patterns)
    return rdms


def score(benchmark: Benchmark, layers: Mapping[str, ArrayLike]) -> Score:
    """Score a model from its layers' responses (stimulus, unit), in the benchmark's order."""
    return score_rdms(benchmark, tuple(layers), layer_rdms(layers, len(benchmark.stimuli)))


def score_rdms(benchmark: Benchmark, names: Sequence[str], rdms: ArrayLike) -> Score:
    """Score a model from its layers' RDMs (layer, pair); layers with NaN do not count."""
    rdms = np.asarray(rdms, dtype=np.float64)
    if not names or rdms.shape != (len(names), len(upper_indices(len(benchmark.stimuli))[0])):
        raise ConfigError(f"{len(names)} layers and RDMs {rdms.shape} do not fit")
    targets = benchmark.all_targets
    goal = np.array([t.chosen.rdm for t in targets])
    factor = np.array([t.chosen.factor for t in targets])
    r = pearson(rdms[:, None], goal)
    corrected = r * factor
    other = np.array([t.unfiltered.rdm for t in targets])
    unfiltered = pearson(rdms[:, None], other) * [t.unfiltered.factor for t in targets]
    reliable = np.array([t.reliable for t in targets])
    finite = np.flatnonzero(np.isfinite(rdms).all(axis=1) & np.isfinite(r).any(axis=1))

    strict = benchmark.protocol == "strict"
    values = corrected[np.ix_(finite, reliable)]
    chosen = np.full(len(targets), -1, dtype=np.intp)
    if strict:
        _, best = statistics.held_out(values)
        chosen[reliable] = np.where(best >= 0, finite[best] if finite.size else -1, -1)
    elif values.size:
        chosen[:] = finite[np.unravel_index(np.argmax(values), values.shape)[0]]
    scored = (chosen >= 0) & reliable
    per_target = np.full(len(targets), np.nan)
    per_target[scored] = corrected[chosen[scored], np.flatnonzero(scored)]
    measure = statistics.mean_held_out if strict else statistics.highest
    test = statistics.max_statistic(rdms, goal[reliable], factor[reliable], measure)
    return Score(
        protocol=benchmark.protocol,
        layers=tuple(names),
        targets=tuple(t.name for t in targets),
        rdms=rdms,
        r=r,
        corrected=corrected,
        unfiltered=unfiltered,
        reliable=tuple(reliable.tolist()),
        chosen=tuple(names[i] if i >= 0 else "" for i in chosen.tolist()),
        per_target=per_target,
        score=test.statistic,
        sem=statistics.standard_error(per_target, ddof=int(strict)),
        p=test.p,
        null_95=test.percentile_95,
    )
