"""What the page is sent: lines of JSON, thinned to what an eye can follow.

Of samples there are ``frame`` lines, some thirty a second whatever the source's rate: the newest
sample, and the least and greatest value of each channel since the frame before, so that no spike
goes unseen. All else is in the daemon's messages (`tactile_rt.daemon.messages`).
"""

import base64
import threading
import time
from collections import deque
from collections.abc import Collection
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec, rotation_matrices
from tactile_rt.daemon.items import Contact, Decision, Event, Item, Opened, SourceChunk
from tactile_rt.daemon.messages import encode, message_of

FEED_VERSION = 1
FRAME_S = 0.024  # with the gathering, some thirty a second
KEPT_EVENTS, KEPT_DECISIONS = 40, 160

Line = tuple[str, bytes]  # the source that it is of alone, or empty; JSON with the end of the line


class _Fold:
    """Samples of one source since the last frame."""

    def __init__(self) -> None:
        self.samples = 0
        self.sent = 0.0
        self.t_ns = 0
        # (element, channel) each
        self.least = self.most = self.newest = np.empty((0, 0), np.float32)

    def add(self, item: SourceChunk) -> None:
        chunk = item.chunk
        values: NDArray[np.float32] = chunk.values
        if not chunk.valid.all():
            values = np.where(chunk.valid[:, :, None], values, np.float32(np.nan))
        least, most = np.fmin.reduce(values), np.fmax.reduce(values)
        if self.samples and least.shape == self.least.shape:
            least, most = np.fmin(least, self.least), np.fmax(most, self.most)
        self.least, self.most, self.newest = least, most, values[-1]
        self.t_ns = int(chunk.t_ns[-1])
        self.samples += len(chunk)

    def line(self, source: str) -> Line:
        frame: dict[str, Any] = {
            "type": "frame", "source": source, "t_ms": self.t_ns / 1e6, "samples": self.samples,
            "newest": _text(self.newest),
        }  # fmt: skip
        if self.samples > 1:
            frame |= {"least": _text(self.least), "most": _text(self.most)}
        self.samples = 0
        return source, msgspec.json.encode(frame) + b"\n"


class Feed:
    """Makes lines of items; in the consumer's thread, but for `recent`."""

    def __init__(self) -> None:
        self._folds: dict[str, _Fold] = {}
        self._lock = threading.Lock()
        # The newest of those that say the same: what is tried again and again hides nothing else.
        self._events: dict[tuple[str, str, str], bytes] = {}
        self._decisions: deque[bytes] = deque(maxlen=KEPT_DECISIONS)

    def take(self, items: list[Item], watched: Collection[str]) -> list[Line]:
        """Return the lines to send now; samples of sources nobody watches cost nothing."""
        lines: list[Line] = []
        for item in items:
            if isinstance(item, SourceChunk):
                if item.source in watched:
                    self._folds.setdefault(item.source, _Fold()).add(item)
            elif isinstance(item, Opened):
                lines.append(("", array_line(item)))
                self._folds.pop(item.source, None)
            elif isinstance(item, Decision | Contact | Event):
                lines.append(("", self._message(item)))
        for source in [s for s in self._folds if s not in watched]:
            del self._folds[source]
        now = time.monotonic()
        for source, fold in self._folds.items():
            if fold.samples and now - fold.sent >= FRAME_S:
                fold.sent = now
                lines.append(fold.line(source))
        return lines

    def recent(self) -> list[bytes]:
        """Lines of what happened last, for whoever comes now; from any thread."""
        with self._lock:
            return [*self._events.values(), *self._decisions]

    def _message(self, item: Item) -> bytes:
        message = message_of(item)
        assert message is not None
        line = encode(message) + b"\n"
        with self._lock:
            if isinstance(item, Event):
                key = (item.part, item.state, item.reason)
                self._events.pop(key, None)
                self._events[key] = line
                if len(self._events) > KEPT_EVENTS:
                    del self._events[next(iter(self._events))]
            else:
                self._decisions.append(line)
        return line


def array_line(opened: Opened) -> bytes:
    """The array of a source."""
    spec = opened.spec
    return (
        msgspec.json.encode(
            {
                "type": "array", "source": opened.source, "name": spec.name, "frame": spec.frame,
                "rate_hz": spec.rate_hz, "elements": spec.elements, "grid": spec.grid,
                "channels": spec.channels, "units": spec.units, "axes": map_axes(spec).tolist(),
            }
        )
        + b"\n"
    )  # fmt: skip


def map_axes(spec: ArraySpec) -> NDArray[np.float64]:
    """(element, 2, 3): turns a vector in each element's own frame into (right, down) of the map.

    Right is the mean direction, in the mount frame, in which the columns of the grid follow each
    other, down that of the rows: the part of a force in the plane of the array, so that arrows of
    elements that point differently can be compared. Where the elements' places do not span a
    plane, it is the element's own (x, y), y upwards.
    """
    n = len(spec.elements)
    plain = np.tile([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], (n, 1, 1))
    grid, places = np.array(spec.grid, float), np.array(spec.positions, float)
    centred = grid - grid.mean(axis=0)
    if np.linalg.matrix_rank(centred) < 2:
        return plain
    down, right = np.linalg.lstsq(centred, places - places.mean(axis=0), rcond=None)[0]
    lengths = np.linalg.norm(right), np.linalg.norm(down)
    if min(lengths) < 1e-9 or np.linalg.norm(np.cross(right, down)) < 0.1 * np.prod(lengths):
        return plain
    right = right / lengths[0]
    down = down - right * (right @ down)  # the map's axes stand at right angles
    axes = np.stack([right, down / np.linalg.norm(down)])
    return np.asarray((axes @ rotation_matrices(spec.orientations)).round(4))


def _text(values: NDArray[np.float32]) -> str:
    """Little-endian float32, base64: a quarter of what digits take; not a number where invalid."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()
