"""The recorder: MCAP files of every source, continuously or around contacts and faults.

    FOLDER/whiskers-20261121T170512Z.mcap

A file begins with a source's first sample or packet, so a source that fails repeatedly leaves none.
It holds samples, raw packets, decisions, health and events of one source, and in its metadata
the configuration in force and the hash of every model. However the process ends, `tactile-rt
recover` restores all but the last moment, and after a power cut all but the last second or so;
the recorder names such files when it starts.
"""

import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path

from tactile_rt.core.files import Syncer
from tactile_rt.core.packages import VERSION
from tactile_rt.daemon.config import RecorderConfig
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import (
    Closed,
    Contact,
    Control,
    Decision,
    Event,
    Item,
    Opened,
    Packet,
    Skipped,
    SourceChunk,
)
from tactile_rt.daemon.ledger import Ledger
from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.daemon.recordings_folder import RecordingsFolder, words
from tactile_rt.daemon.states import OnDisk
from tactile_rt.recording.description import describe
from tactile_rt.recording.layout import (
    DECISIONS,
    EVENTS,
    SAMPLES,
    WIRE,
    Raw,
    encode_packet,
    encode_samples,
    samples_in,
)
from tactile_rt.recording.rotation import Rotation
from tactile_rt.recording.writer import Extent, RecordingWriter

FLUSH_S = 0.4  # with the gathering, well under the second that may be lost
LINGER_NS = 10**9  # after a source's end, for decisions about its last samples
PAUSE_S, PAUSES, STEADY_S = 0.4, 2, 10.0  # per failure, at most; for a file to be steady
SLOW_S = 2.0  # beyond two sync periods, after which a medium is slow, not just briefly busy
RING_BYTES = 64 << 20  # of each source, before a trigger
EVER_NS = 1 << 62
KEEPS = "`tactile-rt recover` keeps what is in it"
MB, NS = 1e6, 1e9


class _Track:
    """Recording state of a source: its open file, and the messages kept for a trigger."""

    def __init__(self, opened: Opened, rotation: Rotation, ledger: Ledger) -> None:
        self.opened, self.rotation, self.ledger = opened, rotation, ledger
        self.wire = describe(opened.stream).wire
        self.prelude_ns = opened.prelude[-1][1] if opened.prelude else -1
        self.file: RecordingWriter | None = None
        self.came = False  # a sample or packet has come: before, there is nothing to record
        self.ring: deque[Raw] = deque()
        self.ring_bytes = 0
        self.since_ns = time.monotonic_ns()  # opening, start of recording, or trigger
        self.until_ns = 0  # end of a trigger's recording; 0: no trigger
        self.closed_ns = 0  # when its source ended; 0: it has not
        self.lost = (0, 0)  # samples and packets since the last file was begun
        self.diagnostic = ""  # why there is no file, or was none before this one
        self.failures = 0  # successive files that failed soon after they were begun
        self.retry_ns = 0  # earliest time to begin a file

    def keep(self, message: Raw, before_ns: int) -> list[Raw]:
        """Append a message to the ring buffer; return the old messages dropped for it."""
        self.ring.append(message)
        self.ring_bytes += len(message.data)
        gone = []
        while self.ring and (
            self.ring[0].t_ns < message.t_ns - before_ns or self.ring_bytes > RING_BYTES
        ):
            gone.append(self.ring.popleft())
            self.ring_bytes -= len(gone[-1].data)
        return gone

    def empty(self) -> list[Raw]:
        """Empty the ring buffer; return its messages."""
        kept = list(self.ring)
        self.ring.clear()
        self.ring_bytes = 0
        return kept


class Recorder(Consumer):
    """The consumer that records every source of the daemon.

    It obeys the controls ``start``, ``stop``, ``trigger`` (as a contact or fault does) and
    ``rotate`` (begin new files). When the disk has less room than ``min_free_mb``, it closes the
    files, counts what it does not record, and resumes when there is room again. It does the same
    when the folder is deleted, moved or no longer writable.
    """

    wants = frozenset(
        {Opened, Closed, SourceChunk, Packet, Decision, Contact, Skipped, Event, Control}
    )
    gather_s = 0.05
    tick_s = 0.2

    def __init__(self, name: str, config: RecorderConfig) -> None:
        self._name, self._config = name, config
        self._folder = RecordingsFolder(
            Path(config.folder), config.min_free_mb, lambda job: self._syncer.add(job),
            lambda state, why, level: self._view.report(self._name, state, why, level),
        )  # fmt: skip
        self._tracks: dict[str, _Track] = {}
        self._ledgers: dict[str, Ledger] = {}
        self._on = True
        self._files = self._bytes = 0
        self._lost_samples = 0
        self._newest = self._soon = ""
        self._flush_at = self._sync_at = 0.0

    def open(self, view: View) -> None:
        self._view = view
        self._syncer = Syncer()
        if cut := self._folder.open():
            some = ", ".join(cut[:3]) + (f" and {len(cut) - 3} more" if len(cut) > 3 else "")
            how = "`tactile-rt recover` makes whole ones of them"
            self._warn(f"{self._folder.path}: cut short: {some}; {how}", "warning")
        for opened in view.streams().values():
            self._begin_track(opened)

    def _warn(self, why: str, level: str = "error") -> None:
        self._view.report(self._name, "running", why, level)

    def handle(self, items: list[Item]) -> None:
        for item in items:
            self._handle_item(item)
        now, sync_s = time.monotonic(), self._config.sync_s
        sync = sync_s > 0 and now >= self._sync_at
        if sync:
            self._sync_at = now + sync_s
        if sync or now >= self._flush_at:
            self._flush_at = now + FLUSH_S
            self._maintain_files(sync)

    def close(self) -> None:
        try:
            for name in list(self._tracks):
                self._end_track(name)
        finally:
            self._tracks.clear()
            self._syncer.close()
            self._count_unsynced()

    def on_disk(self) -> Mapping[str, OnDisk]:
        """Return the `OnDisk` of each source that was ever open; safe from any thread."""
        return {name: self._find_disk(name, ledger) for name, ledger in list(self._ledgers.items())}

    def _find_disk(self, name: str, ledger: Ledger) -> OnDisk:
        track, sync_s = self._tracks.get(name), self._config.sync_s
        slow_s = 2 * sync_s + SLOW_S if sync_s else 0.0
        if track is None:
            return ledger.on_disk(open=False, meant_ns=0, slow_s=slow_s)
        wanted = self._config.mode == "always" or track.until_ns > 0
        meant_ns = track.since_ns if self._on and wanted and not track.closed_ns else 0
        return ledger.on_disk(track.file is not None, meant_ns, slow_s)

    def details(self) -> dict[str, str | int | float]:
        tracks = list(self._tracks.values())
        recording = sum(track.file is not None for track in tracks)
        return {
            "state": self._folder.state if self._folder.why else "on" if self._on else "off",
            "mode": self._config.mode,
            "recording": recording,
            "files": self._files,
            "megabytes": round(self._count_mb(), 1),
            "lost_samples": self._lost_samples,
            "newest": self._newest,
        }

    def _count_mb(self) -> float:
        files = [track.file for track in list(self._tracks.values())]
        return (self._bytes + sum(f.stats.bytes for f in files if f is not None)) / MB

    def foresee(self) -> str:
        return self._soon

    def diagnose(self) -> str:
        folder = self._folder
        if folder.full:
            return f"less than min_free_mb = {self._config.min_free_mb:g} MB free: {folder.path}"
        if folder.why or not self._on:
            return folder.why
        for name, track in list(self._tracks.items()):
            disk = self._find_disk(name, track.ledger)
            if track.diagnostic and disk.meant_ns:
                return track.diagnostic
        return ""

    def _handle_item(self, item: Item) -> None:
        if isinstance(item, Opened):
            known = self._tracks.get(item.source)
            if known is None or known.opened.t_ns != item.t_ns:
                self._begin_track(item)
        elif isinstance(item, Closed):
            if (track := self._tracks.get(item.source)) is not None:
                track.closed_ns = time.monotonic_ns()
        elif isinstance(item, SourceChunk):
            if (track := self._tracks.get(item.source)) is not None:
                self._add(track, Raw(SAMPLES, item.arrived_ns, encode_samples(item.chunk)))
        elif isinstance(item, Packet):
            track = self._tracks.get(item.source)
            # packets that describe the device are at the head of every file
            if track is not None and track.wire and item.t_ns > track.prelude_ns:
                self._add(track, Raw(WIRE, item.t_ns, encode_packet(item.packet, track.wire)))
        elif isinstance(item, Control):
            self._obey(item)
        else:
            self._record(item)

    def _record(self, item: Decision | Contact | Skipped | Event) -> None:
        """Record a decision, contact or skip with its source, an event with all sources."""
        message = message_of(item)
        if message is None:
            return
        if isinstance(item, Event) and item.state == "admitted":
            self._follow_exchange(item.part)
        topic = DECISIONS if isinstance(item, Decision) else EVENTS
        at = item.made_ns if isinstance(item, Decision) else item.t_ns
        raw = Raw(topic, at, encode(message))
        mine = getattr(item, "source", None)
        happened = item.level != "info" if isinstance(item, Event) else isinstance(item, Contact)
        for name, track in self._tracks.items():
            if mine not in (None, name):
                continue
            self._add(track, raw)
            if happened and getattr(item, "part", "") != self._name:
                self._trigger(track)

    def _follow_exchange(self, model: str) -> None:
        """Begin a new file after a model was replaced, as a file names its models."""
        for state in self._view.snapshot().models:
            if state.part.name == model and state.source in self._tracks:
                self._rotate(self._tracks[state.source])

    def _add(self, track: _Track, message: Raw) -> None:
        always = self._config.mode == "always"
        if not track.came and message.topic in (SAMPLES, WIRE):
            track.came = True
            if self._on and (always or track.until_ns > time.monotonic_ns()):
                self._start_file(track)
        if track.file is None and not (always and track.came):
            if self._on:
                before_ns = EVER_NS if always else round(self._config.before_s * NS)
                gone = track.keep(message, before_ns)
                if track.until_ns and track.came:  # triggered, but no file can be begun
                    self._lose(track, *gone)
            return
        if track.file is None:
            if self._on:
                self._lose(track, message)
            return
        try:
            track.file.add(message.topic, message.data, message.t_ns)
        except OSError as error:
            self._lose(track, message)
            self._leave_file(track, error)

    def _lose(self, track: _Track, *messages: Raw) -> None:
        self._count_lost(
            track, sum(samples_in(m.data) for m in messages if m.topic == SAMPLES),
            sum(m.topic == WIRE for m in messages),
            self._folder.why or track.diagnostic,
        )  # fmt: skip

    def _count_lost(self, track: _Track, samples: int, packets: int, why: str) -> None:
        track.lost = track.lost[0] + samples, track.lost[1] + packets
        track.ledger.lose(samples, why)
        self._lost_samples += samples

    def _trigger(self, track: _Track) -> None:
        if self._config.mode != "trigger" or not self._on:
            return
        now = time.monotonic_ns()
        track.since_ns = track.since_ns if track.until_ns else now
        track.until_ns = now + round(self._config.after_s * NS)
        if track.file is None:
            self._start_file(track)

    def _obey(self, control: Control) -> None:
        if control.action == "start":
            self._on = True
            if self._config.mode == "always":
                for track in self._tracks.values():
                    track.since_ns = time.monotonic_ns()
                    self._start_file(track)
        elif control.action == "stop":
            self._on = False
            for track in self._tracks.values():
                self._finish_file(track)
                track.until_ns = 0
                track.empty()
        elif control.action in ("trigger", "rotate"):
            act = self._trigger if control.action == "trigger" else self._rotate
            for track in self._tracks.values():
                act(track)

    def _begin_track(self, opened: Opened) -> None:
        self._end_track(opened.source)
        config = self._config
        rotation = Rotation(self._folder.path, opened.source, config.rotate_mb, config.rotate_s)
        ledger = self._ledgers.setdefault(opened.source, Ledger())
        self._tracks[opened.source] = _Track(opened, rotation, ledger)

    def _end_track(self, source: str) -> None:
        track = self._tracks.pop(source, None)
        if track is not None:
            self._finish_file(track)

    def _start_file(self, track: _Track) -> None:
        if track.file is not None or not track.came or track.closed_ns:
            return
        if time.monotonic_ns() < track.retry_ns:
            return
        if not self._folder.has_room():
            return
        opened, snapshot = track.opened, self._view.snapshot()
        session = {
            "by": f"tactile_rt {VERSION}",
            "daemon_source": opened.source,
            "config": self._view.config_text(),
            **{m.part.name: f"{m.file} sha256:{m.sha256}" for m in snapshot.models},
        }
        try:
            about = describe(opened.stream, opened.url, session)
            track.file = track.rotation.begin(
                opened.stream, about, prelude=opened.prelude, dropped=track.lost,
                syncer=self._syncer,
            )  # fmt: skip
        except OSError as error:
            self._leave_file(track, error)
            return
        track.lost = (0, 0)
        track.ledger.begin(track.file)
        kept = track.empty()
        for n, message in enumerate(kept):
            try:
                track.file.add(message.topic, message.data, message.t_ns)
            except OSError as error:
                self._leave_file(track, error)
                self._lose(track, *kept[n:])
                return
        self._files += 1
        self._newest = track.file.path.name
        # Sync at once, so that a power cut hardly ever leaves a file without its description.
        if self._config.sync_s == 0 or self._sync(track):
            track.diagnostic = ""

    def _finish_file(self, track: _Track, finish: bool = True, reported: bool = False) -> None:
        file, track.file = track.file, None
        if file is None:
            return
        if (where := file.whereabouts()) in ("deleted", "emptied"):
            why = f"{file.path} was {where} while it was written"
            samples, packets = file.disown(Extent())
            self._count_lost(track, samples, packets, why)
            self._warn(f"{why}: {samples} samples are lost")
            finish, reported = False, True
        try:
            file.close(finish)
        except OSError as error:
            if not reported:
                why = f"{file.path}: not finished ({error.strerror or error})"
                self._warn(f"{why}; {KEEPS}")
            why = words(self._folder.path, error)
            self._count_lost(track, *file.disown(file.flushed), why)
        self._bytes += file.stats.bytes

    def _rotate(self, track: _Track) -> None:
        if track.file is not None:
            self._finish_file(track)
            self._start_file(track)

    def _maintain_files(self, sync: bool) -> None:
        """Flush, rotate and finish files as they are due, and check the disk."""
        self._folder.has_room()
        self._soon = self._folder.foresee(self._count_mb())
        self._count_unsynced()
        now = time.monotonic_ns()
        closed = [
            n for n, t in self._tracks.items() if t.closed_ns and now > t.closed_ns + LINGER_NS
        ]
        if closed:
            deciding = {m.source for m in self._view.snapshot().models if m.queue.waiting_bytes}
            for name in closed:
                if name not in deciding:
                    self._end_track(name)
        for track in self._tracks.values():
            over = 0 < track.until_ns < now
            if over:
                track.until_ns = 0
            file = track.file
            if file is None:
                if over:
                    self._lose(track, *track.empty())
                elif self._on and (self._config.mode == "always" or track.until_ns):
                    self._start_file(track)  # there is room again
                continue
            where = file.whereabouts()
            if where == "moved":
                why = f"{file.path} was moved while it was written: another file is begun"
                self._warn(why, "warning")
            if where != "there":
                self._rotate(track)
                continue
            if not self._sync(track, sync):
                continue
            if over or self._folder.full:
                self._finish_file(track)
            elif track.rotation.is_due(file) and not track.closed_ns:
                self._rotate(track)  # decisions after a source's end go into its last file

    def _sync(self, track: _Track, sync: bool = True) -> bool:
        """Flush or sync a track's file; return whether this and the previous sync succeeded."""
        file = track.file
        assert file is not None
        try:
            if file.failed is not None:
                raise file.failed
            file.sync() if sync else file.flush()
        except OSError as error:
            self._leave_file(track, error)
            return False
        return True

    def _count_unsynced(self) -> None:
        """Count the samples and packets lost in closed files whose last sync failed."""
        for name, ledger in self._ledgers.items():
            for file, samples, packets in ledger.settle():
                assert file.failed is not None
                track, why = self._tracks.get(name), words(file.path, file.failed)
                if samples or packets:
                    self._warn(f"{why}; {samples} samples may be lost")
                self._lost_samples += samples
                ledger.lose(samples, why)
                if track is not None:
                    track.lost = track.lost[0] + samples, track.lost[1] + packets

    def _leave_file(self, track: _Track, error: OSError) -> None:
        """Close a file after an error; write its index unless a sync failed. A new file is begun
        later, with pauses if several fail. The reason omits the path, so repeats look alike.
        """
        file, why = track.file, words(self._folder.path, error)
        if file is None:
            if why != track.diagnostic:
                self._warn(f"{why}: not recording")
            track.diagnostic = why
            return
        now = time.monotonic_ns()
        if not track.failures or now - file.begun_ns > STEADY_S * NS:
            track.failures = 0
            self._warn(f"{words(file.path, error)}; {KEEPS}")
        track.retry_ns = now + round(min(track.failures, PAUSES) * PAUSE_S * NS)
        track.failures += 1
        track.diagnostic = why
        kept = file.flushed if file.failed is None else file.synced
        self._count_lost(track, *file.disown(kept), why)
        self._finish_file(track, finish=file.failed is None, reported=True)
