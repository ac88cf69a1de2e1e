"""Touches of a stream, cut as a classifier sees them.

    chunks -> Resampler -> ContactDetector -> RecordedTouch: rest, then a window from the onset on

Goal: a network that learns from a touch gets exactly the values that it gets in a running
`Classifier`: the same resampled samples, the same onset, the same baseline.

Plan: the stream passes the classifier's own resampler and contact detector. An onset begins a
touch, as long as an episode; no other touch begins meanwhile. The touch includes the rest before
it: the latest samples that may enter a baseline, even with gaps between them. These are enough for
a detector that runs on the touch alone to forget its initial state before the onset, and to find
the same onset. A touch cut by a gap or the stream's end carries the reason why it is unusable.
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
SURE = contact.FIRST_GUARD_SAMPLES  # permitted shift of the onset when found in the touch alone
# reasons why nothing can be learnt from a touch
ENDS = "before whose window ends the recording ends"
GAP = "with lost or invalid samples in their window"
UNSURE = "whose onset is not found again after so short a rest"


@dataclass(frozen=True)
class RecordedTouch:
    """Touch cut from a stream: rest, then a window from the onset on."""

    onset_ns: int  # stream time of the onset, ns
    end_ns: int  # stream time of the window's last sample, ns
    # (sample, element, channel) float32: `REST` samples of rest, then the window, SI; an element
    # that a classifier treats as untouched has its baseline throughout
    values: NDArray[np.float32]
    flaw: str = ""  # reason why nothing can be learnt from the touch; empty if usable


def find_touches(
    spec: ArraySpec, chunks: Iterable[Chunk], period_ns: int, floor: NDArray[np.float32]
) -> Iterator[RecordedTouch]:
    """Yield the touches of a stream, in order of their onsets.

    Args:
        period_ns: sample period of a touch, ns.
        floor: (channel,) smallest sigma of the detector, SI.
    """
    resampler, cutter = Resampler(period_ns, spec.rate_hz), _Cutter(spec, period_ns, floor)
    for chunk in chunks:
        resampled = resampler.push(without_bad_samples(chunk)[0])
        if resampled is not None:
            yield from cutter.push(resampled)
    yield from cutter.cut_short(ENDS)


class _Cutter:
    def __init__(self, spec: ArraySpec, period_ns: int, floor: NDArray[np.float32]) -> None:
        self._detector = contact.ContactDetector(spec.shape, floor)
        self._samples = Timing.of(period_ns).samples
        self._rest: deque[tuple[NDArray[np.float32], NDArray[np.bool_]]] = deque(maxlen=REST)
        self._touch: _OpenTouch | None = None
        self._next_seq = 0

    def push(self, chunk: Chunk) -> Iterator[RecordedTouch]:
        for seq, t_ns, values, valid in zip(
            chunk.seq.tolist(), chunk.t_ns.tolist(), chunk.values, chunk.valid, strict=True
        ):
            if seq != self._next_seq:
                yield from self.cut_short(GAP)
            self._next_seq = seq + 1
            detector = self._detector
            quiet = not detector.contact  # no baseline includes the sample at which a contact ends
            begins = detector.update(values, valid)
            if begins and self._touch is None:
                self._touch = _OpenTouch(
                    t_ns, list(self._rest), detector.doubted, detector.offset,
                    detector.has_baseline, detector.floor,
                )  # fmt: skip
            if begins:  # no later baseline includes the doubted samples, either
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

    def cut_short(self, why: str) -> Iterator[RecordedTouch]:
        """End the touch in progress, if any; yield it as unusable for the reason `why`."""
        if self._touch is not None:
            nothing = np.empty((0, *self._touch.offset.shape), np.float32)
            yield RecordedTouch(self._touch.onset_ns, self._touch.onset_ns, nothing, why)
            self._touch = None


@dataclass
class _OpenTouch:
    """Touch in progress: the rest before it, its baseline, and its samples so far."""

    onset_ns: int
    rest: list[tuple[NDArray[np.float32], NDArray[np.bool_]]]
    doubted: int  # number of the last samples of the rest that the baseline leaves out
    offset: NDArray[np.float32]  # (element, channel)
    has_baseline: NDArray[np.bool_]  # (element,)
    floor: NDArray[np.float32]  # (channel,)
    values: list[NDArray[np.float32]] = field(default_factory=list)
    valid: list[NDArray[np.bool_]] = field(default_factory=list)

    def done(self, end_ns: int) -> RecordedTouch:
        window, valid = np.stack(self.values), np.stack(self.valid)
        alive = valid.any(axis=0) & self.has_baseline  # elements that measure anything
        quiet = [values for values, trusted in self.rest if trusted[alive].all()]
        gap = not valid[:, alive].all() or len(quiet) - self.doubted < contact.MIN_BASELINE_SAMPLES
        if gap or not alive.any():
            return RecordedTouch(self.onset_ns, end_ns, window[:0], GAP)
        # A shorter rest is filled up by repeating the samples that the baseline is based on.
        sure = np.arange(len(quiet) - REST, 0) % (len(quiet) - self.doubted)
        rest = np.stack(quiet)
        whole = np.concatenate([rest[sure], rest, window])
        whole[:, ~alive] = self.offset[~alive]
        return RecordedTouch(self.onset_ns, end_ns, whole, "" if self._is_found(whole) else UNSURE)

    def _is_found(self, whole: NDArray[np.float32]) -> bool:
        """Return whether a detector that runs on the touch alone finds the same onset."""
        detector = contact.ContactDetector(self.offset.shape, self.floor)
        trusted = np.ones(len(self.has_baseline), np.bool_)
        onsets = (k for k, sample in enumerate(whole) if detector.update(sample, trusted))
        return abs(next(onsets, -1) - REST) <= SURE
