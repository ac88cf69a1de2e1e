"""Recordings as a ROS 2 bag: a folder that ``ros2 bag info`` and ``play`` take.

    bag/metadata.yaml    what is in it
    bag/bag_0.mcap       a recording, which `Recording` reads, too; more of them are bag_1.mcap, ...

A recording is a file of a bag as it is; here it is written anew, so that an array of one element
gets its wrenches as ``geometry_msgs/msg/WrenchStamped`` besides.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tactile_rt.core.files import whole_folder
from tactile_rt.recording.description import RECOVERED
from tactile_rt.recording.layout import SAMPLES, WIRE, Raw, decode_samples
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2_form import CHANNELS, TEXTS, WRENCH, FileForm
from tactile_rt.recording.writer import McapFile

__all__ = ["write_bag"]

BAG_VERSION = 5  # of metadata.yaml: the newest that ROS 2 Humble reads; later ones read it, too
NS = 10**9


class _File(NamedTuple):
    name: str
    begin_ns: int
    end_ns: int
    counts: dict[tuple[str, str], int]  # of each topic and its message


def write_bag(recordings: Sequence[Recording], folder: Path) -> int:
    """Write them; the number of samples.

    Args:
        folder: To make; one that is there is replaced.
    """
    n = 0
    with whole_folder(folder) as made:
        files = []
        for k, recording in enumerate(recordings):
            name = f"{folder.name}_{k}.mcap"
            samples, file = _write(recording, made / name)
            n += samples
            files.append(file)
        (made / "metadata.yaml").write_text(_metadata(files))
    return n


def _write(recording: Recording, path: Path) -> tuple[int, _File]:
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
    form = FileForm(about)
    kinds = {name: kind for (name, wire), kind in CHANNELS.items() if wire in ("", about.wire)}
    kinds[WRENCH] = messages.WRENCH
    counts = {(form.topic(k), kinds[k]): many for k, many in made.counts.items()}
    return n, _File(path.name, min(begin_ns, end_ns), end_ns, counts)


def _add_wrenches(made: McapFile, raw: Raw) -> int:
    """The wrench of each valid sample, if the array has one; the number of samples."""
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


def _metadata(files: Sequence[_File]) -> str:
    """What ROS 2 reads first: YAML, of which JSON is a part."""
    totals: dict[tuple[str, str], int] = {}
    for file in files:
        for key, many in file.counts.items():
            totals[key] = totals.get(key, 0) + many
    begin_ns, end_ns = min(f.begin_ns for f in files), max(f.end_ns for f in files)
    about = {
        "version": BAG_VERSION,
        "storage_identifier": "mcap",
        "relative_file_paths": [file.name for file in files],
        **_span(begin_ns, end_ns),
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
                **_span(file.begin_ns, file.end_ns),
                "message_count": sum(file.counts.values()),
            }
            for file in files
        ],
    }  # fmt: skip
    text = msgspec.json.format(msgspec.json.encode({"rosbag2_bagfile_information": about}))
    return text.decode() + "\n"


def _span(begin_ns: int, end_ns: int) -> dict[str, Any]:
    return {
        "duration": {"nanoseconds": end_ns - begin_ns},
        "starting_time": {"nanoseconds_since_epoch": begin_ns},
    }
