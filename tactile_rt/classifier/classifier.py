"""The classifier, from chunks of samples to decisions; it needs only ONNX Runtime and numpy.

    Chunk -> Resampler -> ContactDetector -> model step (explicit state) -> Classification

Contact onset starts an episode, and without contact there is no decision. There are two modes:

- ``episode``: the recurrent state is zeroed at the onset, and every completed step gives a
  decision, the last of them final. With `sure`, the first decision that is sure enough is final.
- ``sliding``: as ``episode`` until the first final decision; then, while the contact lasts, a
  decision every few steps, each equal to that of an episode begun that many steps later.

A silence too long for the resampler to bridge ends an episode early, and so does a skipped stretch,
see `tactile_rt.classifier.skips`.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.contact import ContactDetector
from tactile_rt.classifier.decision_rules import (
    IN_A_ROW,
    Deadline,
    EarlyExit,
    Lanes,
    Policy,
    PredictionSetRule,
    fitting,
)
from tactile_rt.classifier.enrolment import identify
from tactile_rt.classifier.model_card import choose_label, kind_columns, rated_noise
from tactile_rt.classifier.model_file import fit_source, load_model
from tactile_rt.classifier.resampler import Resampler
from tactile_rt.classifier.runtime import onnxruntime_names
from tactile_rt.classifier.skips import CatchUp, Skip, Skips
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk

Mode = Literal["episode", "sliding"]
Floats = NDArray[np.float32]
EVERY = 4
# A live network skips to the newest sample when it is further behind than the longer of these.
BEHIND_STEPS, BEHIND_S = 3, 0.15
# Far beyond any load, and far below where squares of float32 overflow.
ABSURD = 1e9
# Times `ModelCard.clip`: a larger load points to a wrong unit or gain.
IMPLAUSIBLE = 10.0
IMPLAUSIBLE_LOADS = "loads are far beyond those that it learnt from: another unit, gain or sensor?"
ENDLESS_S = 10.0
JOINING_S = 5.0  # until then, a first baseline that moves is rejected
ENDLESS = "contact for 10 s without an end: something is held, or readings drift: let go to see"
TOUCHES = 256
FUSED = 8  # touches, at most, that are identified together
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Classification:
    """A model's decision after a step of an episode.

    Attributes:
        onset_ns: The stream time at which contact began, ns.
        t_ns: The stream time of the last resampled sample used, ns.
        step: The number of steps that the decision is based on, from 1; earlier steps of a longer
            contact do not count.
        final: Whether this decision is the last one of its window; an episode that a silence of
            the stream cuts short has no final decision.
        label: The decision: the name of the most probable class, which is a shape where the model
            distinguishes kinds within it; or a refusal: "unknown" for an object of no class that
            the model knows, or what is wrong with the loads, see `ModelCard.refusals`.
        labels: (class,) The names of all classes and then of the refusals, in the order of
            `probabilities`.
        probabilities: (class,) The posterior probability of each label, float32.
        latency_s: The time that the model's step took, s.
        prediction_set: The classes that are still possible, the most probable first, by the model's
            rule for the measured noise; empty without such a rule, and in mode ``sliding`` for
            windows that begin after the onset.
        coverage: The share of touches of known kinds whose true class is in the prediction set of
            every step; None without a set.
        late: Whether the decision missed its deadline, see `decision_rules.Deadline`.
        embedding: (unit,) The input of the network's last layer in the step, or, for a model that
            was trained to tell objects apart, a vector of length 1 that is alike for touches of one
            object, float32; None unless the classifier's option `embedding` is set.
        names: The kinds of the label's class that are still possible, the most probable first:
            box, crate; empty if the class has no kinds, or no rule as for `prediction_set`.
        names_coverage: The share of touches of that class whose true kind is among the names of
            every step; None without names.
        object: The enrolled object, or "none of these"; empty if none is enrolled, before a touch's
            last step, and if `sure` ends it early, since the thresholds are those of the last step.
        object_margin: The score of the likeliest object minus its threshold; below 0 the object is
            none of these; None without objects.
        object_touches: The number of touches from which `object` was identified, more than 1 where
            touches are fused; 0 without objects.
    """

    onset_ns: int
    t_ns: int
    step: int
    final: bool
    label: str
    labels: tuple[str, ...]
    probabilities: Floats
    latency_s: float
    prediction_set: tuple[str, ...] = ()
    coverage: float | None = None
    late: bool = False
    embedding: Floats | None = None
    names: tuple[str, ...] = ()
    names_coverage: float | None = None
    object: str = ""
    object_margin: float | None = None
    object_touches: int = 0

    @property
    def probability(self) -> float:
        """The posterior probability of `label`."""
        return float(self.probabilities[self.labels.index(self.label)])

    def top(self, k: int = 5) -> list[tuple[str, float]]:
        """Return the k most probable labels with their probabilities, in descending order."""
        order = np.argsort(-self.probabilities, kind="stable")[:k]
        return [(self.labels[i], float(self.probabilities[i])) for i in order]


@dataclass
class ClassifierStats:
    """Counters since the classifier was created.

    Attributes:
        withheld: The number of decisions that were not returned because they were late.
        skips: The number of stretches of the stream that were skipped.
        bad_samples: The number of samples of one element that were NaN, infinite or absurdly large
            though marked valid; they were treated as invalid.
        bad_steps: The number of steps whose logits were not finite; they gave no decision.
        implausible: The number of episodes with a load of more than ten times `ModelCard.clip`, as
            from a sensor in another unit.
    """

    steps: int = 0
    late: int = 0
    withheld: int = 0
    skips: int = 0
    bad_samples: int = 0
    bad_steps: int = 0
    implausible: int = 0


class Classifier:
    """A model that classifies a stream of samples. One thread at a time may use it.

    The stream may have another rate, and its elements another order, than the model's array.

    Args:
        model: The path of the ``.onnx`` file.
        mode: ``episode`` or ``sliding``.
        every: steps between the windows of ``sliding``, None for 4 (180 ms at 45 ms); the network
            runs in ceil(steps / every) lanes, and takes up to that many times longer.
        sure: probability of the best class that ends an episode early, None for never. It trades
            accuracy for time, see `tactile_rt.classifier.decision_rules`. For ``episode`` only.
        in_a_row: consecutive steps in which the same class must be that probable.
        deadline_s: backlog of work, and age of the newest sample, beyond which a step is late, s;
            None is the step's length.
        late: how to treat a late decision, see `tactile_rt.classifier.decision_rules.Deadline`.
        providers: execution providers, first choice first: cpu, cuda, tensorrt, openvino, coreml.
        embedding: whether each decision carries a copy of the step's embedding.
        age: returns the present age, s, of the sample at a stream time (ns); for live streams.
        catch_up: what to do when a live stream's decisions would be older than `behind_s`: skip to
            the ``newest`` sample, or take ``all`` steps.
        behind_s: the greatest age of a step's newest sample at its decision, s; None for three
            steps, or 0.15 s if that is more.
        fuse_s: a touch that begins within this time after the last decision on an object counts as
            a touch of the same object and is identified together with it, s; 0 for each alone.

    Attributes:
        detector: The contact detector, which holds the stream's contact state and baseline.
        deviation: (element, channel) The last resampled sample less the baseline, SI; zeros before
            the first. The next `push` overwrites it.
        touches: The newest 256 changes of contact, as stream time (ns) and whether contact began;
            a reader removes what it reads.
        implausible: True if the newest episode has implausible loads, see `ClassifierStats`.
        undecided: True if the newest answer was not finite, and so gave no decision.
        stats: The counters of steps, late steps and bad samples.
        providers: The names of the execution providers in use, as onnxruntime spells them.

    Raises:
        ModelError: the file cannot be used.
        SpecMismatch: the model was made for another array; the message says where they differ.
        ConfigError: an invalid option, or a requested execution provider that is missing.
    """

    def __init__(
        self,
        model: Path,
        spec: ArraySpec,
        *,
        mode: Mode = "episode",
        every: int | None = None,
        sure: float | None = None,
        in_a_row: int = IN_A_ROW,
        deadline_s: float | None = None,
        late: Policy = "count",
        providers: Sequence[str] = ("cpu",),
        embedding: bool = False,
        age: Callable[[int], float] | None = None,
        catch_up: CatchUp = "all",
        behind_s: float | None = None,
        skips: Iterable[Skip] = (),
        fuse_s: float = 0.0,
    ) -> None:
        if mode not in get_args(Mode):
            raise ConfigError(f"mode must be one of {', '.join(get_args(Mode))}, not {mode!r}")
        if mode == "sliding" and sure is not None:
            raise ConfigError("sure needs mode episode: sliding windows have no early end")
        if fuse_s < 0:
            raise ConfigError(f"fuse_s must be 0 or more, not {fuse_s} s")
        self._exit = EarlyExit(sure, in_a_row)
        names = onnxruntime_names(providers)
        session, self.card = load_model(model, names)
        self.providers = tuple(session.get_providers())
        order = fit_source(model, self.card, spec)
        self.detector = ContactDetector(spec.shape, np.array(self.card.floor, dtype=np.float32))
        self.deviation = np.zeros(spec.shape, dtype=np.float32)
        self.touches: deque[tuple[int, bool]] = deque(maxlen=TOUCHES)
        self.stats = ClassifierStats()
        self._sliding = mode == "sliding"
        self._embeds = embedding
        steps = self.card.steps
        every = min(EVERY, steps) if every is None else every
        self._lanes = Lanes(steps, every if self._sliding else steps)
        step_s = self.card.substeps * self.card.period_ns / NS_PER_S
        self._deadline = Deadline(step_s if deadline_s is None else deadline_s, late, age)
        if catch_up not in get_args(CatchUp):
            raise ConfigError(
                f"catch_up must be one of {', '.join(get_args(CatchUp))}, not {catch_up!r}"
            )
        most_s = max(BEHIND_S, BEHIND_STEPS * step_s) if behind_s is None else behind_s
        self.skips = Skips(skips, most_s, age if catch_up == "newest" else None)
        self._stepper = Stepper(session, self.card, self._lanes.count)
        self._rate_hz = spec.rate_hz
        self._resampler = Resampler(self.card.period_ns, spec.rate_hz)
        self._order = order  # index of each of the model's elements in the array
        # Baseline of the episode; the detector never writes into these arrays, it replaces them.
        self._offset = self.detector.offset
        self._sigma = self.detector.sigma
        self._filled = 0  # sub-steps of the current step
        self._step = 0  # steps done since the onset
        self._onset_ns: int | None = None  # None when no episode is under way
        self._decided = False  # the episode has had its final decision
        self._changed_ns, self._endless = 0, False  # time of the latest change of contact
        self._skipping = False
        self._next_seq = 0
        self._rated = rated_noise(self.card)
        self._plausible = IMPLAUSIBLE * np.array(self.card.clip, dtype=np.float32)
        self.implausible = self.undecided = False
        self._set_rule: PredictionSetRule | None = None  # of the episode
        self._columns = kind_columns(self.card.kinds)
        self._name_rules: dict[str, PredictionSetRule | None] = {}  # likewise, by class
        self._fuse_ns = fuse_s * NS_PER_S
        self._embeddings = deque[Floats](maxlen=FUSED)  # embeddings of touches of one thing
        self._fused_ns = 0  # decision time of the last of them

    @property
    def deciding(self) -> bool:
        """True if something is touched or an episode is under way."""
        return self.detector.contact or self._onset_ns is not None

    @property
    def step_ms(self) -> float:
        """Length of a step in stream time, ms."""
        return self.card.substeps * self.card.period_ns / 1e6

    def go_on_from(self, other: "Classifier") -> bool:
        """Adopt another classifier's stream position and baseline; return whether that is possible.

        Both need the same period and floor, and no episode may be under way."""
        if self.card.period_ns != other.card.period_ns or self.card.floor != other.card.floor:
            return False
        self._resampler, self.detector = other._resampler, other.detector
        self._offset, self._sigma = self.detector.offset, self.detector.sigma
        self._next_seq = other._next_seq
        return True

    def forget(self) -> None:
        """Reset the classifier to its initial state, so that it estimates the baseline anew."""
        self._renew_detector()
        self._resampler = Resampler(self.card.period_ns, self._rate_hz)
        self._onset_ns, self._next_seq = None, 0
        self._embeddings.clear()

    def _renew_detector(self) -> None:
        shape, floor = self.detector.offset.shape, self.detector.floor
        self.detector = ContactDetector((shape[0], shape[1]), floor)

    def push(self, chunk: Chunk) -> list[Classification]:
        """Feed a chunk of samples; return the decisions that these complete."""
        return list(self.decide(chunk))

    def decide(self, chunk: Chunk) -> Iterator[Classification]:
        """Feed a chunk of samples; yield each decision as soon as it is made.

        Exhaust the iterator: it processes the samples only as it advances."""
        # NaN, infinite and absurdly large values are no measurements.
        chunk, bad = without_bad_samples(chunk)
        self.stats.bad_samples += bad
        resampled = self._resampler.push(chunk)
        if resampled is None:
            return
        for i in range(len(resampled)):
            if resampled.seq[i] != self._next_seq:
                self._onset_ns = None  # after a gap, another object may be touched
            self._next_seq = int(resampled.seq[i]) + 1
            decision = self._update(int(resampled.t_ns[i]), resampled.values[i], resampled.valid[i])
            if decision is not None:
                yield decision

    def _update(self, t_ns: int, sample: Floats, valid: NDArray[np.bool_]) -> Classification | None:
        touched = self.detector.contact
        joined = self._next_seq * self.card.period_ns > JOINING_S * NS_PER_S
        ready = self.detector.ready or joined
        begins = self.detector.update(sample, valid)
        if self.detector.ready and not ready and self.detector.moves:
            self._renew_detector()  # the stream began within a touch: wait for its end
        if self.detector.contact != touched:
            self.touches.append((t_ns, not touched))
            self._changed_ns = t_ns
        elif touched and not self._endless and t_ns - self._changed_ns > ENDLESS_S * NS_PER_S:
            self._endless = True  # warn once
            log.warning("%s: %s", self.card.name, ENDLESS)
        # An element without a trustworthy value, or without a baseline, reads as untouched.
        untouched = ~(valid & self.detector.has_baseline)
        np.subtract(sample, self.detector.offset, out=self.deviation)
        self.deviation[untouched] = 0
        before = self._skipping
        if self.skips.covers(t_ns):
            self._skip()
            return None
        self._skipping = False
        if begins and (self._onset_ns is None or self._decided):
            self._begin(t_ns)
        elif before and self._sliding and self.detector.contact:
            self._begin(t_ns)  # a window that begins within a contact
            self._set_rule, self._name_rules = None, {}
        if self._decided and not self.detector.contact:
            self._onset_ns = None  # released: the next contact is a new episode
        if self._onset_ns is None or (self._decided and not self._sliding):
            return None
        if not self.implausible and (np.abs(self.deviation) > self._plausible).any():
            self.implausible = True
            self.stats.implausible += 1
            if self.stats.implausible == 1:  # later ones are counted
                log.warning("%s: %s", self.card.name, IMPLAUSIBLE_LOADS)
        now = np.where(untouched[:, None], self._offset, sample)
        self._stepper.samples[:, self._filled] = now[self._order]
        self._filled += 1
        if self._filled < self.card.substeps:
            return None
        if self.skips.before_step(t_ns):
            self._skip()
            return None
        return self._advance(t_ns, self._onset_ns)

    def _skip(self) -> None:
        """End the episode, and count a skipped stretch if it begins with this sample."""
        self.stats.skips += not self._skipping
        self._skipping, self._onset_ns = True, None

    def _begin(self, t_ns: int) -> None:
        self._onset_ns = t_ns
        self._filled = self._step = 0
        self._decided = self.implausible = False
        self._exit.begin()
        self._offset = self.detector.offset
        self._sigma = self.detector.sigma
        self._stepper.begin(self._offset[self._order], self._sigma[self._order])
        self._deadline.begin()
        # The noise of an element without a baseline is unknown.
        known = self._sigma[self.detector.has_baseline] / self._rated
        noise = float(np.median(known)) if known.size else np.inf
        self._set_rule = fitting(self.card.candidates, noise)
        self._name_rules = {k: fitting(rules, noise) for k, rules in self.card.names.items()}

    def _advance(self, t_ns: int, onset_ns: int) -> Classification | None:
        """Run a step on the gathered samples; return its decision, or None."""
        began = time.perf_counter()
        lane = self._lanes.beginning(self._step)
        if lane is not None:
            self._stepper.reset(lane)
        logits = self._stepper.run()
        latency = time.perf_counter() - began
        asked = self._lanes.choose_lane(self._step)
        self._filled = 0
        self._step += 1
        self.stats.steps += 1
        late = self._deadline.add_step(t_ns, latency)
        self.stats.late = self._deadline.late
        if self.skips.after_step(t_ns, latency):
            self._skip()
            return None
        if asked is None:
            return None
        lane, step = asked
        probabilities = self._compute_posterior(logits[lane])
        self.undecided = probabilities is None
        if probabilities is None:
            # The state is not finite and would stay so: end the episode, or restart the windows.
            self.stats.bad_steps += 1
            self._step, self._decided = 0, True
            self._stepper.begin(self._offset[self._order], self._sigma[self._order])
            return None
        best = choose_label(self.card, probabilities, step)
        final = step == self.card.steps or self._exit.may_end(best, float(probabilities[best]))
        # the rules were fitted on windows that begin at the onset
        rule = None if self._decided else self._set_rule
        left = rule.prediction_set(probabilities[: len(self.card.classes)], step) if rule else []
        label = self.card.labels[best]
        name_rule = None if self._decided else self._name_rules.get(label)
        names = self._find_kinds(name_rule, label, lane, step) if name_rule else ()
        whole = step == self.card.steps and not self._decided
        found = self._identify(onset_ns, t_ns, lane) if whole and self.card.enrolled else {}
        self._decided = self._decided or final
        if late and self._deadline.policy == "skip":
            self.stats.withheld += 1
            return None
        return Classification(
            onset_ns=onset_ns,
            t_ns=t_ns,
            step=step,
            final=final,
            label=label,
            labels=self.card.labels,
            probabilities=probabilities,
            latency_s=latency,
            prediction_set=tuple(self.card.classes[k] for k in left),
            coverage=rule.coverage if rule else None,
            late=late,
            embedding=self._stepper.embedding[lane].copy() if self._embeds else None,
            names=names,
            names_coverage=name_rule.coverage if name_rule else None,
            **found,
        )

    def _identify(self, onset_ns: int, t_ns: int, lane: int) -> dict[str, Any]:
        """Identify the touched object at the last step; return its `Classification` fields."""
        if onset_ns - self._fused_ns > self._fuse_ns:
            self._embeddings.clear()
        self._embeddings.append(self._stepper.embedding[lane].copy())
        self._fused_ns = t_ns
        assert self.card.identity is not None
        name, margin = identify(self.card.identity, self.card.enrolled, self._embeddings)
        return {"object": name, "object_margin": margin, "object_touches": len(self._embeddings)}

    def _find_kinds(
        self, rule: PredictionSetRule, label: str, lane: int, step: int
    ) -> tuple[str, ...]:
        logits = self._stepper.names[lane, self._columns[label]]
        probabilities = np.exp(logits - logits.max())
        left = rule.prediction_set(probabilities / probabilities.sum(), step)
        return tuple(self.card.kinds[label][k] for k in left)

    def _compute_posterior(self, logits: Floats) -> Floats | None:
        probabilities: Floats = logits / self.card.temperature
        probabilities -= probabilities.max()
        np.exp(probabilities, out=probabilities)
        probabilities /= probabilities.sum()
        return probabilities if np.isfinite(probabilities).all() else None


def fuse(posteriors: Sequence[Floats]) -> Floats:
    """Return the normalised product of posteriors (class,) of independent sweeps of one object.

    Assumes equal priors, as the training sets have.

    Raises:
        ValueError: There are no posteriors.
    """
    evidence = np.log(np.clip(np.stack(posteriors), 1e-12, None)).sum(axis=0)
    fused = np.exp(evidence - evidence.max())
    normalised: Floats = (fused / fused.sum()).astype(np.float32)
    return normalised


def without_bad_samples(chunk: Chunk) -> tuple[Chunk, int]:
    """Mark elements of a chunk invalid whose values are NaN, infinite or absurdly large.

    Returns:
        The chunk itself if all values are good, else a copy with those elements marked and zero;
        and the number of element samples that were newly marked.
    """
    # One dot product is the cheapest test of all values: a bad value makes it large or NaN.
    if np.vdot(chunk.values, chunk.values) < ABSURD**2:
        return chunk, 0
    largest = np.abs(chunk.values).max(axis=2)  # (n, element); NaN if one is
    good: NDArray[np.bool_] = largest < ABSURD
    bad = int((chunk.valid & ~good).sum())
    values = np.where(good[..., None], chunk.values, np.float32(0))
    return Chunk(chunk.seq, chunk.t_ns, values, chunk.valid & good), bad
