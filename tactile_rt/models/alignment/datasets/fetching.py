"""The sessions of a published dataset, by name, size and checksum, and what is needed of them.

A session is gigabytes, of which its voltages are nearly all. What alignment reads, trials, contacts
and spikes, is read from the archive's own files by HTTP ranges and written to small NWB files of
the same structure, which everything else takes like whole ones.

The list is of one version of the dataset, and its addresses are of one version of every file, so
that whoever fetches gets the same.
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import Any

from tactile_rt.errors import ConfigError
from tactile_rt.files import write_whole
from tactile_rt.models.alignment.datasets.ranges import RangeFile, connections
from tactile_rt.models.alignment.nwb import read_nwb
from tactile_rt.models.alignment.nwb_parts import (
    COLUMNS,
    CONTACTS,
    EXPERIMENT,
    LARGEST,
    SUBJECT,
    TRIALS,
    WHISKER,
    last_time,
)

__all__ = ["Fetched", "PublishedFile", "counted", "fetch", "published_files"]

UNITS = ("spike_times", "spike_times_index", "depth", "inhibitory")


@dataclass(frozen=True)
class PublishedFile:
    """A session's file in an archive.

    Attributes:
        path: The path in the dataset, ``sub-231CR/sub-231CR_ses-20190921T144923_....nwb``.
        size: Bytes.
        sha256: The checksum of the whole file, hexadecimal.
    """

    path: str
    size: int
    sha256: str
    url: str

    @property
    def name(self) -> str:
        """The name of the file alone."""
        return PurePosixPath(self.path).name


@dataclass(frozen=True)
class Fetched:
    """What came of it.

    Attributes:
        files: The number of files that are in the folder now.
        new: The number of those that were not there before.
        transferred: The bytes that came over the network.
    """

    files: int
    new: int
    transferred: int


def published_files(listing: str) -> tuple[PublishedFile, ...]:
    """The files with spikes of a dataset, from the list of them that ships."""
    text = resources.files(__package__).joinpath(listing).read_text("utf-8")
    return tuple(
        PublishedFile(row["path"], int(row["bytes"]), row["sha256"], row["url"])
        for row in csv.DictReader(text.splitlines())
    )


def fetch(
    files: Sequence[PublishedFile],
    folder: Path,
    progress: Callable[[float], None] = lambda share: None,
) -> Fetched:
    """Write what alignment needs of some files to a folder, one small NWB file each.

    What is there already stays, so that a fetch that broke off goes on.

    Args:
        folder: is made if it is not there.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: a file cannot be had, or is not the one that was published; those before it
            are in the folder.
        ModuleNotFoundError: h5py or urllib3 is not installed.
    """
    pool = connections()
    new = transferred = 0
    for done, file in enumerate(files, start=1):
        path = folder / file.name
        if not path.exists():
            small, came = _needed(RangeFile(pool, file.url, file.size), file)
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda out, small=small: out.write(small))  # type: ignore[misc]
            new, transferred = new + 1, transferred + came
        progress(done / len(files))
    return Fetched(len(files), new, transferred)


def counted(paths: Sequence[Path]) -> tuple[int, int, list[str]]:
    """Mice and units of sessions with valid trials, and notes on what was left out.

    Raises:
        ConfigError: none can be read.
    """
    readings, notes = read_nwb(paths, "start")
    mice = {reading.session.animal for reading in readings}
    return len(mice), sum(r.session.rates.shape[1] for r in readings), notes


def _needed(remote: RangeFile, published: PublishedFile) -> tuple[bytes, int]:
    """An NWB file of what is needed of another, and the bytes that came for it."""
    import h5py

    small = io.BytesIO()
    try:
        with h5py.File(remote, "r") as source, h5py.File(small, "w") as target:
            for name in _columns(source):
                _copy(source, target, name)
            for name, end in _clocks(source):
                target[name] = [end]
            target.attrs["source"] = published.url
            target.attrs["source_sha256"] = published.sha256
    except Exception as error:  # of what a file over the network raises, h5py makes many things
        reason = remote.error or " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{published.path} cannot be fetched: {reason}") from None
    return small.getvalue(), remote.transferred


def _columns(file: Any) -> Iterator[str]:
    """Datasets that `nwb` reads, those that are there."""
    yield from (name for name in (SUBJECT, EXPERIMENT) if name in file)
    for table, columns in ((TRIALS, COLUMNS), ("units", UNITS)):
        yield from (f"{table}/{c}" for c in columns if table in file and c in file[table])
    yield from (
        f"acquisition/{name}/starting_time"
        for name, series in file.get("acquisition", {}).items()
        if "starting_time" in series
    )
    for module in file.get("processing", {}).values():
        yield from (
            f"{table.name[1:]}/start_time"
            for name, table in module.items()
            if name.startswith(CONTACTS) and "start_time" in table
        )


def _clocks(file: Any) -> Iterator[tuple[str, float]]:
    """Clocks of whiskers, millions of times, and the last time, which alone counts."""
    for module in file.get("processing", {}).values():
        for name, group in module.items():
            end = last_time(group) if name.startswith(WHISKER) else None
            if end is not None:
                yield f"{group.name[1:]}/angle/timestamps", end


def _copy(source: Any, target: Any, name: str) -> None:
    data, (place, _, leaf) = source[name], name.rpartition("/")
    if data.size * max(data.dtype.itemsize, 1) > LARGEST:
        raise ConfigError(f"{name} has {data.size} values, more than a session can have")
    group = target.require_group(place)
    source.copy(data, group, leaf)
    if "neurodata_type" in data.parent.attrs:  # by which the recording is known among series
        group.attrs["neurodata_type"] = data.parent.attrs["neurodata_type"]
