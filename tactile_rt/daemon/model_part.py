"""The part of a model: a classifier in a thread of its own, fed from a mailbox."""

import math
import time
from collections import deque
from contextlib import suppress
from dataclasses import replace

import numpy as np

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.classifier.model_card import sensor_of
from tactile_rt.classifier.model_file import hash_of
from tactile_rt.classifier.trial import Trial
from tactile_rt.core.errors import ConfigError, SpecMismatch, TactileError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, Source, concatenate
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.daemon.admission import Admission, file_stamp, model_path
from tactile_rt.daemon.clock import Clock
from tactile_rt.daemon.config import LimitsConfig, ModelConfig
from tactile_rt.daemon.diagnostics import LossWindow
from tactile_rt.daemon.items import Contact, Decision, Item, Opened, Skipped, SourceChunk
from tactile_rt.daemon.mailbox import Hub, Mailbox
from tactile_rt.daemon.part import Part, Report
from tactile_rt.daemon.source_part import keeps_host_time
from tactile_rt.daemon.states import LatencyMeter, ModelState

MODEL_BYTES = 64 << 20
WAKE_S, LOOK_S = 0.25, 0.02
LONGEST_S = 10.0  # a touch that lasts longer does not delay a new model
STOP_SHARE = 0.35  # of the time in which all parts must end
BEGINNING_NS = 60 * NS_PER_S  # longer than samples wait for a model that is still being loaded


class ModelPart(Part):
    """The part that runs one model and posts its `Decision`, `Contact` and `Skipped` items."""

    def __init__(
        self, config: ModelConfig, hub: Hub, report: Report, limits: LimitsConfig, clock: Clock
    ) -> None:
        super().__init__(f"model.{config.name}", report, limits)
        self.config = config
        self.file = model_path(config)
        self.box = Mailbox(
            {Opened, SourceChunk}, limits.model_queue_items, MODEL_BYTES, limits.gather_ms / 1e3,
            source=config.source,
        )  # fmt: skip
        self._hub, self._clock = hub, clock
        self._opened: Opened | None = None
        self._classifier: Classifier | None = None
        self._refused: tuple[object, TactileError] | None = None
        self._trial: tuple[tuple[int, ...], Trial | None] = (), None  # file's stamp and trial
        self._wanted: deque[ModelConfig] = deque()  # replacements that were requested
        self._next: Admission | None = None
        self._ready_at = 0.0
        self._until = math.inf  # after a stop, the time to finish waiting samples, monotonic s
        self.refused = ""  # why the newest replacement was refused
        self._half_ns = 0  # half the resampler's kernel
        self._deadline_ns = 0
        self._ahead_ns = 0  # host time less stream time
        self._last_ns: int | None = None  # stream time of the newest sample that was taken
        self._dropped = self._gap = 0  # samples that the mailbox dropped: in all, since `_last_ns`
        self._missed = 0  # events that the mailbox dropped
        self._sha256 = ""
        with suppress(ConfigError):  # loading reports it
            self._sha256 = hash_of(self.file)  # a recording states it from its first byte
        self._labels: tuple[str, ...] = ()
        self.sensor: SensorSpec | None = None  # that the model was made for, if known
        self.changes = 0.0  # share of readings that change at rest, likewise
        self._decisions = self._final = self._late = self._bad_samples = 0
        self._newest: Classification | None = None
        self._object = ""  # the enrolled object of the newest decision's touch
        self._touching = False
        self._latency, self._step = LatencyMeter(), LatencyMeter()
        self._skips, self._age_s, self._bad_steps = 0, 0.0, 0
        self._skipped, self._losses = LossWindow(), LossWindow()

    @property
    def model_state(self) -> ModelState:
        """Present state of the model, for the snapshot."""
        newest, queue, classifier = self._newest, self.box.state, self._classifier
        opened = self._opened
        return ModelState(
            self.state, self.config.source, str(self.file), self._sha256, self._labels,
            queue, self._decisions, self._final, self._touching,
            newest.label if newest else "",
            newest.probability if newest else 0.0,
            self._latency.state, self._step.state, self._late, self._bad_samples,
            1e3 * self._age_s, max(queue.oldest_s, self.silent_s), self._skips,
            self._skipped.add(self._skips), self._losses.add(queue.dropped["samples"]),
            self.refused, classifier is not None and classifier.implausible, self._object,
            self._bad_steps, classifier is not None and classifier.undecided,
            _find_drift(classifier, opened.spec) if classifier and opened else "",
        )  # fmt: skip

    def stop(self) -> None:
        self._until = min(self._until, time.monotonic() + STOP_SHARE * self.limits.stop_s)
        super().stop()
        self.box.close()

    def may_exchange(self, config: ModelConfig, limits: LimitsConfig) -> bool:
        """Return whether `exchange` can apply a configuration without a restart of the part."""
        running = self.state.state == "running"
        return running and config.source == self.config.source and limits == self.limits

    def exchange(self, config: ModelConfig) -> None:
        """Request to replace the model or its options once the new model is admitted. Any thread
        may call this; the newest of several requests counts."""
        self._wanted.append(config)

    def _work(self) -> None:
        self.box.taking = True  # a source that waits for its reader waits for the trial, too
        self._load()
        self._report_running()
        while True:
            items = self.box.take(WAKE_S)
            if not items and self.box.closed:
                return
            self._busy_ns = time.monotonic_ns()
            try:
                self._handle(items)
                self._advance_exchange(bool(items))
            finally:
                self._busy_ns = 0
            if time.monotonic() > self._until:
                why = "it was to end, and so far behind that it has not decided about all"
                self._report(self.name, "cut short", why, "warning")
                return

    def _release(self) -> None:
        self.box.taking = False
        self._classifier = None
        if self._next is not None and self._stop.is_set():
            self._next.give_up()  # otherwise the process would wait for it
        self._set_contact(False, time.monotonic_ns())

    def _may_retry(self) -> bool:
        """Return whether the source's array or the model's file has changed."""
        opened = self._hub.streams().get(self.config.source)
        tried = None if opened is None else (opened.spec, file_stamp(self.file))
        return self._refused is None or tried not in (None, self._refused[0])

    def _load(self) -> None:
        """Load the classifier for the open source; if none is open, only try the model."""
        self._opened = opened = self._hub.streams().get(self.config.source)
        if opened is not None:
            self._make_classifier(opened)
        else:
            self._await_admission(None)

    def _make_classifier(self, opened: Opened) -> None:
        # New for every stream: another object may be touched now.
        self._classifier = None
        if self._next is not None and self._next.finished.is_set() and self._next.error is None:
            self.config, self.file = self._next.config, self._next.file
            self._next = None
        tried = (opened.spec, file_stamp(self.file))
        if self._refused is not None and self._refused[0] == tried:
            raise self._refused[1]  # loading it again would fail until something changes
        self._refused = None
        try:
            admission = self._await_admission(opened)
        except SpecMismatch as error:
            self._refused = (tried, SpecMismatch(f"source {opened.source}: {error}"))
            raise self._refused[1] from None
        except TactileError as error:
            self._refused = (tried, error)
            raise
        if admission is not None:
            self._install(opened, admission)

    def _await_admission(self, opened: Opened | None) -> Admission | None:
        """Start the model's admission and wait for it; return None if the part must end.

        Raises:
            TactileError: The model is refused.
        """
        if self._stop.is_set() and (opened is None or time.monotonic() > self._until):
            return None
        admission = self._start_admission(self.config, opened)
        while not admission.finished.wait(LOOK_S):
            # waiting samples of a recording are still to be classified
            live = opened is None or opened.stream.live
            if time.monotonic() > self._until or (self._stop.is_set() and live):
                admission.give_up()
                return None
        if admission.error is not None:
            raise admission.error
        self._trial = admission.stamp, admission.trial
        return admission

    def _start_admission(self, config: ModelConfig, opened: Opened | None) -> Admission:
        known, trial = self._trial
        same = known == file_stamp(model_path(config)) and config.mode == self.config.mode
        return Admission(config, self.limits, opened, self._compute_age, trial if same else None)

    def _install(self, opened: Opened, admission: Admission) -> None:
        """Put an admitted model into use."""
        assert admission.classifier is not None and admission.trial is not None
        self._classifier = admission.classifier
        self.config, self.file = admission.config, admission.file
        self._sha256, self.refused = admission.trial.sha256, ""
        self._opened = opened
        self._labels = self._classifier.card.labels
        card = self._classifier.card
        self.sensor, self.changes = sensor_of(card), card.changes
        self._half_ns = max(card.period_ns, round(NS_PER_S / opened.spec.rate_hz))
        step_ns = card.substeps * card.period_ns
        self._deadline_ns = round(1e6 * self.config.deadline_ms) or step_ns
        self._last_ns = None

    def _advance_exchange(self, came: bool) -> None:
        """Start a requested replacement, or complete it once the new model is ready."""
        if self._wanted:
            if self._next is not None:
                self._next.give_up()
            self._next = self._start_admission(self._wanted[-1], self._opened)
            self._wanted.clear()
        new = self._next
        if new is None or not new.finished.is_set():
            return
        if new.error is not None:
            self._next, self.refused = None, str(new.error)
            self._report(self.name, "refused", f"the one before goes on: {new.error}", "error")
            return
        self._trial = new.stamp, new.trial
        self._ready_at = self._ready_at or time.monotonic()
        waited = time.monotonic() - self._ready_at
        if new.classifier is None:  # no stream: it is loaded when one opens
            self.config, self.file, self.refused = new.config, new.file, ""
            assert new.trial is not None
            self._sha256 = new.trial.sha256
        elif self._opened is None or not self._can_take_over(new.classifier, came, waited):
            return
        else:
            self._install(self._opened, new)
        self._next, self._ready_at = None, 0.0
        late = (
            f"; in the middle of a touch that did not end for {waited:.0f} s"
            if waited > LONGEST_S
            else ""
        )
        self._report(self.name, "admitted", f"{new.words}{late}")

    def _can_take_over(self, new: Classifier, came: bool, waited: float) -> bool:
        """Return whether a new model may take over: with a baseline between touches, or overdue."""
        old = self._classifier
        if old is None:
            return True
        if old.deciding and waited <= LONGEST_S:
            return False
        return new.go_on_from(old) or not came or new.detector.ready or waited > LONGEST_S

    def _warm_up(self, new: Classifier, old: Classifier, chunk: Chunk) -> None:
        """Feed a chunk to a new model between touches, so that it estimates its baseline."""
        if old.deciding:
            new.forget()
        else:
            new.push(chunk)
            new.skips.found.clear()
            new.touches.clear()

    def _handle(self, items: list[Item]) -> None:
        run: list[SourceChunk] = []
        dropped = self.box.dropped  # the oldest go first, so these came before all of `items`
        self._gap, self._dropped = dropped["samples"] - self._dropped, dropped["samples"]
        opened = self._hub.streams().get(self.config.source)
        if dropped["events"] > self._missed and opened is not None:
            items = [opened, *items]  # it may have been dropped
        self._missed = dropped["events"]
        for item in items:
            if isinstance(item, SourceChunk):
                run.append(item)
            elif isinstance(item, Opened):
                self._classify(run)
                run = []
                if self._opened is None or item.t_ns > self._opened.t_ns:
                    self._make_classifier(item)
        self._classify(run)

    def _classify(self, run: list[SourceChunk]) -> None:
        opened, classifier = self._opened, self._classifier
        # Samples left from an earlier stream are of no use to this classifier.
        run = [s for s in run if opened is not None and s.arrived_ns >= opened.t_ns]
        if not run or classifier is None or opened is None:
            return
        chunk = concatenate([s.chunk for s in run]) if len(run) > 1 else run[0].chunk
        before = replace(classifier.stats)
        arrived, newest = run[-1].arrived_ns, int(chunk.t_ns[-1])
        self._ahead_ns = 0 if keeps_host_time(opened.stream) else arrived - newest
        lost = self._skip_gap(classifier, int(chunk.t_ns[0]))
        offset = run[-1].utc_offset_ns
        frame = opened.spec.frame
        for decision in classifier.decide(chunk):
            self._post(decision, run, opened, offset)
            if time.monotonic() > self._until:
                return
        if self._next is not None and self._next.classifier is not None:
            self._warm_up(self._next.classifier, classifier, chunk)
        self._last_ns = newest
        self._late += classifier.stats.late - before.late
        self._bad_samples += classifier.stats.bad_samples - before.bad_samples
        self._bad_steps += classifier.stats.bad_steps - before.bad_steps
        self._skips += len(classifier.skips.found)
        for skip in classifier.skips.found:
            self._hub.post(
                Skipped(
                    self.config.source, self.config.name, frame, skip.from_ns, skip.until_ns, lost,
                    time.monotonic_ns(), offset,
                )
            )  # fmt: skip
            lost = 0
        classifier.skips.found.clear()
        while classifier.touches:
            t_ns, touching = classifier.touches.popleft()
            self._set_contact(touching, t_ns, frame, offset)
        self._set_contact(classifier.detector.contact, newest, frame, offset)
        if not opened.stream.live:
            for box in self._hub.list_mailboxes(Decision):
                box.wait_for_room(1.0)

    def _post(self, d: Classification, run: list[SourceChunk], opened: Opened, offset: int) -> None:
        """Post a decision at once, before the rest of the chunk is classified."""
        made = time.monotonic_ns()
        sample = self._find_sample_ns(d, run, opened.stream)
        if d.object or self._newest is None or d.onset_ns != self._newest.onset_ns:
            self._object = d.object  # kept while windows of the same touch follow
        self._newest = d
        self._decisions += 1
        self._final += d.final
        self._age_s = (made - sample) / 1e9
        self._latency.add(self._age_s)
        self._step.add(d.latency_s)
        if d.final or self.config.decisions == "every_step":
            config, frame = self.config, opened.spec.frame
            deadline_ns = self._deadline_ns if opened.stream.live else 0
            self._hub.post(
                Decision(config.source, config.name, frame, d, sample, made, offset, deadline_ns)
            )

    def _skip_gap(self, classifier: Classifier, t_ns: int) -> int:
        """Skip a gap before the sample at `t_ns`; return how many samples the mailbox dropped. No
        network receives a stream with a gap."""
        lost, self._gap = self._gap, 0
        if lost:
            first = t_ns - BEGINNING_NS if self._last_ns is None else self._last_ns + 1
            classifier.skips.add(first, t_ns)
        return lost

    def _compute_age(self, t_ns: int) -> float:
        """Return the age of a step, s, given the stream time of its newest sample."""
        end = t_ns + self._half_ns + self._ahead_ns
        return max(0, time.monotonic_ns() - end) / 1e9

    def _find_sample_ns(self, d: Classification, run: list[SourceChunk], stream: Source) -> int:
        """Return the host time of the sample that completed a step, ns."""
        end = d.t_ns + self._half_ns
        for samples in run:
            t_ns = samples.chunk.t_ns
            if t_ns[-1] < end and samples is not run[-1]:
                continue
            arrived = samples.arrived_ns
            if not stream.live or not keeps_host_time(stream):
                return arrived
            taken = int(t_ns[min(int(np.searchsorted(t_ns, end)), len(t_ns) - 1)])
            return min(taken, arrived)
        return run[-1].arrived_ns

    def _set_contact(self, touching: bool, t_ns: int, frame: str = "", offset: int = 0) -> None:
        if touching == self._touching:
            return
        self._touching = touching
        if not frame and self._opened is not None:
            frame, offset = self._opened.spec.frame, self._clock.utc_offset_ns()
        self._hub.post(Contact(self.config.source, self.config.name, frame, touching, t_ns, offset))


def _find_drift(classifier: Classifier, spec: ArraySpec) -> str:
    """Describe the fastest drift at rest; empty if below the noise in 1 s."""
    detector, period_s = classifier.detector, classifier.card.period_ns / NS_PER_S
    moves = np.abs(detector.drift) / detector.sigma / period_s
    at = np.unravel_index(moves.argmax(), moves.shape)
    if moves[at] < 1:
        return ""
    where, minute = spec.elements[at[0]], 60 * float(detector.drift[at]) / period_s
    return f"{where} {spec.channels[at[1]]} moves by {minute:.2g} {spec.units[at[1]]} a minute"
