"""Does the network keep up with its stream?"""

import logging
from typing import Literal, get_args

from tactile_rt.stream import ConfigError

__all__ = ["Deadline", "Policy"]

Policy = Literal["count", "report", "skip"]
log = logging.getLogger("tactile_rt.classifier")


class Deadline:
    """Of every step: is its decision due before the limit, were the stream live?

    The work that waits shrinks with the stream's time and grows with every step's. A step is late
    if more than `limit_s` of work has gathered by its end: because it took so long itself, or
    because those before it did. That depends neither on how the stream was cut into chunks nor on
    how fast it is read, so a replay says what a robot would have met.

    Args:
        limit_s: work that may gather, s.
        policy: what becomes of a late decision. ``count``: it is returned, marked and counted;
            ``report``: and an episode's first is logged as a warning; ``skip``: it is counted and
            withheld, as one that a robot must not act upon. The network takes every step in any
            case: with one left out, the later decisions would be of another signal.

    Attributes:
        behind_s: work that had gathered at the end of the last step, s.
        late: late steps so far.

    Raises:
        ConfigError: no such policy, or a limit that is not positive.
    """

    def __init__(self, limit_s: float, policy: Policy = "count") -> None:
        if policy not in get_args(Policy):
            raise ConfigError(f"late: {policy!r}; it can be {', '.join(get_args(Policy))}")
        if not limit_s > 0:
            raise ConfigError(f"deadline_s: {limit_s}; it must be positive")
        self.limit_s, self.policy = limit_s, policy
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
        if self.behind_s <= self.limit_s:
            return False
        self.late += 1
        if self.policy == "report" and not self._reported:
            self._reported = True
            log.warning(
                "late: a step took %.1f ms and %.1f ms of work have gathered (limit %.1f ms); "
                "%d late steps so far",
                1e3 * took_s, 1e3 * self.behind_s, 1e3 * self.limit_s, self.late,
            )  # fmt: skip
        return True
