"""What every source promises, as tests: `test_source_contract.py` lists the sources.

A case opens its source afresh each time. Most sources are their own context manager, so the class
or a lambda will do; one that needs a device beside it is a generator function under
`contextlib.contextmanager` that yields the source.
"""

import functools
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np
import pytest

from tactile_rt.core.stream import Chunk, EndOfStream, Source, SourceStats, concatenate
from tests.helpers.waiting import PATIENCE_S

AT_ONCE_S = 0.5  # nobody sleeps that long by accident, and a busy machine is forgiven


@dataclass(frozen=True)
class Case:
    """One source under contract."""

    open: Callable[[], AbstractContextManager[Source]]  # opens the source, in a `with`
    # number of samples before the end; None when that is the source's own affair
    samples: int | None = None
    rate_tolerance: float = 1e-3  # share by which the measured rate may be off the nominal one
    # time that the stream as a whole may be too short, s: a device's clock is known by prompt
    # arrivals, and on a busy machine the first ones are not
    settling_s: float = 0.0
    # whether the source never ends by itself, as devices do not, and is to be closed after
    # `samples`
    endless: bool = False
    # whether the source leaves samples out, and counts them, where the processor is taken from it
    # for too long
    stands_still: bool = False


@dataclass(frozen=True)
class Run:
    """A stream read from its first sample to its end."""

    source: Source
    chunks: list[Chunk]
    copies: list[tuple[np.ndarray, ...]]
    arrived_ns: list[int]  # host time of every chunk's delivery
    stats: SourceStats
    ends: int  # how many of three reads after the end raised EndOfStream


def _parts(chunk: Chunk) -> tuple[np.ndarray, ...]:
    return chunk.seq, chunk.t_ns, chunk.values, chunk.valid


def take(source: Source, samples: int) -> Chunk:
    """Read until there are at least so many samples."""
    chunks: list[Chunk] = []
    while sum(map(len, chunks)) < samples:
        chunk = source.read()
        assert chunk is not None
        chunks.append(chunk)
    return concatenate(chunks)


@functools.cache
def read_all(case: Case) -> Run:
    """Read a case's source until it ends; once for all tests that look at the run."""
    chunks, copies, arrived_ns, ends = [], [], [], 0
    give_up = time.monotonic() + PATIENCE_S
    with case.open() as source:
        while ends < 3:
            assert time.monotonic() < give_up, "the stream does not end"
            try:
                chunk = source.read(0.5)
            except EndOfStream:
                ends += 1
                continue
            assert not ends, "a sample after the end"
            if chunk is not None:
                arrived_ns.append(time.monotonic_ns())
                chunks.append(chunk)
                copies.append(tuple(part.copy() for part in _parts(chunk)))
                if case.endless and source.stats.delivered >= (case.samples or 0):
                    source.close()
        return Run(source, chunks, copies, arrived_ns, source.stats, ends)


class SourceContract:
    """Subclass it with a module-wide fixture `case`."""

    @pytest.fixture
    def run(self, case: Case) -> Run:
        return read_all(case)

    def test_shapes_and_types_are_the_spec_s(self, run: Run) -> None:
        assert run.chunks
        for chunk in run.chunks:
            n = len(chunk)
            assert n >= 1
            assert chunk.seq.shape == chunk.t_ns.shape == (n,)
            assert chunk.values.shape == (n, *run.source.spec.shape)
            assert chunk.valid.shape == (n, run.source.spec.shape[0])
            assert [part.dtype for part in _parts(chunk)] == ["int64", "int64", "float32", "bool"]

    def test_what_is_valid_is_finite(self, run: Run) -> None:
        for chunk in run.chunks:
            assert np.isfinite(chunk.values[chunk.valid]).all()

    def test_no_sample_is_lost_between_chunks(self, run: Run, case: Case) -> None:
        steps = np.diff(np.concatenate([c.seq for c in run.chunks]))
        assert (steps >= 1).all()
        assert (steps - 1).sum() == (run.stats.dropped if case.stands_still else 0)

    def test_time_runs_forward_at_the_nominal_rate(self, run: Run, case: Case) -> None:
        t, seq = (
            np.concatenate([getattr(c, name) for c in run.chunks]) for name in ("t_ns", "seq")
        )
        steps, nominal = np.diff(t), run.source.spec.rate_hz
        assert (steps > 0).all()
        assert 1e9 / np.median(steps) == pytest.approx(nominal, rel=case.rate_tolerance)
        seconds = (seq[-1] - seq[0]) / nominal
        off = case.rate_tolerance * seconds + case.settling_s
        assert (t[-1] - t[0]) * 1e-9 == pytest.approx(seconds, abs=off)

    def test_a_live_source_has_no_samples_from_the_future(self, run: Run) -> None:
        if run.source.live:
            for chunk, arrived in zip(run.chunks, run.arrived_ns, strict=True):
                assert chunk.t_ns[-1] <= arrived

    def test_every_sample_delivered_is_counted_once(self, run: Run, case: Case) -> None:
        n = sum(len(c) for c in run.chunks)
        dropped = run.stats.dropped if case.stands_still else 0
        assert run.stats == SourceStats(delivered=n, dropped=dropped)
        assert case.samples in (None, n)

    def test_the_end_is_told_again_and_again(self, run: Run) -> None:
        assert run.ends == 3

    def test_a_chunk_once_delivered_never_changes(self, run: Run) -> None:
        for chunk, copy in zip(run.chunks, run.copies, strict=True):
            for now, then in zip(_parts(chunk), copy, strict=True):
                assert np.array_equal(now, then)

    def test_a_read_without_patience_returns_at_once_and_closing_ends_it(self, case: Case) -> None:
        with case.open() as source:
            took = []
            for _ in range(20):
                began = time.monotonic()
                chunk = source.read(timeout=0)
                took.append(time.monotonic() - began)
                assert chunk is None or isinstance(chunk, Chunk)
            assert sorted(took)[10] < AT_ONCE_S  # a busy machine may hold up some of them
            assert source.read(PATIENCE_S) is not None
            source.close()
            source.close()
            for _ in range(2):
                with pytest.raises(EndOfStream):
                    source.read(0)
            assert list(source) == []

    def test_iteration_goes_from_the_first_chunk_to_the_last(self, run: Run, case: Case) -> None:
        with case.open() as source:
            n = 0
            for chunk in source:
                n += len(chunk)
                if case.endless and n >= (case.samples or 0):
                    break
        assert n == source.stats.delivered == run.stats.delivered

    def test_two_are_two_things_and_end_when_closed_or_left_unread(self, case: Case) -> None:
        with case.open() as one, case.open() as other:
            assert one != other
            assert len({one, other}) == 2
            one.close()
            with pytest.raises(EndOfStream):
                one.read(0)
        with pytest.raises(EndOfStream):
            other.read(0)
