"""Topics of ROS 1 and ROS 2 bags, by the library rosbags, without ROS.

A message is a row, its fields are columns by their paths (``wrench.force.x``, ``data.3``). The
columns of known types are built in: wrenches, arrays of numbers, magnetic fields and the like, and
our own. The time is that of the message's header if it is set, else that of the bag.
"""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Final

import numpy as np

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.settings import nearest
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, concatenate
from tactile_rt.drivers.codecs.ascii_mapping import parse_columns
from tactile_rt.drivers.codecs.column_words import compress_columns
from tactile_rt.drivers.logs import Occurrences
from tactile_rt.recording.description import Description
from tactile_rt.recording.importing.bag_file import OpenBag, open_bag
from tactile_rt.recording.importing.report import Import, clock_of, write_chunks
from tactile_rt.recording.importing.table import (
    BESIDE,
    Table,
    import_table,
    mapping_of,
    shown_names,
)
from tactile_rt.recording.importing.table_guess import propose_fields
from tactile_rt.recording.layout import decode_samples
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2_form import ARRAY

LOOKED_AT: Final = 1 << 28  # bytes of each topic that are read to choose one
MOST: Final = 4096  # fields of a message that become columns
# Columns by message type, with {0} for the name of the frame.
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
    """Topic of a bag, with its message type and columns."""

    name: str
    type: str
    messages: int
    # columns of a known type, in the words of ``--columns``; empty if only the user knows them
    columns: str
    # columns of an unknown type for a user to check; empty if no message holds a number
    proposed: str = ""


def bag_topics(path: Path) -> list[BagTopic]:
    """Return the topics of a bag that have messages, sorted by name."""
    found = []
    with open_bag(path) as bag:
        for name, about in sorted(bag.reader.topics.items()):
            if n := about.msgcount:
                found.append(_describe(bag, name, about.msgtype or "", n, LOOKED_AT)[0])
    return found


def is_recording(path: Path) -> bool:
    """Return whether an MCAP file is a recording of tactile-rt."""
    try:
        return path.is_file() and path.suffix == ".mcap" and bool(Recording(path).description)
    except (RecordingError, ConfigError):
        return False


def import_bag(
    path: Path, output: Path, topic: str = "", columns: str = "", rate_hz: float = 0.0
) -> Import:
    """Write a topic of a bag as a recording.

    Args:
        output: the recording to write, whole or not at all.
        topic: name of the topic; if empty, the only topic that can become a recording.
        columns: the meaning of a message's fields, in words or as a TOML file; if empty, the
            built-in columns of the type.
        rate_hz: rate of the samples, Hz; 0 to estimate it from their times.

    Raises:
        ConfigError: no such topic, invalid columns, or the extra is not installed.
        RecordingError: the bag is damaged, or holds no sample.
    """
    if is_recording(path):
        raise ConfigError(f"{path} is a recording already: `tactile-rt replay` and run take it")
    chosen = _choose_topic(path, bag_topics(path), topic, columns)
    with open_bag(path) as bag:
        if chosen.type == messages.SAMPLES and not columns:
            return _import_own(path, bag, chosen, output)
        chosen, paths, channels = _describe(bag, chosen.name, chosen.type, chosen.messages)
        if all(path.startswith(BESIDE) for path in paths) and not columns:
            raise RecordingError(f"{path}: no message of {chosen.name} is whole and holds a number")
        words = columns or chosen.columns
        if not words:
            raise ConfigError(
                f"{path}: {chosen.name} has {chosen.type}: say with --columns what is what, e.g. "
                f"{paths[-1]}=S.value; its fields are {shown_names(paths)}"
            )
        columns_read = parse_columns(mapping_of(words, path.stem).columns, "--columns")
        labels = {c.label.strip().lower() for c in columns_read if c.label}
        steps = [_split_path(p) if p.lower() in labels or not labels else None for p in paths]
        table = Table(path, tuple(paths), (), times_ns=[], notes=bag.notes)
        table.rows = _read_rows(table, bag, chosen.name, steps, channels)
        made = import_table(table, output, words, rate_hz)
        made.out_of_order = bag.back
        return _count_messages(made, chosen)


def _count_messages(made: Import, topic: BagTopic) -> Import:
    """Update an import's counts by the bag's index, which includes unread messages."""
    unread = topic.messages - made.intact - made.corrupt
    made.unit, made.total = "messages", max(topic.messages, made.intact + made.corrupt)
    made.passed_over = made.total - made.read
    if unread > 0:
        made.notes.append(f"{unread} of {topic.messages} messages were not read")
    return made


def _choose_topic(path: Path, topics: list[BagTopic], topic: str, columns: str) -> BagTopic:
    if topic:
        for one in topics:
            if one.name in (topic, f"/{topic}"):
                return one
        raise ConfigError(f"{path}: no topic {topic!r}; {nearest(topic, [t.name for t in topics])}")
    fitting = topics if columns else [t for t in topics if t.columns or t.type == messages.SAMPLES]
    if len(fitting) == 1:
        return fitting[0]
    listed = ", ".join(f"{t.name} ({t.type})" for t in fitting or topics) or "none"
    none = "of none is known what is what: `tactile-rt sniff` proposes --topic and --columns"
    what = "name one with --topic" if fitting else none
    raise ConfigError(f"{path} has the topics {listed}: {what}")


def _find_columns(kind: str, message: Any) -> str:
    """Return the columns of a known message type, in words; empty for other types."""
    if kind in KNOWN:
        frame = getattr(getattr(message, "header", None), "frame_id", "")
        return KNOWN[kind].format(_NO_NAME.sub("_", frame).strip("_") or "sensor")
    if not NUMBERS.fullmatch(kind) or not len(message.data):
        return ""
    channels = _count_channels(message)
    names = ["value"] if channels == 1 else [f"c{k}" for k in range(channels)]
    n = len(message.data) // channels
    return compress_columns(
        [f"data.{e * channels + c}=T{e}.{names[c]}" for e in range(n) for c in range(channels)]
    )


def _count_channels(message: Any) -> int:
    """Return the number of channels of an array message by its layout; 0 if empty."""
    sizes, n = [d.size for d in message.layout.dim], len(message.data)
    fits = len(sizes) > 1 and int(np.prod(sizes)) == n
    return min(n, sizes[-1] if fits else 1)


def _describe(
    bag: OpenBag, name: str, kind: str, n: int, most: float = np.inf
) -> tuple[BagTopic, list[str], int]:
    """Return (description, paths of numbers, number of an array's channels) of a topic."""
    if kind in KNOWN:  # all messages have one size
        whole = (message for _, _, message in bag.messages(name) if message is not None)
        found = list(islice(whole, 1))
    else:
        found = [] if kind == messages.SAMPLES else bag.samples(name, most)
    names: dict[str | int, int] = {}  # in the order of the message's fields
    paths = {
        leaf: [s if isinstance(s, int) else names.setdefault(s, len(names)) for s in steps]
        for one in found
        for leaf in islice(_list_leaves(one, ""), MOST)
        for steps in [_split_path(leaf)]
    }
    listed = sorted(paths, key=paths.__getitem__)
    columns = _find_columns(kind, found[0]) if found else ""
    few = not columns and len(listed) < MOST  # a message with more numbers is a picture
    proposed = "" if not few else propose_fields([p for p in listed if not p.startswith(BESIDE)])
    channels = _count_channels(found[0]) if found and NUMBERS.fullmatch(kind) else 0
    return BagTopic(name, kind, n, columns, proposed), listed, channels


def _split_path(path: str) -> list[int | str]:
    return [int(s) if s.isdecimal() else s for s in path.split(".")]


def _list_leaves(value: Any, at: str) -> Iterator[str]:
    if is_dataclass(value):
        for f in fields(value):
            if f.name != "__msgtype__":
                yield from _list_leaves(getattr(value, f.name), f"{at}.{f.name}" if at else f.name)
    elif isinstance(value, np.ndarray | list | tuple):
        for k, one in enumerate(value):
            yield from _list_leaves(one, f"{at}.{k}")
    elif isinstance(value, int | float | np.number):
        yield at


def _read_rows(
    table: Table, bag: OpenBag, topic: str, steps: list[list[int | str] | None], channels: int
) -> Iterator[Sequence[Any]]:
    """Yield the rows of a topic; note messages that lack numbers or have other channels."""
    times = table.times_ns
    assert times is not None
    fewer, other = Occurrences("message"), Occurrences("message")
    bag.back = 0
    for number, (t_ns, _, message) in enumerate(bag.messages(topic), 1):
        before = times[-1:]
        times[:] = [_read_header_ns(message) or t_ns]
        bag.back += before > times
        row, missing = _read_row(message, steps) if message is not None else ([], 0)
        if row and channels > 1 and _count_channels(message) not in (0, 1, channels):
            other.add(number)
            row = []
        elif missing:
            fewer.add(number)
        yield row
    if other.n:
        bag.notes.append(f"messages of another number of channels, left out: {other}")
    if fewer.n:
        bag.notes.append(f"messages that lack some of the numbers, which are invalid: {fewer}")


def _read_row(message: Any, steps: list[list[int | str] | None]) -> tuple[list[Any], int]:
    """Return (numbers of a message, NaN if missing; count of missing numbers).

    Args:
        steps: path of each number; None leaves the number out, as NaN.
    """
    row, missing = [], 0
    for path in steps:
        value: Any = np.nan if path is None else message
        try:
            for step in path or ():
                value = value[step] if isinstance(step, int) else getattr(value, step)
        except IndexError:
            value, missing = np.nan, missing + 1  # a list that is shorter than others
        row.append(value)
    return row, missing


def _read_header_ns(message: Any) -> int:
    """Return the time in a message's header, ns; 0 if missing or not set."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec) if stamp else 0


def _import_own(path: Path, bag: OpenBag, topic: BagTopic, output: Path) -> Import:
    """Write samples of our own message type as a recording, bit for bit."""
    account = Import(notes=bag.notes)
    array = _find_array(bag, topic.name)
    chunks: list[Chunk] = []
    read = offset = 0
    for t_ns, raw, message in bag.messages(topic.name):
        read += 1
        if message is None:
            continue
        shape = int(message.elements), int(message.channels)
        if array is not None and shape != array.shape:
            raise ConfigError(
                f"{path}: its array is of {array.shape[0]} x {array.shape[1]}, "
                f"{topic.name} of {shape[0]} x {shape[1]}"
            )
        with suppress(ValueError):
            chunk = decode_samples(messages.strip_header(raw), shape)
            if not chunks:
                offset = (_read_header_ns(message) or t_ns) - int(chunk.t_ns[-1])
            if not chunks or chunk.values.shape[1:] == chunks[0].values.shape[1:]:
                chunks.append(chunk)
    account.intact, account.corrupt = len(chunks), read - len(chunks)
    if not chunks:
        raise RecordingError(f"{path}: no message of {topic.name} is whole")
    whole = concatenate(chunks)
    account.missing = int((np.diff(whole.seq) - 1).clip(0).sum())
    spec = array or _make_array(path.stem, whole)
    zero = max(0, offset if offset >= 0 else clock_of(int(whole.t_ns[0])))
    about = Description(
        spec, zero, f"{path.name}:{topic.name}",
        session={"imported": path.name, "topic": topic.name},
    )  # fmt: skip
    return _count_messages(write_chunks(output, about, whole, account, str(path)), topic)


def _find_array(bag: OpenBag, samples: str) -> ArraySpec | None:
    """Read the array of a samples topic from the topic beside it; None if missing."""
    beside = f"{samples.rpartition('/')[0]}/{ARRAY}"
    if beside not in bag.reader.topics or bag.reader.topics[beside].msgtype != messages.ARRAY:
        return None
    for _, raw, _ in bag.messages(beside):
        with suppress(ValueError, TypeError, KeyError):
            return messages.array_of(raw)
    return None


def _make_array(name: str, chunk: Chunk) -> ArraySpec:
    """Make the spec of an array from the shape and rate of its samples."""
    _, elements, channels = chunk.values.shape
    steps = np.diff(chunk.t_ns)
    rate = NS_PER_S / float(np.median(steps)) if len(steps) else 1.0
    return ArraySpec(
        name, tuple(f"T{k}" for k in range(elements)), tuple((0, k) for k in range(elements)),
        ((0.0, 0.0, 0.0),) * elements, ((1.0, 0.0, 0.0, 0.0),) * elements,
        tuple(f"c{k}" for k in range(channels)), ("1",) * channels, float(f"{rate:.6g}"), "mount",
    )  # fmt: skip
