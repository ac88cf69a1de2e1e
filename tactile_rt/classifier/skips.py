"""Skipped stretches of a stream, so that the network decides about what is touched now.

A network that is too slow, or that was denied the processor, falls behind its stream; from then on
it would decide about what was touched seconds ago. It can still take every step, as a laboratory
may want (``all``); or skip to the newest sample, as a robot must (``newest``).

A network with a state must not be fed a stream with a gap in it: it was trained on no such signal.
So a stretch is skipped whole. It ends the current episode, an onset within it begins no episode,
and the next onset after it begins one. The contact detector still takes every sample: that costs
little, and keeps its baseline and contact state up to date.

Stretches are given in stream time. The same stretches given to a replay give the same decisions.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

CatchUp = Literal["newest", "all"]

SMOOTHING = 0.2  # weight of the newest step in the expected duration of a step
# Shares of the greatest age. A step whose samples are this young is always taken, whatever its
# expected duration: otherwise one slow step would be the last.
FRESH = 0.1
# Any other step should end by this age: the rest is for its publication, on a busy machine.
DONE = 0.8


@dataclass(frozen=True)
class Skip:
    """A stretch of a stream in which the network takes no step.

    Attributes:
        from_ns: The stream time of the first sample that is left out, ns.
        until_ns: The stream time of the first sample after the stretch, ns.
    """

    from_ns: int
    until_ns: int


class Skips:
    """A schedule of stretches of a stream to skip, planned or added for late steps.

    Args:
        planned: The stretches that are known beforehand, in order of time.
        most_s: The greatest age of a step's newest sample at its decision, s; if infinite, nothing
            is skipped for its age.
        age: Returns the present age, s, of the sample at a stream time (ns).

    Attributes:
        found: The stretches added since the list was last emptied.
    """

    def __init__(
        self,
        planned: Iterable[Skip] = (),
        most_s: float = float("inf"),
        age: Callable[[int], float] | None = None,
    ) -> None:
        self._ahead = deque(planned)
        self._most_s, self._age = most_s, age
        self._expected_s = 0.0  # duration of a step
        self.found: list[Skip] = []

    def covers(self, t_ns: int) -> bool:
        """Return whether the sample at a stream time is skipped; times must ascend."""
        while self._ahead and t_ns >= self._ahead[0].until_ns:
            self._ahead.popleft()
        return bool(self._ahead) and t_ns >= self._ahead[0].from_ns

    def add(self, from_ns: int, until_ns: int) -> None:
        """Add a stretch to skip, which begins now."""
        self._ahead.append(Skip(from_ns, until_ns))
        self.found.append(Skip(from_ns, until_ns))

    def before_step(self, t_ns: int) -> bool:
        """Return whether the coming step would be too late; if so, skip up to now."""
        if self._age is None:
            return False
        age_s = self._age(t_ns)
        if age_s <= FRESH * self._most_s or age_s + self._expected_s <= DONE * self._most_s:
            return False
        self._skip(t_ns, age_s)
        return True

    def after_step(self, t_ns: int, took_s: float) -> bool:
        """Return whether the finished step is too late; if so, skip up to now.

        Args:
            t_ns: The stream time of the step's newest sample, ns.
            took_s: The duration of the step, s.
        """
        self._expected_s += SMOOTHING * (took_s - self._expected_s)
        age_s = 0.0 if self._age is None else self._age(t_ns)
        if age_s <= self._most_s:
            return False
        self._skip(t_ns, age_s)
        return True

    def _skip(self, t_ns: int, age_s: float) -> None:
        self.add(t_ns, t_ns + max(1, round(1e9 * age_s)))
