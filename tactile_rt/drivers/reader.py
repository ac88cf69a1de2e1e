"""Reader of many sources in one thread: each is read as soon as it has samples.

    reader = Reader([left, right])
    for source, chunk in reader:
        ...

A thread per device would cost more, since threads contend for Python's GIL at every sample.
"""

import os
import select
import time
from collections.abc import Iterable, Iterator

from tactile_rt.core.stream import Chunk, EndOfStream, Source

BLIND_S = 0.005  # interval at which sources without a descriptor are read
LOOK_S = 0.1  # interval at which every source is read: only a read shows that a device is silent


class Reader:
    """Multiplexer of sources: reads each as its samples arrive, in one thread.

    It polls the descriptors of all sources at once (`Source.fileno`), and reads sources without a
    descriptor every 5 ms: simulations, polled devices and lost lines. While a lost line is being
    reopened, until its device answers, the samples of the other sources wait in their lines.
    Nothing is buffered here. Only `wake` may be called from another thread.

    Args:
        sources: Sources to read; the caller closes them.
        gather_s: Time to wait for further input once some has come, s: waking up for each sample
            costs as much as decoding it.

    Attributes:
        sources: The sources that have not ended, in the order in which they were added.
    """

    def __init__(self, sources: Iterable[Source] = (), gather_s: float = 0.0) -> None:
        self._gather_s = gather_s
        self.sources: list[Source] = []
        self._poll = select.poll()
        self._lines: dict[int, Source] = {}  # by descriptor
        self._blind: list[Source] = []  # those without a descriptor now
        self._look_at = 0.0
        self._wake_reader, self._wake_writer = os.pipe()
        os.set_blocking(self._wake_reader, False)
        self._poll.register(self._wake_reader, select.POLLIN)
        for source in sources:
            self.add(source)

    def __del__(self) -> None:
        os.close(self._wake_reader)
        os.close(self._wake_writer)

    def add(self, source: Source) -> None:
        """Add a source to the sources that are read."""
        self.sources.append(source)
        self._register(source)

    def remove(self, source: Source) -> None:
        """Stop reading a source; it stays open."""
        self.sources.remove(source)
        self._unregister(source)

    def wake(self) -> None:
        """Make `wait` return at once; callable from any thread."""
        os.write(self._wake_writer, b"\0")

    def wait(self, timeout: float | None = None) -> list[Source]:
        """Wait for input; return the sources to read now, none after a timeout or `wake`.

        All sources are returned ten times a second.
        """
        if self._blind:
            for source in [s for s in self._blind if s.fileno() >= 0]:
                self._unregister(source)
                self._register(source)
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            return self.sources.copy()
        most = BLIND_S if self._blind else self._look_at - now
        found = self._poll.poll(1e3 * (most if timeout is None else min(most, timeout)))
        if found and self._gather_s:
            time.sleep(self._gather_s)
            found = self._poll.poll(0)
        ready = [self._lines[fd] for fd, _ in found if fd in self._lines]
        if len(ready) < len(found):  # the other descriptor is that of `wake`
            os.read(self._wake_reader, 4096)
        return ready + self._blind if self._blind else ready

    def take(self, source: Source) -> Chunk | None:
        """Read a source without waiting; return None if it has no samples or has ended.

        Raises:
            SourceError: the device failed; it is removed from the sources.
        """
        try:
            chunk = source.read(0.0)
        except Exception as error:
            self.remove(source)
            if isinstance(error, EndOfStream):
                return None
            raise
        if self._lines.get(source.fileno()) is not source and source not in self._blind:
            self._unregister(source)  # its line is gone or was replaced
            self._register(source)
        return chunk

    def read(self, timeout: float | None = None) -> list[tuple[Source, Chunk]]:
        """Wait for input; return (source, chunk) pairs, none after a timeout or without sources.

        Raises:
            SourceError: a device failed; it is removed from the sources.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while self.sources:
            left = None if end is None else max(0.0, end - time.monotonic())
            came = [(s, chunk) for s in self.wait(left) if (chunk := self.take(s)) is not None]
            if came or (end is not None and time.monotonic() >= end):
                return came
        return []

    def __iter__(self) -> Iterator[tuple[Source, Chunk]]:
        while self.sources:
            yield from self.read()

    def _register(self, source: Source) -> None:
        if (fd := source.fileno()) < 0:
            self._blind.append(source)
            return
        self._lines[fd] = source
        self._poll.register(fd, select.POLLIN)

    def _unregister(self, source: Source) -> None:
        if source in self._blind:
            self._blind.remove(source)
        for fd in [fd for fd, known in self._lines.items() if known is source]:
            del self._lines[fd]
            self._poll.unregister(fd)
