"""Sync of recordings to the storage medium in the background.

Data that the operating system holds outlives the process, but not a power cut: only a sync puts it
on the medium. On a memory card that may take seconds, so a separate thread syncs.
"""

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import NamedTuple


class Extent(NamedTuple):
    """Numbers of samples and packets in a recording up to some moment."""

    samples: int = 0
    packets: int = 0
    newest_ns: int = 0  # host monotonic time of the newest sample, ns; 0 without a sample


class Syncer:
    """Thread that runs queued sync jobs one after another."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="tactile-rt-sync", daemon=True)
        self._thread.start()

    def add(self, job: Callable[[], object]) -> None:
        """Queue a job to run in the thread after all earlier jobs. It must not raise."""
        self._jobs.put(job)

    def close(self) -> None:
        """Wait until all queued jobs are done, then end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
