"""Finders of frames that have a fixed ending, but no fixed beginning.

`EndFinder` is for an ending that no measurement contains, such as six special bytes. A short
ending, such as a line end, also occurs inside the numbers: `StrideFinder` infers from several
frames at once where they end.

Both take bytes cut anywhere and return the frames that they complete, the number of damaged ones
before each, and the arrival time of each (ns).
"""

from bisect import bisect_left
from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import WireStats

GAP: Final = 16  # frames without an ending, after which the bytes are not this device's
FIRST: Final = 2  # successive frames that must fit before any is accepted
MOST: Final = 8  # frames to wait for while several places fit

Found: TypeAlias = tuple[list[bytes], list[int], list[int]]
Raw: TypeAlias = NDArray[np.uint8]


class EndFinder:
    """Finder of frames of fixed length whose ending never occurs inside them.

    The bytes between two endings are a frame if they have its length. If they have the length of
    several frames, the endings between were damaged, and only the last frame is intact.

    Args:
        size: length of a frame with its ending, bytes.
    """

    def __init__(self, end: bytes, size: int, stats: WireStats) -> None:
        self._end, self._size, self._stats = end, size, stats
        self._data = bytearray()
        self.forget()

    def forget(self) -> None:
        """Discard all state, as after a reconnection."""
        self._data.clear()
        self._dropped = 0  # bytes since the last ending that are not kept
        self._damaged = 0
        self._joined = False

    def find(self, packet: bytes, t_ns: int) -> Found:
        """Return the frames that these bytes complete, their damage counts and arrivals."""
        self._data += packet
        frames: list[bytes] = []
        damaged: list[int] = []
        at = 0
        while (end := self._data.find(self._end, at)) >= 0:
            after = end + len(self._end)
            if self._is_frame(end - at):
                frames.append(bytes(self._data[after - self._size : after]))
                damaged.append(self._damaged)
                self._damaged = 0
            at = after
        del self._data[:at]
        keep = len(self._end) - 1
        if len(self._data) > GAP * self._size + keep:
            self._dropped += len(self._data) - keep
            self._stats.skipped += len(self._data) - keep
            del self._data[: len(self._data) - keep]
        return frames, damaged, [t_ns] * len(frames)

    def _is_frame(self, segment: int) -> bool:
        """Return whether a segment of this many bytes ends with an intact frame; count losses."""
        size, body = self._size, self._size - len(self._end)
        length = self._dropped + segment
        joined, self._joined, self._dropped = self._joined, True, 0
        # before the first ending anything may come, such as an answer
        whole = (length + len(self._end)) % size == 0 if joined else length >= body
        whole = whole and length <= GAP * size
        if joined:
            lost = -(-(length + len(self._end)) // size) - whole
            self._stats.corrupt += lost
            self._damaged += lost
        self._stats.skipped += segment - body if whole else segment + len(self._end)
        self._stats.intact += whole
        return whole


class StrideFinder:
    """Finder of frames of fixed length whose ending may also occur inside them.

    The ending must recur at every frame length, and the values between must be in the device's
    range.

    Args:
        possible: Returns, for (n, size) bytes, (n,) whether the device can have sent each frame.
    """

    def __init__(
        self,
        end: bytes,
        size: int,
        possible: Callable[[Raw], NDArray[np.bool_]],
        stats: WireStats,
    ) -> None:
        self._end, self._size = np.frombuffer(end, np.uint8), size
        self._possible, self._stats = possible, stats
        self._data = bytearray()
        self._rivals: list[int] = []  # other offsets at which every frame so far had an ending
        self._times: list[tuple[int, int]] = []  # (bytes received, arrival) of waiting packets
        self.forget()

    def forget(self) -> None:
        """Discard all state, as after a reconnection."""
        self._data.clear()
        self._rivals.clear()
        self._times.clear()
        self._locked = self._joined = False  # whether frames' offset is known, and ever was
        self._taken = self._damaged = 0  # bytes consumed so far; damaged frames
        self._gap = 0  # bytes dropped since the last frame

    @property
    def confidence(self) -> float:
        """Confidence in where frames begin: 0 while unknown, else 1 / (possible offsets)."""
        return 1.0 / (1 + len(self._rivals)) if self._locked else 0.0

    def find(self, packet: bytes, t_ns: int) -> Found:
        """Return the frames that these bytes complete, their damage counts and arrivals."""
        self._data += packet
        self._times.append((self._taken + len(self._data), t_ns))
        frames: list[bytes] = []
        ends: list[int] = []
        damaged: list[int] = []
        while self._locked or self._lock():
            found = self._take_frames()
            if found:
                frames += found
                first = self._taken - len(found) * self._size
                ends += range(first + self._size, self._taken + 1, self._size)
                damaged += [self._damaged] + [0] * (len(found) - 1)
                self._damaged = 0
            if not self._skip_one():
                break
        # frames waited while their offset was unknown: each arrived with its last byte
        times = self._times
        arrived = [times[bisect_left(times, (end,))][1] for end in ends]
        del times[: bisect_left(times, (self._taken + 1,))]
        return frames, damaged, arrived

    def _lock(self) -> bool:
        """Find where frames begin, and drop the bytes before; return whether it was found."""
        size, tail = self._size, len(self._end)
        while len(self._data) >= (FIRST + 1) * size - 1:
            data = np.frombuffer(bytes(self._data), np.uint8)
            windows = np.lib.stride_tricks.sliding_window_view(data, tail)
            ended = (windows == self._end).all(axis=1)
            often = ended[size - tail : 2 * size - tail] & ended[2 * size - tail :][:size]
            fitting = [s for s in np.flatnonzero(often).tolist() if self._can_begin(data, s, FIRST)]
            k = FIRST
            while len(fitting) > 1 and k < MOST:
                k += 1
                if len(data) < (k + 1) * size - 1:
                    return False  # the next frame may exclude some of the offsets
                fitting = [s for s in fitting if self._can_begin(data, s, k)] or fitting[:1]
            if not fitting:
                self._drop(size)
                continue
            start = fitting[0]
            self._drop(start)
            self._rivals = [(s - start) % size for s in fitting[1:]]
            self._locked = True
            lost = -(-self._gap // size) if self._joined else 0
            self._stats.corrupt += lost
            self._damaged += lost
            self._joined, self._gap = True, 0
            return True
        return False

    def _can_begin(self, data: Raw, start: int, frames: int) -> bool:
        """Return whether this many whole frames can begin at `start`."""
        whole = data[start : start + frames * self._size].reshape(frames, self._size)
        return bool(self._have_ending(whole, 0).all() and self._possible(whole).all())

    def _have_ending(self, whole: Raw, at: int) -> NDArray[np.bool_]:
        """Return whether each frame, (n,), has the ending before byte `at`; 0 means its end."""
        places = np.arange(at - len(self._end), at)
        found: NDArray[np.bool_] = (whole[:, places] == self._end).all(axis=1)
        return found

    def _take_frames(self) -> list[bytes]:
        """Remove and return the whole frames before the first that lacks its ending."""
        size = self._size
        n = len(self._data) // size
        whole = np.frombuffer(bytes(self._data[: n * size]), np.uint8).reshape(n, size)
        ended = self._have_ending(whole, 0)
        n = n if ended.all() else int(ended.argmin())
        if self._rivals and n:
            self._rivals = [r for r in self._rivals if self._have_ending(whole[:n], r).all()]
        frames = [bytes(self._data[k * size : (k + 1) * size]) for k in range(n)]
        del self._data[: n * size]
        self._taken += n * size
        self._stats.intact += n
        return frames

    def _skip_one(self) -> bool:
        """Skip a frame that lacks its ending, or restart the search; return False to wait."""
        size = self._size
        if len(self._data) < 2 * size:
            return False
        # a single damaged ending does not make the offset uncertain
        following = np.frombuffer(bytes(self._data[size : 2 * size]), np.uint8)
        if not self._rivals and self._can_begin(following, 0, 1):
            self._drop(size)
            self._gap = 0
            self._stats.corrupt += 1
            self._damaged += 1
        else:
            self._locked = False
        return True

    def _drop(self, n: int) -> None:
        del self._data[:n]
        self._taken += n
        self._gap += n
        self._stats.skipped += n
