"""The touches in a stream, cut as a classifier meets them.

    chunks -> Resampler -> ContactDetector -> RecordedTouch: rest, then a window from the onset on

Goals: a network that learns from a touch gets the very numbers that a running `Classifier` would
have fed it: the same resampled samples, the same onset, the same baseline.

Plan: the stream goes through the resampler and the detector that a classifier has. An onset begins
a touch, as long as an episode; while it lasts no other begins. With a touch goes the rest before
it: the latest samples that a baseline may be made of, whatever lies between them; enough of them
that the detector, run on a touch alone, has forgotten how it began when the onset comes, and finds
it where it found it in the stream. A touch that a classifier would have had no samples for, as the
stream ended or had a gap, is given with the reason why it is none to learn from.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier import contact
from tactile_rt.classifier.classifier import without_bad_samples
from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.stream import ArraySpec, Chunk, Timing

REST = 2 * contact.BASELINE_SAMPLES  # before the onset: a whole baseline, measured on a whole one
SURE = contact.FIRST_GUARD_SAMPLES  # by which an onset may be found elsewhere than in the stream
# why a touch is none to learn from
ENDS = "before whose window ends the recording ends"
GAP = "with lost or invalid samples in their window"
UNSURE = "whose onset is not found again after so short a rest"


@dataclass(frozen=True)
class RecordedTouch:
    """One touch."""

    onset_ns: int  # stream time of the onset, ns
    end_ns: int  # stream time of the window's last sample, ns
    # (sample, element, channel) float32: `REST` samples of rest, then the window, SI; where a
    # classifier takes an element for untouched, its baseline
    values: NDArray[np.float32]
    flaw: str = ""  # reason why nothing can be learnt from the touch; empty: there is none


def find_touches(
    spec: ArraySpec, chunks: Iterable[Chunk], period_ns: int, floor: NDArray[np.float32]
) -> Iterator[RecordedTouch]:
    """The touches of a stream, in their order.

    Args:
        period_ns: of the samples of a touch, ns.
        floor: (channel,) smallest sigma of the detector, SI.
    """
    resampler, cutter = Resampler(period_ns, spec.rate_hz), _Cutter(spec, period_ns, floor)
    for chunk in chunks:
        resampled = resampler.push(without_bad_samples(chunk)[0])
        if resampled is not None:
            yield from cutter.push(resampled)
    yield from cutter.broken(ENDS)


class _Cutter:
    def __init__(self, spec: ArraySpec, period_ns: int, floor: NDArray[np.float32]) -> None:
        self._detector = contact.ContactDetector(spec.shape, floor)
        self._samples = Timing.of(period_ns).samples
        self._rest: deque[tuple[NDArray[np.float32], NDArray[np.bool_]]] = deque(maxlen=REST)
        self._touch: _Growing | None = None
        self._next_seq = 0

    def push(self, chunk: Chunk) -> Iterator[RecordedTouch]:
        for seq, t_ns, values, valid in zip(
            chunk.seq.tolist(), chunk.t_ns.tolist(), chunk.values, chunk.valid, strict=True
        ):
            if seq != self._next_seq:
                yield from self.broken(GAP)
            self._next_seq = seq + 1
            detector = self._detector
            quiet = not detector.contact  # the sample at which a contact ends is in no baseline
            begins = detector.update(values, valid)
            if begins and self._touch is None:
                self._touch = _Growing(
                    t_ns, list(self._rest), detector.doubted, detector.offset,
                    detector.has_baseline, detector.floor,
                )  # fmt: skip
            if begins:  # what was doubted is in no later baseline, either
                for _ in range(min(detector.doubted, len(self._rest))):
                    self._rest.pop()
            if quiet and not begins:
                self._rest.append((values, valid))
            if self._touch is not None:
                self._touch.values.append(values)
                self._touch.valid.append(valid)
                if len(self._touch.values) == self._samples:
                    yield self._touch.done(t_ns)
                    self._touch = None

    def broken(self, why: str) -> Iterator[RecordedTouch]:
        """The touch under way, if there is one, ends before its window does."""
        if self._touch is not None:
            nothing = np.empty((0, *self._touch.offset.shape), np.float32)
            yield RecordedTouch(self._touch.onset_ns, self._touch.onset_ns, nothing, why)
            self._touch = None


@dataclass
class _Growing:
    """A touch under way: what came before it, its baseline, and what has come."""

    onset_ns: int
    rest: list[tuple[NDArray[np.float32], NDArray[np.bool_]]]
    doubted: int  # of the rest, the last samples
    offset: NDArray[np.float32]  # (element, channel)
    has_baseline: NDArray[np.bool_]  # (element,)
    floor: NDArray[np.float32]  # (channel,)
    values: list[NDArray[np.float32]] = field(default_factory=list)
    valid: list[NDArray[np.bool_]] = field(default_factory=list)

    def done(self, end_ns: int) -> RecordedTouch:
        window, valid = np.stack(self.values), np.stack(self.valid)
        there = valid.any(axis=0) & self.has_baseline  # elements that measure anything
        quiet = [values for values, trusted in self.rest if trusted[there].all()]
        gap = not valid[:, there].all() or len(quiet) - self.doubted < contact.MIN_BASELINE_SAMPLES
        if gap or not there.any():
            return RecordedTouch(self.onset_ns, end_ns, window[:0], GAP)
        # Where there was less rest, what the baseline rests on is there again and again.
        sure = np.arange(len(quiet) - REST, 0) % (len(quiet) - self.doubted)
        rest = np.stack(quiet)
        whole = np.concatenate([rest[sure], rest, window])
        whole[:, ~there] = self.offset[~there]
        return RecordedTouch(self.onset_ns, end_ns, whole, "" if self._found_in(whole) else UNSURE)

    def _found_in(self, whole: NDArray[np.float32]) -> bool:
        """Whether the onset is found in the touch alone, too."""
        detector = contact.ContactDetector(self.offset.shape, self.floor)
        trusted = np.ones(len(self.has_baseline), np.bool_)
        onsets = (k for k, sample in enumerate(whole) if detector.update(sample, trusted))
        return abs(next(onsets, -1) - REST) <= SURE
