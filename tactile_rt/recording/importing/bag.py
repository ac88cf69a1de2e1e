"""Topics of ROS 1 and ROS 2 bags, by the library rosbags, without ROS.

A message is a row, its fields are columns by their paths (``wrench.force.x``, ``data.3``). Messages
of known types need no more: wrenches, arrays of numbers, magnetic fields and the like, and our own.
The time is that of the header, where there is one that is set, else that of the bag.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.files import open_regular
from tactile_rt.core.packages import lacking
from tactile_rt.core.settings import nearest
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, concatenate
from tactile_rt.drivers.codecs.column_words import compress_columns
from tactile_rt.recording.description import Description
from tactile_rt.recording.importing.mending import Import, clock_of, mend_bag, write_chunks
from tactile_rt.recording.importing.table import Table, import_table, shown_names
from tactile_rt.recording.layout import decode_samples
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.records import MAGIC
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2_form import ARRAY

__all__ = ["BagTopic", "bag_topics", "import_bag", "is_bag"]

SQLITE: Final = b"SQLite format 3\0"
ROS1: Final = b"#ROSBAG V2.0\n"
MOST: Final = 4096  # fields of a message that are columns
# What messages are of: columns by the end of the type's name, with {} for the frame's name.
KNOWN: Final = {
    "geometry_msgs/msg/WrenchStamped": "wrench.force.x={0}.fx:N,wrench.force.y={0}.fy:N,"
    "wrench.force.z={0}.fz:N,wrench.torque.x={0}.mx:Nm,wrench.torque.y={0}.my:Nm,"
    "wrench.torque.z={0}.mz:Nm",
    "geometry_msgs/msg/Wrench": "force.x={0}.fx:N,force.y={0}.fy:N,force.z={0}.fz:N,"
    "torque.x={0}.mx:Nm,torque.y={0}.my:Nm,torque.z={0}.mz:Nm",
    "geometry_msgs/msg/Vector3Stamped": "vector.x={0}.x,vector.y={0}.y,vector.z={0}.z",
    "sensor_msgs/msg/MagneticField": "magnetic_field.x={0}.bx:T,magnetic_field.y={0}.by:T,"
    "magnetic_field.z={0}.bz:T",
    "sensor_msgs/msg/FluidPressure": "fluid_pressure={0}.pressure:Pa",
    "sensor_msgs/msg/Temperature": "temperature={0}.temperature:degC",
    "std_msgs/msg/Float32": "data={0}.value",
    "std_msgs/msg/Float64": "data={0}.value",
}  # fmt: skip
NUMBERS: Final = re.compile(r"std_msgs/msg/(?:U?Int(?:8|16|32|64)|Float(?:32|64))MultiArray")
_NO_NAME: Final = re.compile(r"[^A-Za-z0-9_-]+")


@dataclass(frozen=True)
class BagTopic:
    """A topic of a bag.

    Attributes:
        columns: What each is a sample of, in the words of ``--columns``; empty where only a user
            can tell.
    """

    name: str
    type: str
    messages: int
    columns: str


@dataclass
class OpenBag:
    """A bag that is open."""

    reader: Any
    notes: list[str] = field(default_factory=list)

    def messages(self, topic: str) -> Iterator[tuple[int, bytes, Any]]:
        """Read (time in ns, bytes, message) of a topic; a damaged message is None."""
        which = [c for c in self.reader.connections if c.topic == topic]
        stored = self.reader.messages(connections=which)
        while True:
            try:
                connection, t_ns, raw = next(stored)
            except StopIteration:
                return
            except Exception as error:  # so it does where a chunk is damaged
                self.notes.append(f"it is damaged, and read up to there ({_words(error)})")
                return
            try:
                message = self.reader.deserialize(raw, connection.msgtype)
            except Exception:  # rosbags raises anything on bytes that are no such message
                message = None
            yield t_ns, bytes(raw), message


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag of ROS 1 or ROS 2.

    Raises:
        RecordingError: it is damaged, or has lost its end.
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise lacking("bags need", "import", error) from None
    with ExitStack() as stack:
        notes: list[str] = []
        store = get_typestore(Stores.LATEST)
        reader = None
        try:
            reader = stack.enter_context(AnyReader([path], default_typestore=store))
        except Exception as error:  # rosbags and what it reads by raise anything on a damaged bag
            why = _words(error)
            notes = [f"its end is missing or damaged ({why}): what is whole before it was read"]
            new = Path(stack.enter_context(TemporaryDirectory())) / "mended.mcap"
            if path.suffix == ".mcap" and mend_bag(path, new):
                with suppress(Exception):  # as above
                    reader = stack.enter_context(AnyReader([new], default_typestore=store))
            if reader is None:
                raise RecordingError(
                    f"{path} cannot be read as a bag: {why:.90}; `rosbag reindex` or "
                    "`ros2 bag reindex` mend one without its end"
                ) from None
        yield OpenBag(reader, notes)


def _words(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def is_bag(path: Path) -> bool:
    """Whether this is a bag: a file of ROS 1, a folder or file of ROS 2; of MCAP any but ours."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    with open_regular(path) as file:
        begins = file.read(len(SQLITE))
    if begins == SQLITE:  # python-can's logger writes such files, too
        return path.suffix == ".db3"
    return begins.startswith((ROS1, MAGIC))


def bag_topics(path: Path) -> list[BagTopic]:
    """The topics of a bag that hold messages."""
    found = []
    with open_bag(path) as bag:
        for name, about in sorted(bag.reader.topics.items()):
            if not about.msgcount:
                continue
            kind, columns = about.msgtype or "", ""
            for message in islice(_whole(bag, name), 1):
                columns = _columns_of(kind, message)
            found.append(BagTopic(name, kind, about.msgcount, columns))
    return found


def import_bag(
    path: Path,
    output: Path,
    topic: str = "",
    columns: str = "",
    rate_hz: float = 0.0,
) -> Import:
    """Write a topic of a bag as a recording.

    Args:
        output: the recording; it is there whole or not at all.
        topic: its name; empty where only one can be a recording.
        columns: which fields of a message are what, or a TOML file of it; empty for what is known
            of the type.
        rate_hz: rate of the samples, Hz; 0: by their times.

    Raises:
        ConfigError: no such topic, columns that cannot be, or the extra is not installed.
        RecordingError: the bag is damaged, or holds no sample.
    """
    if path.is_file() and path.suffix == ".mcap" and _is_ours(path):
        raise ConfigError(f"{path} is a recording already: `tactile-rt replay` and run take it")
    chosen = _chosen(path, bag_topics(path), topic, columns)
    with open_bag(path) as bag:
        if chosen.type == messages.SAMPLES and not columns:
            return _own(path, bag, chosen, output)
        paths = _paths(bag, chosen)
        if not paths:
            raise RecordingError(f"{path}: no message of {chosen.name} is whole and holds a number")
        words = columns or chosen.columns
        if not words:
            raise ConfigError(
                f"{path}: {chosen.name} has {chosen.type}: say with --columns what is what, e.g. "
                f"{paths[-1] if paths else 'data'}=S.value; its fields are {shown_names(paths)}"
            )
        return import_table(_table(path, bag, chosen, paths), output, words, rate_hz)


def _chosen(path: Path, topics: list[BagTopic], topic: str, columns: str) -> BagTopic:
    if topic:
        for one in topics:
            if one.name in (topic, f"/{topic}"):
                return one
        raise ConfigError(f"{path}: no topic {topic!r}; {nearest(topic, [t.name for t in topics])}")
    fitting = topics if columns else [t for t in topics if t.columns or t.type == messages.SAMPLES]
    if len(fitting) == 1:
        return fitting[0]
    told = ", ".join(f"{t.name} ({t.type})" for t in fitting or topics) or "none"
    what = (
        "name one with --topic"
        if fitting
        else "of none is known what is what: give --topic, and --columns tells"
    )
    raise ConfigError(f"{path} has the topics {told}: {what}")


def _is_ours(path: Path) -> bool:
    try:
        return bool(Recording(path).description)
    except (RecordingError, ConfigError):
        return False


def _frame_of(message: Any) -> str:
    name = getattr(getattr(message, "header", None), "frame_id", "") or "sensor"
    return _NO_NAME.sub("_", name).strip("_") or "sensor"


def _columns_of(kind: str, message: Any) -> str:
    """What a message of this type is a sample of, in words; empty: only a user can tell."""
    if kind in KNOWN:
        return KNOWN[kind].format(_frame_of(message))
    if not NUMBERS.fullmatch(kind) or not len(message.data):
        return ""
    sizes = [d.size for d in message.layout.dim] or [len(message.data)]
    if int(np.prod(sizes)) != len(message.data):
        sizes = [len(message.data)]
    channels = sizes[-1] if len(sizes) > 1 else 1
    names = ["value"] if channels == 1 else [f"c{k}" for k in range(channels)]
    n = len(message.data) // channels
    return compress_columns(
        [f"data.{e * channels + c}=T{e}.{names[c]}" for e in range(n) for c in range(channels)]
    )


def _paths(bag: OpenBag, topic: BagTopic) -> list[str]:
    """The paths of the numbers in a message, by the first one."""
    return [leaf for message in islice(_whole(bag, topic.name), 1)
            for leaf in islice(_leaves(message, ""), MOST)]  # fmt: skip


def _whole(bag: OpenBag, topic: str) -> Iterator[Any]:
    return (message for _, _, message in bag.messages(topic) if message is not None)


def _leaves(value: Any, at: str) -> Iterator[str]:
    if is_dataclass(value):
        for f in fields(value):
            if f.name != "__msgtype__":
                yield from _leaves(getattr(value, f.name), f"{at}.{f.name}" if at else f.name)
    elif isinstance(value, np.ndarray | list | tuple):
        for k, one in enumerate(value):
            yield from _leaves(one, f"{at}.{k}")
    elif isinstance(value, int | float | np.number):
        yield at


def _table(path: Path, bag: OpenBag, topic: BagTopic, paths: list[str]) -> Table:
    steps = [[int(s) if s.isdecimal() else s for s in p.split(".")] for p in paths]
    table = Table(path, tuple(paths), (), times_ns=[], notes=bag.notes)

    def rows() -> Iterator[Sequence[Any]]:
        times = table.times_ns
        assert times is not None
        for t_ns, _, message in bag.messages(topic.name):
            times[:] = [_stamp(message) or t_ns]
            yield () if message is None else _row(message, steps)

    table.rows = rows()
    return table


def _row(message: Any, steps: list[list[int | str]]) -> list[Any]:
    row = []
    for path in steps:
        value = message
        try:
            for step in path:
                value = value[step] if isinstance(step, int) else getattr(value, step)
        except IndexError:
            value = np.nan  # a list that is shorter than the first one
        row.append(value)
    return row


def _stamp(message: Any) -> int:
    """Return the time of the message's header, ns; 0 if it has none, or it is not set."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec) if stamp else 0


def _own(path: Path, bag: OpenBag, topic: BagTopic, output: Path) -> Import:
    """Samples of ours in a bag of others: bit for bit."""
    account = Import(notes=bag.notes)
    told = _array_in(bag, topic.name)
    chunks: list[Chunk] = []
    offset = 0
    for t_ns, raw, message in bag.messages(topic.name):
        if message is None:
            account.corrupt += 1
            continue
        shape = int(message.elements), int(message.channels)
        if told is not None and shape != told.shape:
            raise ConfigError(
                f"{path}: its array is of {told.shape[0]} x {told.shape[1]}, "
                f"{topic.name} of {shape[0]} x {shape[1]}"
            )
        try:
            chunk = decode_samples(messages.unstamped(bytes(raw)), shape)
        except ValueError:
            account.corrupt += 1
            continue
        if chunks and chunk.values.shape[1:] != chunks[0].values.shape[1:]:
            account.corrupt += 1
            continue
        offset = offset if chunks else (_stamp(message) or t_ns) - int(chunk.t_ns[-1])
        chunks.append(chunk)
        account.intact += 1
    if not chunks:
        raise RecordingError(f"{path}: no message of {topic.name} is whole")
    whole = concatenate(chunks)
    account.missing = int((np.diff(whole.seq) - 1).clip(0).sum())
    spec = told or _unnamed(path.stem, whole)
    zero = max(0, offset if offset >= 0 else clock_of(int(whole.t_ns[0])))
    about = Description(
        spec, zero, f"{path.name}:{topic.name}",
        session={"imported": path.name, "topic": topic.name},
    )  # fmt: skip
    return write_chunks(output, about, whole, account, str(path))


def _array_in(bag: OpenBag, samples: str) -> ArraySpec | None:
    """What the bag says of the array that the samples of a topic are of, if it does."""
    beside = f"{samples.rpartition('/')[0]}/{ARRAY}"
    if beside not in bag.reader.topics or bag.reader.topics[beside].msgtype != messages.ARRAY:
        return None
    for _, raw, _ in bag.messages(beside):
        try:
            return messages.array_of(bytes(raw))
        except (ValueError, TypeError, KeyError):
            continue
    return None


def _unnamed(name: str, chunk: Chunk) -> ArraySpec:
    """An array of which only its shape and rate are known."""
    _, elements, channels = chunk.values.shape
    steps = np.diff(chunk.t_ns)
    rate = NS_PER_S / float(np.median(steps)) if len(steps) else 1.0
    spec = ArraySpec(
        name, tuple(f"T{k}" for k in range(elements)), tuple((0, k) for k in range(elements)),
        ((0.0, 0.0, 0.0),) * elements, ((1.0, 0.0, 0.0, 0.0),) * elements,
        tuple(f"c{k}" for k in range(channels)), ("1",) * channels, 1.0, "mount",
    )  # fmt: skip
    return replace(spec, rate_hz=float(f"{rate:.6g}"))
