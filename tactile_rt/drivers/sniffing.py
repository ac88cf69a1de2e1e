"""Identification of the codec of unknown bytes, or of frames of a CAN bus.

Requirement: an answer from one second of a line, cut anywhere, even within a frame, for protocols
with and almost without checks; and no answer if nothing fits.

Method. Each codec decodes all of the data, also with the options that change its device's frames
(`Codec.variants`). A codec fits if it found frames, made samples of them, and skipped little. If
several fit, the one whose frames prove more wins: the same bytes are decoded again with single bits
flipped at intervals, and a codec that does not notice this damage proves nothing. On a bus, two
successive identifiers prove little, so values near a sensor's full scale, which it hardly ever
measures, speak against a codec.
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
LEAST: Final = 3  # least number of frames, and of samples of a described device
EXPLAINED: Final = 0.6  # least share of the bytes that a codec must explain
EXPLAINED_UNPROVED: Final = 0.95  # the same, for a codec that notices no damage
PROVED: Final = 0.1  # least share of damaged frames that the codec notices
OF_THE_BUS: Final = 0.02  # least share of a bus's frames, since it may have other devices
COMPLETE: Final = 0.5  # least share of complete samples
BORNE: Final = 0.9  # of the full scale: a load is less, except in an impact
DAMAGE_EVERY: Final = 24  # bytes
NEEDS_A_FILE: Final = ("mapping", "columns")  # options of codecs that users must describe
# Further usual speeds of boards that print text, bit/s.
SPEEDS: Final = (9600, 57600, 230_400, 38_400, 250_000, 500_000)
FIRST_S: Final = 2.5  # for a board that resets when its port is opened
START_S: Final = 0.6  # for a device that was started or polled
MOST_BYTES: Final = 262_144

Heard = tuple[int, str, bytes]  # baud, parity, received bytes
Tried = tuple[str, Mapping[str, str]]  # codec, options


@dataclass(frozen=True)
class CodecFit:
    """A candidate codec, with measures of how well it fits the data.

    Attributes:
        samples: Number of decoded samples; 0 for a device that has not described itself.
        explained: Share of the bytes, or of the bus's frames, that belong to this device.
        proof: Share of damaged frames that the codec notices, 0 to 1.
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
    """Return the codecs that fit bytes of a serial line, the best first.

    Args:
        data: raw bytes, cut anywhere; the first 64 kB are used; if none fits, their second half.
        further: further codecs to try, with their options.
    """
    data = data[:LOOK_BYTES]
    # the beginning may be of a device that starts, or of the line before it was plugged in
    return _find_fits(data, further) or _find_fits(data[len(data) // 2 :], further)


def _find_fits(data: bytes, further: Sequence[Tried]) -> list[CodecFit]:
    if any(data[p:] == data[:-p] for p in (1, 2, 3, 4)):
        return []  # it only repeats up to four bytes: no information
    pieces, worse = (
        [whole[at : at + PIECE] for at in range(0, len(data), PIECE)]
        for whole in (data, _flip_bits(data))
    )
    fits = []
    for codec, options in _list_candidates("serial", further, ()):
        fit = _try_codec("serial", codec, options, pieces, len(data))
        if not fit.likely or fit.explained < EXPLAINED or fit.corrupt > 2 * fit.intact:
            continue
        again = _try_codec("serial", codec, options, worse, len(data))
        fit = replace(fit, proof=1.0 - min(1.0, again.intact / fit.intact))
        if fit.proof >= PROVED or fit.explained >= EXPLAINED_UNPROVED:
            fits.append(fit)
    return _rank(fits)


def sniff_frames(frames: Sequence[CanFrame], further: Iterable[Tried] = ()) -> list[CodecFit]:
    """Return the codecs that fit frames of a CAN bus, the best first.

    Args:
        frames: frames in the order received; other devices may be on the bus.
    """
    frames = frames[:LOOK_FRAMES]
    packets = [[frame] for frame in frames]
    counts = Counter(f.id for f in frames if not f.extended)
    seen = {i for i, n in counts.items() if n >= max(LEAST, OF_THE_BUS * len(frames) / 4)}
    fits = []
    for codec, options in _list_candidates("can", further, seen):
        fit = _try_codec("can", codec, options, packets, len(frames))
        if fit.likely and fit.explained >= OF_THE_BUS and 4 * fit.corrupt <= fit.intact:
            fits.append(fit)
    return _rank(fits)


def _list_candidates(
    wire: str, further: Iterable[Tried], seen: Collection[int]
) -> Iterable[tuple[str, dict[str, str]]]:
    for codec, options in further:
        make_codec(wire, codec, dict(options))  # raises at wrong options before any is tried
        yield codec, dict(options)
    for name, kind in _list_codecs(wire):
        if not _needs_file(kind):
            yield from ((name, options) for options in ({}, *kind.variants(seen)))


def _list_codecs(wire: str) -> Iterator[tuple[str, type[Codec[Any]]]]:
    """Yield (name, class) of each codec of a wire whose library is installed."""
    for of, name in CODECS:
        if of == wire:
            with suppress(ConfigError):
                yield name, codec_class(wire, name)


def _needs_file(kind: type[Codec[Any]]) -> bool:
    return bool(set(NEEDS_A_FILE) & set(kind.Options.__dataclass_fields__))


def _try_codec(
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
    silent = not described or bool(codec.complaint)  # a right codec may have no samples then
    return CodecFit(
        wire, name, options, stats.intact, stats.corrupt, samples,
        max(0.0, 1.0 - stats.skipped / max(1, total)), described=described,
        likely=stats.intact >= LEAST and (samples >= LEAST - 1 or silent),
    )  # fmt: skip


def _flip_bits(data: bytes) -> bytes:
    """Return the data with a bit flipped every `DAMAGE_EVERY` bytes, reproducibly."""
    hurt = np.frombuffer(data, np.uint8).copy()
    draw = np.random.default_rng(0)
    at = np.arange(DAMAGE_EVERY // 2, len(hurt), DAMAGE_EVERY)
    hurt[at] ^= (1 << draw.integers(0, 8, len(at))).astype(np.uint8)
    return hurt.tobytes()


def _rank(fits: list[CodecFit]) -> list[CodecFit]:
    """Sort, best first: by explained share times proof, share, fewest options, intact frames."""
    return sorted(fits, reverse=True, key=lambda fit: (
        round(min(1.0, fit.explained) * (0.5 + 0.5 * fit.proof), 1),
        round(fit.explained, 2), -len(fit.options), fit.intact,
    ))  # fmt: skip


# listening to lines with unknown devices


def line_speeds() -> list[tuple[int, str]]:
    """Return (baud, parity) of all serial codecs, most frequent first, then further speeds."""
    found: list[tuple[int, str]] = []
    for name, kind in _list_codecs("serial"):
        codec: Any = kind if _needs_file(kind) else make_codec("serial", name, {})
        found.append((codec.baud, codec.parity))
    usual = sorted(set(found), key=lambda speed: (-found.count(speed), speed))
    return usual + [(s, "N") for s in SPEEDS if (s, "N") not in usual]


def hear_port(port: str, seconds: float, speeds: list[tuple[int, str]]) -> Iterator[Heard]:
    """Yield (baud, parity, received bytes) of a serial port at each of these speeds.

    Args:
        seconds: time to listen at each speed, s.
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
    """Return the frames received on a CAN bus within this many seconds.

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
    """Start or poll the device as each codec does; yield (codec, received data).

    Args:
        seconds: time to listen after the first sample, s.
    """
    connect(make_codec(wire, "native", {})).close()  # raises once if the line cannot be opened
    for name, kind in _list_codecs(wire):
        if _needs_file(kind):
            continue
        codec = make_codec(wire, name, {})
        if not codec.polls and not codec.commands(Command.START):
            continue
        received: list[Any] = []
        try:
            with DeviceSource(
                lambda codec=codec: connect(codec), codec,  # type: ignore[misc]
                DeviceOptions(name, start_s=START_S, reconnect=False), name,
            ) as source:  # fmt: skip
                source.tap(lambda packet, _, to=received: to.append(packet))  # type: ignore[misc]
                end = time.monotonic() + seconds
                while (left := end - time.monotonic()) > 0:
                    source.read(left)
        except (SourceError, EndOfStream):
            continue
        packets = [p for p in received if p is not None]
        whole: Any = b"".join(packets) if wire == "serial" else [f for p in packets for f in p]
        yield codec, whole
