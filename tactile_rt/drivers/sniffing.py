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

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import CanFrame, Codec, Samples, codec_class
from tactile_rt.drivers.opening import make_codec
from tactile_rt.errors import ConfigError

__all__ = [
    "LOOK_BYTES",
    "LOOK_FRAMES",
    "NEEDS_A_FILE",
    "CodecFit",
    "Tried",
    "frame_hint",
    "sniff_bytes",
    "sniff_frames",
]

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
LENGTHS: Final = range(4, 1025)  # bytes of a frame that nobody has described
HINT_BYTES: Final = 16_384

Tried = tuple[str, Mapping[str, str]]  # codec, options


@dataclass(frozen=True)
class CodecFit:
    """A codec that fits.

    Attributes:
        options: The codec's options besides their defaults.
        samples: Number of samples; of a device that has not described itself 0.
        explained: Part of the bytes, or of the bus's frames, that is of this device's frames.
        proof: Part of damaged frames that the codec notices, 0 to 1.
        likely: Whether there are frames and, of a device that has told all that it must, samples.
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

    Raises:
        ConfigError: one of `further` cannot be.
    """
    data = data[:LOOK_BYTES]
    # what comes first may be a device that starts, or the line before it was plugged in
    return _fitting(data, further) or _fitting(data[len(data) // 2 :], further)


def _fitting(data: bytes, further: Sequence[Tried]) -> list[CodecFit]:
    if any(data == (data[:p] * (len(data) // p + 1))[: len(data)] for p in (1, 2, 3, 4)):
        return []  # nothing is said in it
    pieces = [data[at : at + PIECE] for at in range(0, len(data), PIECE)]
    hurt = _damaged(data)
    worse = [hurt[at : at + PIECE] for at in range(0, len(hurt), PIECE)]
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

    Raises:
        ConfigError: one of `further` cannot be.
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


def frame_hint(data: bytes) -> str:
    """What can be told of frames of one length that no codec knows; empty: nothing.

    Bytes that are the same in every frame show its length, and the longest run of them how it
    begins, or ends.
    """
    raw = np.frombuffer(data[:HINT_BYTES], np.uint8)
    if not len(raw) or (raw == raw[0]).mean() > 0.9:
        return ""
    for length in LENGTHS:
        n = len(raw) // length
        if n < 8:
            break
        rows = raw[: n * length].reshape(n, length)
        usual = np.median(rows, axis=0).astype(np.uint8)
        same = (rows == usual).mean(axis=0) > 0.9
        if not 2 <= same.sum() < length:
            continue
        doubled = np.concatenate([same, same])
        run, best, begin = 0, 0, 0
        for k in range(2 * length):
            run = run + 1 if doubled[k] else 0
            if run > best and run <= length:
                best, begin = run, k - run + 1
        if best < 2:
            continue
        mark = bytes(usual[(begin + k) % length] for k in range(best))
        return f"frames of {length} bytes, it seems, with {mark.hex(' ').upper()} in each"
    return ""


def _candidates(
    wire: str, further: Iterable[Tried], seen: Collection[int]
) -> Iterable[tuple[str, dict[str, str]]]:
    for codec, options in further:
        make_codec(wire, codec, dict(options))  # refused before anything is fed
        yield codec, dict(options)
    for of, name in CODECS:
        if of != wire:
            continue
        try:
            kind = codec_class(wire, name)
        except ConfigError:
            continue  # what it needs is not installed
        if set(NEEDS_A_FILE) & set(kind.Options.__dataclass_fields__):
            continue
        yield name, {}
        for options in kind.variants(seen):
            yield name, options


def _fed(
    wire: str, name: str, options: Mapping[str, str], packets: Sequence[Any], total: int
) -> CodecFit:
    codec: Codec[Any] = make_codec(wire, name, dict(options))
    samples, valid = 0, 0.0
    limit = None if codec.full_scale is None else BORNE * np.array(codec.full_scale)
    for packet in packets:
        found = codec.feed(packet, 0)
        if found is not None:
            samples += len(found)
            good = found.valid if limit is None else _borne(found, limit)
            valid += float(good.mean()) * len(found)
    stats = codec.stats
    whole = samples - stats.incomplete if stats.incomplete else samples
    described = codec.spec is not None
    if described and samples and (valid < COMPLETE * samples or whole < COMPLETE * samples):
        samples = 0
    silent = not described or bool(codec.complaint)  # there may be samples all the same
    return CodecFit(
        wire, name, options, stats.intact, stats.corrupt, samples,
        max(0.0, 1.0 - stats.skipped / max(1, total)), described=described,
        likely=stats.intact >= LEAST and (samples >= LEAST - 1 or silent),
    )  # fmt: skip


def _borne(found: Samples, limit: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(sample, element) the valid loads that are within the limit of each channel."""
    borne: NDArray[np.bool_] = found.valid & np.all(np.abs(found.values) <= limit, axis=2)
    return borne


def _damaged(data: bytes) -> bytes:
    """The bytes with one bit of every so many turned over, the same ones every time."""
    hurt = np.frombuffer(data, np.uint8).copy()
    draw = np.random.default_rng(0)
    at = np.arange(DAMAGE_EVERY // 2, len(hurt), DAMAGE_EVERY)
    hurt[at] ^= (1 << draw.integers(0, 8, len(at))).astype(np.uint8)
    return hurt.tobytes()


def _ranked(fits: list[CodecFit]) -> list[CodecFit]:
    """The best first: what explains more, or as much with more proof, or with fewer options."""

    def worth(fit: CodecFit) -> tuple[float, ...]:
        return (
            round(min(1.0, fit.explained) * (0.5 + 0.5 * fit.proof), 1),
            round(fit.explained, 2), -len(fit.options), fit.intact,
        )  # fmt: skip

    return sorted(fits, key=worth, reverse=True)
