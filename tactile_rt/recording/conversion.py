"""Conversion of a recording to arrays (.npz, .h5), text (.csv) or a ROS 2 bag.

    seq, t_ns, values, valid       the samples, as in `Chunk`
    decisions, events, health      messages as JSON, each with its time in ..._log_ns
    about                          the recording's description as JSON

A .csv has the samples only. In an .npz, texts are JSON lines in arrays of bytes: in NumPy's own
text arrays each item takes the size of the longest. HDF5 is written piece by piece, and needs the
extra ``hdf5``.

    bag/metadata.yaml    its contents; ``ros2 bag info`` and ``ros2 bag play`` take the folder
    bag/bag_0.mcap       a recording, which `Recording` reads, too; further ones are bag_1.mcap, ...

A recording could be a file of a bag without change; it is rewritten to add the wrenches of an array
of one element as ``geometry_msgs/msg/WrenchStamped``.
"""

import csv
import io
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.files import replace_folder, write_whole
from tactile_rt.core.packages import require_extra
from tactile_rt.core.stream import Chunk, concatenate
from tactile_rt.recording.description import RECOVERED, Description, seal
from tactile_rt.recording.layout import SAMPLES, WIRE, Raw, decode_samples
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2_form import TEXTS, WRENCH
from tactile_rt.recording.writer import McapFile

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

COLUMNS = ("seq", "t_ns", "values", "valid")
BLOCK = 1 << 14  # samples that are written at once
PIECE = 1024  # samples of an HDF5 chunk, which has a checksum


def convert(path: str | Path, output: str | Path) -> int:
    """Write a recording as ``.npz``, ``.csv`` or ``.h5``, whole or not at all.

    Their layout is described in docs/reference/recording.md; raw packets are in the recording only.

    Returns:
        Number of samples.

    Raises:
        ConfigError: the name has another ending, or an extra is not installed.
        RecordingError: the recording is damaged, or has no samples.
    """
    output = Path(output)
    write = WRITERS.get(output.suffix)
    if write is None:
        raise ConfigError(
            f"{output} is none of {', '.join(WRITERS)}; recordings are made by `tactile-rt record` "
            "and, of tables, by `tactile-rt import`"
        )
    if write is write_hdf5:
        _import_h5py()
    recording, n = Recording(path), 0

    def fill(file: BinaryIO) -> None:
        nonlocal n
        n = write(recording, file)

    write_whole(output, fill)
    return n


def about_text(about: Description) -> str:
    """Return a description as one line of JSON, for a file without raw packets."""
    fields = {
        "tactile_rt": replace(about, wire="").to_metadata(),
        "session": seal(about.session) if about.session else {},
        "recovered": about.recovered,
    }
    return msgspec.json.encode(fields).decode()


def write_csv(recording: Recording, file: BinaryIO) -> int:
    """Write a line per sample; cells of invalid elements are empty."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
    lines = csv.writer(text, lineterminator="\n")
    spec, n = recording.spec, 0
    channels = [f"{c} [{unit}]" for c, unit in zip(spec.channels, spec.units, strict=True)]
    lines.writerow(["seq", "t_ns", *(f"{e}.{c}" for e in spec.elements for c in channels)])
    for chunk in _read_blocks(recording):
        lines.writerows(_write_rows(chunk))
        n += len(chunk)
    text.detach()
    return n


def _write_rows(chunk: Chunk) -> Iterator[list[Any]]:
    shown = np.repeat(chunk.valid, chunk.values.shape[2], axis=1)
    flat = chunk.values.reshape(len(chunk), -1)
    for seq, t_ns, row, show in zip(chunk.seq, chunk.t_ns, flat, shown, strict=True):
        # str() of a float32 is the shortest text that reads back as the same number
        yield [seq, t_ns, *(str(x) if ok else "" for x, ok in zip(row, show, strict=True))]


def write_npz(recording: Recording, file: BinaryIO) -> int:
    """Write a recording as arrays, with all of it in memory."""
    about, whole = recording.description, concatenate(list(_read_blocks(recording)))
    arrays: dict[str, Any] = {name: getattr(whole, name) for name in COLUMNS}
    for topic in TEXTS:
        lines, arrays[f"{topic}_log_ns"] = _read_texts(recording, topic)
        arrays[topic] = np.frombuffer("".join(f"{x}\n" for x in lines).encode(), np.uint8)
    arrays |= {
        "utc_offset_ns": np.int64(about.utc_offset_ns),
        "spec": np.str_(about.spec.to_json()),
        "about": np.str_(about_text(about)),
    }
    np.savez(file, **arrays)
    return len(whole)


def write_hdf5(recording: Recording, file: BinaryIO) -> int:
    """Write a recording as datasets, block by block, with names and units."""
    h5py, about, n = _import_h5py(), recording.description, 0
    with _DeferredErrorFile(os.dup(file.fileno())) as out, h5py.File(out, "w") as made:
        for block in _read_blocks(recording):
            for name in COLUMNS:
                _append(made, name, getattr(block, name), n)
            n += len(block)
            out.check()
        text = h5py.string_dtype()
        for topic in TEXTS:
            lines, log_ns = _read_texts(recording, topic)
            made.create_dataset(topic, data=lines, dtype=text, shape=(len(lines),))
            made.create_dataset(f"{topic}_log_ns", data=log_ns)
        for name in ("elements", "channels", "units"):
            made.create_dataset(name, data=list(getattr(about.spec, name)), dtype=text)
        made.create_dataset("about", data=about_text(about), dtype=text)
        made.attrs.update(
            frame=about.spec.frame, rate_hz=about.spec.rate_hz, utc_offset_ns=about.utc_offset_ns
        )
    return n


WRITERS = {".npz": write_npz, ".csv": write_csv, ".h5": write_hdf5, ".hdf5": write_hdf5}


def _append(made: Any, name: str, data: NDArray[Any], n: int) -> None:
    """Append to a dataset that has n rows; create it if n is 0."""
    if not n:
        made.create_dataset(
            name, data=data, maxshape=(None, *data.shape[1:]), chunks=(PIECE, *data.shape[1:]),
            fletcher32=True,
        )  # fmt: skip
        return
    made[name].resize(n + len(data), axis=0)
    made[name][n:] = data


def _read_blocks(recording: Recording) -> Iterator[Chunk]:
    """Yield the samples in blocks of about `BLOCK`; raise RecordingError if none exist."""
    waiting: list[Chunk] = []
    n = total = 0
    for chunk in recording:
        waiting.append(chunk)
        n, total = n + len(chunk), total + len(chunk)
        if n >= BLOCK:
            yield concatenate(waiting)
            waiting, n = [], 0
    if waiting:
        yield concatenate(waiting)
    if not total:
        raise RecordingError(f"{recording.path} has no samples")


def _read_texts(recording: Recording, topic: str) -> tuple[list[str], NDArray[np.int64]]:
    """Return a topic's JSON messages, and the host monotonic time of each, ns."""
    raws = list(recording.raw(topic))
    return [raw.data.decode() for raw in raws], np.array([raw.t_ns for raw in raws], np.int64)


def _import_h5py() -> Any:
    with require_extra("HDF5 needs", "hdf5"):
        import h5py
    return h5py


class _DeferredErrorFile(io.FileIO):
    """File whose write errors are raised by `check`, not while HDF5 writes.

    HDF5 would print dozens of lines for every piece that it cannot write.
    """

    def __init__(self, handle: int) -> None:
        super().__init__(handle, "r+b")
        self._failed: OSError | None = None

    def check(self) -> None:
        """Raise the first write error, if any."""
        if self._failed is not None:
            raise self._failed

    def write(self, data: "ReadableBuffer") -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left and self._failed is None:
                left = left[super().write(left) :]
        except OSError as error:
            self._failed = error
        return size

    def __exit__(self, *_: object) -> None:
        self.close()
        self.check()


BAG_VERSION = 5  # of metadata.yaml: the newest that ROS 2 Humble reads; later releases do, too


class _File(NamedTuple):
    name: str
    begin_ns: int
    end_ns: int
    counts: dict[tuple[str, str], int]  # number of messages by (topic, message type)


def write_bag(recordings: Sequence[Recording], folder: Path) -> int:
    """Write recordings as a ROS 2 bag; return the number of samples.

    Args:
        folder: The bag to write; an existing one is replaced.
    """
    n = 0
    with replace_folder(folder) as made:
        files = []
        for k, recording in enumerate(recordings):
            name = f"{folder.name}_{k}.mcap"
            samples, file = _write_file(recording, made / name)
            n += samples
            files.append(file)
        (made / "metadata.yaml").write_text(_write_metadata(files))
    return n


def _write_file(recording: Recording, path: Path) -> tuple[int, _File]:
    about, n = recording.description, 0
    begin_ns, end_ns = 1 << 63, 0
    with path.open("wb") as file:
        made = McapFile(file, about, further={WRENCH: messages.WRENCH})
        if about.recovered:
            made.note(RECOVERED, {"by": "tactile_rt"})
        for raw in recording.raw(SAMPLES, WIRE, *TEXTS):
            made.add(raw.topic, raw.data, raw.t_ns)
            utc_ns = max(0, raw.t_ns + about.utc_offset_ns)
            begin_ns, end_ns = min(begin_ns, utc_ns), max(end_ns, utc_ns)
            if raw.topic == SAMPLES:
                n += _add_wrenches(made, raw)
        made.finish()
    counts = {made.topics[name]: many for name, many in made.counts.items()}
    return n, _File(path.name, min(begin_ns, end_ns), end_ns, counts)


def _add_wrenches(made: McapFile, raw: Raw) -> int:
    """Add each valid sample's wrench, if the array has one; return the number of samples."""
    about = made.about
    chunk = decode_samples(raw.data, about.spec.shape)
    wrenches = messages.wrenches_of(about.spec, chunk.values)
    if wrenches is not None:
        rows = zip(chunk.t_ns.tolist(), wrenches.tolist(), chunk.valid[:, 0], strict=True)
        for t_ns, row, ok in rows:
            if ok:
                utc_ns = t_ns + about.utc_offset_ns
                data = messages.wrench_message(row, utc_ns, about.spec.frame)
                made.put(WRENCH, data, raw.t_ns)
    return len(chunk)


def _write_metadata(files: Sequence[_File]) -> str:
    """Return the text of metadata.yaml, as JSON, which is a subset of YAML."""
    totals = Counter[tuple[str, str]]()
    for file in files:
        totals.update(file.counts)
    begin_ns, end_ns = min(f.begin_ns for f in files), max(f.end_ns for f in files)
    about = {
        "version": BAG_VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name for file in files],
        **_describe_span(begin_ns, end_ns),
        "message_count": sum(totals.values()),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic, "type": kind, "serialization_format": "cdr",
                    "offered_qos_profiles": "",
                },
                "message_count": many,
            }
            for (topic, kind), many in totals.items()
        ],
        "compression_format": "",
        "compression_mode": "",
        "files": [
            {
                "path": file.name,
                **_describe_span(file.begin_ns, file.end_ns),
                "message_count": sum(file.counts.values()),
            }
            for file in files
        ],
    }  # fmt: skip
    text = msgspec.json.format(msgspec.json.encode({"rosbag2_bagfile_information": about}))
    return text.decode() + "\n"


def _describe_span(begin_ns: int, end_ns: int) -> dict[str, Any]:
    return {
        "duration": {"nanoseconds": end_ns - begin_ns},
        "starting_time": {"nanoseconds_since_epoch": begin_ns},
    }
