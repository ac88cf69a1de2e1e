"""Which steps of an episode give a decision: early exits, overlapping windows and deadlines.

The network takes every step, whatever becomes of its answer. What becomes of it is said here, and
nothing here knows the network:

- `EarlyExit` ends an episode before its last step when the same class has been sure for long
  enough.
- `Lanes` says, where windows overlap, which copy of the state begins before a step and which one
  is asked after it.
- `Deadline` says whether a step's answer comes too late to be acted upon.

How much accuracy does an early exit cost? A calibrated posterior is so over all steps together, or
at the last one; a few steps after the onset a network is often sure of the wrong class, for a
moment. So the same class must be sure in several steps in a row. Top-1 of the shipped model with
rated noise, 576 sweeps of the validation objects and 576 of the test objects, and the mean step at
which it stops:

                              validation        test
    every sweep to step 22    92.2 %            90.5 %
    0.99 once                 89.9 %, 10.8      89.6 %, 11.1
    0.97 in two steps         90.3 %, 10.8      90.6 %, 11.1
    0.99 in two steps         91.1 %, 12.2      90.5 %, 12.7
    0.90 in three steps       90.8 %, 10.4      89.8 %, 10.7
    0.90 once                 77.4 %,  6.9      74.7 %,  7.2

So half the time costs one or two points; 95 % intervals of one figure are about 2.5 points wide
either side, and wider for sweeps of the same objects.
"""

import logging
from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from tactile_rt.core.errors import ConfigError

__all__ = ["IN_A_ROW", "Deadline", "EarlyExit", "Lanes", "Policy"]

IN_A_ROW = 2

Policy = Literal["count", "report", "skip"]
log = logging.getLogger("tactile_rt.classifier")


class EarlyExit:
    """Step by step: is the posterior sure enough to stop?

    Args:
        sure: probability of the best class, or None: never.
        in_a_row: steps running in which the same class must be so sure.

    Raises:
        ConfigError: `sure` is no probability, or `in_a_row` not positive.
    """

    def __init__(self, sure: float | None, in_a_row: int = IN_A_ROW) -> None:
        if sure is not None and not 0 < sure <= 1:
            raise ConfigError(f"sure: {sure} is no probability above 0")
        if in_a_row < 1:
            raise ConfigError(f"in_a_row: {in_a_row} steps; it must be at least 1")
        self._sure, self._in_a_row = np.inf if sure is None else sure, in_a_row
        self._best, self._sure_for = -1, 0

    def begin(self) -> None:
        """An episode begins."""
        self._sure_for = 0

    def reached(self, best: int, probability: float) -> bool:
        """Take a step's best class and its probability; whether the episode may end with it."""
        again = best == self._best
        self._best = best
        if probability < self._sure:
            self._sure_for = 0
        else:
            self._sure_for = self._sure_for + 1 if again else 1
        return self._sure_for >= self._in_a_row


class Lanes:
    """Overlapping windows, each computed exactly: one lane of the batch per phase.

    A network with state can answer for one window only, the one that began when its state was
    zero. With windows of n steps that begin every k steps, ceil(n / k) copies of the state run
    side by side, and each is zeroed when it is its turn to begin. This says which lane begins
    before a step, and which is asked after it; steps are counted from 0.

    Args:
        every: steps from one window's beginning to the next one's.

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
        """The lane whose window begins with a step, or None."""
        return step // self.every % self.count if step % self.every == 0 else None

    def asked(self, step: int) -> tuple[int, int] | None:
        """The lane to ask after a step, and its own step counted from 1; or None.

        Until the first window is complete, that is the first window's lane.
        """
        if step < self.steps:
            return 0, step + 1
        begun = step + 1 - self.steps
        return (begun // self.every % self.count, self.steps) if begun % self.every == 0 else None


class Deadline:
    """Does the network keep up? Of every step: is its decision in time?

    The work that waits shrinks with the stream's time and grows with every step's. A step is late
    if more than `limit_s` of work has gathered by its end: because it took so long itself, or
    because those before it did. That depends neither on how the stream was cut into chunks nor on
    how fast it is read, so a replay says what a robot would have met. Of a live stream a step is
    late, too, if its newest sample is older than `limit_s` by then, whatever kept it.

    Args:
        limit_s: work that may gather, and age of the newest sample that a step may have, s.
        policy: what becomes of a late decision. ``count``: it is returned, marked and counted;
            ``report``: and an episode's first is logged as a warning; ``skip``: it is counted and
            withheld, as one that a robot must not act upon. The network takes every step in any
            case: with one left out, the later decisions would be of another signal.
        age: how old the sample of a stream time (ns) is now, s; None: the stream is not live.

    Attributes:
        behind_s: The work that had gathered at the end of the last step, s.

    Raises:
        ConfigError: no such policy, or a limit that is not positive.
    """

    def __init__(
        self,
        limit_s: float,
        policy: Policy = "count",
        age: Callable[[int], float] | None = None,
    ) -> None:
        if policy not in get_args(Policy):
            raise ConfigError(f"late: {policy!r}; it can be {', '.join(get_args(Policy))}")
        if not limit_s > 0:
            raise ConfigError(f"deadline_s: {limit_s}; it must be positive")
        self.limit_s, self.policy, self._age = limit_s, policy, age
        self.behind_s = 0.0
        self.late = 0
        self._last_ns: int | None = None
        self._reported = False

    def begin(self) -> None:
        """An episode begins; its first late step may be reported."""
        self._reported = False

    def missed(self, t_ns: int, took_s: float) -> bool:
        """Whether a step is late.

        Args:
            t_ns: stream time of its last sample, ns.
            took_s: how long it took, s.
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
                "late: a step took %.1f ms, %.1f ms of work have gathered, its newest sample is "
                "%.1f ms old (limit %.1f ms); %d late steps so far",
                1e3 * took_s, 1e3 * self.behind_s, 1e3 * age, 1e3 * self.limit_s, self.late,
            )  # fmt: skip
        return True
