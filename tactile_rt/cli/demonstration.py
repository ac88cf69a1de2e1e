"""What `tactile-rt demo` runs: objects that pass whiskers, a model's guesses, and the score.

The whiskers are simulated; where nothing can be, a recording of theirs is played by an emulated
device on a serial port, and goes through driver, detector and model as a device's samples do.
"""

import sys
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from tactile_rt.classifier.decision_rules import UNKNOWN
from tactile_rt.stream import NS_PER_S

if TYPE_CHECKING:
    from tactile_rt.classifier.classifier import Classification
    from tactile_rt.sim_backend.source import Pass
    from tactile_rt.stream import Source

__all__ = ["Demonstration", "SweepOutcome"]

END_NS = 50_000_000  # before the end of the recording: the last samples may be lost
LATENCIES_KEPT = 10_000  # steps that the latency percentiles look back on: a demo may run for days


@dataclass(frozen=True)
class SweepOutcome:
    """One object that has passed, and what the model took it for."""

    name: str
    category: str
    said: str | None  # None: it passed without a decision
    probability: float
    faulty: bool = False  # what was said is that something is wrong with the loads

    @property
    def right(self) -> bool:
        """Whether the decision is the object's category."""
        return self.said == self.category

    def line(self) -> str:
        """One line that says it all."""
        if self.said is None:
            return f"{self.name:<12} no decision                   WRONG"
        verdict = "right" if self.right else "WRONG"
        sure = f"{100 * self.probability:3.0f} %"
        what = {UNKNOWN: "like nothing known"}.get(self.said, f"like a {self.said}")
        feels = f"feels {f'wrong: {self.said}' if self.faulty else what}"
        return f"{self.name:<12} {feels:<25}{sure}  {verdict}"


@dataclass(frozen=True)
class RecordedPass:
    """An object that passed when the recording was made, and when, in ns from its first sample."""

    start_ns: int
    name: str
    category: str


class Demonstration:
    """Run a model on the simulated array, or on a recording of it, and keep the score.

    The score counts objects, not touches: only the first episode of each object's pass, by its
    final decision. An episode belongs to the pass in which it began, even if its last steps come
    while the next object is still on its way. An object whose pass brings no decision is wrong.

    Args:
        model: an ``.onnx`` file made for the mouse array.
        sweeps: objects that pass before the end; 0: endless.
        seed: of the drawn objects and sweeps.
        fast: as fast as the simulation goes, instead of in real time.
        recorded: play the recording instead.

    Attributes:
        unseen: Whether the objects are ones that the model has not been trained on.
        recorded: Whether the recording is played.
        classifier: The classifier that is run; holds the contact state and the forces.
        target: The object that `decision` is about; None before the first touch.
        decision: The latest decision of the model; None before the first one.
        outcomes: The outcomes of the objects that have passed, in order.

    Raises:
        ModelError, SpecMismatch: the model cannot be used on the mouse array.
    """

    def __init__(
        self, model: Path, sweeps: int, seed: int, fast: bool, recorded: bool = False
    ) -> None:
        from tactile_rt.classifier.classifier import Classifier
        from tactile_rt.classifier.model_file import load_model
        from tactile_rt.classifier.session import Session

        _, card = load_model(model)
        unseen = card.provenance.get("unseen_objects", [])
        self.recorded = recorded
        self._device = ExitStack()
        self._ends_ns = sys.maxsize  # stream time from the first sample at which it is over
        self.passes: Sequence[Pass | RecordedPass]
        if recorded:
            self._source = self._play(sweeps)
            self.unseen = {p.name for p in self.passes} <= set(unseen)
        else:
            self._source, self.passes = self._simulate(unseen, sweeps, seed, fast)
            self.unseen = bool(unseen)
        self.classifier = Classifier(model, self._source.spec)
        self._session = Session(self._source, self.classifier)
        self.target: Pass | RecordedPass | None = None
        self.decision: Classification | None = None
        self.outcomes: list[SweepOutcome] = []
        self._latencies: deque[float] = deque(maxlen=LATENCIES_KEPT)
        self._first_ns = self._now_ns = 0  # stream time
        self._base_ns = 0  # stream time from which passes count
        self._began = self._now = 0.0  # wall time, s

    def _simulate(
        self, unseen: list[str], sweeps: int, seed: int, fast: bool
    ) -> "tuple[Source, list[Pass]]":
        from tactile_rt.sim_backend.source import SimOptions, SimSource

        options = SimOptions(
            objects=",".join(unseen),  # none listed: the first one of every category
            sweeps=sweeps,
            seed=seed,
            pace="fast" if fast else "realtime",
        )
        source = SimSource("mouse", options)
        return source, source.passes

    def _play(self, sweeps: int) -> "Source":
        """The recording, from an emulated device on a serial port."""
        from tactile_rt.drivers.emulation.device import EmulatedSerial
        from tactile_rt.recording import Recording
        from tactile_rt.recording.replay import DEMO
        from tactile_rt.sources.opening import open_source

        recording = Recording(DEMO)
        notes = recording.description.session
        told = [notes[f"pass_{i}"].split() for i in range(len(notes))]
        passes = [RecordedPass(int(start), name, category) for start, name, category in told]
        chunks = list(recording)
        last = int(chunks[-1].t_ns[-1] - chunks[0].t_ns[0])
        ends = [p.start_ns for p in passes[1:]] + [last - END_NS]
        count = min(sweeps or len(passes), len(passes))
        self.passes, self._ends_ns = passes[:count], ends[count - 1]
        played = self._device.enter_context(open_source(f"replay:{DEMO}?speed=0"))
        device = self._device.enter_context(EmulatedSerial(played, "native", log=False))
        return open_source(device.url)

    def run(self) -> Iterator[list[SweepOutcome]]:
        """Run to the end; yields after every chunk what it has settled."""
        for chunk, decisions in self._session:
            self._now_ns, self._now = int(chunk.t_ns[-1]), time.monotonic()
            if not self._began:
                self._first_ns, self._began = self._now_ns, self._now
                if self.recorded:
                    before = int(chunk.seq[0]) / self._source.spec.rate_hz * NS_PER_S
                    self._base_ns = int(chunk.t_ns[0]) - round(before)
            settled = len(self.outcomes)
            for decision in decisions:
                self._latencies.append(decision.latency_s)
                self._score(decision)
            yield self.outcomes[settled:]
            if self._now_ns - self._base_ns >= self._ends_ns:
                break
        settled = len(self.outcomes)
        self._miss_before(len(self.passes))
        yield self.outcomes[settled:]

    @property
    def right(self) -> int:
        """Objects recognised."""
        return sum(o.right for o in self.outcomes)

    @property
    def simulated_s(self) -> float:
        """Stream time since the first chunk, s."""
        return (self._now_ns - self._first_ns) / NS_PER_S

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall time; 0 at the first chunk."""
        wall = self._now - self._began
        return self.simulated_s / wall if wall > 0 else 0.0

    @property
    def dropped(self) -> int:
        """Samples for which the classifier was too late."""
        return self._session.dropped + self._source.stats.dropped

    @property
    def share_dropped(self) -> float:
        """Those samples over all that there were, 0 to 1."""
        return self.dropped / max(1.0, self.simulated_s * self._source.spec.rate_hz)

    def latency_ms(self, percentile: float) -> float:
        """A percentile of the time that a model step takes, ms; NaN before the first step."""
        if not self._latencies:
            return float("nan")
        return 1e3 * float(np.percentile(self._latencies, percentile))

    def summary(self) -> str:
        """The figures so far, in one line."""
        done = len(self.outcomes)
        score = f"{self.right} of {done} right"
        score += f" ({100 * self.right / done:.0f} %)" if done else ""
        steps = f"step p50 {self.latency_ms(50):.1f}, p99 {self.latency_ms(99):.1f} ms; "
        return (
            f"{score}; {steps if self._latencies else ''}"
            f"{self.real_time_factor:.2f} x real time; {self.dropped} dropped"
        )

    def _score(self, decision: "Classification") -> None:
        passes, onset_ns = self.passes, decision.onset_ns - self._base_ns
        number = bisect_right(passes, onset_ns, key=lambda p: p.start_ns) - 1
        if number < len(self.outcomes):
            return  # touched again after its first episode, which alone counts
        self._miss_before(number)
        self.target, self.decision = passes[number], decision
        if decision.final:
            self.outcomes.append(
                SweepOutcome(
                    self.target.name,
                    self.target.category,
                    decision.label,
                    decision.probability,
                    decision.label in set(self.classifier.card.refusals) - {UNKNOWN},
                )
            )

    def _miss_before(self, number: int) -> None:
        for missed in self.passes[len(self.outcomes) : number]:
            self.outcomes.append(SweepOutcome(missed.name, missed.category, None, 0.0))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._device:
            self._session.__exit__(kind, error, trace)
