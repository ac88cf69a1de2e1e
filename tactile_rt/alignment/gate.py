"""The release gate of a model: four tests, and the exit code for a pipeline.

1. validity: the benchmark has enough reliable animals.
2. NeuroAI Turing test: the model is not worse than another mouse, within a margin of the noise
   ceiling, and better than chance, see below.
3. regression: the model is not worse than a stored model on the same animals.
4. export fidelity (`fidelity`), which needs no neural data.

The Turing test compares the model's mean fit to single mice with each mouse's mean fit to the
others, all corrected for the noise of the mice. The mean over pairs of mice is the *noise ceiling*,
which a perfect model of a mouse is expected to reach.

- A *fit* is a correlation of RDMs with weighted entries. Two entries that share a stimulus covary,
  and a large entry varies more than a small one; both follow from the RDM itself (Diedrichsen et
  al. 2021, "Comparing representational geometries using whitened unbiased-distance-matrix
  similarity"). The weight is the inverse of that covariance, computed from the mice's mean RDM.
- *Worse than another mouse*: below the fit that a further mouse would exceed in nine of ten cases,
  given the spread of the present mice: a prediction bound, with Student's t.
- *Within the margin*: above (1 - `MARGIN`) times the ceiling, with a confidence of 7/8: a one-sided
  test whose error includes both animals and stimuli (jackknives).

`Mice.power` tries both criteria on a benchmark: each mouse serves as a model of the others, intact
or with a share of its geometry replaced by an unrelated geometry: that of another mouse, with
stimuli relabelled and features rotated at random.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.benchmark import Benchmark
from tactile_rt.alignment.rdm import Floats, count_stimuli, relabellings, to_matrices, upper_indices
from tactile_rt.alignment.scoring import Score
from tactile_rt.alignment.statistics import held_out, student

MARGIN = 0.65  # share of the noise ceiling
WORSE, SURE = 10, 8  # error rates: 1/10 of mice called worse by chance, 1/8 of floors too high
LOST = (0.25, 0.5)  # shares of geometry that damaged mice have lost, for the power
DRAWS = 20  # random damages for every mouse and share
# Weight of the variance of distances by deviations alone, which grows with these, relative to that
# along the present differences; 0.25 to 1 do about as well.
OWN = 0.5
NO_FIT = -9.0  # for a layer without a fit: lower than any fit


@cache
def _make_contrasts(stimuli: int) -> Floats:
    """Return contrasts (pair, stimulus): 1 at a pair's first stimulus, -1 at the second."""
    i, j = upper_indices(stimuli)
    return np.eye(stimuli)[i] - np.eye(stimuli)[j]


@cache
def _select_parts(stimuli: int) -> NDArray[np.bool_]:
    """Return masks (part, pair) of RDM entries: all, then those without each stimulus."""
    without = _make_contrasts(stimuli).T == 0
    return np.concatenate([np.ones((1, without.shape[1]), np.bool_), without])


@dataclass(frozen=True, eq=False)
class BesideMice:
    """Comparison of models with mice: correlations of RDMs, corrected for the mice's noise."""

    fits: Floats  # (model, mouse) fit to each mouse, of a layer that was chosen on the others
    fit: Floats  # (model,) mean fit of each model; NaN if no layer has an RDM
    error: Floats  # (model,) standard error of fit minus ceiling, over animals and stimuli
    floor: Floats  # (model,) lower confidence bound of each fit, one-sided, 7/8
    ceiling: float  # noise ceiling: mean fit of a mouse to another
    bound: float  # fit below which a model is worse than another mouse

    @property
    def worse(self) -> NDArray[np.bool_]:
        """Mask (model,) of models that are worse than another mouse."""
        return np.asarray(self.fit < self.bound)

    @property
    def within(self) -> NDArray[np.bool_]:
        """Mask (model,) of models that are within the margin with confidence."""
        return np.asarray(self.floor > (1 - MARGIN) * self.ceiling)


@dataclass(frozen=True)
class Power:
    """Power of the Turing test with a benchmark, estimated from its own mice."""

    passes: float  # share of intact mice that pass
    fails: dict[float, float]  # share of damaged mice that fail, by the share of geometry lost


class Mice:
    """The mice that models are compared with, with the noise ceiling of their fits.

    Args:
        rdms: (mouse, pair), finite, of three mice or more.
        factors: (mouse,) factors that correct a mouse's correlations for its noise.
    """

    def __init__(self, rdms: Floats, factors: Floats) -> None:
        self.rdms, self.factors = rdms, factors
        self._maps = _compute_maps(rdms.mean(axis=0))
        self._targets = self._normalise(rdms) * factors[:, None]  # (part, mouse, pair)
        number = len(rdms)
        pairs = self._targets @ self._targets.swapaxes(-1, -2)
        pairs[:, np.arange(number), np.arange(number)] = 0
        ordered = number * (number - 1)
        sums = pairs[0].sum(axis=1)
        self._ceilings = pairs.sum(axis=(1, 2)) / ordered  # of each part
        self._loo_ceilings = (pairs[0].sum() - 2 * sums) / (ordered - 2 * (number - 1))
        spread = float((sums / (number - 1)).std(ddof=1))
        self.ceiling = float(self._ceilings[0])
        self.bound = self.ceiling - student(number - 1, WORSE) * math.sqrt(1 + 1 / number) * spread

    def compare(self, models: ArrayLike) -> BesideMice:
        """Fit models to mice, given RDMs (model, layer, pair); skip layers with NaN."""
        vectors = self._normalise(np.asarray(models, dtype=np.float64))
        fits = np.einsum("pmlk,pnk->pmln", vectors, self._targets)
        finite = np.isfinite(fits).all(axis=(0, 3))[..., None]
        _, chosen = held_out(np.where(finite, fits[0], NO_FIT))
        fits = np.take_along_axis(fits, chosen[None, :, None, :], axis=2)[:, :, 0]
        number = fits.shape[-1]
        fit = fits[0].mean(axis=-1)
        # Jackknives: differences from the ceiling without each mouse, and without each stimulus.
        less = (fits[0].sum(axis=-1, keepdims=True) - fits[0]) / (number - 1) - self._loo_ceilings
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
        """Estimate power: test each mouse, intact and damaged, against three or more others."""
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
                damaged = _damage(self.rdms[i], strangers, lost, rng)
                fails[k] += rest.compare(damaged[:, None]).worse
        shares = fails.mean(axis=1) / number
        return Power(passes / number, dict(zip(LOST, shares.tolist(), strict=True)))

    def _normalise(self, rdms: Floats) -> Floats:
        """Whiten, centre and normalise RDMs for each part: (part, ..., pair); NaN if constant."""
        values = np.tensordot(rdms, self._maps, axes=(-1, 1))  # (..., part, pair)
        length = np.sqrt((values**2).sum(axis=-1, keepdims=True))
        size = np.sqrt((rdms**2).sum(axis=-1))[..., None, None]
        unit = values / np.where(length > 1e-12 * size, length, np.nan)
        return np.asarray(np.moveaxis(unit, -2, 0))


def _compute_maps(rdm: Floats) -> Floats:
    """Compute (part, pair, pair) matrices that whiten and centre RDMs, for weighted covariances."""
    stimuli = count_stimuli(len(rdm))
    contrasts, parts = _make_contrasts(stimuli), _select_parts(stimuli)
    shared = contrasts @ _compute_gram(rdm) @ contrasts.T
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


def _compute_gram(rdm: Floats) -> Floats:
    """Compute products (stimulus, stimulus) of centred features from an RDM's squared distances.

    The part common to all distances, such as units' noise, is subtracted as far as eigenvalues stay
    non-negative: no weighted correlation depends on it.
    """
    stimuli = count_stimuli(len(rdm))
    centre = np.eye(stimuli) - 1 / stimuli
    products = -0.5 * centre @ to_matrices(rdm) @ centre
    values, vectors = np.linalg.eigh(products)
    order = np.argsort(np.abs(vectors.sum(axis=0)))  # the constant vector is last
    values, vectors = values[order[:-1]], vectors[:, order[:-1]]
    return np.asarray((vectors * (values - values.min())) @ vectors.T)


def _damage(rdm: Floats, strangers: Floats, lost: float, rng: np.random.Generator) -> Floats:
    """Replace a share `lost` of an RDM's geometry by strangers'; return RDMs (draw, pair)."""
    made = np.empty_like(strangers)
    own = _compute_features(rdm)
    stimuli = len(own)
    ways = relabellings(stimuli)
    for k, other in enumerate(strangers):
        other = _compute_features(other[ways[rng.integers(len(ways))]])
        rotation, _ = np.linalg.qr(rng.normal(size=(stimuli, stimuli)))
        features = math.sqrt(1 - lost) * own + math.sqrt(lost) * other @ rotation
        made[k] = ((_make_contrasts(stimuli) @ features) ** 2).sum(axis=-1)
    return made


def _compute_features(rdm: Floats) -> Floats:
    """Compute features (stimulus, feature) with mean square 1 that have a given RDM."""
    values, vectors = np.linalg.eigh(_compute_gram(rdm))
    features = vectors * np.sqrt(np.maximum(values, 0))
    return np.asarray(features / np.sqrt((features**2).mean()))


PASS, FAIL, INCONCLUSIVE, INPUT_ERROR = 0, 1, 2, 3  # exit codes
LEAST_ANIMALS = 5
LARGEST_P = 0.05
LARGEST_DROP = 0.05  # share of the noise ceiling


@dataclass(frozen=True)
class Check:
    """The result of one test of the gate: an exit code and the reason."""

    name: str
    code: int
    why: str

    @property
    def verdict(self) -> str:
        """Result as a word: pass, fail or inconclusive."""
        return ("pass", "fail", "inconclusive")[self.code]


def exit_code(checks: Sequence[Check]) -> int:
    """Combine tests' exit codes: fail if any fails, else inconclusive if any is."""
    codes = {check.code for check in checks}
    return FAIL if FAIL in codes else INCONCLUSIVE if INCONCLUSIVE in codes else PASS


def neural_checks(
    score: Score, benchmark: Benchmark, baseline: ArrayLike | None = None
) -> tuple[Check, ...]:
    """Run the gate's neural tests; if the benchmark is invalid, later tests are inconclusive.

    Args:
        baseline: (layer, pair) RDMs of the stored model's layers; None to skip the regression test.
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
    """Return the reliable animals of a benchmark, which needs at least three."""
    mice = benchmark.reliable
    return Mice(np.array([t.chosen.rdm for t in mice]), np.array([t.chosen.factor for t in mice]))


def validity(benchmark: Benchmark) -> Check:
    """Test that a benchmark has at least `LEAST_ANIMALS` reliable animals."""
    number = len(benchmark.reliable)
    return Check(
        "validity",
        PASS if number >= LEAST_ANIMALS else INCONCLUSIVE,
        f"{number} of {len(benchmark.targets)} animals are reliable, {LEAST_ANIMALS} are needed",
    )


def turing(score: Score, mice: Mice, power: Power | None = None) -> Check:
    """Run a model's Turing test: fail if worse than another mouse, pass if close.

    To pass, the fit must be within the margin of the noise ceiling, and the p of the score below
    `LARGEST_P`. If the model neither fails nor passes, the test is inconclusive.
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
    """Test a model's drop of fit: pass if certainly small, fail if certain and large.

    The drop is from the stored model's fits to single mice, paired; it is small below
    `LARGEST_DROP` of the noise ceiling. Certainty is by one-sided tests over the mice.

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
