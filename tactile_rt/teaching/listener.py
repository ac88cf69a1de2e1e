"""Detection of touches in the stream of a lesson: onset, end and features of each."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.core.errors import RecordingError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk

HASTY_NS = 200_000_000  # after the end of a contact, within which another belongs to that touch
FELT = 6.0  # times the noise: a reading as large in two consecutive samples counts as a touch
LONG_AGO_NS = 2**62
# Parts of a rest, and by how many times the noise within them their means differ at most.
REST_PARTS, MOVED = 8, 10.0
QUIETEST = 0.25  # share of the parts that are free of touches, at least
QUIET = 0.3  # of the noise at rest: the least noise that the contact detector assumes


class Listener:
    """A detector of touches in a stream, which also computes their features.

    Args:
        model: The path of the lesson's ``features.onnx``.
        felt: Computes the features of a touch from the decisions after its steps.
        hasty_ns: How soon after the end of a contact another counts as its continuation, ns.

    Raises:
        SpecMismatch: The stream is from another array than the lesson.
    """

    def __init__(
        self,
        model: Path,
        spec: ArraySpec,
        felt: Callable[[Sequence[Classification]], NDArray[np.float32]],
        hasty_ns: int = HASTY_NS,
    ) -> None:
        self.classifier, self._describe = Classifier(model, spec, embedding=True), felt
        self._spec, self._hasty_ns = spec, hasty_ns
        # input samples for each of the classifier's, after which its readings are inspected
        self._together = max(1, round(spec.rate_hz * self.classifier.card.period_ns / NS_PER_S))
        self._first_ns: int | None = None
        # (channel,) largest deviation from the baseline within contacts, either way
        self.largest = np.zeros(spec.shape[1], np.float32)
        self._received = 0  # samples since the last hint
        self._strongest, self._where = 0.0, ""  # reading since then, in units of the noise
        self._steps: list[Classification] = []
        self._released_ns = -LONG_AGO_NS  # stream time
        self._counts = True  # whether the current touch counts
        self.hasty = 0  # contacts so soon after another that they may belong to it; ignored

    def push(self, chunk: Chunk) -> Iterator[tuple[int, int, NDArray[np.float32]]]:
        """Feed samples; yield onset and end (stream ns) and features of each complete touch."""
        if self._first_ns is None:
            self._first_ns = int(chunk.t_ns[0])
        self._received += len(chunk)
        for k in range(0, len(chunk), self._together):
            yield from self._listen(chunk.select(slice(k, k + self._together)))

    def _listen(self, chunk: Chunk) -> Iterator[tuple[int, int, NDArray[np.float32]]]:
        decisions = self.classifier.push(chunk)
        detector = self.classifier.detector
        if detector.ready and detector.has_baseline.any():
            load = np.abs(self.classifier.deviation)
            if detector.contact:
                np.maximum(self.largest, load.max(axis=0), out=self.largest)
            now = load / detector.sigma
            element, channel = np.unravel_index(now.argmax(), now.shape)
            if now[element, channel] > self._strongest:
                self._strongest = float(now[element, channel])
                self._where = f"{self._spec.elements[element]} {self._spec.channels[channel]}"
        for decision in decisions:
            if decision.step == 1:
                self._steps = []
                onset = decision.onset_ns
                hasty = onset - self._find_release(onset) < self._hasty_ns
                self.hasty, self._counts = self.hasty + hasty, not hasty
            self._steps.append(decision)
            if decision.final and self._counts:
                self._received, self._strongest = 0, 0.0  # this touch was not missed
                yield decision.onset_ns, decision.t_ns, self._describe(self._steps)

    def _find_release(self, onset_ns: int) -> int:
        """Return the stream time at which the contact before an onset ended."""
        changes = self.classifier.touches
        while changes and changes[0][0] < onset_ns:
            t_ns, began = changes.popleft()
            if not began:
                self._released_ns = t_ns
        return self._released_ns

    def hint(self) -> str:
        """Explain to the user why no touch was found since the last touch or hint."""
        received, strongest = self._received, self._strongest
        self._received, self._strongest = 0, 0.0
        if not received:
            return "no sample came for a while: is the device still on?"
        if self.classifier.detector.contact:
            return "it has been touched all the while: let go for a second"
        if not self.classifier.detector.ready:
            return "there was no second at rest yet: let go"
        advice = "touch more firmly" if strongest < FELT else "touch longer"
        return (
            f"no touch was noticed: the strongest reading was {strongest:.1f} times the noise "
            f"({self._where}), and {FELT:g} is felt: {advice}"
        )

    def seconds(self, t_ns: int) -> float:
        """Convert a stream time, ns, to seconds since the first sample."""
        return (t_ns - (self._first_ns or 0)) / NS_PER_S


def find_motion(chunks: Sequence[Chunk], spec: ArraySpec) -> str:
    """Return element and channel of a reading that was not at rest, or "".

    At rest, the means of eighths of the time differ by no more than ten times the noise, or by two
    steps between the levels of a reading.
    """
    values = np.concatenate([c.values for c in chunks]).astype(float) if chunks else np.empty(0)
    if len(values) < 4 * REST_PARTS:
        return ""
    parts = np.array_split(values, REST_PARTS)
    apart = np.ptp([part.mean(axis=0) for part in parts], axis=0)
    noise = np.quantile([part.std(axis=0) for part in parts], QUIETEST, axis=0)
    for element in range(values.shape[1]):
        for channel in range(values.shape[2]):
            levels = np.unique(values[:, element, channel])
            step = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
            if apart[element, channel] > max(MOVED * noise[element, channel], 2 * step):
                return f"{spec.elements[element]} {spec.channels[channel]}"
    return ""


def measure_changes(chunks: Sequence[Chunk]) -> float:
    """Return the share of readings that differ from the one before, for the steadiest element."""
    values = np.concatenate([c.values for c in chunks])
    return float((values[1:] != values[:-1]).mean(axis=0).max(axis=1).min())


def measured_floor(chunks: Sequence[Chunk]) -> NDArray[np.float32]:
    """Estimate the least noise (channel,) for a contact detector, from an array at rest.

    The estimate is a share of the median element's noise. For a channel that hardly changes, it is
    derived from the smallest difference of readings, or from a millionth of the largest reading.
    """
    values = np.concatenate([c.values for c in chunks]) if chunks else np.empty((0, 0, 0))
    valid = np.concatenate([c.valid for c in chunks]) if chunks else np.empty((0, 0))
    there = valid.all(axis=0) if len(valid) else np.zeros(0, bool)
    if len(values) < 2 or not there.any():
        raise RecordingError("the array delivered nothing at rest: is it connected and powered?")
    values = values[:, there].astype(float)
    noise = np.median(values.std(axis=0), axis=0)
    floor: NDArray[np.float64] = QUIET * noise
    for channel in range(values.shape[2]):
        levels = np.unique(values[:, :, channel])
        steps = np.diff(levels)
        step = float(steps.min()) if len(steps) else max(1e-6 * float(abs(levels).max()), 1e-9)
        floor[channel] = max(floor[channel], step / np.sqrt(12))
    return floor.astype(np.float32)
