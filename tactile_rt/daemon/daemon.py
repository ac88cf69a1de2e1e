"""The daemon: parts created from a configuration, watched, replaced and closed."""

import gc
import logging
import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core.files import replace_file
from tactile_rt.core.locks import AlreadyRunning, Locks, device_keys, lock_keys
from tactile_rt.core.packages import VERSION
from tactile_rt.daemon.admission import file_stamp, model_path
from tactile_rt.daemon.advice import DiagnosticOnsets
from tactile_rt.daemon.clock import Clock, Turns
from tactile_rt.daemon.config import config_text
from tactile_rt.daemon.consumer import ConsumerPart
from tactile_rt.daemon.diagnostics import diagnose
from tactile_rt.daemon.items import Control, Event, Opened
from tactile_rt.daemon.loading import Loaded
from tactile_rt.daemon.log import EventHandler
from tactile_rt.daemon.mailbox import Hub
from tactile_rt.daemon.model_part import ModelPart
from tactile_rt.daemon.part import Part, reason_of
from tactile_rt.daemon.publishers import Wanted, wanted_consumers
from tactile_rt.daemon.source_part import Acquisition, SourcePart
from tactile_rt.daemon.states import Diagnostic, Snapshot
from tactile_rt.daemon.trends import Trends, read_resident_bytes
from tactile_rt.drivers.health import Identity

WATCH_S = 0.25
LOGGER = logging.getLogger("tactile_rt.classifier")
STARTED_S = 5.0  # a part that has not started by then is reported as degraded
LATELY_NS = 1_000_000_000  # how long a jump of the wall clock is reported


class Daemon:
    """The supervisor of all parts of a configuration, and the `View` of its consumers.

    Args:
        locks: Locks on devices and configuration against a second daemon, or None for no locks.
        on_over: Called once, from another thread, when all streams have ended.
        freeze: Whether to exempt the objects that exist after the start from garbage collection,
            which suits a process that does nothing else.

    Raises:
        ConfigError: a consumer cannot be created.
        AlreadyRunning: another process has a device, or this configuration.
    """

    def __init__(
        self,
        loaded: Loaded,
        *,
        clock: Clock | None = None,
        locks: Locks | None = None,
        freeze: bool = False,
        on_over: Callable[[], None] | None = None,
    ) -> None:
        self._on_over = on_over
        self._loaded, self._clock, self._locks = loaded, clock or Clock(), locks
        self._file_keys: list[str] = []  # lock keys of its file that are held
        self._freeze = freeze
        self._hub = Hub()
        self._lines = Acquisition()
        folder = os.environ.get("STATE_DIRECTORY")  # the service's, by systemd
        self._memory = Path(folder, "arrays.json") if folder else None
        self._arrays: dict[str, Identity] = {}  # accepted arrays, by URL
        self._sources: dict[str, SourcePart] = {}
        self._models: dict[str, tuple[Any, ModelPart]] = {}
        self._consumers: dict[str, tuple[Any, ConsumerPart]] = {}
        self._changing = threading.RLock()  # held while parts change
        self._started_ns = time.monotonic_ns()
        self._starting, self._stopping = True, False
        self._degraded: tuple[str, ...] = ()
        self._reloads = self._clock_steps = 0
        self._turns = Turns()
        self._onsets, self._foreseen = DiagnosticOnsets(), DiagnosticOnsets()
        self._trends, self._warnings = Trends(), EventHandler(self.report)
        self._refused = ""  # why the newest configuration is not in force
        self._stepped_ns = 0  # when the wall clock last jumped, CLOCK_MONOTONIC
        self._unwatch = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="tactile-rt watch", daemon=True)
        self._ready = [(w, w.make()) for w in wanted_consumers(loaded)]

    # life

    def start(self) -> None:
        """Start all parts, without waiting for them."""
        self._lock(self._loaded, lock_keys(self._loaded.path, []))
        # Consumers first, so that they miss no event.
        ready, self._ready = self._ready, []
        with self._changing:
            for wanted, consumer in ready:
                self._add_consumer(wanted, consumer)
            self._load_accepted_arrays()
            self._reconcile()
        self.report("daemon", "starting", f"{self._loaded.path}")
        self._watcher.start()
        LOGGER.addHandler(self._warnings)

    def reload(self, loaded: Loaded) -> None:
        """Reconcile the parts with a configuration; unchanged parts go on undisturbed.

        A model goes on deciding until its replacement is admitted.

        Raises:
            ConfigError: a consumer cannot be created; nothing has changed.
            AlreadyRunning: another process has a device; nothing has changed.
        """
        with self._changing:
            if self._stopping:
                return
            wanted = {w.name: w for w in wanted_consumers(loaded)}
            new = {
                name: w.make()
                for name, w in wanted.items()
                if name not in self._consumers or self._consumers[name][0] != w.key
            }
            self._lock(loaded, lock_keys(loaded.path, []))
            self._loaded, self._refused = loaded, ""
            self._reloads += 1
            gone = [n for n in self._consumers if n not in wanted or n in new]
            old = [self._consumers.pop(name)[1] for name in gone]
            self._stop_parts(old)
            for name, consumer in new.items():
                self._add_consumer(wanted[name], consumer)
            self._reconcile()
        parts = ", ".join(sorted(new)) if new else "no consumer"
        self.report("daemon", "reloaded", f"{loaded.path}: {parts} new or changed")

    def refuse(self, reason: str) -> None:
        """Report why a new configuration is rejected; the old one stays in force."""
        self._refused = reason
        self.report("daemon", "refused", f"the old configuration goes on: {reason}", "error")

    def stop(self) -> list[str]:
        """Stop sources, then models, then consumers, all within `limits.stop_s`. Each part first
        handles the items that wait for it.

        Returns:
            The names of parts that did not end in time; their threads may still run.
        """
        self._stopping = True
        until = time.monotonic() + self._loaded.config.limits.stop_s
        self.report("daemon", "stopping", "")
        self._unwatch.set()
        LOGGER.removeHandler(self._warnings)
        late: list[Part] = []
        with self._changing:
            groups: list[list[Part]] = [
                list(self._sources.values()),
                [part for _, part in self._models.values()],
                [part for _, part in self._consumers.values() if part.name != "log"],
                [part for _, part in self._consumers.values() if part.name == "log"],
            ]
            for n, group in enumerate(groups):
                for part in group:
                    part.stop()
                # A part that hangs must leave time for the groups after it.
                left = until - time.monotonic()
                end = time.monotonic() + left * (0.5 if n < len(groups) - 1 else 0.9)
                late += [part for part in group if not part.join(end)]
                for part in late:
                    if part in group and n < len(groups) - 1:
                        self.report(part.name, "abandoned", "it did not end in time", "error")
        if self._watcher.ident is not None and self._watcher is not threading.current_thread():
            self._watcher.join(max(0.0, until - time.monotonic()))
        if self._locks is not None:
            self._locks.close()
        return [part.name for part in late if not part.join(0.0)]

    # the view of consumers

    def snapshot(self) -> Snapshot:
        """Return the present states of all parts."""
        # Another thread may change these dictionaries; copying them is atomic.
        sources = tuple(p.source_state for p in self._sources.copy().values())
        models = tuple(p.model_state for _, p in self._models.copy().values())
        consumers = tuple(p.consumer_state for _, p in self._consumers.copy().values())
        now = self._clock.monotonic_ns()
        starved_s = 0.0 if self._stopping else self._turns.starved_s(self._watcher.native_id)
        found = diagnose(
            sources, models, consumers, self._loaded.config.limits, now, starved_s,
            bool(self._stepped_ns) and now - self._stepped_ns < LATELY_NS, self._refused,
        )  # fmt: skip
        utc = self._clock.utc_ns()
        found = self._onsets.explain(found, now, utc)
        soon = [Diagnostic(c.part.name, "disk full soon", c.soon) for c in consumers if c.soon]
        zeros = [s.part.name for s in sources if s.zeros and not s.stuck_at_s]
        soon += [Diagnostic(name, "all zeros", "at rest, or the device hangs") for name in zeros]
        drifts = [(m.part.name, m.drift) for m in models if m.drift]
        soon += [Diagnostic(name, "offset drifts", drift) for name, drift in drifts]
        soon += self._trends.foresee()
        state = "degraded" if found else "running"
        state = "stopping" if self._stopping else "starting" if self._starting else state
        return Snapshot(
            VERSION, os.getpid(), str(self._loaded.path), now,
            utc, self._started_ns, self._reloads, state,
            tuple(one.line for one in found), self._clock_steps, sources, models, consumers,
            found, self._foreseen.explain(soon, now, utc),
        )  # fmt: skip

    def streams(self) -> Mapping[str, Opened]:
        """Return the `Opened` item of each source that is open now, by source name."""
        return self._hub.streams()

    def config_text(self) -> str:
        """Return the whole configuration in force as TOML, with secrets hidden."""
        return config_text(self._loaded.config)

    def report(self, part: str, state: str, reason: str, level: str = "info") -> None:
        """Post an event to the log and all other consumers."""
        now = time.monotonic_ns()
        self._hub.post(Event(part, state, reason, level, now, self._clock.utc_offset_ns()))

    def send(self, consumer: str, control: Control) -> bool:
        """Send a control to the named consumer; return whether it was delivered."""
        box = self._hub.box(consumer)
        if box is None or Control not in box.wants:
            return False
        box.put(control)
        return True

    def utc_offset_ns(self) -> int:
        """Return UTC minus host monotonic time at this moment, ns."""
        return self._clock.utc_offset_ns()

    def note_turn(self, name: str) -> None:
        """Record a loop pass of a critical thread other than a part: ``main`` or ``watch``."""
        self._turns.take(name)

    def silent(self) -> Mapping[str, float]:
        """Return how long each critical thread has been in its current loop pass, s."""
        return {
            **({} if self._stopping else self._turns.silent()),
            **{p.name: p.silent_s for p in self._sources.copy().values()},
            **{p.name: p.silent_s for _, p in self._models.copy().values()},
        }

    # parts

    def _add_consumer(self, wanted: Wanted, consumer: Any) -> None:
        part = ConsumerPart(
            wanted.name, wanted.kind, consumer, self, self.report, self._loaded.config.limits
        )
        self._consumers[wanted.name] = (wanted.key, part)
        self._hub.join(wanted.name, part.box)
        part.start()

    def _reconcile(self) -> None:
        """Start, stop and replace sources and models, so that they match the configuration."""
        config = self._loaded.config
        limits = config.limits
        models = {m.name: ((m, limits, file_stamp(model_path(m))), m) for m in config.model}
        sources = {s.name: s for s in config.source}
        old: list[Part] = []
        for name, (key, running) in list(self._models.items()):
            new = models.get(name)
            if new is None or not (key == new[0] or running.may_exchange(new[1], limits)):
                old.append(self._models.pop(name)[1])
            elif key != new[0]:
                self._models[name] = (new[0], running)
                running.exchange(new[1])
        for name, part in list(self._sources.items()):
            if part.another:  # a reload accepts another array
                self._arrays.pop(part.config.url, None)
            elif sources.get(name) == part.config and part.state.state != "failed":
                continue  # but restart one that has failed: its files may have changed
            old.append(self._sources.pop(name))
        self._stop_parts(old)
        for name, (key, model) in models.items():
            if name not in self._models:
                made = ModelPart(model, self._hub, self.report, limits, self._clock)
                self._models[name] = (key, made)
                self._hub.join(made.name, made.box)
                made.start()
        for name, source in sources.items():
            if name in self._sources:
                self._sources[name].limits = limits
            else:
                part = SourcePart(source, self._hub, self.report, limits, self._clock, self._lines)
                part.accepted = self._arrays.get(source.url)
                self._sources[name] = part
                part.start()

    def _stop_parts(self, parts: list[Any]) -> None:
        """Stop parts that are no longer configured, and wait at most `limits.stop_s`."""
        for part in parts:
            box = getattr(part, "box", None)
            if box is not None:
                self._hub.leave(part.name, box)
            part.stop()
        until = time.monotonic() + self._loaded.config.limits.stop_s
        for part in parts:
            while not part.join(min(until, time.monotonic() + WATCH_S)):
                if self._stopping or time.monotonic() >= until:
                    break
            if not part.join(0.0) and not self._stopping:
                self.report(part.name, "abandoned", "it did not end in time", "error")

    def _watch(self) -> None:
        self.note_turn("watch")
        while not self._unwatch.wait(WATCH_S):
            self._report_starvation()
            self._renew_locks()
            self.note_turn("watch")
            for name, source in self._sources.copy().items():
                on_it = [p for _, p in self._models.copy().values() if p.config.source == name]
                sensor = next((p.sensor for p in on_it if p.sensor is not None), None)
                source.expect(sensor, max((p.changes for p in on_it), default=0.0))
            for part in self._list_parts():
                part.watch()
            late_s = {name: source.late_s for name, source in self._sources.copy().items()}
            self._trends.look(time.monotonic(), read_resident_bytes() or 0, late_s)
            step = self._clock.stepped_ns()
            if step:
                self._clock_steps += 1
                self._stepped_ns = self._clock.monotonic_ns()
                self.report("daemon", "clock", f"the wall clock jumped by {step / 1e9:+.3f} s")
            if self._starting and self._has_started():
                self._starting = False
                if self._freeze:
                    # The objects that exist now stay; scanning them repeatedly costs pauses.
                    gc.collect()
                    gc.freeze()
                if not self.snapshot().degraded:
                    self.report("daemon", "running", "")
            elif not self._starting:
                self._report_degraded()
            if self._sources and all(
                p.state.state == "ended" for p in self._sources.copy().values()
            ):
                done, self._on_over = self._on_over, None
                if done is not None:
                    done()

    def _load_accepted_arrays(self) -> None:
        if self._memory is None or not self._memory.exists():
            return
        try:
            self._arrays = msgspec.json.decode(self._memory.read_bytes(), type=dict[str, Identity])
        except Exception as error:  # any damage to the file
            self.report("daemon", "memory", f"delete {self._memory}: {reason_of(error)}", "warning")

    def _store_accepted_arrays(self) -> None:
        known = {p.config.url: p.accepted for p in self._sources.copy().values() if p.accepted}
        if self._memory is None or (arrays := {**self._arrays, **known}) == self._arrays:
            return
        self._arrays = arrays
        try:
            with replace_file(self._memory) as file:
                file.write(msgspec.json.encode(arrays))
        except OSError as error:
            self.report("daemon", "memory", reason_of(error), "warning")

    def _renew_locks(self) -> None:
        """Store accepted arrays, and lock the device nodes that the URLs lead to now. When a device
        was plugged in again, its link may lead to another node; the old node is released then."""
        if self._changing.acquire(blocking=False):
            try:
                self._store_accepted_arrays()
                with suppress(AlreadyRunning):  # opening it then fails and reports it
                    self._lock(self._loaded, self._file_keys)
            finally:
                self._changing.release()

    def _lock(self, loaded: Loaded, configured: list[str]) -> None:
        """Lock the devices of a configuration, and its file under the keys `configured`."""
        if self._locks is not None and not self._stopping:
            self._locks.hold([*configured, *device_keys([s.url for s in loaded.config.source])])
            self._file_keys = configured

    def _report_starvation(self) -> None:
        if lasted_s := self._turns.watch(self._watcher.native_id):
            why = f"it had no turn for {lasted_s:.1f} s: it was stopped, or the processor was taken"
            self.report("daemon", "starved", why, "warning")

    def _list_parts(self) -> list[Part]:
        return [
            *self._sources.copy().values(),
            *(p for _, p in self._models.copy().values()),
            *(p for _, p in self._consumers.copy().values()),
        ]

    def _has_started(self) -> bool:
        if time.monotonic_ns() - self._started_ns > STARTED_S * 1e9:
            return True
        return all(p.state.state != "starting" or p.state.failures for p in self._list_parts())

    def _report_degraded(self) -> None:
        lines = self.snapshot().degraded
        for line in lines:
            if line not in self._degraded:
                self.report("daemon", "degraded", line, "warning")
        if self._degraded and not lines:
            self.report("daemon", "running", "all parts work again")
        self._degraded = lines
