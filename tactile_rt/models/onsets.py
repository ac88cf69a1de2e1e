"""The contact detector vectorised over stored sweeps, with the results of `ContactDetector`.

`ContactDetector` reads one sample of one stream; here each iteration reads one sample of every
sweep, which is several times faster. Tests check that both agree.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier import contact

BATCH = 128  # sweeps at a time: their histories should stay in the cache


@dataclass(frozen=True)
class Onsets:
    """The onset of contact in every sweep, and the baseline at that time.

    Attributes:
        start: (sweep,) The sample of onset; -1 where none was found.
        offset, sigma: (sweep, element, channel) The mean and noise of the baseline, SI.
    """

    start: NDArray[np.int64]
    offset: NDArray[np.float32]
    sigma: NDArray[np.float32]


def find_onsets(values: NDArray[np.float32], floor: NDArray[np.float32]) -> Onsets:
    """Detect the onset of contact in every sweep, with all elements in use.

    Args:
        values: (sweep, sample, element, channel), noise included, SI.
        floor: (channel,) smallest sigma of the detector, SI.
    """
    n, _, *shape = values.shape
    start = np.full(n, -1, dtype=np.int64)
    offset = np.zeros((n, *shape), dtype=np.float32)
    sigma = np.zeros((n, *shape), dtype=np.float32)
    for i in range(0, n, BATCH):
        part = slice(i, i + BATCH)
        start[part], offset[part], sigma[part] = _detect(values[part], floor.astype(np.float32))
    return Onsets(start, offset, sigma)


def _detect(
    values: NDArray[np.float32], floor: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    n, samples, elements, _ = values.shape
    baseline = _Baseline(values, floor)
    means = np.zeros((len(contact.RATES), n, *values.shape[2:]), dtype=np.float32)  # in sigma
    suspicious_for = np.zeros((n, elements), dtype=np.int64)
    was_above = np.zeros((n, elements), dtype=np.bool_)
    start = np.full(n, -1, dtype=np.int64)
    active = np.arange(n)
    for k in range(samples):
        ready = baseline.count[active] >= contact.MIN_BASELINE_SAMPLES
        first = active[~ready]
        baseline.wait(first, k)
        baseline.learn(first, np.full(len(first), contact.FIRST_GUARD_SAMPLES))
        at = active[ready]
        if not len(at):
            continue
        z = (values[at, k] - baseline.offset[at]) / baseline.pooled[at]
        mean = means[:, at]
        mean += contact.RATES[:, None, None, None] * (
            np.clip(z, -contact.LIMIT[..., None], contact.LIMIT[..., None]) - mean
        )
        means[:, at] = mean
        size = np.minimum(baseline.count[at], contact.BASELINE_SAMPLES)
        z2 = np.square(mean).sum(axis=3)  # (mean, sweep, element)
        excess = (z2 / contact.onset_z2(size)[..., None]).max(axis=0)
        above = excess > 1
        certain = above & was_above[at]
        was_above[at] = above
        suspicious_for[at] = np.where(excess > contact.SUSPICION, suspicious_for[at] + 1, 0)
        begins = certain.any(axis=1)
        start[at[begins]] = k
        since = np.where(certain, suspicious_for[at], 0).max(axis=1)[begins]
        baseline.learn(at[begins], np.maximum(since, contact.FIRST_GUARD_SAMPLES))
        quiet = at[~above.any(axis=1)]
        baseline.wait(quiet, k)
        baseline.learn(quiet, np.full(len(quiet), contact.GUARD_SAMPLES))
        active = active[start[active] < 0]
        if not len(active):
            break
    return start, baseline.offset, baseline.sigma


class _Baseline:
    """Running baselines of all sweeps, each with a queue of samples to add."""

    def __init__(self, values: NDArray[np.float32], floor: NDArray[np.float32]) -> None:
        n, samples, *rest = values.shape
        shape = (n, *rest)
        self.values, self.floor = values, floor
        self.order = np.zeros((samples, n), dtype=np.int64)  # indices of the quiet samples
        self.came = np.zeros(n, dtype=np.int64)  # number of quiet samples so far
        self.count = np.zeros(n, dtype=np.int64)  # number of samples added to the baseline
        self.total, self.squares = np.zeros(shape), np.zeros(shape)
        self.offset = np.zeros(shape, dtype=np.float32)
        self.sigma = np.broadcast_to(floor, shape).astype(np.float32)
        self.pooled = self.sigma.copy()

    def wait(self, of: NDArray[np.int64], k: int) -> None:
        self.order[self.came[of], of] = k
        self.came[of] += 1

    def learn(self, of: NDArray[np.int64], guard: NDArray[np.int64]) -> None:
        """Add the queued samples of sweeps `of` to their baselines, except the last `guard`."""
        changed = of[self.came[of] - self.count[of] > guard]
        while len(of):
            more = self.came[of] - self.count[of] > guard
            of, guard = of[more], guard[more]
            full = of[self.count[of] >= contact.BASELINE_SAMPLES]
            oldest = self._sample(full, self.count[full] - contact.BASELINE_SAMPLES)
            self.total[full] -= oldest
            self.squares[full] -= oldest**2
            newest = self._sample(of, self.count[of])
            self.total[of] += newest
            self.squares[of] += newest**2
            self.count[of] += 1
        of = changed[self.count[changed] >= contact.MIN_BASELINE_SAMPLES]
        if not len(of):
            return
        size = np.minimum(self.count[of], contact.BASELINE_SAMPLES)[:, None, None]
        mean = self.total[of] / size
        variance = np.maximum(self.squares[of] - size * mean**2, 0.0) / (size - 1)
        own = np.maximum(np.sqrt(variance).astype(np.float32), self.floor)
        self.offset[of] = mean.astype(np.float32)
        self.sigma[of] = own
        self.pooled[of] = np.maximum(own, np.median(own, axis=1, keepdims=True))

    def _sample(self, of: NDArray[np.int64], number: NDArray[np.int64]) -> NDArray[np.float64]:
        return self.values[of, self.order[number, of]].astype(np.float64)
