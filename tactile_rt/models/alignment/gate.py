"""Whether a model may be released: four tests, and the exit code that a pipeline reads.

1. validity: enough reliable animals to say anything.
2. NeuroAI Turing test: the model fits as well as animals fit each other, and better than chance.
   The first alone is vacuous where animals hardly fit each other.
3. regression: not worse than a stored model on the same animals.
4. export fidelity (`fidelity`), which needs no neural data.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tactile_rt.models.alignment.benchmark import Benchmark
from tactile_rt.models.alignment.scoring import Score

__all__ = [
    "FAIL",
    "INCONCLUSIVE",
    "INPUT_ERROR",
    "PASS",
    "Check",
    "exit_code",
    "neural_checks",
    "regression",
    "turing",
    "validity",
]

PASS, FAIL, INCONCLUSIVE, INPUT_ERROR = 0, 1, 2, 3  # exit codes
LEAST_ANIMALS = 5
LARGEST_P = 0.05
LARGEST_DROP = 0.05
# 97.5 % points of Student's t, for 1, 2, ... degrees of freedom; the normal's beyond.
STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179,
           2.160, 2.145, 2.131, 2.120, 2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064,
           2.060, 2.056, 2.052, 2.048, 2.045, 2.042)  # fmt: skip
NORMAL = 1.960


@dataclass(frozen=True)
class Check:
    """One test and how it went.

    Attributes:
        name: The name of the test, as a report prints it.
        code: The outcome of the test: `PASS`, `FAIL` or `INCONCLUSIVE`.
        why: The reason for the outcome, in a line with the figures.
    """

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
    score: Score, benchmark: Benchmark, baseline: Mapping[str, float] | None = None
) -> tuple[Check, ...]:
    """Tests 1 to 3. Without a valid benchmark the others are inconclusive.

    Args:
        score: of the model on the benchmark.
        benchmark: the benchmark.
        baseline: by animal, the stored model's score on the same benchmark.
    """
    valid = validity(benchmark)
    if valid.code != PASS:
        left = ["turing", *(["regression"] if baseline is not None else [])]
        return valid, *(Check(n, INCONCLUSIVE, "the benchmark is not valid") for n in left)
    checks = [valid, turing(score, benchmark)]
    if baseline is not None:
        checks.append(regression(score, baseline))
    return tuple(checks)


def validity(benchmark: Benchmark) -> Check:
    """At least `LEAST_ANIMALS` reliable animals."""
    number = len(benchmark.reliable)
    return Check(
        "validity",
        PASS if number >= LEAST_ANIMALS else INCONCLUSIVE,
        f"{number} of {len(benchmark.targets)} animals are reliable, {LEAST_ANIMALS} are needed",
    )


def turing(score: Score, benchmark: Benchmark) -> Check:
    """Score at least a2a less its standard error, and p of the maximum below `LARGEST_P`."""
    bar = benchmark.a2a.mean - benchmark.a2a.sem
    why = (
        f"score {score.score:.3f}, animal to animal {benchmark.a2a.mean:.3f} "
        f"± {benchmark.a2a.sem:.3f} (at least {bar:.3f}); p {score.p:.4f} (below {LARGEST_P})"
    )
    if not all(map(math.isfinite, (score.score, score.p, bar))):
        return Check("turing", INCONCLUSIVE, f"cannot be computed: {why}")
    return Check("turing", PASS if score.score >= bar and score.p < LARGEST_P else FAIL, why)


def regression(score: Score, baseline: Mapping[str, float]) -> Check:
    """Mean paired drop above `LARGEST_DROP` with a 95 % interval (Student's t) above zero fails."""
    now = dict(zip(score.targets, score.per_target.tolist(), strict=True))
    drops = np.array([baseline[n] - now[n] for n in now if n in baseline])
    drops = drops[np.isfinite(drops)]
    if drops.size < 2:
        return Check("regression", INCONCLUSIVE, f"{drops.size} animals were scored in both")
    degrees = drops.size - 1
    point = STUDENT[degrees - 1] if degrees <= len(STUDENT) else NORMAL
    half = point * float(drops.std(ddof=1)) / math.sqrt(drops.size)
    mean = float(drops.mean())
    return Check(
        "regression",
        FAIL if mean > LARGEST_DROP and mean - half > 0 else PASS,
        f"dropped by {mean:+.3f} [{mean - half:+.3f}, {mean + half:+.3f}] over {drops.size} "
        f"animals (at most {LARGEST_DROP}, or not to be told from none)",
    )
