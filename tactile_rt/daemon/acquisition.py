"""One thread reads the lines of all devices, and hands each source's samples on.

    lines --> Acquisition (one thread) --> SourcePart.take --> hub

A source's own thread opens it, waits for what has no line, and opens a lost line again; as long as
there is a line it lends the source to this thread.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from tactile_rt.drivers.reader import Reader
from tactile_rt.stream import Chunk, Source

__all__ = ["Acquisition"]


@dataclass(eq=False)
class _Lent:
    source: Source
    take: Callable[[Chunk | None], None]
    wanted: Callable[[], bool]
    over: threading.Event = field(default_factory=threading.Event)
    error: Exception | None = None


class Acquisition:
    """Reads what is lent to it; the thread is there while anything is."""

    def __init__(self) -> None:
        self._reader = Reader()
        self._new: deque[_Lent] = deque()
        self._lent: dict[Source, _Lent] = {}
        self._lock = threading.Lock()  # of the thread's beginning and end
        self._running = False

    def attend(
        self, source: Source, take: Callable[[Chunk | None], None], wanted: Callable[[], bool]
    ) -> None:
        """Read a source until its line is lost, or it is not wanted any more; returns then.

        Args:
            take: Called in the thread that reads with what comes; several times a second with
                None, if nothing does.
            wanted: Tells whether to go on.
        """
        lent = _Lent(source, take, wanted)
        with self._lock:
            self._new.append(lent)
            if not self._running:
                self._running = True
                threading.Thread(target=self._run, name="tactile-rt lines", daemon=True).start()
        self._reader.wake()
        lent.over.wait()
        if lent.error is not None:
            raise lent.error

    def _run(self) -> None:
        while True:
            with self._lock:
                while self._new:
                    lent = self._new.popleft()
                    self._lent[lent.source] = lent
                    self._reader.add(lent.source)
                if not self._lent:
                    self._running = False
                    return
            for source in self._reader.wait():
                self._read(self._lent[source])

    def _read(self, lent: _Lent) -> None:
        try:
            if lent.wanted():
                lent.take(lent.source.read(0.0))
                if lent.source.fileno() >= 0:
                    return
        except Exception as error:
            lent.error = error
        del self._lent[lent.source]
        self._reader.remove(lent.source)
        lent.over.set()
