"""The demonstration: objects sweep past the simulated array and every guess is scored.

Needs the `sim` extra.
"""

import time
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.classifier.model_file import load_model
from tactile_rt.classifier.session import Session
from tactile_rt.sim_backend.source import Pass, SimOptions, SimSource
from tactile_rt.stream import NS_PER_S

__all__ = ["Demonstration", "SweepOutcome"]

LATENCIES_KEPT = 10_000  # steps that the latency percentiles look back on: a demo may run for days


@dataclass(frozen=True)
class SweepOutcome:
    """One object that has passed, and what the model took it for."""

    name: str
    category: str
    said: str | None  # None: it passed without a decision
    probability: float

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
        return f"{self.name:<12} feels like a {self.said:<12}{sure}  {verdict}"


class Demonstration:
    """Run a model on the simulated array and keep the score.

    The score counts objects, not touches: only the first episode of each object's pass, by its
    final decision. An episode belongs to the pass in which it began, even if its last steps come
    while the next object is still on its way. An object whose pass brings no decision is wrong.

    Args:
        model: an ``.onnx`` file made for the mouse array.
        sweeps: objects that pass before the end; 0: endless.
        seed: of the drawn objects and sweeps.
        fast: as fast as the simulation goes, instead of in real time.

    Attributes:
        unseen: the objects are ones that the model has not been trained on.
        classifier: what is run; holds the contact state and the forces.
        target: the object that `decision` is about; None before the first touch.
        decision: the latest one.
        outcomes: of the objects done, in order.

    Raises:
        ModelError, SpecMismatch: the model cannot be used on the mouse array.
    """

    def __init__(self, model: Path, sweeps: int, seed: int, fast: bool) -> None:
        _, card = load_model(model)
        unseen = card.provenance.get("unseen_objects", [])
        self.unseen = bool(unseen)
        options = SimOptions(
            objects=",".join(unseen),  # none listed: the first one of every category
            sweeps=sweeps,
            seed=seed,
            pace="fast" if fast else "realtime",
        )
        self._source = SimSource("mouse", options)
        self.classifier = Classifier(model, self._source.spec)
        self._session = Session(self._source, self.classifier)
        self.target: Pass | None = None
        self.decision: Classification | None = None
        self.outcomes: list[SweepOutcome] = []
        self._latencies: deque[float] = deque(maxlen=LATENCIES_KEPT)
        self._first_ns = self._now_ns = 0  # stream time
        self._began = self._now = 0.0  # wall time, s

    def run(self) -> Iterator[list[SweepOutcome]]:
        """Run to the end; yields after every chunk what it has settled."""
        for chunk, decisions in self._session:
            self._now_ns, self._now = int(chunk.t_ns[-1]), time.monotonic()
            if not self._began:
                self._first_ns, self._began = self._now_ns, self._now
            settled = len(self.outcomes)
            for decision in decisions:
                self._latencies.append(decision.latency_s)
                self._score(decision)
            yield self.outcomes[settled:]
        settled = len(self.outcomes)
        self._miss_before(len(self._source.passes))
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

    def _score(self, decision: Classification) -> None:
        passes = self._source.passes
        number = bisect_right(passes, decision.onset_ns, key=lambda p: p.start_ns) - 1
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
                    float(decision.probabilities.max()),
                )
            )

    def _miss_before(self, number: int) -> None:
        for missed in self._source.passes[len(self.outcomes) : number]:
            self.outcomes.append(SweepOutcome(missed.name, missed.category, None, 0.0))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._session.__exit__(kind, error, trace)
