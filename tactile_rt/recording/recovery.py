"""Recovery of a recording that was cut short or damaged."""

import os
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.files import open_regular, sync_folder, write_whole
from tactile_rt.recording.description import METADATA, RECOVERED, SESSION, Description
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.records import MAGIC, read_whole_records
from tactile_rt.recording.ros2_form import ARRAY, CHANNELS, is_in_file_form, name_channel, plain
from tactile_rt.recording.writer import McapFile, check_not_recorded

if TYPE_CHECKING:
    from tactile_rt.recording.records import Record

MOST_NONE = 1000  # invalid messages, beyond which the file is taken for no recording at all


def recover(path: str | Path, output: str | Path | None = None, force: bool = False) -> Path:
    """Copy all intact parts of a recording into a new one; keep the old one.

    Args:
        path: recording that was cut short (a killed process, a full disk) or damaged.
        output: the file to write; None: ``NAME.recovered.mcap`` in the same folder.

    Returns:
        The new file; `path` itself if that is intact and `output` is None.

    Raises:
        ConfigError: no such file exists, or the output exists already or is being recorded right
            now.
        RecordingError: the file is no recording, or nothing in it is intact.
    """
    path = Path(path)
    whole = _is_whole(path)
    if whole and output is None:
        return path
    output = path.with_name(f"{path.stem}.recovered.mcap") if output is None else Path(output)
    if output.exists() and not force:
        raise ConfigError(f"{output} already exists: name another file, or force it")
    if output.resolve() == path.resolve():
        raise ConfigError(f"{output} is the damaged file itself: name another")
    check_not_recorded(output)
    with open_regular(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{path} is not an MCAP file, or was cut before it began")
        file.seek(0)
        about, records = _read_head(path, _read_records(path, file))
        write_whole(output, lambda new: _copy(path, records, new, about))
    sync_folder(output.parent)
    return output


def _is_whole(path: Path) -> bool:
    try:
        for _ in Recording(path).raw():
            pass
    except RecordingError:
        return False
    return True


def _read_records(path: Path, file: BinaryIO) -> "Iterator[Record]":
    try:
        yield from read_whole_records(file)
    except ValueError as error:
        raise RecordingError(f"{path} is no recording: {error}") from None


def _read_head(path: Path, records: "Iterator[Record]") -> "tuple[Description, Iterator[Record]]":
    """Return the description of a recording, and the records after it."""
    from mcap.records import Metadata

    found: dict[str, dict[str, str]] = {}
    for record in records:
        if isinstance(record, Metadata):
            found.setdefault(record.name, record.metadata)
        elif found:
            records = chain((record,), records)
            break
    if METADATA not in found:
        raise RecordingError(f"{path}: nothing in it is whole, or it is no recording of tactile-rt")
    about = Description.from_metadata(str(path), found[METADATA], found.get(SESSION, {}), True)
    return about, records


def _copy(path: Path, records: "Iterator[Record]", new: BinaryIO, about: Description) -> None:
    from mcap.records import Channel, Message

    file = McapFile(new, about)
    file.note(RECOVERED, {"by": "tactile_rt"})
    # A damaged first chunk loses the names of the channels, but their numbers are always the same.
    numbered = (name for name, wire in CHANNELS if wire in ("", about.wire))
    names = dict(enumerate(numbered, 1))
    whole, none = False, 0
    for record in records:
        if isinstance(record, Channel):
            names[record.id] = name_channel(record.topic)
        elif isinstance(record, Message) and record.channel_id in names:
            name = names[record.channel_id]
            if name == ARRAY:  # `McapFile.add` writes it anew
                continue
            if is_in_file_form(name, record.data, about.spec.shape):
                t_ns = record.log_time - about.utc_offset_ns
                file.add(name, plain(name, record.data), t_ns)
                whole = True
            else:
                none += 1
        if none > MOST_NONE:
            raise RecordingError(
                f"{path} is no recording: more than {MOST_NONE} messages cannot be decoded"
            )
    if not whole:
        raise RecordingError(f"{path}: nothing in it is whole")
    file.finish()
    os.fsync(new.fileno())
