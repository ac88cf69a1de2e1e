"""Many sources, one thread: whoever has something is read, in the order in which it came.

    reader = Reader([left, right])
    for source, chunk in reader:
        ...

A thread for each device costs more: they take the interpreter's lock from each other at every
sample.
"""

import os
import select
import time
from collections.abc import Iterable, Iterator

from tactile_rt.core.stream import Chunk, EndOfStream, Source

BLIND_S = 0.005  # how often sources are looked at that have no descriptor to wait for
LOOK_S = 0.1  # how often each source is: a device is silent only when somebody has looked


class Reader:
    """Reads sources as their samples come. One thread at a time may use it, but for `wake`.

    It waits for the descriptors of all sources at once (`Source.fileno`), and looks at those that
    have none every 5 ms: simulations, devices that are asked for each sample, and lines that are
    lost. While a lost one is opened again, which may take as long as its device takes to answer,
    the others wait in their lines. Nothing is buffered here.

    Args:
        sources: what to read; they stay the caller's to close.
        gather_s: how long what has come waits for more, s: to be woken for each sample costs as
            much as to decode it.

    Attributes:
        sources: The sources that have not ended, in the order in which they were added.
    """

    def __init__(self, sources: Iterable[Source] = (), gather_s: float = 0.0) -> None:
        self._gather_s = gather_s
        self.sources: list[Source] = []
        self._poll = select.poll()
        self._lines: dict[int, Source] = {}  # by descriptor
        self._blind: list[Source] = []  # without one, now
        self._look_at = 0.0
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._woken, False)
        self._poll.register(self._woken, select.POLLIN)
        for source in sources:
            self.add(source)

    def __del__(self) -> None:
        os.close(self._woken)
        os.close(self._wake)

    def add(self, source: Source) -> None:
        """Read this one, too."""
        self.sources.append(source)
        self._attend(source)

    def remove(self, source: Source) -> None:
        """Read this one no longer; it stays open."""
        self.sources.remove(source)
        self._neglect(source)

    def wake(self) -> None:
        """Let `wait` return at once; from any thread."""
        os.write(self._wake, b"\0")

    def wait(self, timeout: float | None = None) -> list[Source]:
        """Sources whose `read` may have something now; none if the time is over, or it was woken.
        Ten times a second all of them are.
        """
        if self._blind:
            for source in [s for s in self._blind if s.fileno() >= 0]:
                self._neglect(source)
                self._attend(source)
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
        if len(ready) < len(found):  # the other is `wake`
            os.read(self._woken, 4096)
        return ready + self._blind if self._blind else ready

    def take(self, source: Source) -> Chunk | None:
        """What has come of a source that is ready; None: nothing, or it has ended.

        Raises:
            SourceError: the device broke, and is read no longer.
        """
        try:
            chunk = source.read(0.0)
        except Exception as error:
            self.remove(source)
            if isinstance(error, EndOfStream):
                return None
            raise
        if self._lines.get(source.fileno()) is not source and source not in self._blind:
            self._neglect(source)  # its line is gone, or another
            self._attend(source)
        return chunk

    def read(self, timeout: float | None = None) -> list[tuple[Source, Chunk]]:
        """What has come of any of them since the last call; nothing when the time is over, or no
        source is left.

        Raises:
            SourceError: a device broke; it is among the sources no longer.
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

    def _attend(self, source: Source) -> None:
        if (fd := source.fileno()) < 0:
            self._blind.append(source)
            return
        self._lines[fd] = source
        self._poll.register(fd, select.POLLIN)

    def _neglect(self, source: Source) -> None:
        if source in self._blind:
            self._blind.remove(source)
        for fd in [fd for fd, known in self._lines.items() if known is source]:
            del self._lines[fd]
            self._poll.unregister(fd)
