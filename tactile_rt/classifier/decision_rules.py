"""Decision rules: early exits, overlapping windows, deadlines, open sets and prediction sets.

The network takes every step. Early exits, overlapping windows and deadlines determine which steps
give a decision, independently of the network.

Open-set and prediction-set rules are fitted on sweeps of objects that the network was not trained
on, and stored in the `ModelCard`. A score is larger the less a step looks like the training data.
It is stored by name; a reader that does not know the name cannot apply the rule.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError

MAX_NAME = 200  # characters
UNKNOWN = "unknown"  # the decision on an object of no class that the model knows
POSTERIOR = "posterior of unknown"  # the score of an `OpenSetRule`: of the label `unknown`
# The score of a `PredictionSetRule`: the posterior mass of the more probable classes.
MASS_ABOVE = "mass above"

Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(gt=0, lt=1)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class OpenSetRule(msgspec.Struct, frozen=True):
    """A rule that decides when an object is of no class that the model knows.

    Attributes:
        score: The name of the score: `POSTERIOR`.
        output: The output of the graph that the score is computed from.
        thresholds: (step,) or (1,) The score above which the object is unknown, by step or for all.
    """

    score: str
    output: Literal["logits", "embedding"]
    thresholds: tuple[float, ...]

    def fault(self, steps: int) -> str:
        """Return why the rule cannot be used for episodes of `steps` steps, or ""."""
        if not is_printable_name(self.score):
            return f"score must be 1 to {MAX_NAME} printable characters"
        if len(self.thresholds) not in (1, steps):
            return f"thresholds: {len(self.thresholds)} values, neither 1 nor one for {steps} steps"
        if not np.isfinite(self.thresholds).all():
            return "thresholds must be finite"
        return ""

    def threshold(self, step: int) -> float:
        """Return the threshold of a step, counted from 1."""
        return self.thresholds[step - 1 if len(self.thresholds) > 1 else 0]


class PredictionSetRule(msgspec.Struct, frozen=True):
    """A rule that selects a step's prediction set: the classes that remain possible.

    A class is in the set if its score in the step is at most the step's quantile.

    Attributes:
        score: The name of the score that every class gets in a step: `MASS_ABOVE`.
        coverage: The share of sweeps of unseen objects whose true class is in the prediction set of
            every step, in (0, 1).
        quantiles: (step,) The largest score of a class in the set, by step.
        objects: The number of objects that the quantiles were fitted on; the sweeps of an object
            count as one.
        noise: The largest noise for which the coverage holds, in multiples of the rated noise;
            None if it holds for any noise.
    """

    score: str
    coverage: Share
    quantiles: tuple[float, ...]
    objects: Count
    noise: Annotated[float, msgspec.Meta(ge=0)] | None = None

    def fault(self, steps: int) -> str:
        """Return why the rule cannot be used for episodes of `steps` steps, or ""."""
        if not is_printable_name(self.score):
            return f"score must be 1 to {MAX_NAME} printable characters"
        if len(self.quantiles) != steps:
            return f"quantiles: {len(self.quantiles)} values for {steps} steps"
        if not np.isfinite(self.quantiles).all():
            return "quantiles must be finite"
        return ""

    def prediction_set(self, probabilities: NDArray[np.float32], step: int) -> list[int]:
        """Return the prediction set of a step as indices of `probabilities` (class,).

        Steps count from 1. The most probable class is first, and always in the set.
        """
        order = np.argsort(-probabilities, kind="stable")
        allowed = mass_above(probabilities)[order] <= self.quantiles[step - 1]
        return [int(k) for k in order[: max(1, int(allowed.sum()))]]


def fitting(rules: Sequence[PredictionSetRule], noise: float) -> PredictionSetRule | None:
    """Return the rule with the least noise limit not below `noise` (relative to rated noise)."""
    known = [r for r in rules if r.score == MASS_ABOVE and (r.noise is None or noise <= r.noise)]
    return min(known, key=lambda r: np.inf if r.noise is None else r.noise, default=None)


def mass_above(probabilities: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return for each class (..., class) the summed posterior of the more probable classes.

    It is 0 for the most probable class and close to 1 for the least. If the posterior of every
    class is 0, since a refusal has all of it, the classes count as equally probable.
    """
    p = probabilities.astype(np.float64)
    p = np.where(p.sum(axis=-1, keepdims=True) > 0, p, 1.0)
    p = p / p.sum(axis=-1, keepdims=True)
    order = np.argsort(-p, axis=-1, kind="stable")
    ranked = np.take_along_axis(p, order, axis=-1)
    above = np.cumsum(ranked, axis=-1) - ranked
    out: NDArray[np.float64] = np.empty_like(above)
    np.put_along_axis(out, order, above, axis=-1)
    return out


def is_printable_name(text: str) -> bool:
    """Return whether a text is printable and has 1 to `MAX_NAME` characters."""
    return 0 < len(text) <= MAX_NAME and text.isprintable()


IN_A_ROW = 2

Policy = Literal["count", "report", "skip"]
log = logging.getLogger("tactile_rt.classifier")


class EarlyExit:
    """A rule that ends an episode early once one class is probable enough.

    Args:
        sure: The probability that the best class needs, or None for no early exit.
        in_a_row: The consecutive steps in which the same class must be that probable.

    Raises:
        ConfigError: `sure` is no probability, or `in_a_row` is not positive.
    """

    def __init__(self, sure: float | None, in_a_row: int = IN_A_ROW) -> None:
        if sure is not None and not 0 < sure <= 1:
            raise ConfigError(f"sure must be above 0, at most 1, not {sure}")
        if in_a_row < 1:
            raise ConfigError(f"in_a_row must be at least 1 step, not {in_a_row}")
        self._sure, self._in_a_row = np.inf if sure is None else sure, in_a_row
        self._best, self._sure_for = -1, 0

    def begin(self) -> None:
        """Begin an episode: forget the steps counted so far."""
        self._sure_for = 0

    def may_end(self, best: int, probability: float) -> bool:
        """Update with a step's best class and probability; return whether the episode may end."""
        again = best == self._best
        self._best = best
        if probability < self._sure:
            self._sure_for = 0
        else:
            self._sure_for = self._sure_for + 1 if again else 1
        return self._sure_for >= self._in_a_row


class Lanes:
    """A schedule of overlapping windows, each computed exactly in a lane of the batch.

    A network with state can answer only for the window that began when its state was zero. With
    windows of n steps that begin every k steps, ceil(n / k) copies of the state run side by side,
    and each is zeroed when its window begins. `beginning` names the lane to zero before a step,
    `choose_lane` the lane that answers after it; steps are counted from 0.

    Args:
        every: steps from the beginning of one window to that of the next.

    Attributes:
        count: The number of lanes, ceil(steps / every).

    Raises:
        ConfigError: `every` is not from 1 to `steps`.
    """

    def __init__(self, steps: int, every: int) -> None:
        if not 1 <= every <= steps:
            raise ConfigError(f"every: {every} steps; windows of {steps} take 1 to {steps}")
        self.steps, self.every = steps, every
        self.count = -(-steps // every)

    def beginning(self, step: int) -> int | None:
        """Return the lane whose window begins with a step, or None."""
        return step // self.every % self.count if step % self.every == 0 else None

    def choose_lane(self, step: int) -> tuple[int, int] | None:
        """Return the lane that answers after a step, and the lane's step, or None.

        A lane's steps are counted from 1. Until the first window is complete, its lane answers.
        """
        if step < self.steps:
            return 0, step + 1
        begun = step + 1 - self.steps
        return (begun // self.every % self.count, self.steps) if begun % self.every == 0 else None


class Deadline:
    """A check of whether the network's steps keep up with its stream.

    The backlog of work shrinks as stream time passes and grows by the time that each step takes. A
    step is late if the backlog exceeds `limit_s` at its end, because it or the steps before it took
    too long. That depends neither on how the stream was cut into chunks nor on how fast it is read,
    so a replay shows what a robot would have met. In a live stream a step is also late if its
    newest sample is then older than `limit_s`, for any reason.

    Args:
        limit_s: greatest backlog, and greatest age of a step's newest sample, s.
        policy: how to treat a late decision. ``count``: return, mark and count it; ``report``:
            also log the first of an episode as a warning; ``skip``: count and withhold it, so that
            a robot does not act on it. The network takes every step in any case: with one left out,
            later decisions would be about another signal.
        age: returns the present age, s, of the sample at a stream time (ns); None if not live.

    Attributes:
        behind_s: The backlog at the end of the last step, s.

    Raises:
        ConfigError: The policy is unknown, or the limit is not positive.
    """

    def __init__(
        self,
        limit_s: float,
        policy: Policy = "count",
        age: Callable[[int], float] | None = None,
    ) -> None:
        if policy not in get_args(Policy):
            raise ConfigError(f"late must be one of {', '.join(get_args(Policy))}, not {policy!r}")
        if not limit_s > 0:
            raise ConfigError(f"deadline_s must be positive, not {limit_s}")
        self.limit_s, self.policy, self._age = limit_s, policy, age
        self.behind_s = 0.0
        self.late = 0
        self._last_ns: int | None = None
        self._reported = False

    def begin(self) -> None:
        """Begin an episode, whose first late step may be reported."""
        self._reported = False

    def add_step(self, t_ns: int, took_s: float) -> bool:
        """Add a step to the backlog; return whether it is late.

        Args:
            t_ns: The stream time of the step's last sample, ns.
            took_s: The duration of the step, s.
        """
        passed = 0.0 if self._last_ns is None else (t_ns - self._last_ns) / 1e9
        self._last_ns = t_ns
        self.behind_s = max(0.0, self.behind_s - passed) + took_s
        age = self.behind_s if self._age is None else self._age(t_ns)
        if max(age, self.behind_s) <= self.limit_s:
            return False
        self.late += 1
        if self.policy == "report" and not self._reported:
            self._reported = True
            log.warning(
                "late: step took %.1f ms, backlog %.1f ms%s (limit %.1f ms); %d late steps so far",
                1e3 * took_s, 1e3 * self.behind_s,
                "" if self._age is None else f", newest sample {1e3 * age:.1f} ms old",
                1e3 * self.limit_s, self.late,
            )  # fmt: skip
        return True
