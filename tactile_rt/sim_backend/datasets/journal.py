"""An object's sweeps on their way to its file: each is kept as soon as it is finished.

`NAME.part` holds records of (length, CRC-32, sweep). Whatever kills the process, what was appended
stays; a record that was being written is told by its length or checksum, and cut off.
"""

import fcntl
import os
import struct
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.datasets.inventory import SUMS
from tactile_rt.sweep_set import MANIFEST, SKIPPED

__all__ = ["Journal", "SweepRecord", "remove_leftovers"]

HEADER = struct.Struct("<QI")  # length of the record that follows, its CRC-32
SUFFIX = ".part"
STALE_S = 60


@dataclass(frozen=True)
class SweepRecord:
    """One finished sweep.

    Attributes:
        values: The (sample, element, channel) loads of the sweep, SI.
        parameters: The parameters that the sweep was made with, by name.
        contacts: The (sample, element) contacts, see `Sweeps`; None when they are not kept.
    """

    values: NDArray[np.float32]
    parameters: dict[str, float]
    contacts: NDArray[np.float32] | None = None


class _Stored(msgspec.Struct, omit_defaults=True):
    index: int
    shape: tuple[int, ...]
    parameters: dict[str, float]
    values: bytes
    contacts: bytes | None = None


class Journal:
    """The finished sweeps of one object, which one process at a time may append to.

    Another process that opens it waits for the first to leave; so does a run that begins while
    the last worker of a killed one is still at this object.

    Args:
        folder: the set.
        name: the object.

    Attributes:
        records: The finished sweeps of the object, by index.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.path = folder / f"{name}{SUFFIX}"
        self._file = self.path.open("a+b", buffering=0)
        fcntl.flock(self._file, fcntl.LOCK_EX)
        self._file.seek(0)
        content = self._file.read()
        self.records, valid = _parse(content)
        if valid < len(content):
            self._file.truncate(valid)

    def append(self, index: int, record: SweepRecord) -> None:
        """Keep a finished sweep.

        Raises:
            OSError: naming the journal: the medium is full.
        """
        values = np.ascontiguousarray(record.values, dtype=np.float32)
        contacts = None if record.contacts is None else record.contacts.astype("<f4").tobytes()
        stored = _Stored(index, values.shape, record.parameters, values.tobytes(), contacts)
        payload = msgspec.msgpack.encode(stored)
        whole = memoryview(HEADER.pack(len(payload), zlib.crc32(payload)) + payload)
        try:
            while whole:
                whole = whole[self._file.write(whole) :]
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from None
        self.records[index] = record

    def remove(self) -> None:
        """Delete the journal: its sweeps are in the object's own file."""
        self.path.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()  # which also lets the next one in


def _parse(content: bytes) -> tuple[dict[int, SweepRecord], int]:
    """The whole records from the start, and how many bytes they take."""
    records: dict[int, SweepRecord] = {}
    at = 0
    while len(content) - at >= HEADER.size:
        length, checksum = HEADER.unpack_from(content, at)
        payload = content[at + HEADER.size : at + HEADER.size + length]
        if len(payload) < length or zlib.crc32(payload) != checksum:
            break
        try:
            stored = msgspec.msgpack.decode(payload, type=_Stored)
        except msgspec.MsgspecError:  # a run of zeros has the right checksum of nothing
            break
        values = np.frombuffer(stored.values, dtype=np.float32).reshape(stored.shape)
        contacts = None
        if stored.contacts is not None:
            contacts = np.frombuffer(stored.contacts, dtype=np.float32).reshape(stored.shape[:2])
        records[stored.index] = SweepRecord(values, stored.parameters, contacts)
        at += HEADER.size + length
    return records, at


def remove_leftovers(folder: Path) -> None:
    """Delete what killed processes left half-written: hidden files that no one is filling."""
    for path in folder.glob(".*.npz.*"):
        name = path.name[1:].rpartition(".npz.")[0]
        with _locked(folder / f"{name}{SUFFIX}") as free:
            if free:
                path.unlink(missing_ok=True)
    for name in (MANIFEST, SKIPPED, SUMS):
        for path in folder.glob(f".{name}.*"):
            # No lock tells whether someone is at these, but they take milliseconds to write.
            if time.time() - path.stat().st_mtime > STALE_S:
                path.unlink(missing_ok=True)


@contextmanager
def _locked(path: Path) -> Iterator[bool]:
    """Hold a journal's lock, if it can be had at once; one that is not there needs none."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        yield True
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        yield False
    else:
        yield True
    finally:
        os.close(handle)
