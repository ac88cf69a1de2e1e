"""Which codec do these bytes, or these frames of a CAN bus, speak?

What is needed: an answer from one second of a line that is cut anywhere, in the middle of a frame,
of a device with a protocol that is checked or hardly so; and none where nothing fits.

The plan. Every codec is fed with all of it, also with the options that change what its device sends
(`Codec.variants`). A codec fits if it found frames, made samples of them, and left little beside.
If several do, the one whose frames prove more is right: the same bytes are fed once more with a bit
in every so many turned over, and whoever does not notice had no reason to believe them before. On a
bus two identifiers in a row prove little; there it counts that a sensor hardly ever measures the
most that it can.
"""

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.stream import EndOfStream
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import CanFrame, Codec, Command, codec_class
from tactile_rt.drivers.device_source import DeviceOptions, DeviceSource
from tactile_rt.drivers.links import Link, SerialLink
from tactile_rt.drivers.opening import make_codec, open_line

LOOK_BYTES: Final = 65_536
LOOK_FRAMES: Final = 20_000
PIECE: Final = 512  # bytes fed at a time
LEAST: Final = 3  # frames, and samples of a device that is known
EXPLAINED: Final = 0.6  # of the bytes
EXPLAINED_UNPROVED: Final = 0.95  # by frames in which no damage is noticed
PROVED: Final = 0.1
OF_THE_BUS: Final = 0.02  # of its frames: other devices may be on it
COMPLETE: Final = 0.5  # of the samples
BORNE: Final = 0.9  # of the full scale: a load is less, but for a blow
DAMAGE_EVERY: Final = 24  # bytes
NEEDS_A_FILE: Final = ("mapping", "columns")  # options without which there is no such codec
# Of boards that print, besides those that codecs name.
SPEEDS: Final = (9600, 57600, 230_400, 38_400, 250_000, 500_000)
FIRST_S: Final = 2.5  # for a board that begins anew when its port is opened
START_S: Final = 0.6  # for a device that was asked
MOST_BYTES: Final = 262_144

Heard = tuple[int, str, bytes]  # baud, parity, what came
Tried = tuple[str, Mapping[str, str]]  # codec, options


@dataclass(frozen=True)
class CodecFit:
    """A codec that fits.

    Attributes:
        samples: Number of samples; of a device that has not described itself 0.
        explained: Part of the bytes, or of the bus's frames, that is of this device's frames.
        proof: Part of damaged frames that the codec notices, 0 to 1.
    """

    wire: str
    codec: str
    options: Mapping[str, str]
    intact: int
    corrupt: int
    samples: int
    explained: float
    proof: float = 0.0
    described: bool = True
    likely: bool = True

    @property
    def fields(self) -> dict[str, str]:
        """The codec with its options, as in a URL."""
        return {"codec": self.codec, **self.options}


def sniff_bytes(data: bytes, further: Sequence[Tried] = ()) -> list[CodecFit]:
    """The codecs that fit what came over a serial line, the best first; none where none does.

    Args:
        data: bytes as they came, cut anywhere; the first 64 kB are looked at, and where nothing
            fits them, the second half of these.
    """
    data = data[:LOOK_BYTES]
    # what comes first may be a device that starts, or the line before it was plugged in
    return _fitting(data, further) or _fitting(data[len(data) // 2 :], further)


def _fitting(data: bytes, further: Sequence[Tried]) -> list[CodecFit]:
    if any(data[p:] == data[:-p] for p in (1, 2, 3, 4)):
        return []  # nothing is said in it
    pieces, worse = (
        [whole[at : at + PIECE] for at in range(0, len(data), PIECE)]
        for whole in (data, _damaged(data))
    )
    fits = []
    for codec, options in _candidates("serial", further, ()):
        fit = _fed("serial", codec, options, pieces, len(data))
        if not fit.likely or fit.explained < EXPLAINED or fit.corrupt > 2 * fit.intact:
            continue
        again = _fed("serial", codec, options, worse, len(data))
        fit = replace(fit, proof=1.0 - min(1.0, again.intact / fit.intact))
        if fit.proof >= PROVED or fit.explained >= EXPLAINED_UNPROVED:
            fits.append(fit)
    return _ranked(fits)


def sniff_frames(frames: Sequence[CanFrame], further: Iterable[Tried] = ()) -> list[CodecFit]:
    """The codecs that fit frames of a CAN bus, the best first; none where none does.

    Args:
        frames: as they came; other devices may be on the bus.
    """
    frames = frames[:LOOK_FRAMES]
    packets = [[frame] for frame in frames]
    counts = Counter(f.id for f in frames if not f.extended)
    seen = {i for i, n in counts.items() if n >= max(LEAST, OF_THE_BUS * len(frames) / 4)}
    fits = []
    for codec, options in _candidates("can", further, seen):
        fit = _fed("can", codec, options, packets, len(frames))
        if fit.likely and fit.explained >= OF_THE_BUS and 4 * fit.corrupt <= fit.intact:
            fits.append(fit)
    return _ranked(fits)


def _candidates(
    wire: str, further: Iterable[Tried], seen: Collection[int]
) -> Iterable[tuple[str, dict[str, str]]]:
    for codec, options in further:
        make_codec(wire, codec, dict(options))  # refused before anything is fed
        yield codec, dict(options)
    for name, kind in _codecs(wire):
        if not _needs_file(kind):
            yield from ((name, options) for options in ({}, *kind.variants(seen)))


def _codecs(wire: str) -> Iterator[tuple[str, type[Codec[Any]]]]:
    """List the codecs of a wire, but those whose library is not installed."""
    for of, name in CODECS:
        if of == wire:
            with suppress(ConfigError):
                yield name, codec_class(wire, name)


def _needs_file(kind: type[Codec[Any]]) -> bool:
    return bool(set(NEEDS_A_FILE) & set(kind.Options.__dataclass_fields__))


def _fed(
    wire: str, name: str, options: Mapping[str, str], packets: Sequence[Any], total: int
) -> CodecFit:
    codec: Codec[Any] = make_codec(wire, name, dict(options))
    samples, valid = 0, 0.0
    limit = np.inf if codec.full_scale is None else BORNE * np.array(codec.full_scale)
    for packet in packets:
        found = codec.feed(packet, 0)
        if found is not None:
            samples += len(found)
            good = found.valid & ~np.any(np.abs(found.values) > limit, axis=2)
            valid += float(good.mean()) * len(found)
    stats = codec.stats
    described = codec.spec is not None
    if described and min(valid, samples - stats.incomplete) < COMPLETE * samples:
        samples = 0
    silent = not described or bool(codec.complaint)  # there may be samples all the same
    return CodecFit(
        wire, name, options, stats.intact, stats.corrupt, samples,
        max(0.0, 1.0 - stats.skipped / max(1, total)), described=described,
        likely=stats.intact >= LEAST and (samples >= LEAST - 1 or silent),
    )  # fmt: skip


def _damaged(data: bytes) -> bytes:
    """The bytes with one bit of every so many turned over, the same ones every time."""
    hurt = np.frombuffer(data, np.uint8).copy()
    draw = np.random.default_rng(0)
    at = np.arange(DAMAGE_EVERY // 2, len(hurt), DAMAGE_EVERY)
    hurt[at] ^= (1 << draw.integers(0, 8, len(at))).astype(np.uint8)
    return hurt.tobytes()


def _ranked(fits: list[CodecFit]) -> list[CodecFit]:
    """The best first: what explains more, or as much with more proof, or with fewer options."""
    return sorted(fits, reverse=True, key=lambda fit: (
        round(min(1.0, fit.explained) * (0.5 + 0.5 * fit.proof), 1),
        round(fit.explained, 2), -len(fit.options), fit.intact,
    ))  # fmt: skip


# what comes over a line that nobody knows anything about


def line_speeds() -> list[tuple[int, str]]:
    """(baud, parity) of every serial codec, the most usual first, then of other boards."""
    found: list[tuple[int, str]] = []
    for name, kind in _codecs("serial"):
        codec: Any = kind if _needs_file(kind) else make_codec("serial", name, {})
        found.append((codec.baud, codec.parity))
    usual = sorted(set(found), key=lambda speed: (-found.count(speed), speed))
    return usual + [(s, "N") for s in SPEEDS if (s, "N") not in usual]


def hear_port(port: str, seconds: float, speeds: list[tuple[int, str]]) -> Iterator[Heard]:
    """Listen to a serial port, which is opened once, at each of these speeds.

    Args:
        seconds: how long to listen at each, s.
        speeds: (baud, parity) of each.
    """
    with closing(SerialLink(port, *speeds[0])) as link:
        wait = FIRST_S
        for k, (baud, parity) in enumerate(speeds):
            if k:
                link.retune(baud, parity)
            found = link.receive(wait)
            wait = seconds
            data = bytearray(found[0] if found else b"")
            end = time.monotonic() + seconds
            while found and (left := end - time.monotonic()) > 0 and len(data) < MOST_BYTES:
                more = link.receive(left)
                data += more[0] if more else b""
            yield baud, parity, bytes(data)


def hear_bus(url: str, seconds: float) -> list[CanFrame]:
    """The frames that come over a CAN bus.

    Args:
        url: ``can:INTERFACE:CHANNEL``, with the bus's options.
    """
    frames: list[CanFrame] = []
    with closing(open_line(url)) as link:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            found = link.receive(left)
            frames += found[0] if found else ()
    return frames


def ask_devices(
    wire: str, connect: Callable[[Codec[Any]], Link[Any]], seconds: float
) -> Iterator[tuple[Codec[Any], Any]]:
    """Start the device of each codec that waits for it; return what then comes.

    Args:
        seconds: how long to listen after the first sample, s.
    """
    connect(make_codec(wire, "native", {})).close()  # told once, not for every codec
    for name, kind in _codecs(wire):
        if _needs_file(kind):
            continue
        codec = make_codec(wire, name, {})
        if not codec.polls and not codec.commands(Command.START):
            continue
        heard: list[Any] = []
        try:
            with DeviceSource(
                lambda codec=codec: connect(codec), codec,  # type: ignore[misc]
                DeviceOptions(name, start_s=START_S, reconnect=False), name,
            ) as source:  # fmt: skip
                source.tap(lambda packet, _, heard=heard: heard.append(packet))  # type: ignore[misc]
                end = time.monotonic() + seconds
                while (left := end - time.monotonic()) > 0:
                    source.read(left)
        except (SourceError, EndOfStream):
            continue
        packets = [p for p in heard if p is not None]
        whole: Any = b"".join(packets) if wire == "serial" else [f for p in packets for f in p]
        yield codec, whole
