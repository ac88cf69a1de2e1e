"""The feed of the page: lines of JSON, thinned to what an eye can follow.

Samples are sent as ``frame`` lines, some thirty a second at any rate of the source: the newest
sample, and the least and greatest value of each channel since the frame before, so that no spike
goes unseen. All other lines are the daemon's messages (`tactile_rt.daemon.messages`).
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

Line = tuple[str, bytes]  # source whose watchers get it, or empty for all; JSON with line break


class _Fold:
    """Accumulator of a source's samples since the last frame: least, most, newest values."""

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
            "newest": _encode_values(self.newest),
        }  # fmt: skip
        if self.samples > 1:
            frame |= {"least": _encode_values(self.least), "most": _encode_values(self.most)}
        self.samples = 0
        return source, msgspec.json.encode(frame) + b"\n"


class Feed:
    """Encoder of items as lines for browsers; for the consumer's thread, except `recent`."""

    def __init__(self) -> None:
        self._folds: dict[str, _Fold] = {}
        self._lock = threading.Lock()
        # Only the newest of equal events is kept, so that a repeated failure hides no others.
        self._events: dict[tuple[str, str, str], bytes] = {}
        self._decisions: deque[bytes] = deque(maxlen=KEPT_DECISIONS)

    def take(self, items: list[Item], watched: Collection[str]) -> list[Line]:
        """Encode items; return the lines to send now, without samples of unwatched sources."""
        lines: list[Line] = []
        for item in items:
            if isinstance(item, SourceChunk):
                if item.source in watched:
                    self._folds.setdefault(item.source, _Fold()).add(item)
            elif isinstance(item, Opened):
                lines.append(("", array_line(item)))
                self._folds.pop(item.source, None)
            elif isinstance(item, Decision | Contact | Event):
                lines.append(("", self._encode_message(item)))
        for source in [s for s in self._folds if s not in watched]:
            del self._folds[source]
        now = time.monotonic()
        for source, fold in self._folds.items():
            if fold.samples and now - fold.sent >= FRAME_S:
                fold.sent = now
                lines.append(fold.line(source))
        return lines

    def recent(self) -> list[bytes]:
        """Return lines of the newest events and decisions; safe from any thread."""
        with self._lock:
            return [*self._events.values(), *self._decisions]

    def _encode_message(self, item: Item) -> bytes:
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
    """Encode the array of an opened source as a line of JSON."""
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
    """Return matrices (element, 2, 3) from elements' own frames to the map's (right, down).

    Right is the mean direction, in the mount frame, in which the columns of the grid follow each
    other, down that of the rows. So the map shows the part of a force in the plane of the array,
    and arrows of elements that point differently can be compared. If the elements' positions span
    no plane, the axes are the element's own (x, y), y upwards.
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
    down = down - right * (right @ down)  # make the axes perpendicular
    axes = np.stack([right, down / np.linalg.norm(down)])
    return np.asarray((axes @ rotation_matrices(spec.orientations)).round(4))


def _encode_values(values: NDArray[np.float32]) -> str:
    """Encode values as base64 of little-endian float32, a quarter of the size of digits."""
    return base64.b64encode(values.astype("<f4").tobytes()).decode()
