"""Who reads: our sources, or nothing but `os.read`; each device in a thread of its own."""

import os
import threading
import time
from array import array
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import Chunk, Source, SourceStats
from tactile_rt.drivers.reader import Reader
from tactile_rt.sources.opening import open_source

SILENCE_S = 1.5  # after which nothing more comes
WARM_S = 0.5  # not on the bill: the descriptions, the first fits


@dataclass(frozen=True)
class Came:
    """What one reader got of one device.

    Attributes:
        seq: (n,) number of each sample.
        at_ns: (n,) host time at which the caller had it.
        told_ns: (n,) host time that it is said to be of; empty for a bare reader.
        reads: Number of calls that brought something.
        stats: The losses that the source counted.
        drift_ppm: Drift of the device's clock as the source found it, ppm.
    """

    seq: NDArray[np.int64]
    at_ns: NDArray[np.int64]
    told_ns: NDArray[np.int64]
    reads: int
    stats: SourceStats
    drift_ppm: float = 0.0


class _Bill:
    """CPU time and wall time of this process, from shortly after the beginning to the end."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._began: tuple[float, float] | None = None
        self._ended = (0.0, 0.0)

    def begin(self) -> None:
        time.sleep(WARM_S)
        self._began = time.process_time(), time.monotonic()

    def end(self) -> None:
        """One has read its last sample; the first that ends closes the bill."""
        with self._lock:
            if not self._ended[1]:
                self._ended = time.process_time(), time.monotonic()

    @property
    def share(self) -> float:
        """Of a core."""
        assert self._began is not None
        return (self._ended[0] - self._began[0]) / (self._ended[1] - self._began[1])


class _Notes:
    """What one device's samples were, written down as cheaply as can be."""

    def __init__(self) -> None:
        self.seq, self.at, self.told = array("q"), array("q"), array("q")
        self.reads = 0

    def add(self, chunk: Chunk) -> None:
        now = time.monotonic_ns()
        self.reads += 1
        self.seq.frombytes(chunk.seq.tobytes())
        self.told.frombytes(chunk.t_ns.tobytes())
        if len(self.seq) == len(self.at) + 1:
            self.at.append(now)
        else:
            self.at.extend([now] * (len(self.seq) - len(self.at)))

    def came(self, source: Source) -> Came:
        health = getattr(source, "health", None)
        drift = 0.0 if health is None else health.drift_ppm
        seq, at, told = (np.array(a, np.int64) for a in (self.seq, self.at, self.told))
        return Came(seq, at, told, self.reads, replace(source.stats), drift)


def read_sources(
    pipe: Connection, urls: list[str], samples: int, gather_s: float | None = None
) -> None:
    """Open these, say that, read so many samples of each; say [`Came`] and the share of a core.

    Args:
        pipe: to whom to say it.
        urls: of the sources.
        samples: of each.
        gather_s: that one reader for all of them lets samples gather; None: a thread for each.
    """
    sources = [open_source(url) for url in urls]
    pipe.send("open")
    notes = [_Notes() for _ in sources]
    bill = _Bill()

    def read_all() -> None:
        note = dict(zip(sources, notes, strict=True))
        reader = Reader(sources, gather_s or 0.0)
        last = time.monotonic()
        while any(len(n.seq) < samples for n in notes) and time.monotonic() - last < SILENCE_S:
            for source, chunk in reader.read(0.1):
                note[source].add(chunk)
                last = time.monotonic()
        bill.end()

    def read(source: Source, note: _Notes) -> None:
        last = time.monotonic()
        while len(note.seq) < samples and time.monotonic() - last < SILENCE_S:
            chunk = source.read(0.1)
            if chunk is not None:
                note.add(chunk)
                last = time.monotonic()
        bill.end()

    pairs = list(zip(sources, notes, strict=True))
    threads = [threading.Thread(target=read, args=pair) for pair in pairs]
    if gather_s is not None:
        threads = [threading.Thread(target=read_all)]
    for thread in threads:
        thread.start()
    bill.begin()
    for thread in threads:
        thread.join()
    came = [note.came(source) for source, note in pairs]
    for source in sources:
        source.close()
    pipe.send((came, bill.share))


def read_bare(pipe: Connection, paths: list[str], samples: int) -> None:
    """The same with `os.read` alone; it is told how many bytes a sample has when all is read."""
    lines = [os.open(path, os.O_RDWR | os.O_NOCTTY) for path in paths]
    pipe.send("open")
    pieces: list[list[tuple[int, int]]] = [[] for _ in lines]
    bill, finished = _Bill(), threading.Event()

    def read(k: int, line: int) -> None:
        mine = pieces[k]
        while not finished.is_set():
            try:
                data = os.read(line, 65_536)
            except OSError:
                return
            mine.append((len(data), time.monotonic_ns()))

    threads = [threading.Thread(target=read, args=e, daemon=True) for e in enumerate(lines)]
    for thread in threads:
        thread.start()
    bill.begin()
    size = pipe.recv()
    bill.end()
    finished.set()
    found = []
    for mine in pieces:
        ends, at = np.cumsum([n for n, _ in mine]), np.array([t for _, t in mine], np.int64)
        whole = min(samples, int(ends[-1]) // size) if len(mine) else 0
        which = np.searchsorted(ends, size * (np.arange(whole) + 1))
        none = np.empty(0, np.int64)
        found.append(
            Came(np.arange(whole), at[which] if whole else none, none, len(mine), SourceStats())
        )
    pipe.send((found, bill.share))
