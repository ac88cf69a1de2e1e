"""Whether a model may be released: four tests, and the exit code that a pipeline reads.

1. validity: enough reliable animals to say anything.
2. NeuroAI Turing test: the model is not worse than another mouse, shown to be near one, and better
   than chance, see below.
3. regression: not worse than a stored model on the same animals.
4. export fidelity (`fidelity`), which needs no neural data.

The Turing test compares the model's mean fit to single mice with each mouse's mean fit to the
others, all corrected for the noise of the mice. The mean over pairs of mice is the *noise ceiling*,
what a perfect model of a mouse can be expected to reach.

- A *fit* is a correlation of RDMs in which entries are weighted. Two entries that share a stimulus
  vary together, and a large one varies more than a small one, in a way that follows from the RDM
  itself (Diedrichsen et al. 2021, "Comparing representational geometries using whitened
  unbiased-distance-matrix similarity"); the inverse of that covariance, from the mice's mean RDM,
  is the weight.
- *Worse than another mouse*: below the fit that one more mouse would exceed in nine of ten cases,
  given how much the mice that are there differ: a prediction bound, with Student's t.
- *Within the margin*: above the ceiling less `MARGIN` of it, in seven of eight cases: a one-sided
  test whose error is of both animals and stimuli (jackknives).

What the two find in a benchmark is in `Mice.power`: each mouse is taken for a model of the others,
whole or with a share of its geometry replaced by one that has nothing to do with it: that of
another mouse, the stimuli relabelled and the features turned at random.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.benchmark import Benchmark
from tactile_rt.alignment.rdm import Floats, count_stimuli, relabellings, square, upper
from tactile_rt.alignment.scoring import Score
from tactile_rt.alignment.statistics import held_out, student

MARGIN = 0.65  # of the noise ceiling
WORSE, SURE = 10, 8  # a mouse is called worse in one of so many cases, a floor is too high in one
LOST = (0.25, 0.5)  # shares of its geometry that a damaged mouse has lost, for the power
DRAWS = 20  # of damage, for every mouse and share
# Beside its change along the differences that are there, how much a distance varies by what is
# added to it, as a share. It grows with the deviation; 0.25 to 1 do about as well.
OWN = 0.5
NO_FIT = -9.0  # of a layer that has none, lower than any


@cache
def _contrasts(stimuli: int) -> Floats:
    """(pair, stimulus): each pair's first stimulus less its second."""
    i, j = upper(stimuli)
    return np.eye(stimuli)[i] - np.eye(stimuli)[j]


@cache
def _parts(stimuli: int) -> NDArray[np.bool_]:
    """(part, pair): entries that take part: all, and those without each of the stimuli."""
    there = _contrasts(stimuli).T == 0
    return np.concatenate([np.ones((1, there.shape[1]), np.bool_), there])


@dataclass(frozen=True, eq=False)
class BesideMice:
    """Models beside mice. Fits are mean correlations with mice, corrected for their noise."""

    fits: Floats  # (model, mouse) fit to each mouse, of a layer that was chosen on the others
    fit: Floats  # (model,) mean fit of each model; NaN where no layer has an RDM
    error: Floats  # (model,) standard error of that less the ceiling, over animals and stimuli
    floor: Floats  # (model,) what each fit exceeds in seven of eight cases, given that error
    ceiling: float
    bound: float

    @property
    def worse(self) -> NDArray[np.bool_]:
        """(model,) Whether each is worse than another mouse."""
        return np.asarray(self.fit < self.bound)

    @property
    def within(self) -> NDArray[np.bool_]:
        """(model,) Whether each is shown to be within the margin."""
        return np.asarray(self.floor > (1 - MARGIN) * self.ceiling)


@dataclass(frozen=True)
class Power:
    """What the two tests find in a benchmark, by trial on its own mice."""

    passes: float
    fails: dict[float, float]


class Mice:
    """The mice that models are compared to.

    Args:
        rdms: (mouse, pair), finite, of three mice or more.
        factors: (mouse,) that correct a mouse's correlations for its noise.
    """

    def __init__(self, rdms: Floats, factors: Floats) -> None:
        self.rdms, self.factors = rdms, factors
        self._maps = _weights(rdms.mean(axis=0))
        self._targets = self._vectors(rdms) * factors[:, None]  # (part, mouse, pair)
        number = len(rdms)
        pairs = self._targets @ self._targets.swapaxes(-1, -2)
        pairs[:, np.arange(number), np.arange(number)] = 0
        ordered = number * (number - 1)
        sums = pairs[0].sum(axis=1)
        self._ceilings = pairs.sum(axis=(1, 2)) / ordered  # of each part
        self._without = (pairs[0].sum() - 2 * sums) / (ordered - 2 * (number - 1))  # each mouse
        spread = float((sums / (number - 1)).std(ddof=1))
        self.ceiling = float(self._ceilings[0])
        self.bound = self.ceiling - student(number - 1, WORSE) * math.sqrt(1 + 1 / number) * spread

    def compare(self, models: ArrayLike) -> BesideMice:
        """Compare models, given as RDMs (model, layer, pair); a layer with a NaN takes no part."""
        vectors = self._vectors(np.asarray(models, dtype=np.float64))
        fits = np.einsum("pmlk,pnk->pmln", vectors, self._targets)
        there = np.isfinite(fits).all(axis=(0, 3))[..., None]
        _, chosen = held_out(np.where(there, fits[0], NO_FIT))
        fits = np.take_along_axis(fits, chosen[None, :, None, :], axis=2)[:, :, 0]
        number = fits.shape[-1]
        fit = fits[0].mean(axis=-1)
        # Jackknives: the difference from the ceiling, without each mouse and without each stimulus.
        less = (fits[0].sum(axis=-1, keepdims=True) - fits[0]) / (number - 1) - self._without
        parts = fits[1:].mean(axis=-1) - self._ceilings[1:, None]
        stimuli = len(parts)
        error = np.sqrt((number - 1) * less.var(axis=-1) + (stimuli - 1) * parts.var(axis=0))
        return BesideMice(
            fits=fits[0],
            fit=fit,
            error=error,
            floor=fit - student(min(number, stimuli) - 1, SURE) * error,
            ceiling=self.ceiling,
            bound=self.bound,
        )

    def power(self, seed: int = 0) -> Power:
        """Take each mouse for a model of the others, whole and damaged; needs four mice or more."""
        rng = np.random.default_rng(seed)
        number = len(self.rdms)
        passes, fails = 0, np.zeros((len(LOST), DRAWS))
        for i in range(number):
            others = np.arange(number) != i
            rest = Mice(self.rdms[others], self.factors[others])
            whole = rest.compare(self.rdms[i][None, None])
            passes += int((whole.within & ~whole.worse)[0])
            strangers = self.rdms[others][rng.integers(number - 1, size=DRAWS)]
            for k, lost in enumerate(LOST):
                damaged = _damaged(self.rdms[i], strangers, lost, rng)
                fails[k] += rest.compare(damaged[:, None]).worse
        shares = fails.mean(axis=1) / number
        return Power(passes / number, dict(zip(LOST, shares.tolist(), strict=True)))

    def _vectors(self, rdms: Floats) -> Floats:
        """Weighted, centred, of length one, for each part: (part, ..., pair); NaN if constant."""
        values = np.tensordot(rdms, self._maps, axes=(-1, 1))  # (..., part, pair)
        length = np.sqrt((values**2).sum(axis=-1, keepdims=True))
        size = np.sqrt((rdms**2).sum(axis=-1))[..., None, None]
        unit = values / np.where(length > 1e-12 * size, length, np.nan)
        return np.asarray(np.moveaxis(unit, -2, 0))


def _weights(rdm: Floats) -> Floats:
    """Maps (part, pair, pair) of RDMs to vectors whose product is the weighted covariance."""
    stimuli = count_stimuli(len(rdm))
    contrasts, parts = _contrasts(stimuli), _parts(stimuli)
    shared = contrasts @ _gram(rdm) @ contrasts.T
    own = contrasts @ contrasts.T
    covariance = shared * own / np.trace(shared * own) + OWN * own**2 / np.trace(own**2)
    maps = np.zeros((len(parts), len(rdm), len(rdm)))
    for part, entries in zip(maps, parts, strict=True):
        values, vectors = np.linalg.eigh(covariance[np.ix_(entries, entries)])
        root = (vectors / np.sqrt(values)) @ vectors.T
        constant = root.sum(axis=0)
        constant /= np.sqrt(constant @ constant)
        part[np.ix_(entries, entries)] = root - np.outer(root @ constant, constant)
    return maps


def _gram(rdm: Floats) -> Floats:
    """Products of the centred features, (stimulus, stimulus), of an RDM of squared distances.

    What all distances have in common, the noise of the units included, is taken away as far as the
    others allow: no weighted correlation sees it.
    """
    stimuli = count_stimuli(len(rdm))
    centre = np.eye(stimuli) - 1 / stimuli
    products = -0.5 * centre @ square(rdm) @ centre
    values, vectors = np.linalg.eigh(products)
    order = np.argsort(np.abs(vectors.sum(axis=0)))  # the constant one is last
    values, vectors = values[order[:-1]], vectors[:, order[:-1]]
    return np.asarray((vectors * (values - values.min())) @ vectors.T)


def _damaged(rdm: Floats, strangers: Floats, lost: float, rng: np.random.Generator) -> Floats:
    """RDMs (draw, pair) of a geometry that lost a share to strangers (draw, pair)."""
    made = np.empty_like(strangers)
    own = _features(rdm)
    stimuli = len(own)
    ways = relabellings(stimuli)
    for k, other in enumerate(strangers):
        other = _features(other[ways[rng.integers(len(ways))]])
        turned, _ = np.linalg.qr(rng.normal(size=(stimuli, stimuli)))
        features = math.sqrt(1 - lost) * own + math.sqrt(lost) * other @ turned
        made[k] = ((_contrasts(stimuli) @ features) ** 2).sum(axis=-1)
    return made


def _features(rdm: Floats) -> Floats:
    """Features (stimulus, feature) of an RDM, of mean square one."""
    values, vectors = np.linalg.eigh(_gram(rdm))
    features = vectors * np.sqrt(np.maximum(values, 0))
    return np.asarray(features / np.sqrt((features**2).mean()))


PASS, FAIL, INCONCLUSIVE, INPUT_ERROR = 0, 1, 2, 3  # exit codes
LEAST_ANIMALS = 5
LARGEST_P = 0.05
LARGEST_DROP = 0.05  # of the noise ceiling


@dataclass(frozen=True)
class Check:
    """One test and how it went."""

    name: str
    code: int
    why: str

    @property
    def verdict(self) -> str:
        """In a word."""
        return ("pass", "fail", "inconclusive")[self.code]


def exit_code(checks: Sequence[Check]) -> int:
    """Any failure fails; otherwise anything inconclusive is inconclusive."""
    codes = {check.code for check in checks}
    return FAIL if FAIL in codes else INCONCLUSIVE if INCONCLUSIVE in codes else PASS


def neural_checks(
    score: Score, benchmark: Benchmark, baseline: ArrayLike | None = None
) -> tuple[Check, ...]:
    """Tests 1 to 3. Without a valid benchmark the others are inconclusive.

    Args:
        baseline: (layer, pair) RDMs of the stored model's layers.
    """
    valid = validity(benchmark)
    if valid.code != PASS:
        left = ["turing", *(["regression"] if baseline is not None else [])]
        return valid, *(Check(n, INCONCLUSIVE, "the benchmark is not valid") for n in left)
    mice = mice_of(benchmark)
    checks = [valid, turing(score, mice, mice.power())]
    if baseline is not None:
        checks.append(regression(score, mice, baseline))
    return tuple(checks)


def mice_of(benchmark: Benchmark) -> Mice:
    """The reliable animals of a benchmark; there must be three."""
    there = benchmark.reliable
    return Mice(np.array([t.chosen.rdm for t in there]), np.array([t.chosen.factor for t in there]))


def validity(benchmark: Benchmark) -> Check:
    """At least `LEAST_ANIMALS` reliable animals."""
    number = len(benchmark.reliable)
    return Check(
        "validity",
        PASS if number >= LEAST_ANIMALS else INCONCLUSIVE,
        f"{number} of {len(benchmark.targets)} animals are reliable, {LEAST_ANIMALS} are needed",
    )


def turing(score: Score, mice: Mice, power: Power | None = None) -> Check:
    """Fails a model that is worse than another mouse; passes one that is shown to be like one.

    That takes a fit within the margin of the noise ceiling, and a p of the maximum below
    `LARGEST_P`. What is neither worse nor shown to be like one is inconclusive.
    """
    found = mice.compare(score.rdms[None])
    fit, floor, least = float(found.fit[0]), float(found.floor[0]), (1 - MARGIN) * found.ceiling
    why = (
        f"fit {fit:.3f}, of another mouse {found.ceiling:.3f} and in 9 of 10 cases at least "
        f"{found.bound:.3f}; confidently above {floor:.3f} ({least:.3f} is needed); "
        f"p {score.p:.4f} (below {LARGEST_P})"
    )
    if not all(map(math.isfinite, (fit, floor, score.p))):
        return Check("turing", INCONCLUSIVE, f"cannot be computed: {why}")
    if power is not None:
        caught = ", ".join(f"{share:.0%} at {lost:.0%}" for lost, share in power.fails.items())
        why += (
            f". Power: of these mice {power.passes:.0%} pass as models of the others; "
            f"with part of their geometry lost fail {caught}"
        )
    if found.worse[0]:
        return Check("turing", FAIL, why)
    return Check("turing", PASS if found.within[0] and score.p < LARGEST_P else INCONCLUSIVE, why)


def regression(score: Score, mice: Mice, baseline: ArrayLike) -> Check:
    """Passes a drop that is surely small; fails one that is surely there, and not small.

    The drop is that of the fit to single mice, paired; small is below `LARGEST_DROP` of the noise
    ceiling. Sure is by one-sided tests over the mice, on these stimuli.

    Args:
        baseline: (layer, pair) RDMs of the stored model's layers.
    """
    before = mice.compare(np.asarray(baseline, dtype=np.float64)[None]).fits[0]
    drops = (before - mice.compare(score.rdms[None]).fits[0]) / mice.ceiling
    mean = float(drops.mean())
    half = student(drops.size - 1, SURE) * float(drops.std(ddof=1)) / math.sqrt(drops.size)
    why = (
        f"the fit dropped by {mean:+.3f} [{mean - half:+.3f}, {mean + half:+.3f}] of the noise "
        f"ceiling over {drops.size} animals (at most {LARGEST_DROP})"
    )
    if not math.isfinite(mean):
        return Check("regression", INCONCLUSIVE, f"cannot be computed: {why}")
    if mean + half < LARGEST_DROP:
        return Check("regression", PASS, why)
    surely = mean - half > 0
    return Check("regression", FAIL if surely and mean > LARGEST_DROP else INCONCLUSIVE, why)
