"""Bags opened: by the library rosbags where they are whole, else from their beginning on.

A bag that was cut short has no index, which every library reads first. Its records are still there
one after the other: they are read until one is not whole. So is an MCAP file that did not come from
ROS 2: messages of ROS 1 and in JSON.
"""

import bz2
import os
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec

from tactile_rt.errors import RecordingError
from tactile_rt.extras import lacking
from tactile_rt.files import open_regular
from tactile_rt.recording.records import MAGIC
from tactile_rt.stream import NS_PER_S

__all__ = ["ROS1", "OpenBag", "open_bag"]

ROS1: Final = b"#ROSBAG V2.0\n"
LARGEST: Final = 1 << 30  # bytes of a record
MESSAGE, CHUNK, CONNECTION = b"\x02", b"\x05", b"\x07"
NOT_WHOLE: Final = (TypeError, ValueError, KeyError, AssertionError, IndexError, struct.error)

# How messages in an MCAP file are encoded, and what describes them; of JSON nothing needs to.
CDR, OF_ROS1, JSON = "cdr", "ros1", "json"
DESCRIBED: Final = {CDR: "ros2msg", OF_ROS1: "ros1msg"}

Stored = tuple[str, int, bytes]  # topic, time in ns, message


@dataclass
class OpenBag:
    """A bag that is open.

    Attributes:
        path: Path of the bag.
        types: The type of each topic's messages.
        counts: The number of messages of each topic.
        notes: What could not be read, a sentence each.
    """

    path: Path
    types: dict[str, str]
    counts: Counter[str]
    notes: list[str] = field(default_factory=list)
    _reader: Any = None
    _stored: list[Stored] = field(default_factory=list)
    _decoders: dict[str, Callable[[bytes], Any]] = field(default_factory=dict)

    def messages(self, topic: str) -> Iterator[tuple[int, bytes, Any]]:
        """(time in the bag in ns, bytes, message) of each message of a topic; None for a message
        that is damaged."""
        if self._reader is None:
            decode = self._decoders[topic]
        else:
            decode = partial(self._reader.deserialize, typ=self.types[topic])
        for t_ns, raw in self._raw(topic):
            try:
                message = decode(raw)
            except Exception:  # rosbags raises anything on bytes that are no such message
                message = None
            yield t_ns, raw, message

    def _raw(self, topic: str) -> Iterator[tuple[int, bytes]]:
        if self._reader is None:
            yield from ((t_ns, raw) for name, t_ns, raw in self._stored if name == topic)
            return
        which = [c for c in self._reader.connections if c.topic == topic]
        try:
            for _, t_ns, raw in self._reader.messages(connections=which):
                yield t_ns, bytes(raw)
        except Exception as error:  # so it does where a chunk is damaged
            self.notes.append(f"it is damaged, and read up to there ({_words(error)})")


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag of ROS 1 or ROS 2.

    Raises:
        ConfigError: the extra is not installed.
        RecordingError: nothing of it can be read.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise lacking("bags need", "import", error) from None
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    except Exception as error:  # rosbags and what it reads by raise anything on a damaged bag
        yield _from_its_beginning(path, _words(error))
        return
    try:
        types = {name: topic.msgtype or "" for name, topic in reader.topics.items()}
        counts = Counter({name: topic.msgcount for name, topic in reader.topics.items()})
        yield OpenBag(path, types, counts, _reader=reader)
    finally:
        reader.close()


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def _from_its_beginning(path: Path, why: str) -> OpenBag:
    """What is whole of a bag that has lost its end.

    Raises:
        RecordingError: nothing is.
    """
    if path.is_dir():
        files = sorted(path.glob("*.mcap"))
        if len(files) != 1:
            raise RecordingError(f"{path} cannot be read as a bag: {why}")
        (path,) = files
    found = _Found()
    with open_regular(path) as file:
        begins = file.read(len(ROS1))
        file.seek(0)
        mcap = begins.startswith(MAGIC)
        if mcap:
            whole = _read_mcap(file, found)
        elif begins == ROS1:
            whole = False
            file.seek(len(ROS1))
            _read_ros1(file, found)
    types, decoders = _decoders(found)
    stored = [one for one in found.stored if one[0] in types]
    if not stored:
        others = sorted(found.others)
        if mcap and others:
            why = f"its messages are {' and '.join(others)}; those of ROS and in JSON are read"
        raise RecordingError(f"{path} cannot be read as a bag: {why}")
    counts = Counter(topic for topic, _, _ in stored)
    notes = [] if whole else [
        f"its end is missing or damaged ({why}): what is whole before it was read"
    ]  # fmt: skip
    return OpenBag(path, types, counts, notes, None, stored, decoders)


def _decoders(found: "_Found") -> tuple[dict[str, str], dict[str, Callable[[bytes], Any]]]:
    """The type of each topic that can be read, and what makes a message of its bytes."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros2, ros1 = get_typestore(Stores.LATEST), get_typestore(Stores.ROS1_NOETIC)
    types: dict[str, str] = {}
    decoders: dict[str, Callable[[bytes], Any]] = {}
    for topic, (kind, text, encoding) in found.topics.items():
        if encoding == JSON:
            types[topic], decoders[topic] = kind or "JSON", msgspec.json.decode
            continue
        store = ros2 if encoding == CDR else ros1
        name = kind if kind.count("/") == 2 else kind.replace("/", "/msg/")
        try:
            known = get_types_from_msg(text, name)
            store.register({k: v for k, v in known.items() if k not in store.fielddefs})
        except Exception:  # a definition that is not of our kind: a topic that we cannot read
            continue
        types[topic] = name
        decode = store.deserialize_cdr if encoding == CDR else store.deserialize_ros1
        decoders[topic] = partial(decode, typename=name)
    return types, decoders


@dataclass
class _Found:
    topics: dict[str, tuple[str, str, str]] = field(default_factory=dict)
    """Type, its definition, and encoding: one of `CDR`, `OF_ROS1`, `JSON`."""
    others: set[str] = field(default_factory=set)
    """Encodings that are not read."""
    stored: list[Stored] = field(default_factory=list)


def _read_mcap(file: BinaryIO, found: _Found) -> bool:
    """The records of messages in an MCAP file, also those of a chunk that is cut short; whether the
    file is whole."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Channel, Message, Schema

    schemas: dict[int, Schema] = {}
    channels: dict[int, str] = {}

    def take(opcode: int, data: bytes) -> None:
        if opcode == 3:
            schema = Schema.read(ReadDataStream(BytesIO(data)))
            schemas[schema.id] = schema
        elif opcode == 4:
            channel = Channel.read(ReadDataStream(BytesIO(data)))
            told, encoding = schemas.get(channel.schema_id), channel.message_encoding
            name = told.name if told else ""
            if encoding == JSON:
                text = ""
            elif told and DESCRIBED.get(encoding) == told.encoding:
                text = told.data.decode("utf-8", "replace")
            else:
                found.others.add(encoding or "of no encoding")
                return
            channels[channel.id] = channel.topic
            found.topics[channel.topic] = name, text, encoding
        elif opcode == 5:
            message = Message.read(ReadDataStream(BytesIO(data)), len(data))
            if message.channel_id in channels:
                stored = channels[message.channel_id], message.log_time, message.data
                found.stored.append(stored)

    file.seek(len(MAGIC))
    try:
        for opcode, data, whole in _framed(file):
            if opcode != 6:
                if whole:
                    take(opcode, data)
                continue
            # how much a chunk says that it holds is not what is there
            name_at = 8 + 8 + 8 + 4
            (n,) = struct.unpack_from("<I", data, name_at)
            kind, begin = data[name_at + 4 : name_at + 4 + n], name_at + 4 + n + 8
            for inner, record, complete in _framed(BytesIO(_unpacked(kind, data[begin:]))):
                if complete:
                    take(inner, record)
    except (EOFError, OSError, RuntimeError, *NOT_WHOLE):
        return False
    file.seek(-len(MAGIC), os.SEEK_END)
    return file.read() == MAGIC


def _framed(file: BinaryIO) -> Iterator[tuple[int, bytes, bool]]:
    """(opcode, record, whether it is whole) of MCAP records."""
    while len(head := file.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", head)
        data = file.read(min(length, LARGEST))
        yield opcode, data, len(data) == length


def _read_ros1(file: BinaryIO, found: _Found) -> None:
    """The records of a bag of ROS 1, also those of a chunk that is cut short."""
    topics: dict[bytes, str] = {}
    try:
        for header, data in _records(file):
            if header.get(b"op") == CHUNK:
                for inner, message in _records(BytesIO(_unpacked(header[b"compression"], data))):
                    _take(inner, message, topics, found)
            else:
                _take(header, data, topics, found)
    except (EOFError, OSError, RuntimeError, *NOT_WHOLE):
        return


def _take(header: dict[bytes, bytes], data: bytes, topics: dict[bytes, str], found: _Found) -> None:
    if header.get(b"op") == CONNECTION:
        told = _fields(data)
        topic = header[b"topic"].decode("utf-8", "replace")
        topics[header[b"conn"]] = topic
        found.topics[topic] = (
            told[b"type"].decode("utf-8", "replace"),
            told[b"message_definition"].decode("utf-8", "replace"),
            OF_ROS1,
        )
    elif header.get(b"op") == MESSAGE and header[b"conn"] in topics:
        seconds, ns = struct.unpack("<II", header[b"time"])
        found.stored.append((topics[header[b"conn"]], seconds * NS_PER_S + ns, data))


def _records(file: BinaryIO) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """(header, data) of each record; the data of a chunk may be cut short."""
    while head := file.read(4):
        header = _fields(_exactly(file, *struct.unpack("<I", head)))
        (n,) = struct.unpack("<I", _exactly(file, 4))
        data = file.read(n) if header.get(b"op") == CHUNK else _exactly(file, n)
        yield header, data


def _exactly(file: BinaryIO, n: int) -> bytes:
    data = file.read(min(n, LARGEST))
    if len(data) < n:
        raise EOFError
    return data


def _fields(data: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at < len(data):
        (n,) = struct.unpack_from("<I", data, at)
        name, _, value = data[at + 4 : at + 4 + n].partition(b"=")
        fields[name] = value
        at += 4 + n
    return fields


def _unpacked(compression: bytes, data: bytes) -> bytes:
    """What is in a chunk, as far as it is there."""
    if compression in (b"none", b""):
        return data
    if compression == b"bz2":
        return bz2.BZ2Decompressor().decompress(data, LARGEST)
    if compression == b"zstd":
        import zstandard

        return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(data))
    import lz4.frame

    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, LARGEST))
