"""Download of the needed parts of a published dataset's sessions.

A session has gigabytes, nearly all of them voltages. Alignment needs trials, contacts and spikes:
these are read from the archive's own files by HTTP ranges and written to small NWB files of the
same structure, which can be used like the original files.

The list gives each file's name, size, checksum and address, for one version of the dataset, so that
all users fetch the same data.
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.request import getproxies

from tactile_rt.alignment import nwb_parts as parts
from tactile_rt.alignment.nwb import read_nwb
from tactile_rt.core.errors import ConfigError, describe_error
from tactile_rt.core.files import write_whole

if TYPE_CHECKING:
    import urllib3

UNITS = ("spike_times", "spike_times_index", "depth", "inhibitory")
BLOCK = 1 << 16  # bytes of a block
KEPT = 1 << 10  # blocks in the cache at most
PATIENCE_S = 60.0  # timeout of a request
AGAIN = 4  # retries of a request, after 0, 1, 2 and 4 s
BUSY = (429, 500, 502, 503, 504)  # HTTP status codes after which a request is retried


def connections() -> "urllib3.PoolManager":
    """Make an HTTP connection pool with retries, through the proxy if the system has one."""
    import urllib3

    again = urllib3.Retry(AGAIN, backoff_factor=0.5, status_forcelist=BUSY, raise_on_status=False)
    proxy = getproxies().get("https")
    if proxy:
        return urllib3.ProxyManager(proxy, retries=again, timeout=PATIENCE_S)
    return urllib3.PoolManager(retries=again, timeout=PATIENCE_S)


class RangeFile(io.RawIOBase):
    """A read-only file object for a file on a web server, read by HTTP ranges.

    Bytes are fetched in blocks, which are cached: the metadata of HDF5 is small, scattered over
    gigabytes, and read again and again. Adjacent missing blocks are fetched by one request.
    h5py hides this object's errors behind its own; the first error's message stays in `error`.

    Args:
        size: the file's size in bytes; an error if the server reports another size.
    """

    def __init__(self, pool: "urllib3.PoolManager", url: str, size: int) -> None:
        self.error = ""  # message of the first failed request
        self.transferred = 0  # bytes
        self._pool, self._url, self._size = pool, url, size
        self._blocks: dict[int, bytes] = {}
        self._place = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._place = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._place}.get(whence, self._size)
        return self._place

    def tell(self) -> int:
        return self._place

    def readinto(self, buffer: "memoryview | bytearray") -> int:  # type: ignore[override]
        wanted = memoryview(buffer).cast("B")
        begin, end = self._place, min(self._place + len(wanted), self._size)
        if begin >= end:
            return 0
        first, last = begin // BLOCK, (end - 1) // BLOCK
        missing = [k for k in range(first, last + 1) if k not in self._blocks]
        if missing:
            self._fetch(missing[0], missing[-1])
        data = b"".join(self._blocks[k] for k in range(first, last + 1))
        wanted[: end - begin] = data[begin - first * BLOCK : end - first * BLOCK]
        self._place = end
        while len(self._blocks) > KEPT:
            del self._blocks[next(iter(self._blocks))]
        return end - begin

    def _fetch(self, first: int, last: int) -> None:
        """Fetch blocks `first` to `last`, inclusive, into the cache."""
        import urllib3

        begin, end = first * BLOCK, min((last + 1) * BLOCK, self._size)
        try:
            answer = self._pool.request(
                "GET",
                self._url,
                headers={"Range": f"bytes={begin}-{end - 1}"},
                preload_content=False,
            )
            try:
                whole = answer.headers.get("Content-Range", "").rpartition("/")[2]
                if answer.status in (206, 416) and whole != str(self._size):
                    raise ConfigError(f"it has {whole or 'no'} bytes, and not {self._size}")
                if answer.status == 200:
                    raise ConfigError("the server sends whole files, no ranges")
                if answer.status != 206:
                    raise ConfigError(f"the server says {answer.status} {answer.reason or ''}")
                data = answer.read()
            except ConfigError:
                answer.close()  # or its remaining bytes would be read as the next answer
                raise
            answer.release_conn()
            if len(data) != end - begin:
                raise ConfigError(f"{len(data)} bytes received, not the {end - begin} requested")
        except (ConfigError, urllib3.exceptions.HTTPError) as error:
            reason = str(getattr(error, "reason", error))  # of the last retry
            self.error = self.error or " ".join(reason.split())
            raise ConfigError(self.error) from None
        self.transferred += len(data)
        for k in range(first, last + 1):
            self._blocks[k] = data[k * BLOCK - begin : (k + 1) * BLOCK - begin]


@dataclass(frozen=True)
class PublishedFile:
    """A session's file in a public archive, as the list names it."""

    path: str  # path in the dataset, ``sub-231CR/sub-231CR_ses-20190921T144923_....nwb``
    size: int  # bytes
    sha256: str
    url: str

    @property
    def name(self) -> str:
        """Name of the file without folders."""
        return PurePosixPath(self.path).name


def published_files(listing: str) -> tuple[PublishedFile, ...]:
    """Read the list of a dataset's files with spikes from this package."""
    text = resources.files(__package__).joinpath(listing).read_text("utf-8")
    return tuple(
        PublishedFile(row["path"], int(row["bytes"]), row["sha256"], row["url"])
        for row in csv.DictReader(text.splitlines())
    )


def fetch(
    files: Sequence[PublishedFile],
    folder: Path,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[int, int]:
    """Download the parts of files that alignment needs, each into a small NWB file.

    Files that exist are skipped, so that an interrupted fetch can be resumed.

    Returns:
        The number of new files, and the number of bytes received over the network.

    Raises:
        ConfigError: a file cannot be fetched, or differs from the published file; earlier files
            stay in the folder.
    """
    pool = connections()
    new = transferred = 0
    for done, file in enumerate(files, start=1):
        path = folder / file.name
        if not path.exists():
            small, received = _extract_needed(RangeFile(pool, file.url, file.size), file)
            folder.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda out, small=small: out.write(small))  # type: ignore[misc]
            new, transferred = new + 1, transferred + received
        progress(done / len(files))
    return new, transferred


def count_recorded(paths: Sequence[Path]) -> tuple[int, int, list[str]]:
    """Count the mice and units of sessions with valid trials; return notes on omissions too."""
    readings, notes = read_nwb(paths, "start")
    mice = {reading.session.animal for reading in readings}
    return len(mice), sum(r.session.rates.shape[1] for r in readings), notes


def _extract_needed(remote: RangeFile, published: PublishedFile) -> tuple[bytes, int]:
    """Copy the needed parts of a remote NWB file; return them and bytes received."""
    import h5py

    small = io.BytesIO()
    try:
        with h5py.File(remote, "r") as source, h5py.File(small, "w") as target:
            for name in _find_columns(source):
                _copy_dataset(source, target, name)
            for name, end in _find_clocks(source):
                target[name] = [end]
            target.attrs["source"] = published.url
            target.attrs["source_sha256"] = published.sha256
    except Exception as error:  # h5py turns errors of a remote file into many types
        reason = remote.error or describe_error(error)
        raise ConfigError(f"{published.path} cannot be fetched: {reason}") from None
    return small.getvalue(), remote.transferred


def _find_columns(file: Any) -> Iterator[str]:
    """Yield the names of the HDF5 datasets that `nwb` reads and the file has."""
    yield from (name for name in (parts.SUBJECT, parts.EXPERIMENT) if name in file)
    for table, columns in ((parts.TRIALS, parts.COLUMNS), ("units", UNITS)):
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
            if name.startswith(parts.CONTACTS) and "start_time" in table
        )


def _find_clocks(file: Any) -> Iterator[tuple[str, float]]:
    """Yield the path and last value, s, of each whisker's timestamps. No other is needed."""
    for module in file.get("processing", {}).values():
        for name, group in module.items():
            end = parts.last_time(group) if name.startswith(parts.WHISKER) else None
            if end is not None:
                yield f"{group.name[1:]}/angle/timestamps", end


def _copy_dataset(source: Any, target: Any, name: str) -> None:
    data, (place, _, leaf) = source[name], name.rpartition("/")
    if data.size * max(data.dtype.itemsize, 1) > parts.LARGEST:
        raise ConfigError(f"{name} has {data.size} values, more than a session can have")
    group = target.require_group(place)
    source.copy(data, group, leaf)
    if "neurodata_type" in data.parent.attrs:  # distinguishes the recording from other series
        group.attrs["neurodata_type"] = data.parent.attrs["neurodata_type"]
