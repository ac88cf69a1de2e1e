"""Sources lent to the one thread that reads all lines."""

import os
import threading
from unittest import mock

import numpy as np
import pytest

from tactile_rt.core.stream import Chunk, SourceStats
from tactile_rt.daemon import source_part as module
from tactile_rt.daemon.source_part import Acquisition
from tactile_rt.testing import small_spec
from tests.helpers.waiting import PATIENCE_S, until

SPEC = small_spec()
pytestmark = pytest.mark.usefixtures("no_thread_left")


class PipedSource:
    """A source whose line is a pipe: each byte is a sample, and what is read is counted."""

    spec, live = SPEC, True

    def __init__(self):
        self._read, self.write = os.pipe()
        os.set_blocking(self._read, False)
        self.samples = 0

    @property
    def stats(self):
        return SourceStats(samples=self.samples)

    def fileno(self):
        return self._read

    def read(self, timeout_s=0.0):
        try:
            n = len(os.read(self._read, 100))
        except BlockingIOError:
            return None
        if n == 0:  # nobody writes any more
            os.close(self._read)
            self._read = -1
            return None
        seq = np.arange(self.samples, self.samples + n)
        self.samples += n
        shape = (n, *SPEC.shape)
        return Chunk(seq, seq, np.zeros(shape, np.float32), np.ones(shape[:2], bool))

    def hang_up(self):
        os.close(self.write)
        self.write = -1

    def close(self):
        for fd in (self.write, self._read):
            if fd >= 0:
                os.close(fd)


@pytest.fixture
def source():
    source = PipedSource()
    yield source
    source.close()


class Lent:
    """A source in an acquisition, and what came of it."""

    def __init__(self, lines, source, most=1 << 30):
        self.came, self.error, self._most = 0, None, most
        self.attending = threading.Thread(target=self._attend, args=(lines, source))
        self.attending.start()

    def _attend(self, lines, source):
        try:
            lines.attend(source, self._take, lambda: self.came < self._most)
        except OSError as error:
            self.error = error

    def _take(self, chunk):
        self.came += len(chunk) if chunk is not None else 0

    def over(self):
        self.attending.join(PATIENCE_S)
        return not self.attending.is_alive()


def test_one_that_is_not_wanted_any_more_has_delivered_all_that_was_read_of_it(source):
    os.write(source.write, bytes(300))
    lent = Lent(Acquisition(), source, most=150)
    assert lent.over()
    assert lent.came == source.samples == 200  # the line holds the others


def test_a_source_goes_back_to_who_lent_it_when_its_line_is_lost(source):
    os.write(source.write, bytes(42))
    lent = Lent(Acquisition(), source)
    until(lambda: lent.came == 42)
    source.hang_up()
    assert lent.over()
    assert lent.error is None


def test_what_reading_raises_is_raised_where_it_was_lent_and_the_others_go_on(source):
    lines, other = Acquisition(), PipedSource()
    try:
        goes_on = Lent(lines, other)
        os.write(other.write, bytes(1))
        until(lambda: goes_on.came == 1)

        def breaks(timeout_s=0.0):
            raise OSError("the line is broken")

        source.read = breaks
        os.write(source.write, bytes(1))
        broken = Lent(lines, source)
        assert broken.over()
        assert str(broken.error) == "the line is broken"
        os.write(other.write, bytes(5))
        until(lambda: goes_on.came == 6)
        other.hang_up()
        assert goes_on.over()
    finally:
        other.close()


def test_a_thread_that_cannot_be_started_is_started_for_the_next_one(source, monkeypatch):
    lines = Acquisition()
    with monkeypatch.context() as short:
        short.setattr(module.threading, "Thread", mock.Mock(side_effect=RuntimeError("no thread")))
        with pytest.raises(RuntimeError, match="no thread"):
            lines.attend(source, lambda chunk: None, lambda: True)
    os.write(source.write, bytes(42))
    lent = Lent(lines, source)
    until(lambda: lent.came == 42)
    source.hang_up()
    assert lent.over() and source.samples == 42
