"""Combination of several arrays into one, with one clock and one spec.

combined:robot_head.toml, which reads

    name = "head"
    rate_hz = 1000               # of the combined stream
    [[source]]
    name = "left"
    url = "serial:///dev/ttyACM0?codec=native"
    [[source]]
    name = "right"
    url = "serial:///dev/ttyACM1?codec=native"
    position = [0.0, -0.04, 0.0]            # of its mount frame in the combined one, m
    orientation = [1.0, 0.0, 0.0, 0.0]      # unit quaternion, w x y z
"""

import contextlib
import os
import time
from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.errors import ConfigError, SourceError, TactileError
from tactile_rt.core.settings import convert, read_toml, refusal
from tactile_rt.core.stream import (
    NS_PER_S,
    ArraySpec,
    Chunk,
    EndOfStream,
    Source,
    quaternion_product,
    rotation_matrices,
)
from tactile_rt.drivers.opening import Prepared
from tactile_rt.sources.opening import check_source, open_source

LATEST_NS = NS_PER_S // 5  # an array that lags further is left out: its elements are invalid
SLICE_S = 0.005


class MemberArray(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Array to combine with others: the URL of its source, and its pose.

    Attributes:
        name: Name of the array, put before the names of its elements.
        position: Origin of the array's mount frame in the combined mount frame, m.
        orientation: Unit quaternion (w, x, y, z) that rotates the array's mount frame into the
            combined one.
    """

    name: str
    url: str
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


class _File(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    rate_hz: Annotated[float, msgspec.Meta(gt=0)]
    source: tuple[MemberArray, ...] = ()


# Nested files that are being read: no file may combine itself.
_READING: ContextVar[tuple[str, ...]] = ContextVar("_READING", default=())


def prepare_combined(path: str, fields: dict[str, str]) -> Prepared:
    """Check a TOML file of arrays to combine; return a `Prepared` that opens them.

    Raises:
        ConfigError: the file cannot be read, is not of the layout above, or a URL in it is wrong.
            Opening the returned source raises `SourceError` if a device cannot be opened.
    """
    if not path:
        raise ConfigError("combined: needs a file, e.g. combined:head.toml")
    if fields:
        raise ConfigError(f"combined:{path} takes no options: they are in the file")
    nodes = read_toml(Path(path))
    file: _File = convert(nodes, _File)
    if not file.source:
        raise ConfigError(f"{path}: no [[source]] to combine")
    place, above = os.path.realpath(path), _READING.get()
    if place in above:
        raise ConfigError(f"{path} combines itself")
    within = _READING.set((*above, place))
    specs = []
    try:
        for i, part in enumerate(file.source):
            try:
                specs.append(check_source(part.url))
            except TactileError as error:
                raise refusal(nodes, ["source", i, "url"], str(error)) from None
    finally:
        _READING.reset(within)

    def open_all() -> Source:
        with contextlib.ExitStack() as stack:
            sources = [stack.enter_context(open_source(part.url)) for part in file.source]
            made = CombinedSource(sources, file.source, file.name, file.rate_hz)
            stack.pop_all()
            return made

    known = [spec for spec in specs if spec is not None]
    if len(known) < len(specs):
        return Prepared(None, open_all)
    return Prepared(combine_specs(known, file.source, file.name, file.rate_hz), open_all)


def combine_specs(
    specs: list[ArraySpec], parts: Sequence[MemberArray], name: str, rate_hz: float
) -> ArraySpec:
    """Combine array specs into one, with each array's grid rows below the previous array's.

    Raises:
        ConfigError: the arrays do not measure the same channels, or two have the same name.
    """
    for spec, part in zip(specs, parts, strict=True):
        if (spec.channels, spec.units) != (specs[0].channels, specs[0].units):
            raise ConfigError(
                f"{part.name} measures {', '.join(spec.channels)} ({', '.join(spec.units)}), "
                f"{parts[0].name} {', '.join(specs[0].channels)} ({', '.join(specs[0].units)}): "
                "combined arrays must measure the same"
            )
    grid, rows = [], 0
    positions, orientations = [], []
    for spec, part in zip(specs, parts, strict=True):
        grid += [(rows + r, c) for r, c in spec.grid]
        rows += spec.grid_shape[0]
        orient = np.array(part.orientation)
        if abs(np.linalg.norm(orient) - 1) > 1e-6:
            raise ConfigError(f"{part.name}: orientation {part.orientation} is no unit quaternion")
        positions += [tuple(rotation_matrices(orient) @ p + part.position) for p in spec.positions]
        orientations += [tuple(quaternion_product(orient, q)) for q in spec.orientations]
    return replace(
        specs[0],
        name=name,
        elements=tuple(
            f"{part.name}.{e}" for s, part in zip(specs, parts, strict=True) for e in s.elements
        ),
        grid=tuple(grid),
        positions=tuple((float(x), float(y), float(z)) for x, y, z in positions),
        orientations=tuple((float(w), float(x), float(y), float(z)) for w, x, y, z in orientations),
        rate_hz=rate_hz,
        frame=name,
    )


@dataclass
class _Feed:
    """Resampler and undelivered samples of one source of a `CombinedSource`."""

    source: Source
    resampler: Resampler
    begin: int  # index of its first element among all
    rows: dict[int, tuple[NDArray[np.float32], NDArray[np.bool_]]]
    newest: int | None = None  # newest grid point
    ended: bool = False


class CombinedSource(Source):
    """Source that joins the samples of several sources, resampled to common times.

    An array that is more than 0.2 s behind, lost or at its end is left out: its elements are
    invalid until its samples come again. The stream ends when all sources have ended.

    Args:
        sources: The sources to combine; closed with this one.
    """

    def __init__(
        self, sources: list[Source], parts: Sequence[MemberArray], name: str, rate_hz: float
    ) -> None:
        super().__init__(combine_specs([s.spec for s in sources], parts, name, rate_hz))
        self.live = any(s.live for s in sources)
        self.sources = sources
        period = round(NS_PER_S / rate_hz)
        begins = np.cumsum([0, *(len(s.spec.elements) for s in sources)]).tolist()
        self._feeds = [
            _Feed(s, Resampler(period, s.spec.rate_hz, aligned=True), begin, {})
            for s, begin in zip(sources, begins, strict=False)
        ]
        self._period_ns = period
        self._next: int | None = None  # next grid point to deliver
        self._first = 0
        self._closed = False

    def read(self, timeout: float | None = None) -> Chunk | None:
        end, over = None if timeout is None else time.monotonic() + timeout, False
        while not self._closed:
            if (chunk := self._take_ready()) is not None:
                self.stats.delivered += len(chunk)
                return chunk
            if over:
                return None
            if all(feed.ended for feed in self._feeds):
                break
            left = SLICE_S if end is None else min(SLICE_S, max(0.0, end - time.monotonic()))
            self._read_on(left)
            over = end is not None and time.monotonic() >= end
        raise EndOfStream

    def close(self) -> None:
        self._closed = True
        for source in self.sources:
            source.close()

    def _read_on(self, patience_s: float) -> None:
        """Read the source that is furthest behind, then the others until one has samples."""
        running = [feed for feed in self._feeds if not feed.ended]
        running.sort(key=lambda feed: -1 if feed.newest is None else feed.newest)
        for feed in running:
            if self._read_feed(feed, patience_s):
                return
            patience_s = 0.0

    def _read_feed(self, feed: _Feed, patience_s: float) -> bool:
        try:
            chunk = feed.source.read(patience_s)
        except EndOfStream:
            feed.ended = True
            return True
        except SourceError:
            feed.ended = True
            if all(f.ended for f in self._feeds):
                raise
            return True
        if chunk is None:
            return False
        out = feed.resampler.push(chunk)
        if out is not None:
            for k, values, valid in zip(out.seq.tolist(), out.values, out.valid, strict=True):
                feed.rows[k] = values, valid
            feed.newest = int(out.seq[-1])
        return True

    def _take_ready(self) -> Chunk | None:
        """Remove and return the combined samples that are complete or overdue."""
        reached = [feed.newest for feed in self._feeds if feed.newest is not None]
        if not reached:
            return None
        if self._next is None:
            waiting = any(f.newest is None and not f.ended for f in self._feeds)
            span = max(reached) - min(min(f.rows) for f in self._feeds if f.rows)
            if waiting and span * self._period_ns < LATEST_NS:
                return None
            self._next = self._first = max(min(f.rows) for f in self._feeds if f.rows)
        newest = max(reached)
        behind = LATEST_NS // self._period_ns
        ready = min(
            newest if f.ended else max(newest - behind, -1 if f.newest is None else f.newest)
            for f in self._feeds
        )
        n = ready + 1 - self._next
        if n <= 0:
            return None
        values = np.zeros((n, *self.spec.shape), np.float32)
        valid = np.zeros(values.shape[:2], np.bool_)
        for feed in self._feeds:
            stop = feed.begin + len(feed.source.spec.elements)
            for k in [k for k in feed.rows if k <= ready]:
                row, good = feed.rows.pop(k)
                if k >= self._next:
                    values[k - self._next, feed.begin : stop] = row
                    valid[k - self._next, feed.begin : stop] = good
        points = np.arange(self._next, ready + 1, dtype=np.int64)
        self._next = ready + 1
        return Chunk(points - self._first, points * self._period_ns, values, valid)
