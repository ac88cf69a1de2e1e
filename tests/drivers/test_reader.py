"""Many devices read in one thread, and in an event loop."""

import asyncio
import threading
from contextlib import ExitStack

import numpy as np
import pytest

from tactile_rt.core.errors import SourceError
from tactile_rt.core.stream import EndOfStream, Source
from tactile_rt.drivers.health import State
from tactile_rt.drivers.reader import Reader
from tactile_rt.sources.asynchronous import chunks
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, FakeSerial, cut_chunks, small_spec
from tests.helpers.waiting import PATIENCE_S, until

SPEC = small_spec()
SAMPLES = 500
PATIENT = f"&start_s={PATIENCE_S:g}&stale_s={PATIENCE_S:g}"

pytestmark = pytest.mark.usefixtures("no_thread_left")


def values(seed=0):
    return np.random.default_rng(seed).normal(size=(SAMPLES, *SPEC.shape)).astype(np.float32)


class Got(dict):
    """What came of each source of a reader."""

    def __init__(self, reader):
        self._reader = reader

    def until(self, true):
        """Read on until that is so."""
        until(true, meanwhile=self._read)

    def _read(self):
        for source, chunk in self._reader.read(0.02):
            self.setdefault(source, []).append(chunk)

    def count(self, source):
        return sum(map(len, self.get(source, ())))


def same(found, expected):
    return np.array_equal(np.concatenate([c.values for c in found]), expected)


def test_what_each_of_many_devices_sends_comes_and_nothing_else():
    with ExitStack() as stack:
        fakes = [stack.enter_context(FakeSerial(values(k), spec=SPEC)) for k in range(5)]
        sources = [stack.enter_context(open_source(f.url + PATIENT)) for f in fakes]
        got = Got(Reader(sources))
        got.until(lambda: all(got.count(s) == SAMPLES for s in sources))
        for k, source in enumerate(sources):
            assert same(got[source], values(k))
            assert source.stats.missing == source.stats.corrupt == 0
            assert source.health.connections == 1


def test_a_line_that_is_lost_comes_again_and_holds_up_nobody(tmp_path):
    link = str(tmp_path / "tty")
    with ExitStack() as stack:
        goes = stack.enter_context(FakeSerial(values(1), spec=SPEC, link=link))
        stays = stack.enter_context(FakeSerial(values(2), spec=SPEC))
        lost, kept = (stack.enter_context(open_source(f.url + PATIENT)) for f in (goes, stays))
        got = Got(Reader([lost, kept]))
        got.until(lambda: lost in got)
        goes.unplug()
        got.until(lambda: lost.health.state == State.LOST)
        assert lost.fileno() == -1 and kept.fileno() >= 0
        goes.replug()
        before = got.count(lost)
        got.until(lambda: got.count(lost) > before)
        assert lost.fileno() >= 0 and lost.health.connections == 2
        got.until(lambda: got.count(kept) == SAMPLES)
        assert same(got[kept], values(2))


def test_a_source_without_a_line_is_read_too_and_ends():
    one, other = values(3), values(4)
    sources = [ArraySource(SPEC, cut_chunks(v, 1000.0, 50)) for v in (one, other)]
    reader = Reader(sources)
    found = list(reader)
    for source, expected in zip(sources, (one, other), strict=True):
        assert same([c for s, c in found if s is source], expected)
    assert reader.sources == [] and reader.read() == []


class Broken(Source):
    def __init__(self):
        super().__init__(SPEC)

    def read(self, timeout=None):
        raise SourceError("it burns")

    def close(self):
        pass


def test_one_that_breaks_is_told_and_the_others_go_on():
    good = ArraySource(SPEC, cut_chunks(values(), 1000.0, 50))
    broken = Broken()
    reader = Reader([broken, good])
    with pytest.raises(SourceError, match="it burns"):
        reader.read()
    assert reader.sources == [good]
    assert same([c for _, c in reader], values())


def test_one_may_come_later_and_be_taken_away():
    first, second = (ArraySource(SPEC, cut_chunks(values(k), 1000.0, 50)) for k in range(2))
    reader = Reader([first])
    assert [s for s, _ in reader.read()] == [first]
    reader.add(second)
    reader.remove(first)
    assert {s for s, _ in reader} == {second}
    assert len(first.read()) == 50  # it is still open


def test_whoever_waits_can_be_woken():
    with FakeSerial(values()[:1], spec=SPEC) as fake, open_source(fake.url + PATIENT) as source:
        reader = Reader([source])
        Got(reader).until(lambda: source.stats.delivered == 1)
        woken = threading.Timer(0.01, reader.wake)
        woken.start()
        until(lambda: reader.wait(PATIENCE_S) in ([], [source]))
        woken.join()


def test_in_an_event_loop_samples_come_beside_other_work():
    async def run():
        with FakeSerial(values(5), spec=SPEC) as fake, open_source(fake.url + PATIENT) as source:
            found, turns = [], 0

            async def work():
                nonlocal turns
                while True:
                    turns += 1
                    await asyncio.sleep(0)

            task = asyncio.create_task(work())
            async for chunk in chunks(source):
                found.append(chunk)
                if sum(map(len, found)) == SAMPLES:
                    break
            task.cancel()
            return found, turns

    found, turns = asyncio.run(run())
    assert same(found, values(5)) and turns > SAMPLES / 10


def test_in_an_event_loop_a_source_without_a_line_is_read_and_ends():
    async def run():
        source = ArraySource(SPEC, cut_chunks(values(), 1000.0, 50))
        return [chunk async for chunk in chunks(source)], source

    found, source = asyncio.run(run())
    assert same(found, values())
    with pytest.raises(EndOfStream):
        source.read()
