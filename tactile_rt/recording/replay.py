"""`replay:` URLs: recordings and sweep sets played back as streams.

replay:run.mcap                                   the recorded chunks, at the recorded pace
replay:run.mcap?speed=10                          ten times as fast; 0: as fast as they are read
replay:run.mcap?loop=true                         over and over
replay:run.mcap?from=wire                         raw packets, decoded again
replay:run.mcap?from=wire&codec=native            by another codec than the recorded one
replay:data/default24/mug-1.npz?sweep=3&rest_s=1    one object's sweeps out of a sweep set
replay:demo?loop=true                             the recording that comes with the package
"""

import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.files import open_regular
from tactile_rt.core.settings import take_options
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source, SourceStats
from tactile_rt.drivers.clocks import DeviceTime, Stamper
from tactile_rt.drivers.codec import Codec, Command, Samples
from tactile_rt.drivers.opening import Prepared, make_codec
from tactile_rt.recording.layout import SAMPLES, WIRE, Packet
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.records import MAGIC
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import read_object

# `replay:demo`: six objects sweep past simulated whiskers; made by bench/write_demo.py.
DEMO = Path(__file__).parents[1] / "assets" / "demo.mcap"
NPZ = b"PK"  # first bytes of such a file
SWEEP_CHUNK_NS = 9_000_000  # length of a chunk, as of other sources
SLICE_S = 0.1  # time after which a waiting read notices that the source was closed, at most

# Chunks with the time at which each is due: ns on any clock, with any zero.
Timed = Iterator[tuple[int, Chunk]]


@dataclass(frozen=True)
class ReplayOptions:
    """Options of ``replay:`` of a recording, in addition to those of its codec."""

    # pace of the stream, as a multiple of the recorded one; 0 for as fast as it is read
    speed: float = 1.0
    codec: str = ""  # name of the codec that decodes raw packets; empty for the recorded one
    # whether the recording begins again at its end; sample numbers and times continue
    loop: bool = False


def prepare_replay(target: str, fields: dict[str, str]) -> Prepared:
    """Prepare a recording, or one object of a sweep set, for opening as a source.

    Raises:
        ConfigError: no such file, a wrong option, or the extra is not installed.
    """
    path, what = Path(target), f"replay:{target}"
    if not target:
        raise ConfigError("replay: needs a file, e.g. replay:run.mcap, replay:data/SET/mug-1.npz")
    if target == "demo":  # a file of that name is ./demo
        path = DEMO
    _check_file(path)
    if path.suffix == ".npz":
        sweeps = _take_options(what, fields, SweepOptions)
        manifest = SweepManifest.read(path.parent)
        spec = replace(manifest.spec, rate_hz=NS_PER_S / manifest.period_ns)

        def sweep(_: SourceStats) -> Timed:
            return _read_sweeps(path, manifest, sweeps)

        return Prepared(spec, partial(ReplaySource, spec, sweep, sweeps.speed, loop=sweeps.loop))
    fields = dict(fields)
    channel = fields.pop("from", SAMPLES)
    recording = Recording(path)
    about = recording.description
    if channel == SAMPLES:
        options = _take_options(what, fields, ReplayOptions)
        if options.codec:
            raise ConfigError(f"{what}: codec= is for from=wire; samples are decoded already")
        chunks, calibrated = partial(_read_chunks, recording), about.calibration is not None
        arguments = (about.spec, chunks, options.speed, calibrated, options.loop)
        return Prepared(about.spec, partial(ReplaySource, *arguments))
    if channel != WIRE:
        raise ConfigError(f"{what}: from must be samples or wire, not {channel!r}")
    if not about.wire:
        raise ConfigError(f"{what} has no raw packets: {about.source or 'its source'} is no device")
    ours = [k for k in fields if k in ReplayOptions.__dataclass_fields__]
    options = _take_options(what, {k: fields[k] for k in ours}, ReplayOptions)
    own = {k: v for k, v in fields.items() if k not in ours}
    same = options.codec in ("", about.codec)
    if same:
        own = {**about.codec_options, **own}
    declared = own.pop("array", "")  # the array that the device was declared to be
    array = ArraySpec.from_json(declared) if declared else None

    def new_codec() -> Codec[Any]:
        codec = make_codec(about.wire, options.codec or about.codec, own)
        codec.spec = codec.spec or array
        return codec

    def decode() -> _Decoder:
        return _Decoder(str(path), new_codec(), recording.packets(), about.clock)

    def open_decoded() -> Source:
        first = [decode()]  # it has the array's spec; each further pass is decoded anew
        return ReplaySource(
            first[0].spec, lambda stats: (first.pop() if first else decode()).chunks(stats),
            options.speed, loop=options.loop,
        )  # fmt: skip

    prepared = Prepared(new_codec().spec, open_decoded)
    if about.calibration is not None:
        prepared = prepared.with_calibration(about.calibration)
    # A device's own description is among the recorded packets.
    return replace(prepared, spec=about.spec) if same and not prepared.spec else prepared


def _check_file(path: Path) -> None:
    """Raise an error unless a path is a file in MCAP or npz form."""
    if not os.path.isfile(path):
        raise ConfigError(f"no file {path}")
    try:
        with open_regular(path) as file:
            begins = file.read(len(MAGIC))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    if begins != MAGIC and not begins.startswith(NPZ):
        raise RecordingError(f"{path} is no recording: it is neither MCAP nor npz")


def _take_options(what: str, fields: dict[str, str], kind: type[Any]) -> Any:
    (options,) = take_options(what, fields, kind)
    if not 0 <= (speed := options.speed) < math.inf:
        raise ConfigError(f"{what}: speed must be 0 (as fast as it is read) or more, not {speed:g}")
    return options


class ReplaySource(Source):
    """Source that delivers stored chunks, each when it is due.

    The chunks, their times and all decisions on them do not depend on the speed. A recording is not
    live at any speed: it waits for its reader, so a slow reader falls behind the pace but loses
    nothing.

    Args:
        timed: yields (due time in ns, chunk); it counts lost samples in its argument.
        speed: multiple of the recorded pace; 0 to deliver each chunk at once.
        loop: whether to begin again at the end, with numbers and times that continue.
    """

    live = False

    def __init__(
        self,
        spec: ArraySpec,
        timed: Callable[[SourceStats], Timed],
        speed: float = 1.0,
        calibrated: bool = False,
        loop: bool = False,
    ) -> None:
        super().__init__(spec)
        self.calibrated = calibrated
        self._speed = speed
        self._timed = self._repeat(timed) if loop else timed(self.stats)
        self._next: tuple[int, Chunk] | None = None
        self._begin: tuple[int, int] | None = None  # due time and host time of the first chunk
        self._closed = False

    def read(self, timeout: float | None = None) -> Chunk | None:
        end = None if timeout is None else time.monotonic() + timeout
        while not self._closed:
            if self._next is None:
                self._next = next(self._timed, None)
                if self._next is None:
                    self.close()
                    break
            due, chunk = self._next
            wait = self._find_wait_s(due)
            if wait <= 0:
                self._next = None
                self.stats.delivered += len(chunk)
                return chunk
            left = math.inf if end is None else end - time.monotonic()
            if left <= 0:
                return None
            time.sleep(min(wait, left, SLICE_S))
        raise EndOfStream

    def close(self) -> None:
        self._closed = True
        try:
            self._timed.close()  # type: ignore[attr-defined]  # it closes the file
        except ValueError:
            pass  # another thread is reading: its next read ends

    def _repeat(self, timed: Callable[[SourceStats], Timed]) -> Timed:
        """Repeat the stream for ever; each pass begins one sample period after the last."""
        period = round(NS_PER_S / self.spec.rate_hz)
        end: tuple[int, int] | None = None  # number and time of the next sample
        while True:
            shift: tuple[int, int] | None = None  # added to numbers and times of this pass
            for due, chunk in timed(self.stats):
                if shift is None:
                    begins = int(chunk.seq[0]), int(chunk.t_ns[0])
                    shift = (end[0] - begins[0], end[1] - begins[1]) if end else (0, 0)
                chunk = replace(chunk, seq=chunk.seq + shift[0], t_ns=chunk.t_ns + shift[1])
                end = int(chunk.seq[-1]) + 1, int(chunk.t_ns[-1]) + period
                yield due + shift[1], chunk
            if shift is None:
                return  # the stream is empty

    def _find_wait_s(self, due: int) -> float:
        if not self._speed:
            return 0.0
        now = time.monotonic_ns()
        if self._begin is None:
            self._begin = due, now
        since = (due - self._begin[0]) / self._speed
        return (since - (now - self._begin[1])) / NS_PER_S


def _read_chunks(recording: Recording, stats: SourceStats) -> Timed:
    """Yield the recorded chunks; count gaps in their numbers as missing samples."""
    after: int | None = None
    for chunk in recording:
        first, last = int(chunk.seq[0]), int(chunk.seq[-1])
        before = first if after is None else after
        stats.missing += max(0, last + 1 - before - len(chunk))
        after = last + 1
        yield int(chunk.t_ns[-1]), chunk


class _Decoder:
    """Decoder of recorded packets; it time-stamps samples as `DeviceSource` does live.

    Raises:
        RecordingError: the codec finds no description of the array in the packets.
    """

    def __init__(
        self, path: str, codec: Codec[Any], packets: Iterator[tuple[Packet, int]], clock: str
    ) -> None:
        self._codec, self._packets, self._clock = codec, packets, clock
        self._early: list[tuple[Samples | None, int]] = []
        # Samples that come before the device has described itself wait, as in a live start.
        while codec.spec is None:
            found = next(packets, None)
            if found is None:
                break
            self._early += self._decode(*found)
        if codec.spec is None:
            raise RecordingError(
                f"{path}: codec {type(codec).__name__} finds no description of an array in its "
                f"packets ({codec.stats.corrupt} damaged, {codec.stats.intact} intact frames)"
            )
        self.spec = codec.spec

    def chunks(self, stats: SourceStats) -> Timed:
        """Yield (arrival in ns of the packet that completes the chunk, chunk)."""
        codec = self._codec
        stamper = Stamper(codec, self.spec, stats, steady=self._clock != "log")
        if self._clock == "device" and codec.tick_ns is not None:
            stamper.clock = DeviceTime(codec.tick_ns, codec.tick_bits)
        connected = False
        later = chain.from_iterable(self._decode(packet, t_ns) for packet, t_ns in self._packets)
        for samples, t_ns in chain(self._early, later):
            if samples is None:
                if connected:
                    stamper.resume()
                connected = True
                continue
            chunk = stamper.chunk(samples)
            if chunk is not None:
                yield t_ns, chunk

    def _decode(self, packet: Packet, t_ns: int) -> list[tuple[Samples | None, int]]:
        if packet is None:
            self._codec.forget()
            self._codec.commands(Command.START)  # some codecs store what they have requested
            return [(None, t_ns)]
        samples = self._codec.feed(packet, t_ns)
        return [] if samples is None else [(samples, t_ns)]


@dataclass(frozen=True)
class SweepOptions:
    """Options of ``replay:`` of a sweep set's object."""

    speed: float = 1.0  # pace as a multiple of real time; 0 for as fast as it is read
    # whether the sweeps begin again at their end; sample numbers and times continue
    loop: bool = False
    # number of the only sweep to stream, from 0; None to stream all, one after another
    sweep: int | None = None
    # rest before each sweep, s, in addition to the stored lead, so that the contact ends and a new
    # baseline is taken before the next sweep
    rest_s: float = 0.5

    def __post_init__(self) -> None:
        if not 0 <= self.rest_s <= 3600:
            raise ConfigError(f"rest_s must be 0 to 3600 s, not {self.rest_s:g}")


def _read_sweeps(path: Path, manifest: SweepManifest, options: SweepOptions) -> Timed:
    """Read and check the sweeps of an object; yield them in chunks."""
    values, _ = read_object(path.parent, path.stem)
    if values.ndim != 4 or values.shape[2:] != manifest.spec.shape or not values.shape[1]:
        raise RecordingError(
            f"{path} holds {values.shape}, not (sweep, sample, *{manifest.spec.shape})"
        )
    which = range(len(values)) if options.sweep is None else [options.sweep]
    if options.sweep is not None and not 0 <= options.sweep < len(values):
        raise ConfigError(f"{path} has sweeps 0 to {len(values) - 1}, not {options.sweep}")
    sweeps = (values[k].astype(np.float32) for k in which)
    return _cut_sweeps(sweeps, round(options.rest_s * NS_PER_S / manifest.period_ns), manifest)


def _cut_sweeps(sweeps: Iterator[np.ndarray], rest: int, manifest: SweepManifest) -> Timed:
    period, size = manifest.period_ns, max(1, SWEEP_CHUNK_NS // manifest.period_ns)
    first = 0
    for sweep in sweeps:
        # The rest repeats the lead, so that it has the noise of the sweep.
        lead = sweep[: max(1, manifest.lead)]
        stream = np.concatenate([np.resize(lead, (rest, *lead.shape[1:])), sweep])
        for at in range(0, len(stream), size):
            piece = stream[at : at + size]
            seq = first + at + np.arange(len(piece), dtype=np.int64)
            t_ns = seq * period
            yield int(t_ns[-1]), Chunk(seq, t_ns, piece, np.isfinite(piece).all(axis=2))
        first += len(stream)
