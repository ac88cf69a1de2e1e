"""What a slow or stuck consumer does to acquisition: nothing, and it is told what it missed."""

import time
from array import array
from typing import Any

import numpy as np

from bench.drivers.metronome import Beat, play
from bench.processes import Helper
from tactile_rt.classifier.session import Session
from tactile_rt.core.stream import Chunk, Source
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sources.opening import open_source

QUICK_S, WHOLE_S = 12.0, 120.0
SEGMENT_S = 0.25  # that the consumer keeps to one way
QUEUE = 64  # chunks
SPARE_S = 20.0  # the device is stopped, it does not end
REACHES_S = 0.3  # within which a sample that was sent is in the queue
PAUSES = {"quick": 0.0, "slow": 0.02, "stuck": SEGMENT_S}  # after each chunk of some 1 ms


class _Watched(Source):
    """A source that writes down when each sample was in hand."""

    def __init__(self, source: Source) -> None:
        super().__init__(source.spec)
        self.source, self.stats = source, source.stats
        self.seq, self.at_ns = array("q"), array("q")

    def read(self, timeout: float | None = None) -> Chunk | None:
        chunk = self.source.read(timeout)
        if chunk is not None:
            now = time.monotonic_ns()
            numbers = chunk.seq.tolist()
            self.seq.extend(numbers)
            self.at_ns.extend([now] * len(numbers))
        return chunk

    def close(self) -> None:
        self.source.close()


class _Nothing:
    """In a classifier's place: what consumes is the loop around the session."""

    def push(self, chunk: Chunk) -> list[Any]:
        return []


def consumers(quick: bool) -> list[Record]:
    """One consumer that is quick, slow and stuck by turns: what slows the machine slows all."""
    seconds = QUICK_S if quick else WHOLE_S
    beat = Beat("serial", (0.0,), 35, 1000.0, seconds + SPARE_S)
    ways, taken = tuple(PAUSES.items()), 0
    with Helper(play, beat) as device:
        ((address, _),) = device.hear()
        source = _Watched(open_source(f"{address}?codec=native"))
        consumer: Any = _Nothing()
        began = time.monotonic()
        with Session(source, consumer, queue_chunks=QUEUE) as session:
            for chunk, _ in session:
                taken += len(chunk)
                passed = time.monotonic() - began
                if passed > seconds:
                    (sent,) = device.ask("stop")
                    time.sleep(REACHES_S)  # what is on its way when a session ends, nobody counts
                    break
                left = SEGMENT_S - passed % SEGMENT_S
                pause = ways[int(passed / SEGMENT_S) % len(ways)][1]
                time.sleep(min(pause, left))
        waiting = session._queue.state.waiting["samples"]
    stats, seq = source.stats, np.array(source.seq)
    at = np.array(source.at_ns)
    late = (at - sent.at_ns[seq]) / 1e3
    way = ((at / 1e9 - began) / SEGMENT_S).astype(int) % len(ways)
    p50 = {name: float(np.median(late[way == k])) for k, name in enumerate(PAUSES)}
    how = (
        f"native at 1 kHz over a pty, {seconds:g} s, session of {QUEUE} chunks; by turns of "
        f"{SEGMENT_S:g} s quick, slow ({1e3 * PAUSES['slow']:g} ms a chunk), stuck"
    )
    lost = stats.missing + stats.corrupt + len(seq) - len(np.unique(seq))
    return [
        Record("drivers.consumer.lost", lost, "samples", "== 0", "by acquisition", how),
        *(
            Record(
                f"drivers.consumer.{name}_p50", p50[name] / p50["quick"], "x", "<= 1.1",
                f"device's write to chunk in hand: {p50[name]:.0f} us, quick {p50['quick']:.0f}",
                how,
            )
            for name in ("slow", "stuck")
        ),
        Record(
            "drivers.consumer.uncounted", abs(stats.delivered - taken - waiting - session.dropped),
            "samples", "== 0", f"{session.dropped} dropped", how,
        ),
    ]  # fmt: skip
