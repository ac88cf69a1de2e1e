import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from tactile_rt.classifier.session import Session
from tactile_rt.core.errors import SourceError
from tactile_rt.core.stream import Chunk, EndOfStream, Source
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.waiting import PATIENCE_S, until

SPEC = small_spec()
CHUNKS = cut_chunks(
    np.random.default_rng(0).normal(size=(400, *SPEC.shape)), SPEC.rate_hz, samples=4
)

pytestmark = pytest.mark.usefixtures("no_thread_left")


class Listener:
    """Stands in for a classifier; remembers what it was given."""

    def __init__(self, decide: Callable[[Chunk], list] = lambda chunk: []) -> None:
        self.seqs: list[int] = []
        self._decide = decide

    def push(self, chunk: Chunk) -> list:
        self.seqs += chunk.seq.tolist()
        return self._decide(chunk)


class Device(Source):
    """A live source under the test's control: gives what is in `arriving`, else nothing in time."""

    def __init__(self, *arriving: Chunk | Exception, live: bool = True) -> None:
        super().__init__(SPEC)
        self.live, self.arriving = live, list(arriving)
        self.readers: set[str] = set()
        self.reads = 0
        self.closed_by: list[str] = []
        self._busy = threading.Lock()

    def read(self, timeout: float | None = None) -> Chunk | None:
        assert self._busy.acquire(blocking=False), "two threads in one source"
        try:
            self.readers.add(threading.current_thread().name)
            self.reads += 1
            if self.closed_by:
                raise EndOfStream
            if not self.arriving:
                if not self.live:
                    raise EndOfStream
                assert timeout is not None and timeout < 1, "nobody could ever stop this"
                time.sleep(timeout / 10)
                return None
            item = self.arriving.pop(0)
        finally:
            self._busy.release()
        if isinstance(item, Exception):
            raise item
        self.stats.delivered += len(item)
        return item

    def close(self) -> None:
        assert self._busy.acquire(blocking=False), "closed while it was read"
        self._busy.release()
        self.closed_by.append(threading.current_thread().name)


def reading() -> bool:
    return any(t.name == "tactile-rt-reader" for t in threading.enumerate())


@pytest.mark.parametrize("live", [False, True])
def test_every_chunk_comes_with_its_decisions_in_order(live: bool) -> None:
    source = ArraySource(SPEC, CHUNKS, live=live)
    listener = Listener(lambda chunk: [int(chunk.seq[0])] if chunk.seq[0] % 40 == 0 else [])
    with Session(source, listener, queue_chunks=len(CHUNKS)) as session:
        got = list(session)
    assert [chunk for chunk, _ in got] == CHUNKS  # the very same objects: nothing is copied
    assert [d for _, ds in got for d in ds] == list(range(0, 400, 40))
    assert all((ds != []) == (chunk.seq[0] % 40 == 0) for chunk, ds in got)
    assert session.dropped == 0
    assert listener.seqs == list(range(400))


def test_what_waits_for_its_reader_loses_nothing_however_slow_he_is() -> None:
    source = ArraySource(SPEC, CHUNKS)
    before = threading.active_count()
    n = 0
    with Session(source, Listener(), queue_chunks=1) as session:
        for chunk, _ in session:
            n += len(chunk)
            # read in step: no further ahead than the chunk in hand, and in no other thread
            assert source.stats.delivered == n
            assert threading.active_count() == before
    assert n == 400 and session.dropped == 0


def test_a_slow_consumer_gets_the_newest_and_every_loss_is_counted() -> None:
    source = ArraySource(SPEC, CHUNKS, live=True)
    listener = Listener()
    with Session(source, listener, queue_chunks=8) as session:
        chunks = iter(session)
        first, _ = next(chunks)
        until(lambda: not reading())  # all has arrived while we did something else
        assert source.stats.delivered == 400
        rest = [chunk for chunk, _ in chunks]
    assert rest == [chunk for chunk in CHUNKS[-8:] if chunk is not first]
    assert session.dropped == 400 - len(listener.seqs) > 0
    assert listener.seqs == sorted(listener.seqs)


@pytest.mark.parametrize("error", [SourceError("whisker 3 fell off"), ZeroDivisionError("bug")])
@pytest.mark.parametrize("live", [False, True])
def test_an_error_of_the_source_reaches_the_consumer_after_the_samples_before_it(
    error: Exception, live: bool
) -> None:
    device, listener = Device(*CHUNKS[:3], error, live=live), Listener()
    with pytest.raises(type(error), match=str(error)), Session(device, listener) as session:
        for _ in session:
            pass
    assert listener.seqs == list(range(12))
    assert device.closed_by


@pytest.mark.parametrize("live", [False, True])
def test_an_error_of_the_classifier_ends_reading_at_once(live: bool) -> None:
    def fail(chunk: Chunk) -> list:
        raise ArithmeticError("no")

    device = Device(*CHUNKS, live=live)
    session = Session(device, Listener(fail))
    # Not even a caller who keeps the traceback keeps the thread.
    with pytest.raises(ArithmeticError) as caught:
        for _ in session:
            pass
    assert caught.tb is not None
    assert not reading()
    assert device.closed_by


@pytest.mark.parametrize("live", [False, True])
def test_stop_from_another_thread_ends_the_iteration(live: bool) -> None:
    device = Device(*(CHUNKS[:5] if live else CHUNKS * 1000), live=live)
    with Session(device, Listener()) as session:
        stopper = threading.Timer(0.1, session.stop)
        stopper.name = "stopper"
        stopper.start()
        began = time.monotonic()
        for _ in session:
            pass
        assert time.monotonic() - began < PATIENCE_S
        stopper.join()
        session.stop()
        assert not reading()
    assert device.closed_by
    assert "stopper" not in device.closed_by, "closed while its reader was at work"


def test_stop_from_within_the_loop_gives_nothing_more() -> None:
    for live in (False, True):
        device = Device(*CHUNKS, live=live)
        n = 0
        with Session(device, Listener()) as session:
            for _ in session:
                n += 1
                if n == 3:
                    session.stop()
        assert n == 3
        assert device.closed_by


def test_leaving_the_context_waits_for_the_reader_though_the_loop_is_still_open() -> None:
    device = Device(*CHUNKS[:2])
    with Session(device, Listener()) as session:
        chunks = iter(session)  # a caller who keeps the iterator
        next(chunks)
    assert not reading()
    assert device.closed_by
    assert list(chunks) == []


def test_a_session_that_was_stopped_gives_nothing_and_closes_its_source() -> None:
    for live in (False, True):
        device = Device(live=live)
        with Session(device, Listener()) as session:
            session.stop()
            assert list(session) == []
        assert device.closed_by and device.reads <= 1


def test_a_live_source_is_read_in_one_other_thread() -> None:
    device = Device(*CHUNKS, EndOfStream())
    with Session(device, Listener()) as session:
        assert len(list(session)) == len(CHUNKS)
    assert device.readers == {"tactile-rt-reader"}
