"""How fast a device measures: the rate of the newest second, whatever is lost on the way.

The newest second is cut into stretches of a fifth each, every one of them as exact as its times. A
device is slow if they are together, and most of them: a hiccup or a reconnection is in one of them.
"""

import itertools
from collections import deque
from statistics import median

from tactile_rt.core.stream import NS_PER_S

STRETCH_NS = NS_PER_S // 5
LONGEST_NS = 60 * NS_PER_S  # longer: the device's clock has begun anew
FEWEST = 5  # stretches, so that two hiccups are fewer than the others
SLOW = 0.9  # of the nominal rate: a cheap oscillator is within a twentieth of it


class RateMeter:
    """Measures a rate from a count that grows with what was measured.

    Args:
        stretch_ns: Length of a stretch, ns; five of them are judged together.
    """

    def __init__(self, stretch_ns: int = STRETCH_NS) -> None:
        self._stretch_ns = stretch_ns
        self._marks: deque[tuple[int, int]] = deque()  # where stretches begin: time, count
        self.hz = self.typical_hz = 0.0  # over all stretches, and their median; 0: unknown

    def add(self, count: int, t_ns: int) -> None:
        """Take the count at a time, ns."""
        marks = self._marks
        if marks and t_ns - marks[-1][0] < self._stretch_ns:
            return
        if marks and t_ns - marks[-1][0] > LONGEST_NS:
            marks.clear()
            self.hz = self.typical_hz = 0.0
        marks.append((t_ns, count))
        window_ns = FEWEST * self._stretch_ns
        while len(marks) > FEWEST + 1 and t_ns - marks[1][0] >= window_ns:
            marks.popleft()
        if len(marks) > FEWEST and t_ns - marks[0][0] >= window_ns:
            ends = itertools.pairwise(marks)
            self.typical_hz = median(NS_PER_S * (b[1] - a[1]) / (b[0] - a[0]) for a, b in ends)
            self.hz = NS_PER_S * (count - marks[0][1]) / (t_ns - marks[0][0])

    def judge(self, nominal_hz: float, silent_s: float) -> tuple[float, bool]:
        """Return the rate, Hz, and whether it is slow; 0 after a silence, s."""
        if silent_s > max(1.0, 3 / max(self.hz, 1e-9)):
            return 0.0, False
        hz = min(self.hz, max(self.typical_hz, nominal_hz))  # a backlog is in one stretch
        return hz, 0 < max(self.hz, self.typical_hz) < SLOW * nominal_hz
