"""The default protocol `strict`: named stimuli, cross-fitted choice of units, noise correction.

- Stimuli have names; sessions are pooled by name, and stimuli that were not shown do not count.
- *Cross-fit.* Trials are divided in two within every session and stimulus: units are chosen on one
  half (reliability of their tuning > 0.5) and scored on the other, and vice versa. An RDM is the
  mean over many such divisions, in both directions, so that it depends little on a single one.
- An animal's reliability is that of the RDM of a scored half: the RDMs of the half's own two halves
  have a correlation r, and Spearman-Brown is applied to the mean of r over all divisions, including
  negative values. It is used to correct for noise; an animal at or below zero is not scored. Only
  animals whose RDM has a reliability of at least 0.5 count in mean scores.
- The same values without the choice of units are reported as well.
- Divisions are drawn from trials in an order that depends only on the data (`canonical`), so that
  neither the order of files, trials and units nor the scale of rates matters.

Random divisions are the same for the same data only if the order of trials follows from the data.
Sorting trials by value depends on the order of units, and sorting units on that of trials. So both
get keys together, by colour refinement (Weisfeiler and Leman): a unit's key is computed from its
rates and the keys of their trials, a trial's key from its rates and the keys of their units, again
and again. Sums of keys are integers modulo 2^64, so the order of summation does not matter. Rates
enter by their rank, which no scale changes. Trials or units with the same final key are
interchangeable.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.benchmark import Benchmark, Consistency, Frozen, Target
from tactile_rt.alignment.neural import Animal, NeuralSession, rates_sha256
from tactile_rt.alignment.rdm import CONSTANT, Floats, normalise_vectors, pearson, upper_indices
from tactile_rt.alignment.reliability import BOOTSTRAPS, SEED, spearman_brown
from tactile_rt.core.errors import ConfigError, name_some

MINIMUM_RELIABILITY = 0.5  # of a unit, and of an animal's RDM
MINIMUM_TRIALS = 4  # of every stimulus in a session: one in each quarter
TIE = 1e-9
MINIMUM_UNITS = 5  # of an RDM: with fewer, correlations are mostly 1 or -1


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over units of responses to stimuli and of their products, from which RDMs follow."""

    units: Floats  # (...) number of units in the sums
    sums: Floats  # (..., stimulus) sum over units of the response to each stimulus
    # (..., stimulus, stimulus) sum over units of the products of the responses to two stimuli
    products: Floats

    def __add__(self, other: "Moments") -> "Moments":
        return Moments(
            self.units + other.units, self.sums + other.sums, self.products + other.products
        )

    def rdm(self) -> Floats:
        """Compute RDMs (..., pair); NaN where a response is the same in all units."""
        units = np.maximum(self.units, 1)[..., None]
        mean = self.sums / units
        covariance = self.products - units[..., None] * mean[..., :, None] * mean[..., None, :]
        variance = np.diagonal(covariance, axis1=-2, axis2=-1)
        scale = np.diagonal(self.products, axis1=-2, axis2=-1)
        deviation = np.sqrt(np.where(variance > np.sqrt(CONSTANT) * scale, variance, np.nan))
        correlation = covariance / (deviation[..., :, None] * deviation[..., None, :])
        i, j = upper_indices(correlation.shape[-1])
        return np.asarray(1 - correlation[..., i, j])


@dataclass(frozen=True, eq=False)
class _Pool:
    """Moments of the units of one or more animals, for every division and its halves."""

    # (division, 2, ...) moments of the mean responses over each half of the trials, for the units
    # that were chosen on the other half
    halves: Moments
    quarters: Moments  # (division, 2, 2, ...) moments for the two halves of each half

    def __add__(self, other: "_Pool") -> "_Pool":
        return _Pool(self.halves + other.halves, self.quarters + other.quarters)

    def freeze(self) -> Frozen:
        """Compute the mean RDM, its reliability and the factor that corrects for noise.

        A model's score is its mean correlation with the RDMs of the halves, divided by the root of
        their reliability. Correlations are products of RDMs of length one, so their mean is the
        product with the mean RDM, whose length goes into the factor.
        """
        enough = self.halves.units >= MINIMUM_UNITS
        rdms = self.halves.rdm()
        parts = self.quarters.rdm()
        r = pearson(parts[..., 0, :], parts[..., 1, :])
        unit = normalise_vectors(rdms)
        valid = enough & np.isfinite(r) & np.isfinite(unit).all(axis=-1)
        units = round(float(self.halves.units.mean()))
        if 2 * valid.sum() < valid.size:
            return Frozen(np.zeros(rdms.shape[-1]), np.nan, np.nan, units)
        reliability = float(spearman_brown(r[valid].mean()))
        mean = unit[valid].mean(axis=0)
        length = float(np.sqrt(mean @ mean))
        factor = length / np.sqrt(reliability) if reliability > 0 else np.nan
        level = rdms[valid].mean(axis=-1, keepdims=True)
        spread = np.sqrt(((rdms[valid] - level) ** 2).sum(axis=-1)).mean()
        return Frozen(level.mean() + spread * mean, reliability, float(factor), units)


def freeze_strict(
    animals: Sequence[Animal],
    bootstraps: int = BOOTSTRAPS,
    seed: int = SEED,
    progress: Callable[[float], None] = lambda share: None,
) -> Benchmark:
    """Compute the benchmark of protocol strict from recordings.

    Args:
        animals: rates must count from first contact to choice, and no session may be given twice.
        bootstraps: number of divisions of the trials; each is used in both directions.
    """
    names, notes = [], []
    targets: list[Target] = []
    pools: list[_Pool] = []
    for done, animal in enumerate(sorted(animals, key=lambda a: a.name), start=1):
        sessions = []
        for session in sorted(animal.sessions, key=lambda s: s.name):
            few = [f"{n} of {s}" for s, n in zip(session.stimuli, session.trials, strict=True)
                   if n < MINIMUM_TRIALS]  # fmt: skip
            if few:
                notes.append(
                    f"session {session.name} left out: it has {', '.join(few)}, "
                    f"and every stimulus needs {MINIMUM_TRIALS} correct trials"
                )
            else:
                sessions.append(session)
        if not sessions:
            notes.append(f"animal {animal.name} left out: none of its sessions can be used")
            progress(done / len(animals))
            continue
        ordered = sorted((canonical(s) for s in sessions), key=lambda pair: pair[1])
        every, kept = _make_pools(ordered, bootstraps, seed)
        chosen = kept.freeze()
        names.append(animal.name)
        pools.append(kept)
        targets.append(
            Target(
                name=animal.name,
                chosen=chosen,
                unfiltered=every.freeze(),
                reliable=bool(chosen.reliability >= MINIMUM_RELIABILITY),
                trials=sum(len(s.stimulus) for s in sessions),
                sha256=rates_sha256(
                    {f"{i} rates": s.rates for i, (s, _) in enumerate(ordered)}
                    | {f"{i} stimulus": s.stimulus for i, (s, _) in enumerate(ordered)}
                ),
            )
        )
        progress(done / len(animals))
    if not targets:
        raise ConfigError(f"no animal can be used: {name_some(notes, 1)}")
    return Benchmark(
        protocol="strict",
        targets=tuple(targets),
        pooled=None,
        a2a=_compare_animals(tuple(names), targets, pools),
        bootstraps=bootstraps,
        seed=seed,
        notes=tuple(notes),
        stimuli=animals[0].sessions[0].stimuli,
    )


def _make_pools(
    sessions: Sequence[tuple[NeuralSession, int]], divisions: int, seed: int
) -> tuple[_Pool, _Pool]:
    """Pool all units, and only the reliable units, of sessions with keys from `canonical`."""
    every, kept = [], []
    for session, key in sessions:
        made = divide_trials(session, divisions, np.random.default_rng([seed, key]))
        every.append(_Pool(moments_of(made.halves), moments_of(made.quarters)))
        chosen = made.reliable[:, ::-1]  # chosen on the half that is not scored
        kept.append(
            _Pool(moments_of(made.halves, chosen), moments_of(made.quarters, chosen[:, :, None]))
        )
    return reduce(add, every), reduce(add, kept)


@dataclass(frozen=True, eq=False)
class Divided:
    """Random divisions of a session's trials in two, and of each half in two."""

    halves: Floats  # (division, 2, stimulus, unit) mean responses over each half of the trials
    quarters: Floats  # (division, 2, 2, stimulus, unit) mean responses over each half of a half
    # (division, 2, unit) True if the tuning of a unit over that half of the trials has a
    # reliability above `MINIMUM_RELIABILITY`
    reliable: NDArray[np.bool_]


def divide_trials(session: NeuralSession, divisions: int, rng: np.random.Generator) -> Divided:
    """Divide a session's trials at random into halves and quarters, within every stimulus.

    A unit's reliability is the share of the variance over stimuli of its mean responses that is not
    noise, as estimated from the variance within stimuli: 1 - 1/F of an analysis of variance. It
    equals the Spearman-Brown corrected correlation of two halves, without drawing halves.
    """
    units = session.rates.shape[1]
    stimuli = len(session.stimuli)
    quarters = np.empty((divisions, 4, stimuli, units))
    halves = np.empty((divisions, 2, stimuli, units))
    noise = np.zeros((divisions, 2, units))  # variance of a mean response, mean over stimuli
    for stimulus in range(stimuli):
        rates = session.rates[session.stimulus == stimulus]
        n = len(rates)
        # Sizes of the quarters differ by at most one, and so do sizes of the halves.
        edges = np.array([n // 4, n // 2, n // 2 + (n - n // 2) // 2])
        place = np.searchsorted(edges, np.arange(n), side="right")
        drawn = rng.permuted(np.broadcast_to(place, (divisions, n)), axis=1)
        member = (drawn[:, None, :] == np.arange(4)[:, None]).astype(np.float64)
        sizes = np.bincount(place, minlength=4)[:, None]
        sums, squares = member @ rates, member @ rates**2
        quarters[:, :, stimulus] = sums / sizes
        sizes = sizes[0::2] + sizes[1::2]
        mean = (sums[:, 0::2] + sums[:, 1::2]) / sizes
        spread = np.maximum((squares[:, 0::2] + squares[:, 1::2]) / sizes - mean**2, 0)
        halves[:, :, stimulus] = mean
        noise += spread / (sizes - 1) / stimuli
    signal = halves.var(axis=2, ddof=1)
    varies = signal > CONSTANT * (halves**2).mean(axis=2)
    # Spike counts are integers, so a unit may be exactly at the limit: TIE decides, not rounding.
    reliable = varies & (noise < (1 - MINIMUM_RELIABILITY - TIE) * signal)
    return Divided(halves, quarters.reshape(divisions, 2, 2, stimuli, units), reliable)


def _compare_animals(
    names: tuple[str, ...], targets: Sequence[Target], pools: Sequence[_Pool]
) -> Consistency:
    """Score each reliable animal against all others pooled, and against each of them."""
    pooled = np.full(len(names), np.nan)
    pairwise = np.full((len(names), len(names)), np.nan)
    usable = [i for i, target in enumerate(targets) if target.reliable]
    for i in usable:
        mine = targets[i].chosen
        others = [j for j in usable if j != i]
        if not others:
            break
        source = reduce(add, [pools[j] for j in others]).freeze()
        pooled[i] = pearson(source.rdm, mine.rdm) * source.factor * mine.factor
        for j in others:
            other = targets[j].chosen
            pairwise[i, j] = pearson(mine.rdm, other.rdm) * mine.factor * other.factor
    return Consistency(names, pooled, pairwise)


def moments_of(patterns: Floats, counted: NDArray[np.bool_] | None = None) -> Moments:
    """Compute moments of responses (..., stimulus, unit) over all or `counted` units."""
    if counted is None:
        units = np.full(patterns.shape[:-2], float(patterns.shape[-1]))
    else:
        units = counted.sum(axis=-1, dtype=np.float64)
        patterns = np.where(counted[..., None, :], patterns, 0.0)
    return Moments(
        units=units,
        sums=patterns.sum(axis=-1),
        products=np.matmul(patterns, np.swapaxes(patterns, -1, -2)),
    )


Keys = NDArray[np.uint64]

ROUNDS = 3
SAME = 1e-9  # rates with a smaller relative difference count as equal


def canonical(session: NeuralSession) -> tuple[NeuralSession, int]:
    """Sort a session's trials and units into an order that depends only on the data.

    Returns:
        The session with only rates and stimuli, its trials sorted by stimulus; and a hash of the
        data below 2^64 that does not depend on the order of trials or units or the scale of rates.
    """
    ranks = _rank_rates(session.rates)
    trial = _mix(session.stimulus.astype(np.uint64) + np.uint64(1))
    trial, unit = _refine(ranks, trial)
    key = int(trial.sum(dtype=np.uint64))
    while len(found := _find_repeated(trial)):
        # These may be exchanged, but only together with units: put one of these trials first.
        trial[found[0]] = _mix(trial[found[:1]])[0]
        trial, unit = _refine(ranks, trial)
    rows, columns = np.lexsort((trial, session.stimulus)), np.argsort(unit)
    ordered = NeuralSession(
        session.animal, session.name, session.rates[np.ix_(rows, columns)],
        session.stimulus[rows], stimuli=session.stimuli,
    )  # fmt: skip
    return ordered, key


def _refine(ranks: Keys, start: Keys) -> tuple[Keys, Keys]:
    """Compute keys of trials and units by colour refinement from initial keys of trials."""
    trial = start
    for _ in range(ROUNDS):
        unit = _mix(_mix(ranks + trial[:, None]).sum(axis=0, dtype=np.uint64))
        trial = _mix(_mix(ranks ^ unit).sum(axis=1, dtype=np.uint64) + start)
    return trial, unit


def _find_repeated(keys: Keys) -> NDArray[np.intp]:
    """Return the positions of the lowest key that occurs more than once."""
    values, counts = np.unique(keys, return_counts=True)
    return (
        np.flatnonzero(keys == values[counts > 1][:1]) if (counts > 1).any() else np.array([], int)
    )


def _rank_rates(rates: NDArray[np.float64]) -> Keys:
    """Rank all rates together, ties sharing a rank; return one 64-bit hash per rate."""
    order = np.argsort(rates, axis=None)
    sorted_ = rates.ravel()[order]
    steps = np.diff(sorted_) > SAME * np.maximum(np.abs(sorted_[1:]), np.abs(sorted_[:-1]))
    ranks = np.empty(rates.size, dtype=np.uint64)
    ranks[order] = np.concatenate([[0], np.cumsum(steps)])[: rates.size]
    return _mix(ranks.reshape(rates.shape))


def _mix(keys: Keys) -> Keys:
    """Hash each key to 64 bits (the finaliser of SplitMix64, Steele et al. 2014)."""
    keys = keys + np.uint64(0x9E3779B97F4A7C15)
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(keys ^ (keys >> np.uint64(31)))
