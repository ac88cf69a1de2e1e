"""Atomic writing and sync of files and folders; refusal of paths that are no regular files."""

import errno
import os
import secrets
import shutil
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import BinaryIO, Final, cast

from tactile_rt.core.errors import ConfigError

POINTER: Final = "is a Git LFS pointer, not the file itself: `git lfs pull`"
_LFS: Final = b"version https://git-lfs.github.com/spec/"


def is_pointer(begins: bytes) -> bool:
    """Return whether a file's first bytes make it a Git LFS pointer to content elsewhere."""
    return begins.startswith(_LFS)


def refuse_lfs_pointer(path: Path) -> None:
    """Refuse a Git LFS pointer; ignore a file that cannot be read.

    Raises:
        ConfigError: the file is a pointer.
    """
    with suppress(OSError):
        open_regular(path).close()


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading. Refuse a pipe, socket or device without waiting.

    Raises:
        ConfigError: the file is a Git LFS pointer.
        OSError: the path is no regular file, or cannot be read.
    """
    _check_regular(path, os.stat(path))  # before opening, which may have effects on a device
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        _check_regular(path, os.fstat(file.fileno()))  # again: it may have been replaced since
        if is_pointer(os.pread(file.fileno(), len(_LFS), 0)):
            raise ConfigError(f"{path} {POINTER}")
    except (OSError, ConfigError):
        file.close()
        raise
    return file


def _check_regular(path: Path, status: os.stat_result) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "a pipe, socket or device, no file", str(path))


def sync_folder(folder: Path) -> None:
    """Sync a folder to the disk, so that its files' names survive a power cut.

    Raises:
        OSError: the disk failed, or no such folder exists.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except PermissionError:  # a folder may be writable but not readable
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # the file system cannot sync folders
            raise
    finally:
        os.close(handle)


class Syncer:
    """Thread that runs queued sync jobs one after another.

    Data that the operating system holds outlives the process, but not a power cut: only a sync puts
    it on the medium. On a memory card that may take seconds, so a separate thread syncs.
    """

    def __init__(self) -> None:
        self._jobs: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="tactile-rt-sync", daemon=True)
        self._thread.start()

    def add(self, job: Callable[[], object]) -> None:
        """Queue a job to run in the thread after all earlier jobs. It must not raise."""
        self._jobs.put(job)

    def close(self) -> None:
        """Wait until all queued jobs are done, then end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            job()


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file atomically by `write(file)`: it gets its name only when complete.

    Until then it is hidden: ``.NAME.XXXXXXXX`` in the same folder. After a failure nothing has
    changed. A path that is no regular file, as ``/dev/null`` or a pipe, is written to directly.

    Raises:
        OSError: names `path`: its folder cannot be written into, or the disk is full.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        try:
            with path.open("wb") as file:
                write(file)
        except OSError as error:
            _raise_for(error, path, path)
            raise
        return
    with _write_hidden(path, _hide_name(path), "x+b") as file:
        write(file)


@contextmanager
def _write_hidden(path: Path, hidden: Path, mode: str) -> Iterator[BinaryIO]:
    """Yield a new file `hidden`; rename it to `path` when the block succeeds."""
    try:
        with cast(BinaryIO, hidden.open(mode)) as file:
            yield file
        os.replace(hidden, path)
    except BaseException as error:
        with suppress(OSError):  # in a read-only folder it cannot be removed, either
            hidden.unlink(missing_ok=True)
        _raise_for(error, hidden, path)
        raise


def _hide_name(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def _raise_for(error: BaseException, hidden: Path, path: Path) -> None:
    """Raise an OSError that names `hidden`, or no file, as one of `path`. Ignore other errors."""
    if not isinstance(error, OSError) or not error.errno:
        return
    named = error.filename  # a number if the file was opened by its descriptor
    if named is None or (isinstance(named, str) and Path(named).is_relative_to(hidden)):
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from None


@contextmanager
def replace_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file, which is synced and replaces `path` when the block succeeds.

    Until then it is called ``STEM.partial``, so that killed processes leave at most one; the
    folder must be locked (`locks.alone_in`). If the block fails, nothing has changed.

    Raises:
        OSError: names `path`: the disk is full, or failed.
    """
    with _write_hidden(path, path.with_suffix(".partial"), "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def replace_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder to fill, which replaces `path` when the block succeeds.

    Until then it is hidden: ``.NAME.XXXXXXXX`` beside it. If the block fails, nothing has changed.

    Raises:
        OSError: names `path` or a file in it; for example, the disk is full.
    """
    made = _hide_name(path)
    try:
        made.mkdir()
        yield made
        if path.exists():
            old = _hide_name(path)
            path.rename(old)
            made.rename(path)
            shutil.rmtree(old)
        else:
            made.rename(path)
    except BaseException as error:
        shutil.rmtree(made, ignore_errors=True)
        _raise_for(error, made, path)
        raise
