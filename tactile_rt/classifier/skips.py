"""Which stretches of a stream the network skips, so that it decides about what is touched now.

A network that is too slow, or that the processor was kept from, falls behind its stream; from then
on it would decide about what was touched seconds ago. It can take every step all the same, as a
laboratory may want (``all``); or skip to the newest sample, as a robot must (``newest``).

A network with a state must not be fed a stream with a hole in it: what it then says is of no signal
that it was trained on. So a stretch is skipped whole. The episode under way ends where it begins,
an onset within it begins none, and the next onset after it begins one. The contact detector takes
every sample all the same: that costs little, and it then knows its baseline, and what is touched.

A stretch is said in stream times. The same stretches given to a replay give the same decisions.
"""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

CatchUp = Literal["newest", "all"]

SMOOTHING = 0.2  # of the time that a step is expected to take
# Shares of the greatest age. A step whose samples are this young is tried whatever it is expected
# to take: else one that was slow once would be the last.
FRESH = 0.1
# Another one should be done by here: the rest is for its publication, on a machine that is busy.
DONE = 0.8


@dataclass(frozen=True)
class Skip:
    """A stretch of a stream of which the network takes no step.

    Attributes:
        from_ns: The stream time of the first sample that is left out, ns.
        until_ns: The stream time of the first sample after the stretch, ns.
    """

    from_ns: int
    until_ns: int


class Skips:
    """Says of every sample whether it is skipped, and finds what has to be.

    Args:
        planned: stretches that are known beforehand, in their order.
        most_s: how old the newest sample of a step may be when its decision is there, s; infinite:
            nothing is ever skipped for its age.
        age: how old the sample of a stream time (ns) is now, s.

    Attributes:
        found: The stretches that were found since the list was last emptied.
    """

    def __init__(
        self,
        planned: Iterable[Skip] = (),
        most_s: float = float("inf"),
        age: Callable[[int], float] | None = None,
    ) -> None:
        self._ahead = deque(planned)
        self._most_s, self._age = most_s, age
        self._expected_s = 0.0  # what a step takes
        self.found: list[Skip] = []

    def covers(self, t_ns: int) -> bool:
        """Whether the sample of this stream time is skipped; times only ever grow."""
        while self._ahead and t_ns >= self._ahead[0].until_ns:
            self._ahead.popleft()
        return bool(self._ahead) and t_ns >= self._ahead[0].from_ns

    def add(self, from_ns: int, until_ns: int) -> None:
        """Skip this stretch, which begins now."""
        self._ahead.append(Skip(from_ns, until_ns))
        self.found.append(Skip(from_ns, until_ns))

    def before_step(self, t_ns: int) -> bool:
        """Whether the step that this sample completes would come too late; if so it is skipped,
        with all that was taken up to now."""
        if self._age is None:
            return False
        age_s = self._age(t_ns)
        if age_s <= FRESH * self._most_s or age_s + self._expected_s <= DONE * self._most_s:
            return False
        self._skip(t_ns, age_s)
        return True

    def after_step(self, t_ns: int, took_s: float) -> bool:
        """Whether a step has come too late; if so it is as if it had been skipped.

        Args:
            t_ns: stream time of its newest sample, ns.
            took_s: how long it took, s.
        """
        self._expected_s += SMOOTHING * (took_s - self._expected_s)
        age_s = 0.0 if self._age is None else self._age(t_ns)
        if age_s <= self._most_s:
            return False
        self._skip(t_ns, age_s)
        return True

    def _skip(self, t_ns: int, age_s: float) -> None:
        self.add(t_ns, t_ns + max(1, round(1e9 * age_s)))
