"""One stream through one classifier: acquisition never waits for the network.

    source --(thread)--> bounded queue --> classifier --> (chunk, decisions)

A thread reads a live source. When the consumer falls behind by more than the queue holds, the
oldest chunks are dropped and counted, so that decisions stay recent. A source that waits for its
reader (a recording, a simulation at full speed) is read in step, and nothing can be lost.
"""

import contextlib
import threading
from collections.abc import Generator, Iterator
from typing import Self

from tactile_rt.classifier.classifier import Classification, Classifier
from tactile_rt.core.bounded_queue import BoundedQueue
from tactile_rt.core.stream import Chunk, EndOfStream, Source

POLL_S = 0.1  # how soon a reader thread notices that it should stop


class Session:
    """An iterable over a source's chunks, each with the decisions of a classifier.

    Args:
        source: The source of samples; the session closes it.
        classifier: The classifier, created for the source's array.
        queue_chunks: The number of chunks that may wait for the classifier.
    """

    def __init__(self, source: Source, classifier: Classifier, queue_chunks: int = 256) -> None:
        self.source = source
        self.classifier = classifier
        self._queue = BoundedQueue[Chunk](
            queue_chunks, measure=lambda chunk: ("samples", len(chunk), 0), kinds=("samples",)
        )
        self._stopping = False
        self._ending: Exception | None = None
        self._reader: threading.Thread | None = None

    @property
    def dropped(self) -> int:
        """Number of samples of a live source that were dropped before classification."""
        return self._queue.dropped["samples"]

    def __iter__(self) -> Iterator[tuple[Chunk, list[Classification]]]:
        # Closing: an error of the classifier ends the reader now, not when its traceback is freed.
        with contextlib.closing(self._drain() if self.source.live else self._read_all()) as chunks:
            for chunk in chunks:
                yield chunk, self.classifier.push(chunk)

    def stop(self) -> None:
        """End the iteration, which then closes the source; from any thread, safe to call twice."""
        self._stopping = True
        self._queue.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _close(self) -> None:
        """Stop the reader thread, then close the source."""
        self.stop()
        if self._reader is not None:
            self._reader.join()
        self.source.close()

    def _read_all(self) -> Generator[Chunk, None, None]:
        try:
            while not self._stopping:
                chunk = self.source.read()
                if chunk is not None and not self._stopping:
                    yield chunk
        except EndOfStream:
            pass
        finally:
            self._close()

    def _drain(self) -> Generator[Chunk, None, None]:
        self._reader = threading.Thread(target=self._read, name="tactile-rt-reader", daemon=True)
        self._reader.start()
        try:
            while (chunk := self._take()) is not None:
                yield chunk
        finally:
            self._close()

    def _take(self) -> Chunk | None:
        chunk = self._queue.get()
        if self._stopping:
            return None
        if chunk is None and not isinstance(self._ending, EndOfStream):
            assert self._ending is not None
            raise self._ending
        return chunk

    def _read(self) -> None:
        while not self._stopping:
            try:
                chunk = self.source.read(POLL_S)
            except Exception as error:  # any error is raised in the consumer's thread
                self._ending = error
                self._queue.close()
                return
            if chunk is not None and not self._stopping:
                self._queue.put(chunk)
