"""Baseline and contact onset: from a resampled stream to episodes.

Training windows and the live classifier start at the onset that this detector reports, and use the
baseline (offset and noise) that it measured while nothing was touched.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.baseline_drift import Drift, RestLevels

MIN_BASELINE_SAMPLES = 20  # quiet samples before the first decision: 180 ms at 9 ms
BASELINE_SAMPLES = 100  # the baseline is the mean of at most this many of the last quiet samples
# The latest quiet samples may already hold a faint onset: they join the baseline only once it would
# have been detected. The first baseline holds back fewer, so that a robot feels sooner.
GUARD_SAMPLES = 15
FIRST_GUARD_SAMPLES = 5
MOVES = 9.0  # times the variance between neighbouring samples: no quiet baseline varies as much
RELEASE_SAMPLES = 20

# EWMA charts of rate r: the sample itself, and means over about 7 and 19 samples (2/r - 1).
RATES = np.array([1.0, 0.25, 0.1], dtype=np.float32)
MEAN_VARIANCE = (RATES / (2 - RATES)).astype(np.float64)
ONSET_Z2 = np.array([26.0, 40.0, 40.0])
RELEASE = 0.83  # of the onset's threshold: a contact lasts while a statistic exceeds it
SUSPICION = 0.45  # of the onset's threshold: samples since it was exceeded stay out of the baseline
# A sample counts at most this much in a chart, in sigma: a glitch is no touch, and the chart
# recovers soon after a touch ends.
LIMIT = np.array([np.inf, 3.0, 3.0], dtype=np.float32)[:, None, None]

Floats = NDArray[np.float32]


def onset_z2(quiet: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the onset thresholds (chart, element) of the EWMA charts, in sigma^2.

    An element's baseline is the mean of its n = `quiet` (element,) samples, which adds a variance
    of 1 / n. Its sigma is estimated with n - 1 degrees of freedom, which raises the mean square by
    (n - 1) / (n - 3), the mean of an F distribution.
    """
    n = np.maximum(quiet, MIN_BASELINE_SAMPLES)
    variance = (MEAN_VARIANCE[:, None] + 1 / n) * (n - 1) / (n - 3)
    threshold: NDArray[np.float64] = ONSET_Z2[:, None] * variance
    return threshold


class ContactDetector:
    """Contact detector: EWMA charts against a running baseline, sample by sample.

    The statistic of an element is z^2 = sum over its channels of (m / sigma)^2 / v, where m is a
    mean of (x - offset) over the last samples, and v the variance of m in units of sigma^2: that
    of an exponentially weighted mean of rate r, r / (2 - r), and that of the baseline. While
    nothing is touched it is chi-square distributed with as many degrees of freedom as channels. An
    EWMA chart whose length suits the size of a step detects it in white noise nearly as soon as
    any test can (Roberts 1959, Technometrics 1:239; for several channels together: Lowry et al.
    1992, Technometrics 34:46, eq. 2.2 and 2.3). Touches are of every size, so three charts run
    side by side: the sample itself, and means over about 7 and about 19 samples.

    Contact begins when an element exceeds its threshold (26, 40, 40) in two consecutive samples. It
    ends when no element has exceeded 0.83 of it for 20 samples. For six channels, 30 whiskers and
    111 Hz, 9 hours of white noise had 2 false onsets, 4,000 first seconds had 2, and 2 hours of
    a drift of 0.001 sigma per sample had 1; three times that drift has one in a minute.

    Args:
        shape: (element, channel).
        floor: (channel,) The smallest sigma that is assumed, SI.

    A baseline measured during a touch, as when an array is plugged in again while it is touched,
    would cause a contact without end. So the detector looks for still stretches of 20 samples
    within a contact. Once the signal has returned three times to the level of such a stretch, and
    stayed longer than it was quiet on the baseline, that level becomes the baseline.

    Where quiet samples drift along a line, as while a sensor warms up, the baseline follows it,
    also within a contact, for as long as the drift was observed before. If the newest samples of a
    contact lie on a line that leads back to the baseline, it was drift and no contact.

    An invalid element counts neither as touched nor as at rest: its baseline is computed from its
    own valid samples, and the element is ignored until it has enough of them.

    Attributes:
        ready: Whether enough quiet samples have been seen for a baseline; no contact is reported
            before.
        offset: (element, channel) The baseline: the mean of the quiet samples, carried on along
            their drift, SI.
        sigma: (element, channel) The noise per sample, one standard deviation, SI; it is never
            below `floor`.
        has_baseline: (element,) Whether `offset` and `sigma` are from enough samples, bool.
        doubted: The number of samples before the latest onset that the baseline leaves out, as
            they may already belong to the touch.
    """

    def __init__(self, shape: tuple[int, int], floor: Floats) -> None:
        self.floor = floor.astype(np.float32)
        self.contact = False
        self.offset = np.zeros(shape, dtype=np.float32)
        self.sigma = np.broadcast_to(self.floor, shape).astype(np.float32)
        self.has_baseline: NDArray[np.bool_] = np.zeros(shape[0], dtype=np.bool_)
        self.doubted = 0
        # Quiet samples with their validity; an invalid one adds nothing to any sum.
        self._pending: deque[tuple[int, NDArray[np.float64], NDArray[np.bool_]]] = deque()
        self._baseline: deque[tuple[int, NDArray[np.float64], NDArray[np.bool_]]] = deque()
        self._count = np.zeros(shape[0], dtype=np.int64)
        self._sum = np.zeros(shape)
        self._sum_of_squares = np.zeros(shape)
        self._pooled = self.sigma
        self._ewma = np.zeros((len(RATES), *shape), dtype=np.float32)  # in sigma
        self._onset_z2 = onset_z2(self._count)  # (chart, element)
        self._suspicious_for = np.zeros(shape[0], dtype=np.int64)
        self._above: NDArray[np.bool_] = np.zeros(shape[0], dtype=np.bool_)
        self._quiet_for = 0
        self._quiet = 0  # quiet samples since the baseline was started
        self._rest = RestLevels()
        self._now = 0  # number of the sample, since the first
        self._drift = Drift()
        self._slope = Drift()  # of the current contact
        self._level = self.offset  # the mean of the baseline

    @property
    def ready(self) -> bool:
        """True if the baseline is complete."""
        return len(self._baseline) >= MIN_BASELINE_SAMPLES

    @property
    def moves(self) -> bool:
        """True if the baseline's samples wander as in a touch, more than white noise does."""
        samples = np.array([sample for _, sample, _ in self._baseline])
        steps = np.square(np.diff(samples, axis=0)).mean(axis=0) / 2  # of white noise, the variance
        known = self._count == len(samples)
        wander = samples.var(axis=0) > MOVES * np.maximum(steps, self.floor**2)
        return bool(wander[known].any())

    @property
    def drift(self) -> NDArray[np.float64]:
        """Drift of the baseline (element, channel), SI per sample; 0 where none is certain."""
        return np.broadcast_to(self._drift.slope, self.offset.shape)

    def update(self, sample: Floats, valid: NDArray[np.bool_]) -> bool:
        """Update with one sample; return whether contact begins with it.

        Args:
            sample: (element, channel) The values, SI.
            valid: (element,) Whether the element is trusted.
        """
        self._now += 1
        if self._drift.found:
            self._follow_drift()
        if not self.ready:
            self._add_quiet(sample, valid)
            self._grow_baseline(FIRST_GUARD_SAMPLES)
            return False
        excess = self._compute_excess(sample, valid)
        above: NDArray[np.bool_] = excess > 1
        certain = above & self._above
        begins = not self.contact and bool(certain.any())
        self._above = above
        self._suspicious_for = np.where(excess > SUSPICION, self._suspicious_for + 1, 0)
        if begins:
            self.contact = True
            self._quiet_for = 0
            self._rest, self._slope = RestLevels(), Drift()
            # Samples before the onset are now known to be quiet, and join the baseline.
            self._grow_baseline(max(FIRST_GUARD_SAMPLES, int(self._suspicious_for[certain].max())))
            self.doubted = len(self._pending) + 1  # plus the first above its threshold
            self._pending.clear()
        elif self.contact:
            self._quiet_for = 0 if (excess > RELEASE).any() else self._quiet_for + 1
            if self._quiet_for >= RELEASE_SAMPLES:
                self.contact = False
            elif self._rest.confirm_rest(
                sample, valid & self.has_baseline, self._pooled, self._quiet
            ):
                self._restart_baseline(Drift())
            elif self._slope.add(self._now, sample, valid, self._pooled):
                if self._slope.leads_to(self._find_middle(), self._level, self._pooled):
                    self._restart_baseline(self._slope)
        elif not above.any():
            self._add_quiet(sample, valid)
            self._grow_baseline(GUARD_SAMPLES)
        return begins

    def _compute_excess(self, sample: Floats, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Update the charts; return each element's largest ratio of statistic to threshold."""
        trusted = (valid & self.has_baseline)[:, None]
        z = np.where(trusted, sample - self.offset, np.float32(0)) / self._pooled
        self._ewma += RATES[:, None, None] * (np.minimum(np.maximum(z, -LIMIT), LIMIT) - self._ewma)
        z2 = np.square(self._ewma).sum(axis=2)  # (chart, element)
        excess: NDArray[np.float64] = (z2 / self._onset_z2).max(axis=0)
        return excess

    def _add_quiet(self, sample: Floats, valid: NDArray[np.bool_]) -> None:
        if not valid.any():  # it must not displace a valid sample from the baseline
            return
        self._quiet += 1
        quiet = np.where(valid[:, None], sample, 0.0).astype(np.float64)
        self._pending.append((self._now, quiet, valid.copy()))

    def _follow_drift(self) -> None:
        """Extrapolate the baseline along its drift to the present sample."""
        ahead = min(self._now - self._find_middle(), self._drift.span)
        self.offset = (self._level + ahead * self._drift.slope).astype(np.float32)

    def _find_middle(self) -> float:
        """Return the mean sample number of the baseline."""
        return float(np.mean([at for at, _, _ in self._baseline]))

    def _restart_baseline(self, drift: "Drift") -> None:
        """End the contact, and restart the baseline from the latest samples, which are rest."""
        self.contact = False
        self._above = np.zeros_like(self._above)
        self._suspicious_for = np.zeros_like(self._suspicious_for)
        self._ewma = np.zeros_like(self._ewma)
        self._pending.clear()
        self._baseline.clear()
        self._drift = drift
        self._quiet = 0
        for total in (self._count, self._sum, self._sum_of_squares):
            total[...] = 0
        for sample, valid in self._rest.block:
            self._add_quiet(sample, valid)
        self._grow_baseline(0)

    def _grow_baseline(self, guard: int) -> None:
        """Update the baseline with all but the latest `guard` pending samples."""
        if len(self._pending) <= guard:
            return
        before = self._count.copy()
        while len(self._pending) > guard:
            if len(self._baseline) == BASELINE_SAMPLES:
                _, oldest, was_valid = self._baseline.popleft()
                self._count -= was_valid
                self._sum -= oldest
                self._sum_of_squares -= oldest**2
            at, newest, is_valid = self._pending.popleft()
            self._baseline.append((at, newest, is_valid))
            self._drift.add(at, newest, is_valid, self._pooled)
            self._count += is_valid
            self._sum += newest
            self._sum_of_squares += newest**2
        if (self._count != before).any():
            self.has_baseline = self._count >= MIN_BASELINE_SAMPLES
            self._onset_z2 = onset_z2(self._count)
        if not self.has_baseline.any():
            return
        n = np.maximum(self._count, 2)[:, None]
        mean = self._sum / n
        variance = np.maximum(self._sum_of_squares - n * mean**2, 0.0) / (n - 1)
        if self._drift.found:
            times = np.var([at for at, _, _ in self._baseline])
            variance = np.maximum(variance - np.square(self._drift.slope) * times, 0.0)
        # An element with too few samples keeps its last known values.
        known = self.has_baseline[:, None]
        self._level = np.where(known, mean.astype(np.float32), self._level)
        self.offset = self._level
        if self._drift.found:
            self._follow_drift()
        sigma = np.maximum(np.sqrt(variance).astype(np.float32), self.floor)
        self.sigma = np.where(known, sigma, self.sigma)
        # Twenty samples underestimate an element's own noise often enough to raise false onsets:
        # for detection, no element counts as quieter than the median.
        self._pooled = np.maximum(self.sigma, np.median(self.sigma[self.has_baseline], axis=0))
