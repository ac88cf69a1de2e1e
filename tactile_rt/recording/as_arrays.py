"""A recording as arrays, and back; and as the .npz of them, which `numpy.load` reads.

Every form (npz, CSV, HDF5) holds the same, so that each becomes the recording again but for its raw
packets. What a table of samples does not show goes beside it:

    seq, t_ns, values, valid         the samples, as in `Chunk`
    chunk_samples, chunk_log_ns      how they came: samples of each chunk, and when it was recorded
    decisions, events, health        messages, JSON, each with its time in ..._log_ns
    about                            what the recording is of, JSON

In an .npz, texts are JSON lines in arrays of bytes: in numpy's own text each takes the room of the
longest.
"""

import heapq
from collections.abc import Generator, Iterable, Iterator, Mapping
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError, RecordingError, name_some
from tactile_rt.recording.description import Description, seal
from tactile_rt.recording.layout import (
    DECISIONS,
    EVENTS,
    HEALTH,
    SAMPLES,
    Raw,
    decode_samples,
    encode_samples,
)
from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk, concatenate

__all__ = [
    "ABOUT",
    "COLUMNS",
    "TEXTS",
    "Told",
    "about_of",
    "about_text",
    "raws_of",
    "read_npz",
    "write_npz",
]

ABOUT = "about"
COLUMNS = ("seq", "t_ns", "values", "valid")
TEXTS = (DECISIONS, EVENTS, HEALTH)
KINDS = (np.int64, np.int64, np.float32, np.bool_)
CHUNK_NS = 9_000_000  # of samples that came in no chunks
BLOCK = 1 << 14  # samples read at once


class Told:
    """What is not a sample: how samples were cut into chunks, and what was told meanwhile.

    Attributes:
        chunk_samples: The number of samples of each chunk.
        chunk_log_ns: The host monotonic time at which each chunk was recorded, ns.
        texts: The messages of each topic, JSON.
        log_ns: The host monotonic time at which each message of a topic was recorded, ns.
    """

    def __init__(self) -> None:
        self.chunk_samples: list[int] = []
        self.chunk_log_ns: list[int] = []
        self.texts: dict[str, list[str]] = {topic: [] for topic in TEXTS}
        self.log_ns: dict[str, list[int]] = {topic: [] for topic in TEXTS}

    def chunks(self, spec: ArraySpec, raws: Iterable[Raw]) -> Iterator[Chunk]:
        """The chunks among the messages; all else is kept here."""
        for raw in raws:
            if raw.topic == SAMPLES:
                chunk = decode_samples(raw.data, spec.shape)
                self.chunk_samples.append(len(chunk))
                self.chunk_log_ns.append(raw.t_ns)
                yield chunk
            elif raw.topic in self.texts:
                self.texts[raw.topic].append(raw.data.decode())
                self.log_ns[raw.topic].append(raw.t_ns)

    def times(self) -> dict[str, NDArray[np.int64]]:
        """The arrays besides samples and texts."""
        return {
            "chunk_samples": np.array(self.chunk_samples, np.int64),
            "chunk_log_ns": np.array(self.chunk_log_ns, np.int64),
            **{f"{topic}_log_ns": np.array(at, np.int64) for topic, at in self.log_ns.items()},
        }


def about_text(about: Description) -> str:
    """What a recording is of, as one line of JSON; that it has raw packets is left out."""
    fields = {
        "tactile_rt": replace(about, wire="").to_metadata(),
        "session": seal(about.session) if about.session else {},
        "recovered": about.recovered,
    }
    return msgspec.json.encode(fields).decode()


def about_of(what: str, text: str) -> Description:
    """Read what `about_text` wrote.

    Raises:
        RecordingError: it is damaged, or of another version.
    """
    try:
        fields = msgspec.json.decode(text, type=dict[str, Any])
        plain = msgspec.convert(fields["tactile_rt"], dict[str, str])
        session = msgspec.convert(fields["session"], dict[str, str])
        recovered = bool(fields["recovered"])
    except (msgspec.MsgspecError, KeyError) as error:
        raise RecordingError(f"{what} is damaged: `{ABOUT}` cannot be read ({error})") from None
    return Description.from_metadata(what, plain, session, recovered)


def _spec_of(what: str, text: str, utc_offset_ns: int) -> Description:
    """What arrays of one's own are of: those that have a `spec` alone.

    Raises:
        RecordingError: it is no array's.
    """
    try:
        return Description(ArraySpec.from_json(text), utc_offset_ns)
    except ConfigError as error:
        raise RecordingError(f"{what}: spec: {error}") from None


def raws_of(
    what: str, about: Description, arrays: Mapping[str, Any], texts: Mapping[str, Iterable[str]]
) -> Generator[Raw, None, None]:
    """The messages of a recording that was made into arrays.

    Args:
        what: the file, for messages.
        about: what it is of.
        arrays: `COLUMNS`, and what `Told.times` gives; without the latter samples are cut anew.
        texts: of each topic.

    Raises:
        RecordingError: arrays that do not go together.
    """
    _check(what, arrays, about.spec.shape)
    n = len(arrays["seq"])
    sizes, at = _cut(what, arrays, n, about.spec.rate_hz)
    told = [_texts(what, topic, arrays, texts.get(topic, ())) for topic in TEXTS]
    return heapq.merge(_samples(arrays, sizes, at), *told, key=attrgetter("t_ns"))


def _check(what: str, arrays: Mapping[str, Any], shape: tuple[int, int]) -> None:
    missing = [name for name in COLUMNS if name not in arrays]
    if missing:
        raise RecordingError(f"{what} holds no {name_some(missing)}")
    n = len(arrays["seq"])
    for name, kind in zip(COLUMNS, KINDS, strict=True):
        expected = {"values": (n, *shape), "valid": (n, shape[0])}.get(name, (n,))
        found = arrays[name]
        if found.shape != expected or found.dtype != kind:
            raise RecordingError(
                f"{what}: {name} is {found.dtype} {found.shape}, not {np.dtype(kind)} {expected}"
            )
    if not n:
        raise RecordingError(f"{what} has no samples")


def _cut(
    what: str, arrays: Mapping[str, Any], n: int, rate_hz: float
) -> tuple[list[int], list[int]]:
    """Samples of each chunk, and when each was recorded."""
    if "chunk_samples" in arrays and "chunk_log_ns" in arrays:
        sizes, at = (arrays[name][:].tolist() for name in ("chunk_samples", "chunk_log_ns"))
        if len(sizes) != len(at) or min(sizes, default=0) < 1 or sum(sizes) != n:
            raise RecordingError(
                f"{what}: chunks of {sum(sizes)} samples for {n}: leave chunk_samples and "
                "chunk_log_ns out to have them cut anew"
            )
        return sizes, at
    size = max(1, round(CHUNK_NS * rate_hz / NS_PER_S))
    sizes = [min(size, n - begin) for begin in range(0, n, size)]
    return sizes, arrays["t_ns"][:][np.cumsum(sizes) - 1].tolist()


def _samples(arrays: Mapping[str, Any], sizes: list[int], log_ns: list[int]) -> Iterator[Raw]:
    begin, k = 0, 0
    while k < len(sizes):
        last, n = k, 0
        while last < len(sizes) and (n == 0 or n + sizes[last] <= BLOCK):
            n += sizes[last]
            last += 1
        # Files on disk are asked for much at once: a chunk is some ten samples.
        block = [np.ascontiguousarray(arrays[name][begin : begin + n]) for name in COLUMNS]
        at = 0
        for size, t_ns in zip(sizes[k:last], log_ns[k:last], strict=True):
            chunk = Chunk(*(column[at : at + size] for column in block))
            yield Raw(SAMPLES, t_ns, encode_samples(chunk))
            at += size
        begin, k = begin + n, last


def _texts(what: str, topic: str, arrays: Mapping[str, Any], texts: Iterable[str]) -> Iterator[Raw]:
    lines = list(texts)
    at = arrays[f"{topic}_log_ns"][:].tolist() if lines and f"{topic}_log_ns" in arrays else []
    if len(lines) != len(at):
        raise RecordingError(f"{what}: {len(lines)} {topic}, but {len(at)} times of them")
    return (Raw(topic, t_ns, text.encode()) for text, t_ns in zip(lines, at, strict=True))


def write_npz(what: str, about: Description, raws: Iterable[Raw], file: BinaryIO) -> int:
    """Write it; the number of samples.

    Raises:
        RecordingError: there is none.
    """
    told = Told()
    chunks = list(told.chunks(about.spec, raws))
    if not chunks:
        raise RecordingError(f"{what} has no samples")
    whole = concatenate(chunks)
    texts = {
        topic: np.frombuffer("".join(f"{line}\n" for line in lines).encode(), np.uint8)
        for topic, lines in told.texts.items()
    }
    arrays: dict[str, Any] = {
        **{name: getattr(whole, name) for name in COLUMNS},
        **told.times(),
        **texts,
        "utc_offset_ns": np.int64(about.utc_offset_ns),
        "spec": np.str_(about.spec.to_json()),
        ABOUT: np.str_(about_text(about)),
    }
    np.savez(file, **arrays)
    return len(whole)


def read_npz(path: Path) -> tuple[Description, Generator[Raw, None, None]]:
    """What it is of, and its messages.

    Arrays of one's own need `COLUMNS` and ``spec``.

    Raises:
        RecordingError: it is damaged, or holds something else.
    """
    try:
        with path.open("rb") as file, np.load(file) as found:
            arrays = {name: found[name] for name in found.files}
    except MemoryError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{path} is damaged, or no .npz ({reason})") from None
    what = str(path)
    if ABOUT in arrays:
        about = about_of(what, str(arrays[ABOUT]))
    elif "spec" in arrays:
        offset = int(arrays.get("utc_offset_ns", np.int64(0)))
        about = _spec_of(what, str(arrays["spec"]), offset)
    else:
        raise RecordingError(
            f"{what} does not say what array it is of: it needs `spec`, as ArraySpec.to_json gives"
        )
    texts = {topic: _lines(arrays[topic]) for topic in TEXTS if topic in arrays}
    return about, raws_of(what, about, arrays, texts)


def _lines(data: NDArray[np.uint8]) -> list[str]:
    return data.tobytes().decode().split("\n")[:-1]
