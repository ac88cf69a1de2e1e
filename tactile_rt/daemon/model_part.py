"""A classifier in a thread of its own, fed from a mailbox."""

import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.classifier.model_card import sensor_of
from tactile_rt.classifier.model_file import hash_of, shipped_model
from tactile_rt.daemon.clock import Clock
from tactile_rt.daemon.config import LimitsConfig, ModelConfig
from tactile_rt.daemon.health import LatencyMeter, ModelState
from tactile_rt.daemon.items import Contact, Decision, Item, Opened, Skipped, SourceChunk
from tactile_rt.daemon.mailbox import Hub, Mailbox
from tactile_rt.daemon.part import Part, Report
from tactile_rt.daemon.source_part import keeps_host_time
from tactile_rt.daemon.troubles import LossWindow
from tactile_rt.sensor_spec import SensorSpec
from tactile_rt.stream import (
    NS_PER_S,
    ConfigError,
    Source,
    SpecMismatch,
    TactileError,
    concatenate,
)

__all__ = ["ModelPart", "file_stamp", "model_path"]

MODEL_BYTES = 64 << 20
BEGINNING_NS = 60 * NS_PER_S  # more than waits for a model that is still being loaded


class ModelPart(Part):
    """Posts `Decision`, `Contact` and `Skipped` of one model."""

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
        self._half_ns = 0  # half the resampler's kernel
        self._deadline_ns = 0
        self._ahead_ns = 0  # host time less stream time
        self._last_ns: int | None = None  # stream time of the newest sample that was taken
        self._dropped = self._hole = 0  # samples that the mailbox has dropped; since that one
        self._sha256 = ""
        self._hashed: tuple[int, ...] = ()
        self._hash()  # a recording tells it from its first byte
        self._labels: tuple[str, ...] = ()
        self.sensor: SensorSpec | None = None  # what the model was made for, if it tells
        self._decisions = self._final = self._late = self._bad_samples = 0
        self._newest: Classification | None = None
        self._touching = False
        self._latency, self._step = LatencyMeter(), LatencyMeter()
        self._skips, self._age_s = 0, 0.0
        self._skipped, self._losses = LossWindow(), LossWindow()

    @property
    def model_state(self) -> ModelState:
        """For the snapshot."""
        newest, queue = self._newest, self.box.state
        return ModelState(
            self.state, self.config.source, str(self.file), self._sha256, self._labels,
            queue, self._decisions, self._final, self._touching,
            newest.label if newest else "",
            newest.probability if newest else 0.0,
            self._latency.state, self._step.state, self._late, self._bad_samples,
            1e3 * self._age_s, max(queue.oldest_s, self.silent_s), self._skips,
            self._skipped.add(self._skips), self._losses.add(queue.dropped["samples"]),
        )  # fmt: skip

    def stop(self) -> None:
        super().stop()
        self.box.close()

    def _work(self) -> None:
        self._load()
        self.box.taking = True
        self._up()
        while True:
            items = self.box.take()
            if not items and self.box.closed:
                return
            self._busy_ns = time.monotonic_ns()
            try:
                self._take(items)
            finally:
                self._busy_ns = 0

    def _release(self) -> None:
        self.box.taking = False
        self._classifier = None
        self._touch(False, time.monotonic_ns())

    def _mended(self) -> bool:
        """Whether the source is of another array by now, or the model another file."""
        opened = self._hub.streams().get(self.config.source)
        tried = None if opened is None else (opened.spec, file_stamp(self.file))
        return self._refused is None or tried not in (None, self._refused[0])

    def _load(self) -> None:
        """Make the classifier; without a source, at least see whether there is a model."""
        self._opened = self._hub.streams().get(self.config.source)
        if self._opened is not None:
            self._make(self._opened)
        elif not self.file.is_file():
            raise ConfigError(f"no model file {self.file}")

    def _make(self, opened: Opened) -> None:
        # Anew for every stream: what was touched before need not be what is touched now.
        self._classifier = None
        tried = (opened.spec, file_stamp(self.file))
        if self._refused is not None and self._refused[0] == tried:
            raise self._refused[1]  # as long as nothing has changed, loading it again is in vain
        self._refused = None
        try:
            config = self.config
            self._classifier = Classifier(
                self.file, opened.spec, mode=config.mode, every=config.every or None,
                sure=config.sure or None, in_a_row=config.in_a_row,
                deadline_s=config.deadline_ms / 1e3 or None, late=config.late,
                providers=config.providers, age=self._age if opened.stream.live else None,
                catch_up=config.catch_up, behind_s=config.behind_ms / 1e3 or None,
            )  # fmt: skip
        except SpecMismatch as error:
            self._refused = (tried, SpecMismatch(f"source {opened.source}: {error}"))
            raise self._refused[1] from None
        except TactileError as error:
            self._refused = (tried, error)
            raise
        self._opened = opened
        self._labels = self._classifier.card.labels
        self.sensor = sensor_of(self._classifier.card)
        self._hash()
        card = self._classifier.card
        self._half_ns = max(card.period_ns, round(NS_PER_S / opened.spec.rate_hz))
        step_ns = card.substeps * card.period_ns
        self._deadline_ns = round(1e6 * self.config.deadline_ms) or step_ns
        self._last_ns = None

    def _hash(self) -> None:
        """Note the file's hash, anew only if it is another file; loading tells if it is none."""
        stamp = file_stamp(self.file)
        if stamp != self._hashed:
            with suppress(ConfigError):
                self._sha256, self._hashed = hash_of(self.file), stamp

    def _take(self, items: list[Item]) -> None:
        run: list[SourceChunk] = []
        dropped = self.box.dropped["samples"]  # the oldest: they came before all these
        self._hole, self._dropped = dropped - self._dropped, dropped
        for item in items:
            if isinstance(item, SourceChunk):
                run.append(item)
            elif isinstance(item, Opened):
                self._classify(run)
                run = []
                if self._opened is None or item.t_ns > self._opened.t_ns:
                    self._make(item)
        self._classify(run)

    def _classify(self, run: list[SourceChunk]) -> None:
        opened, classifier = self._opened, self._classifier
        # What is left of a stream before this one is of no use to its classifier.
        run = [s for s in run if opened is not None and s.arrived_ns >= opened.t_ns]
        if not run or classifier is None or opened is None:
            return
        chunk = concatenate([s.chunk for s in run]) if len(run) > 1 else run[0].chunk
        before = replace(classifier.stats)
        arrived, newest = run[-1].arrived_ns, int(chunk.t_ns[-1])
        self._ahead_ns = 0 if keeps_host_time(opened.stream) else arrived - newest
        lost = self._lost(classifier, int(chunk.t_ns[0]))
        offset = run[-1].utc_offset_ns
        frame = opened.spec.frame
        for decision in classifier.decide(chunk):
            self._tell(decision, run, opened, offset)
        self._last_ns = newest
        self._late += classifier.stats.late - before.late
        self._bad_samples += classifier.stats.bad_samples - before.bad_samples
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
        self._touch(classifier.detector.contact, int(chunk.t_ns[-1]), frame, offset)
        if not opened.stream.live:
            for box in self._hub.wanted(Decision):
                box.wait_for_room(1.0)

    def _tell(self, d: Classification, run: list[SourceChunk], opened: Opened, offset: int) -> None:
        """Publish a decision, at once: what else is in the chunk may take its time."""
        made = time.monotonic_ns()
        sample = self._completed(d, run, opened.stream)
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

    def _lost(self, classifier: Classifier, t_ns: int) -> int:
        """How many samples the mailbox dropped before this one: a stream with a hole, which no
        network is fed."""
        lost, self._hole = self._hole, 0
        if lost:
            first = t_ns - BEGINNING_NS if self._last_ns is None else self._last_ns + 1
            classifier.skips.add(first, t_ns)
        return lost

    def _age(self, t_ns: int) -> float:
        """How old the step is whose newest resampled sample has this stream time, s."""
        end = t_ns + self._half_ns + self._ahead_ns
        return max(0, time.monotonic_ns() - end) / 1e9

    def _completed(self, d: Classification, run: list[SourceChunk], stream: Source) -> int:
        """Host time of the sample that completed a step."""
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

    def _touch(self, touching: bool, t_ns: int, frame: str = "", offset: int = 0) -> None:
        if touching == self._touching:
            return
        self._touching = touching
        if not frame and self._opened is not None:
            frame, offset = self._opened.spec.frame, self._clock.utc_offset_ns()
        self._hub.post(Contact(self.config.source, self.config.name, frame, touching, t_ns, offset))


def model_path(config: ModelConfig) -> Path:
    """The model's file; that of the package if the configuration names none."""
    return Path(config.file) if config.file else shipped_model()


def file_stamp(file: Path) -> tuple[int, ...]:
    """Changes when a file is replaced, written, or taken away."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        return ()
    return (found.st_mtime_ns, found.st_size, found.st_ino)
