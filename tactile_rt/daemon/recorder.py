"""The recorder: MCAP files of every source, always or around what happens.

    FOLDER/whiskers-20261121T170512Z.mcap

A file is begun with a source's first sample or packet: one that fails again and again leaves none.
It holds samples, raw packets, decisions, health and events of one source, and in its metadata
the configuration in force and the hash of every model. Whatever ends the process, `tactile-rt
recover` gets back all but the last moment; files that were left so are named when the recorder
begins.
"""

import shutil
import time
from collections import deque
from contextlib import suppress
from pathlib import Path

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
    SourceChunk,
)
from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.recording.description import describe
from tactile_rt.recording.layout import (
    DECISIONS,
    EVENTS,
    SAMPLES,
    WIRE,
    Raw,
    encode_packet,
    encode_samples,
    need_mcap,
    samples_in,
)
from tactile_rt.recording.reader import is_finished
from tactile_rt.recording.rotation import Rotation
from tactile_rt.recording.writer import PART, RecordingWriter
from tactile_rt.stream import RecordingError
from tactile_rt.version import VERSION

__all__ = ["Recorder"]

FLUSH_S = 0.4  # with the gathering still well under the second that may be lost
LINGER_NS = 10**9  # after a source's end, for decisions about its last samples
STALE_S = 3600.0  # a file that is begun has its name long before
RING_BYTES = 64 << 20  # of each source, before a trigger
EVER_NS = 1 << 62
MB, NS = 1e6, 1e9


class _Track:
    """A source, the file that is open for it, and what is kept for a trigger."""

    def __init__(self, opened: Opened, rotation: Rotation) -> None:
        self.opened, self.rotation = opened, rotation
        self.wire = describe(opened.stream).wire
        self.prelude_ns = opened.prelude[-1][1] if opened.prelude else -1
        self.file: RecordingWriter | None = None
        self.came = False  # a sample, or a packet: before, there is nothing to record
        self.ring: deque[Raw] = deque()
        self.ring_bytes = 0
        self.until_ns = 0  # of a trigger; 0: none
        self.closed_ns = 0  # when its source ended; 0: it has not
        self.lost = (0, 0)  # samples and packets, for want of room on the disk

    def keep(self, message: Raw, before_ns: int) -> None:
        """Into the ring, from which the oldest goes."""
        self.ring.append(message)
        self.ring_bytes += len(message.data)
        while self.ring and (
            self.ring[0].t_ns < message.t_ns - before_ns or self.ring_bytes > RING_BYTES
        ):
            self.ring_bytes -= len(self.ring.popleft().data)

    def empty(self) -> list[Raw]:
        """All of the ring."""
        kept = list(self.ring)
        self.ring.clear()
        self.ring_bytes = 0
        return kept


class Recorder(Consumer):
    """Records every source of the daemon.

    It knows the controls ``start``, ``stop``, ``trigger`` (as if something had happened) and
    ``rotate`` (begin new files). When the disk has less room than ``min_free_mb`` the files are
    closed, what is not recorded is counted, and it goes on when there is room again.

    Args:
        name: for the log.
        config: the table ``[recorder]``.

    Raises:
        ConfigError: the extra is not installed.
    """

    wants = frozenset({Opened, Closed, SourceChunk, Packet, Decision, Contact, Event, Control})
    gather_s = 0.05
    tick_s = 0.2

    def __init__(self, name: str, config: RecorderConfig) -> None:
        need_mcap()
        self._name, self._config = name, config
        self._folder = Path(config.folder)
        self._tracks: dict[str, _Track] = {}
        self._on = True
        self._full = False
        self._files = self._bytes = 0
        self._lost_samples = 0
        self._newest = ""
        self._flush_at = 0.0

    def open(self, view: View) -> None:
        self._view = view
        self._folder.mkdir(parents=True, exist_ok=True)
        cut = [p.name for p in sorted(self._folder.glob("*.mcap")) if not is_finished(p)]
        if cut:
            some = ", ".join(cut[:3]) + (f" and {len(cut) - 3} more" if len(cut) > 3 else "")
            view.report(
                self._name, "running", f"{self._folder}: cut short: {some}; `tactile-rt recover` "
                "makes whole ones of them", "warning",
            )  # fmt: skip
        for left in self._folder.glob(f".*{PART}"):  # of one who was killed as it began a file
            with suppress(OSError):
                if time.time() - left.stat().st_mtime > STALE_S:  # else it is just being begun
                    left.unlink()
        for opened in view.streams().values():
            self._begin(opened)

    def handle(self, items: list[Item]) -> None:
        for item in items:
            self._take(item)
        now = time.monotonic()
        if now >= self._flush_at:
            self._flush_at = now + FLUSH_S
            self._look_after()

    def close(self) -> None:
        try:
            for name in list(self._tracks):
                self._end(name)
        finally:
            self._tracks.clear()

    def details(self) -> dict[str, str | int | float]:
        tracks = list(self._tracks.values())
        recording = sum(track.file is not None for track in tracks)
        size = self._bytes + sum(t.file.stats.bytes for t in tracks if t.file is not None)
        return {
            "state": "disk full" if self._full else ("on" if self._on else "off"),
            "mode": self._config.mode,
            "recording": recording,
            "files": self._files,
            "megabytes": round(size / MB, 1),
            "lost_samples": self._lost_samples,
            "newest": self._newest,
        }

    def _take(self, item: Item) -> None:
        if isinstance(item, Opened):
            known = self._tracks.get(item.source)
            if known is None or known.opened.t_ns != item.t_ns:
                self._begin(item)
        elif isinstance(item, Closed):
            if (track := self._tracks.get(item.source)) is not None:
                track.closed_ns = time.monotonic_ns()
        elif isinstance(item, SourceChunk):
            if (track := self._tracks.get(item.source)) is not None:
                self._add(track, Raw(SAMPLES, item.arrived_ns, encode_samples(item.chunk)))
        elif isinstance(item, Packet):
            track = self._tracks.get(item.source)
            # what described the device stands at the head of every file
            if track is not None and track.wire and item.t_ns > track.prelude_ns:
                self._add(track, Raw(WIRE, item.t_ns, encode_packet(item.packet, track.wire)))
        elif isinstance(item, Control):
            self._obey(item)
        else:
            self._tell(item)

    def _tell(self, item: Decision | Contact | Event) -> None:
        """A decision or contact goes to its source's file, an event to all."""
        message = message_of(item)
        if message is None:
            return
        topic = DECISIONS if isinstance(item, Decision) else EVENTS
        at = item.made_ns if isinstance(item, Decision) else item.t_ns
        told = Raw(topic, at, encode(message))
        mine = getattr(item, "source", None)
        happened = item.level != "info" if isinstance(item, Event) else isinstance(item, Contact)
        for name, track in self._tracks.items():
            if mine not in (None, name):
                continue
            self._add(track, told)
            if happened and getattr(item, "part", "") != self._name:
                self._trigger(track)

    def _add(self, track: _Track, message: Raw) -> None:
        always = self._config.mode == "always"
        if not track.came and message.topic in (SAMPLES, WIRE):
            track.came = True
            if self._on and (always or track.until_ns > time.monotonic_ns()):
                self._start_file(track)
        if track.file is None and not (always and track.came):
            if self._on:
                track.keep(message, EVER_NS if always else round(self._config.before_s * NS))
            return
        if track.file is None:
            if self._on:
                self._lose(track, message)
            return
        try:
            track.file.add(message.topic, message.data, message.t_ns)
        except OSError as error:
            self._lose(track, message)
            self._no_room(track, error)

    def _lose(self, track: _Track, *messages: Raw) -> None:
        self._count_lost(
            track, sum(samples_in(m.data) for m in messages if m.topic == SAMPLES),
            sum(m.topic == WIRE for m in messages),
        )  # fmt: skip

    def _count_lost(self, track: _Track, samples: int, packets: int) -> None:
        track.lost = track.lost[0] + samples, track.lost[1] + packets
        self._lost_samples += samples

    def _trigger(self, track: _Track) -> None:
        if self._config.mode != "trigger" or not self._on:
            return
        track.until_ns = time.monotonic_ns() + round(self._config.after_s * NS)
        if track.file is None:
            self._start_file(track)

    def _obey(self, control: Control) -> None:
        if control.action == "start":
            self._on = True
            if self._config.mode == "always":
                for track in self._tracks.values():
                    self._start_file(track)
        elif control.action == "stop":
            self._on = False
            for track in self._tracks.values():
                self._finish_file(track)
                track.empty()
        elif control.action == "trigger":
            for track in self._tracks.values():
                self._trigger(track)
        elif control.action == "rotate":
            for track in self._tracks.values():
                self._rotate(track)

    def _begin(self, opened: Opened) -> None:
        self._end(opened.source)
        config = self._config
        rotation = Rotation(self._folder, opened.source, config.rotate_mb, config.rotate_s)
        self._tracks[opened.source] = _Track(opened, rotation)

    def _end(self, source: str) -> None:
        track = self._tracks.pop(source, None)
        if track is not None:
            self._finish_file(track)

    def _start_file(self, track: _Track) -> None:
        if track.file is not None or not track.came or track.closed_ns or not self._room():
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
                opened.stream, about, prelude=opened.prelude, dropped=track.lost
            )
        except OSError as error:
            self._no_room(track, error)
            return
        track.lost = (0, 0)
        kept = track.empty()
        for n, message in enumerate(kept):
            try:
                track.file.add(message.topic, message.data, message.t_ns)
            except OSError as error:
                self._lose(track, *kept[n:])
                self._no_room(track, error)
                return
        self._files += 1
        self._newest = track.file.path.name

    def _finish_file(self, track: _Track, told: bool = False) -> None:
        file, track.file, track.until_ns = track.file, None, 0
        if file is None:
            return
        try:
            file.close()
        except OSError as error:
            if not told:
                self._view.report(
                    self._name, "running", f"{file.path}: not finished "
                    f"({error.strerror or error}); `tactile-rt recover` keeps what is in it",
                    "error",
                )  # fmt: skip
            self._count_lost(track, *file.unsafe())
        self._bytes += file.stats.bytes

    def _rotate(self, track: _Track) -> None:
        if track.file is not None:
            self._finish_file(track)
            self._start_file(track)

    def _look_after(self) -> None:
        """Flush, rotate, end what a trigger began or whose source ended, look at the disk."""
        self._room()
        now = time.monotonic_ns()
        closed = [
            n for n, t in self._tracks.items() if t.closed_ns and now > t.closed_ns + LINGER_NS
        ]
        if closed:
            deciding = {m.source for m in self._view.snapshot().models if m.queue.waiting_bytes}
            for name in closed:
                if name not in deciding:
                    self._end(name)
        for track in self._tracks.values():
            file = track.file
            if file is None:
                if self._config.mode == "always" and self._on:
                    self._start_file(track)  # there is room again
                continue
            try:
                file.flush()
            except OSError as error:
                self._no_room(track, error)
                continue
            if self._full:
                self._finish_file(track)
            elif track.until_ns and now > track.until_ns:
                self._finish_file(track)
            elif track.rotation.is_due(file):
                self._rotate(track)

    def _room(self) -> bool:
        """Whether the disk has room; told when that changes."""
        try:
            free = shutil.disk_usage(self._folder).free / MB
        except OSError as error:
            raise RecordingError(f"{self._folder}: {error.strerror or error}") from None
        full = free < self._config.min_free_mb
        if full != self._full:
            self._full = full
            if full:
                self._view.report(
                    self._name, "disk full", f"{self._folder}: {free:.0f} MB free, less than "
                    f"min_free_mb = {self._config.min_free_mb:g}: not recording", "warning",
                )  # fmt: skip
            else:
                self._view.report(self._name, "running", f"{free:.0f} MB free: recording again")
        return not full

    def _no_room(self, track: _Track, error: OSError) -> None:
        """The file cannot be written: it is left as it is, and tried anew at the next look."""
        path = track.file.path if track.file is not None else self._folder
        self._view.report(
            self._name, "running", f"{path}: {error.strerror or error}; `tactile-rt recover` keeps "
            "what is in it", "error",
        )  # fmt: skip
        if track.file is not None:
            self._count_lost(track, *track.file.unsafe())
            self._finish_file(track, told=True)
