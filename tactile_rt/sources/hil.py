"""Emulated hardware in the loop: a test whether a driver changes the decisions.

source --> emulated device --> pty, slcan or CAN bus --> the real driver --> classifier
   |                                                                            | compared
   +--(the same samples, stamped by the device's clock)-----------> classifier --+

A decision depends on the times of its samples, as they are resampled. So the driver uses the
device's own time (`clock=device`), and samples of the direct path have the time that the device's
clock showed: only the effects of wire and driver are compared. If a device sends no time, samples
are a period apart on both paths.
"""

import os
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.calibration import declare
from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.stream import NS_PER_S, Chunk, Source, SourceStats
from tactile_rt.drivers.codec import codec_class
from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedSerial
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sources.opening import open_source

if TYPE_CHECKING:
    from tactile_rt.drivers.emulation.faults import FaultSchedule
    from tactile_rt.drivers.health import Health

WIRES: Final = ("serial", "slcan", "virtual")
SAME_LABEL: Final = 0.99  # least share of decisions with equal label if the format rounds values
START_S: Final = 30.0  # time for a simulation to build its world before the first sample
WAIT_S: Final = 0.1
# Ranges of an emulated native device with rounded values, N and N m: a count is then finer than the
# least noise that the models assume, 2 uN and 10 nN m. A mouse's whiskers bear a fiftieth of them.
RANGES: Final = {"range_n": "0.01", "range_nm": "0.0001"}
SAME_EPISODE_NS: Final = 100_000_000  # largest difference between onsets of the same touch


@dataclass(frozen=True)
class LoopReport:
    """Result of a hardware-in-the-loop test: counts of samples and decisions on both paths."""

    samples: int
    identical_samples: int  # with the same bits
    direct: int  # decisions of the direct path
    wire: int  # decisions of the driver's path
    identical: int  # decisions with the same bits on both paths, except for latency
    same_label: int  # decisions of the same touch and step with the same label
    finals: int  # last decisions of a touch on the direct path
    finals_same: int  # last decisions of a touch with the same label on both paths
    passed: int  # simulated objects that passed; 0 if the source does not report them
    right: int  # objects whose first touch ended, on the driver's path, with the right name
    exact: bool  # whether all decisions must be identical; else 99 % must have the same label
    faulty: bool  # whether faults were injected: then only the counts of losses must be right
    stats: SourceStats
    sent: int  # packets, including copies
    health: "Health"

    @property
    def accounted(self) -> bool:
        """True if each packet is delivered or counted as lost."""
        s = self.stats
        return self.sent == s.delivered + s.corrupt + s.missing + s.dropped + s.duplicates

    @property
    def failure(self) -> str:
        """Message about the requirement that is not met; empty if all are met."""
        decisions = max(self.direct, self.wire)
        if not self.accounted:
            return f"{self.sent} packets were sent, and the driver's account does not add up"
        if self.faulty:
            return ""
        if not decisions:
            return "nothing was touched, so there is nothing to compare: more sweeps or seconds"
        if self.exact and not (
            self.identical_samples == self.samples and self.identical == decisions
        ):
            return "the driver's path is not bit-equal to the direct one"
        if self.same_label < SAME_LABEL * decisions:
            return f"less than {SAME_LABEL:.0%} of the decisions have the same label"
        return ""


class _Tee(Source):
    """Source that returns another source's chunks and stores them in `kept`, too."""

    def __init__(self, inner: Source) -> None:
        super().__init__(inner.spec)
        self.inner, self.live, self.stats = inner, inner.live, inner.stats
        self.kept: deque[Chunk] = deque()

    def read(self, timeout: float | None = None) -> Chunk | None:
        chunk = self.inner.read(timeout)
        if chunk is not None:
            self.kept.append(chunk)
        return chunk

    def close(self) -> None:
        self.inner.close()


class Loop:
    """Test that compares a model's decisions with and without an emulated device and driver.

    Args:
        source: The signal that the device measures; the loop closes it.
        options: Options of the codec, as in a URL; a native device's ranges are `RANGES` unless
            given.
        faults: Faults to inject; the schedule is consumed.
        seconds: Length of the source's stream to send, s; None to send all.

    Attributes:
        complete: True once the loop has run to its end; until then, reports are partial.

    Raises:
        ConfigError: an unknown wire, codec or option.
        SpecMismatch: the model is for another array.
    """

    def __init__(
        self,
        source: Source,
        model: Path,
        wire: str = "serial",
        codec: str = "native",
        options: dict[str, str] | None = None,
        faults: "FaultSchedule | None" = None,
        seconds: float | None = None,
    ) -> None:
        check_line(wire, codec, options or {})
        self._options = {**(RANGES if codec == "native" else {}), **(options or {})}
        self._model, self._faulty = model, faults is not None
        self._direct = Classifier(model, source.spec)
        self._tee = _Tee(source)
        further: dict[str, Any] = {
            "options": self._options,
            "faults": faults,
            "pace": "realtime" if source.live else "fast",
            "seconds": seconds,
            "log": False,
        }
        if wire == "virtual":
            further["bus"] = f"virtual:hil-{os.getpid()}-{id(self)}"
        make = EmulatedSerial if wire == "serial" else EmulatedCan
        self._device = make(self._tee, codec, **further)
        own = codec_class(make.wire, codec).Options
        form = self._options.get("format", getattr(own, "format", ""))
        self._exact = codec == "native" and form == "float32" and not faults
        self._tick_ns = self._device.codec.tick_ns  # of the device's clock; None: no clock
        self._period_ns = NS_PER_S / source.spec.rate_hz
        self._first_ns: int | None = None
        self._pending: deque[tuple[int, Chunk]] = deque()  # first number, samples
        self._samples = self._identical = 0
        self._decided: tuple[list[Classification], list[Classification]] = ([], [])
        self._driver: Source | None = None
        self.complete = False

    def run(self) -> LoopReport:
        """Run to the end of the source; return the report. After an interrupt, call `report`.

        Raises:
            SourceError: the source, the device or the driver broke.
            SpecMismatch: the codec cannot carry the source's array.
        """
        with self._tee, self._device:
            clock = "host" if self._tick_ns is None else "device"
            url = f"{self._device.url}&clock={clock}&start_s={START_S:g}"
            try:
                driver = open_source(url)
            except SourceError:
                self._device.wait(0)  # if the source broke, that is why
                raise
            with driver:
                # The codec's names of elements and channels are replaced by the source's.
                driver = self._driver = declare(driver, self._tee.spec)
                classifier = Classifier(self._model, driver.spec)
                while True:
                    chunk = driver.read(WAIT_S)
                    self._push_direct()
                    if chunk is not None:
                        if self._tick_ns is None:
                            chunk = self._space_evenly(chunk, chunk.seq)
                        self._decided[1].extend(classifier.push(chunk))
                        self._compare(chunk)
                    elif self._device.wait(0):
                        break
        self.complete = True
        return self.report()

    def report(self) -> LoopReport:
        """Return the counts of the samples and decisions so far."""
        driver: Any = self._driver
        if driver is None:
            raise SourceError("the loop has not been closed: there is nothing to report")
        direct, wire = self._decided
        pairs = pair(direct, wire)
        finals = [(a, b) for a, b in pairs if a.final]
        log = self._device.log
        return LoopReport(
            samples=self._samples,
            identical_samples=self._identical,
            direct=len(direct),
            wire=len(wire),
            identical=sum(_is_identical(a, b) for a, b in pairs),
            same_label=sum(a.label == b.label for a, b in pairs),
            finals=sum(d.final for d in direct),
            finals_same=sum(a.label == b.label for a, b in finals),
            passed=len(self._passes),
            right=named_right(self._passes, wire),
            exact=self._exact,
            faulty=self._faulty,
            stats=driver.stats,
            sent=log.sent + log.duplicated,
            health=driver.health,
        )

    @property
    def _passes(self) -> "list[tuple[int, str]]":
        """Start time (driver's clock, ns) and class of each object's pass."""
        began_ns, class_of = self._first_ns or 0, self._direct.card.class_of
        passes = getattr(self._tee.inner, "passes", ())
        return [(p.start_ns - began_ns, class_of.get(p.category, p.category)) for p in passes]

    def _space_evenly(self, chunk: Chunk, numbers: NDArray[np.int64]) -> Chunk:
        """Return the chunk with new times: the sample numbers times the sample period."""
        t_ns = np.round(numbers * self._period_ns).astype(np.int64)
        return Chunk(chunk.seq, t_ns, chunk.values, chunk.valid)

    def _push_direct(self) -> None:
        """Classify, on the direct path, the new samples that the device has read."""
        while self._tee.kept:
            chunk = self._tee.kept.popleft()
            if self._first_ns is None:
                self._first_ns = int(chunk.t_ns[0])
            if self._tick_ns is None:
                chunk = self._space_evenly(chunk, self._samples + np.arange(len(chunk)))
            else:
                ticks = np.floor_divide(chunk.t_ns - self._first_ns, self._tick_ns)
                t_ns = np.round(ticks * self._tick_ns).astype(np.int64)
                chunk = Chunk(chunk.seq, t_ns, chunk.values, chunk.valid)
            self._pending.append((self._samples, chunk))
            self._samples += len(chunk)
            self._decided[0].extend(self._direct.push(chunk))

    def _compare(self, chunk: Chunk) -> None:
        """Count the received samples that are identical to the sent ones of equal number."""
        for i, number in enumerate(chunk.seq.tolist()):
            while self._pending and self._pending[0][0] + len(self._pending[0][1]) <= number:
                self._pending.popleft()
            if not self._pending or number < self._pending[0][0]:
                continue
            first, went = self._pending[0]
            at = number - first
            if went.values.shape[1:] == chunk.values.shape[1:]:
                same = went.values[at].tobytes() == chunk.values[i].tobytes()
                same = same and bool((went.valid[at] == chunk.valid[i]).all())
                self._identical += bool(same and went.t_ns[at] == chunk.t_ns[i])


def check_line(wire: str, codec: str, options: dict[str, str]) -> None:
    """Refuse a wire, a codec or options that `Loop` cannot emulate.

    Raises:
        ConfigError: an unknown wire, codec or option.
    """
    if wire not in WIRES:
        raise ConfigError(f"wire must be one of {', '.join(WIRES)}, not {wire!r}")
    make_codec("serial" if wire == "serial" else "can", codec, options)


def named_right(passes: Sequence[tuple[int, str]], decisions: Sequence[Classification]) -> int:
    """Count the objects that the last decision of their first touch names correctly.

    Args:
        passes: start of each object's pass, stream time in ns, and its category; in order.
    """
    named: dict[int, str] = {}
    for decision in decisions:
        if decision.final:
            number = bisect_right(passes, decision.onset_ns, key=lambda p: p[0]) - 1
            named.setdefault(number, decision.label)
    return sum(named.get(i) == category for i, (_, category) in enumerate(passes))


def pair(
    direct: Sequence[Classification], wire: Sequence[Classification]
) -> list[tuple[Classification, Classification]]:
    """Pair the decisions of both paths that belong to the same touch and step."""
    by_step: dict[int, list[Classification]] = {}
    for decision in wire:
        by_step.setdefault(decision.step, []).append(decision)
    pairs = []
    for decision in direct:
        others = by_step.get(decision.step, [])
        if not others:
            continue
        at = min(range(len(others)), key=lambda i: abs(others[i].onset_ns - decision.onset_ns))
        if abs(others[at].onset_ns - decision.onset_ns) <= SAME_EPISODE_NS:
            pairs.append((decision, others.pop(at)))
    return pairs


def _is_identical(a: Classification, b: Classification) -> bool:
    """Return whether two decisions have equal times, step, label and bits of probabilities."""
    plain = all(getattr(a, n) == getattr(b, n) for n in ("onset_ns", "t_ns", "step", "final"))
    return plain and a.label == b.label and a.probabilities.tobytes() == b.probabilities.tobytes()
