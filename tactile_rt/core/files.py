"""Files and folders that are there whole or not at all, and files that are none."""

import errno
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Final, cast

from tactile_rt.core.errors import ConfigError

POINTER: Final = "is a Git LFS pointer, not the file itself: `git lfs pull`"
_LFS: Final = b"version https://git-lfs.github.com/spec/"


def is_pointer(begins: bytes) -> bool:
    """Return whether a Git LFS pointer, which names content stored elsewhere, begins so."""
    return begins.startswith(_LFS)


def check_no_pointer(path: Path) -> None:
    """Refuse a Git LFS pointer; what cannot be read is left to the reader.

    Raises:
        ConfigError: it is one.
    """
    with suppress(OSError):
        open_regular(path).close()


def open_regular(path: Path) -> BinaryIO:
    """Open a file to read. A pipe, socket or device is refused, and never waited for.

    Raises:
        ConfigError: it is a Git LFS pointer.
        OSError: it is no file, or cannot be read.
    """
    _check_regular(path, os.stat(path))  # opening a device may do something to it
    file = os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb")
    try:
        _check_regular(path, os.fstat(file.fileno()))  # nor what has come in its place since
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
    """Put the names of a folder's files on the medium; without it a power cut may take them.

    Raises:
        OSError: the medium failed, or there is no such folder.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except PermissionError:  # who may write into a folder need not be allowed to read it
        return
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a file system that knows no such thing
            raise
    finally:
        os.close(handle)


def write_whole(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let `write(file)` fill a file that appears under its name only when complete.

    Until then it is hidden: ``.NAME.XXXXXXXX`` in the same folder. If it fails, nothing has
    changed. What is no file, as ``/dev/null`` or a pipe, is written into.

    Raises:
        OSError: naming `path`: its folder cannot be written into, or the medium is full.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        try:
            with path.open("wb") as file:
                write(file)
        except OSError as error:
            _name(error, path, path)
            raise
        return
    with _complete(path, _hidden(path), "x+b") as file:
        write(file)


@contextmanager
def _complete(path: Path, hidden: Path, mode: str) -> Iterator[BinaryIO]:
    """A file that takes its name when the block ends; if that fails, nothing has changed."""
    try:
        with cast(BinaryIO, hidden.open(mode)) as file:
            yield file
        os.replace(hidden, path)
    except BaseException as error:
        with suppress(OSError):  # where nothing may be written it may not be removed either
            hidden.unlink(missing_ok=True)
        _name(error, hidden, path)
        raise


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}")


def _name(error: BaseException, hidden: Path, path: Path) -> None:
    """Let a failure of what is hidden, or of no file that is named, be one of `path`."""
    if not isinstance(error, OSError) or not error.errno:
        return
    named = error.filename  # a number, where the file was opened by one
    if named is None or (isinstance(named, str) and Path(named).is_relative_to(hidden)):
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from None


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """A file to fill that takes its name when the block ends, and is on the medium by then.

    Until then it is ``STEM.partial`` beside it, so that a process that was killed leaves one at
    most; the folder must be one's own (`locks.alone_in`). If the block fails, nothing has changed.

    Raises:
        OSError: naming `path`: the medium is full, or failed.
    """
    with _complete(path, path.with_suffix(".partial"), "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder to fill, which takes its name, and the place of what had it, when the block ends.

    Until then it is hidden: ``.NAME.XXXXXXXX`` beside it. If the block fails, nothing has changed.

    Raises:
        OSError: naming `path`, where it is of no file in it: the medium is full, for one.
    """
    made = _hidden(path)
    try:
        made.mkdir()
        yield made
        if path.exists():
            old = _hidden(path)
            path.rename(old)
            made.rename(path)
            shutil.rmtree(old)
        else:
            made.rename(path)
    except BaseException as error:
        shutil.rmtree(made, ignore_errors=True)
        _name(error, made, path)
        raise
