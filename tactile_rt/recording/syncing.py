"""Put what is written on the medium, and let nobody wait for it.

What the operating system has outlives the process, but not a power cut: only a sync puts it on the
medium, which on a memory card may take seconds. So a thread of its own does that.
"""

import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import NamedTuple


class Extent(NamedTuple):
    """How much of a recording there is, up to some moment."""

    samples: int = 0
    packets: int = 0
    newest_ns: int = 0  # host monotonic time of the newest sample, ns; 0 if there is none


class Syncer:
    """A thread that syncs one file after another, in the order in which they ask."""

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="tactile-rt-sync", daemon=True)
        self._thread.start()

    def add(self, job: Callable[[], object]) -> None:
        """Call this in the thread, after all that was added before; it must not raise."""
        self._jobs.put(job)

    def close(self) -> None:
        """Wait until all of it is done, and end."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()
