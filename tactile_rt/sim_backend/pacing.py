"""A simulation as a source: simulated when it is read, delivered when it is due."""

import abc
import time
from typing import Final

from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk, ConfigError, EndOfStream, Source

__all__ = ["CHUNK_SAMPLES", "PACES", "PacedSource", "check_pace"]

CHUNK_SAMPLES: Final = 9
PACES: Final = ("realtime", "fast")


def check_pace(pace: str) -> None:
    """Raise a `ConfigError` if there is no such pace."""
    if pace not in PACES:
        raise ConfigError(f"no pace {pace!r}: there are {', '.join(PACES)}")


class PacedSource(Source):
    """What all simulated arrays have in common; implementations give `_simulate`.

    Time is simulated: it starts at the first read, and in real time the reader waits for it.

    Args:
        spec: what the samples are.
        pace: ``realtime`` delivers samples when they are due, ``fast`` as soon as simulated.

    Attributes:
        live: whether samples wait for nobody (real-time pace).
    """

    def __init__(self, spec: ArraySpec, pace: str) -> None:
        super().__init__(spec)
        self.live = pace == "realtime"
        self._start_ns: int | None = None
        self._next: Chunk | None = None  # simulated, not yet due
        self._closed = False

    @abc.abstractmethod
    def _simulate(self, start_ns: int) -> Chunk | None:
        """The next samples; None when all of them are dropped.

        Args:
            start_ns: when the stream began.

        Raises:
            EndOfStream: there are no more.
        """

    def read(self, timeout: float | None = None) -> Chunk | None:
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns() if self.live else 0
        while self._next is None:
            if self._closed:
                raise EndOfStream
            self._next = self._simulate(self._start_ns)
        chunk = self._next
        if self.live:
            wait = (int(chunk.t_ns[-1]) - time.monotonic_ns()) / NS_PER_S
            if timeout is not None and wait > timeout:
                time.sleep(max(timeout, 0))
                return None
            time.sleep(max(wait, 0))
        self._next = None
        self.stats.delivered += len(chunk)
        return chunk

    def close(self) -> None:
        self._closed = True
        self._next = None
