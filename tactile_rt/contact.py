"""Tare and contact onset: from a resampled stream to episodes.

Training windows and the live classifier start where this detector says that contact began, on a
baseline (offset and noise) that it measured while nothing was touched.
"""

from collections import deque

import numpy as np
from numpy.typing import NDArray

__all__ = ["CHANNEL_FLOOR", "ContactDetector"]

TARE_SAMPLES = 20  # quiet samples before the first decision: 180 ms at 9 ms
BASELINE_SAMPLES = 100  # the baseline is the mean of at most this many of the last quiet samples
GUARD_SAMPLES = 5  # the latest quiet samples may already hold a slow onset: they wait outside
SMOOTHING = 0.25  # of the slow statistic: an exponential mean over about 7 samples
SMOOTHED_VARIANCE = SMOOTHING / (2 - SMOOTHING)
ONSET_Z2 = np.array([36.0, 48.0])  # fast, slow: see `ContactDetector`
RELEASE_Z2 = np.array([30.0, 40.0])
RELEASE_SAMPLES = 20

# The smallest sigma assumed per channel, for sources without noise: 2 uN and 0.01 uN m.
CHANNEL_FLOOR = {"N": 2e-6, "N m": 1e-8}


class ContactDetector:
    """Sample by sample: is anything touched, and what is the baseline?

    The statistic is z^2 = sum over an element's channels of ((x - offset) / sigma)^2, chi-square
    distributed with as many degrees of freedom as channels while nothing is touched; taken of the
    sample itself (fast) and of an exponential mean over about 7 samples (slow, for touches below
    the noise of one sample). Contact begins when one element exceeds its threshold (36 fast, 48
    slow) in two samples running: for six channels, white noise, 30 whiskers and 111 Hz, about one
    false onset in three days. It ends when no element has exceeded 30 (40) for 20 samples.

    Args:
        shape: (element, channel).
        floor: (channel,) smallest sigma assumed, SI.

    An element that is not trusted neither touches nor tares: its baseline is that of its own
    trusted samples, and it is left out until it has enough of them.

    Attributes:
        ready: enough quiet samples have been seen for a tare; no contact is reported before.
        contact: something is touched.
        offset: (element, channel) tare, SI.
        sigma: (element, channel) noise per sample, SI, not below `floor`.
        tared: (element,) bool; False where `offset` and `sigma` rest on too few samples.
    """

    def __init__(self, shape: tuple[int, int], floor: NDArray[np.float32]) -> None:
        self.floor = floor.astype(np.float32)
        self.contact = False
        self.offset = np.zeros(shape, dtype=np.float32)
        self.sigma = np.broadcast_to(self.floor, shape).astype(np.float32)
        self.tared: NDArray[np.bool_] = np.zeros(shape[0], dtype=np.bool_)
        # Quiet samples with their validity; an invalid one counts as nothing in every sum.
        self._pending: deque[tuple[NDArray[np.float64], NDArray[np.bool_]]] = deque()
        self._baseline: deque[tuple[NDArray[np.float64], NDArray[np.bool_]]] = deque()
        self._count = np.zeros(shape[0], dtype=np.int64)
        self._sum = np.zeros(shape)
        self._sum_of_squares = np.zeros(shape)
        self._pooled = self.sigma
        self._slow = np.zeros(shape, dtype=np.float32)
        self._above: NDArray[np.bool_] = np.zeros(shape[0], dtype=np.bool_)
        self._quiet_for = 0

    @property
    def ready(self) -> bool:
        """Whether the tare is complete."""
        return len(self._baseline) >= TARE_SAMPLES

    def update(self, sample: NDArray[np.float32], valid: NDArray[np.bool_]) -> bool:
        """Take one sample; return True when contact begins with it.

        Args:
            sample: (element, channel) SI.
            valid: (element,) elements to trust.
        """
        if not self.ready:
            self._learn(sample, valid)
            return False
        trusted = (valid & self.tared)[:, None]
        fast = np.where(trusted, sample - self.offset, np.float32(0))
        self._slow += SMOOTHING * (fast - self._slow)
        # The offset is itself a mean of noisy samples.
        tare_variance = 1 / np.maximum(self._count, TARE_SAMPLES)  # (element,)
        z2 = np.stack(
            [
                np.square(fast / self._pooled).sum(axis=1) / (1 + tare_variance),
                np.square(self._slow / self._pooled).sum(axis=1)
                / (SMOOTHED_VARIANCE + tare_variance),
            ],
            axis=1,
        )  # (element, 2)
        above: NDArray[np.bool_] = np.asarray((z2 > ONSET_Z2).any(axis=1))
        begins = not self.contact and bool((above & self._above).any())
        self._above = above
        if begins:
            self.contact = True
            self._pending.clear()
            self._quiet_for = 0
        elif self.contact:
            self._quiet_for = 0 if (z2 > RELEASE_Z2).any() else self._quiet_for + 1
            if self._quiet_for >= RELEASE_SAMPLES:
                self.contact = False
        elif not above.any():
            self._learn(sample, valid)
        return begins

    def _learn(self, sample: NDArray[np.float32], valid: NDArray[np.bool_]) -> None:
        self._pending.append(
            (np.where(valid[:, None], sample, 0.0).astype(np.float64), valid.copy())
        )
        if len(self._pending) <= GUARD_SAMPLES:
            return
        if len(self._baseline) == BASELINE_SAMPLES:
            oldest, was_valid = self._baseline.popleft()
            self._count -= was_valid
            self._sum -= oldest
            self._sum_of_squares -= oldest**2
        newest, is_valid = self._pending.popleft()
        self._baseline.append((newest, is_valid))
        self._count += is_valid
        self._sum += newest
        self._sum_of_squares += newest**2
        self.tared = self._count >= TARE_SAMPLES
        if not self.tared.any():
            return
        n = np.maximum(self._count, 2)[:, None]
        mean = self._sum / n
        variance = np.maximum(self._sum_of_squares - n * mean**2, 0.0) / (n - 1)
        # An element with too few samples keeps what was last known of it.
        known = self.tared[:, None]
        self.offset = np.where(known, mean.astype(np.float32), self.offset)
        sigma = np.maximum(np.sqrt(variance).astype(np.float32), self.floor)
        self.sigma = np.where(known, sigma, self.sigma)
        # Twenty samples underestimate an element's own noise often enough to raise false onsets:
        # for detection no element counts as quieter than the typical one.
        self._pooled = np.maximum(self.sigma, np.median(self.sigma[self.tared], axis=0))
