"""Whether a model may be released: four tests, and the exit code that a pipeline reads.

1. validity: enough reliable animals to say anything.
2. NeuroAI Turing test: the model is not worse than another mouse, shown to be near one, and better
   than chance (`another_mouse`). How far that can be told in this benchmark stands beside it.
3. regression: not worse than a stored model on the same animals.
4. export fidelity (`fidelity`), which needs no neural data.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tactile_rt.alignment.another_mouse import MARGIN, SURE, Mice, Power
from tactile_rt.alignment.benchmark import Benchmark
from tactile_rt.alignment.scoring import Score
from tactile_rt.alignment.statistics import student

__all__ = [
    "FAIL",
    "INCONCLUSIVE",
    "INPUT_ERROR",
    "LARGEST_DROP",
    "PASS",
    "Check",
    "exit_code",
    "mice_of",
    "neural_checks",
    "regression",
    "turing",
    "validity",
]

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
        baseline: (layer, 15) RDMs of the stored model's layers.
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
        baseline: (layer, 15) RDMs of the stored model's layers.
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
