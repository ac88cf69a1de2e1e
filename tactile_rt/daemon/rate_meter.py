"""The rate at which a device measures, over the newest second, lost samples included.

The newest second is cut into stretches of a fifth of a second. A device is slow if its rate is low
over all of them together and in most: a hiccup or a reconnection affects only one stretch.
"""

import itertools
from collections import deque
from statistics import median

from tactile_rt.core.stream import NS_PER_S

STRETCH_NS = NS_PER_S // 5
LONGEST_NS = 60 * NS_PER_S  # a longer stretch means that the device's clock was restarted
FEWEST = 5  # stretches, so that two hiccups are a minority
SLOW = 0.9  # of the nominal rate: a cheap oscillator is within a twentieth of it


class RateMeter:
    """A meter of the rate at which a count of measurements grows.

    Args:
        stretch_ns: Length of a stretch, ns; five of them are judged together.
    """

    def __init__(self, stretch_ns: int = STRETCH_NS) -> None:
        self._stretch_ns = stretch_ns
        self._marks: deque[tuple[int, int]] = deque()  # beginnings of stretches: time, count
        self.hz = self.typical_hz = 0.0  # over all stretches, and their median; 0: unknown

    def add(self, count: int, t_ns: int) -> None:
        """Update the rates with the total count of measurements and the time of the count."""
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
        """Return the rate, Hz, or 0 after a silence, and whether the device is slow."""
        if silent_s > max(1.0, 3 / max(self.hz, 1e-9)):
            return 0.0, False
        hz = min(self.hz, max(self.typical_hz, nominal_hz))  # a backlog shows in one stretch only
        return hz, 0 < max(self.hz, self.typical_hz) < SLOW * nominal_hz
