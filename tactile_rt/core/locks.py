"""Locks that allow one process per configuration, device and folder, and name its pid to others.

A lock is a name in the kernel's abstract namespace of Unix sockets (unix(7)), which is released
when its process ends. No file is written, so environment variables, a read-only file system or
leftover files of another user have no influence.
"""

import errno
import hashlib
import os
import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote, urlsplit

from tactile_rt.core.errors import ConfigError, TactileError

DEVICES = ("serial", "can")
TRIES = 20  # to lock a name whose holder does not answer: it has just started, or has just ended
PAUSE_S = 0.01
CREDENTIALS = struct.Struct("3i")  # pid, uid, gid
WAITING = 4096  # length of the queue of processes that request the pid: it is never emptied


class AlreadyRunning(TactileError):
    """Another process has locked the configuration, device or folder; the message names it."""


def lock_keys(config: Path, urls: list[str]) -> list[str]:
    """List the lock keys of a daemon, for its configuration and each device."""
    # The given name is locked, too: a link may lead to another file when a second daemon starts.
    paths = [os.path.realpath(config), os.path.abspath(config)]
    return list(dict.fromkeys([*(f"configuration {p}" for p in paths), *device_keys(urls)]))


def device_keys(urls: list[str]) -> list[str]:
    """List the lock keys of the devices in some URLs. Links to one port give one key."""
    keys = []
    for url in urls:
        parts = urlsplit(url, allow_fragments=False)
        if parts.scheme not in DEVICES:
            continue
        target = unquote(parts.netloc + parts.path)
        port = target.removeprefix("slcan:") if target.startswith("slcan:") else target
        # A CAN bus has a name; a serial line is a file, maybe relative to the working folder.
        line = port != target or parts.scheme == "serial"
        is_file = port.startswith("/") or (line and os.path.exists(port))
        keys.append(f"device {os.path.realpath(port) if is_file else target}")
    return list(dict.fromkeys(keys))


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Lock a folder for this process while the block runs.

    The folder need not exist yet; links are resolved. Only processes of one computer see the lock.

    Raises:
        ConfigError: another process has locked the folder.
        TactileError: the kernel refuses the lock; see `Locks.hold`.
    """
    locks = Locks()
    try:
        locks.hold([f"folder {os.path.realpath(folder)}"])
    except AlreadyRunning as error:
        raise ConfigError(f"{error}: wait until it has ended, or choose another folder") from None
    try:
        yield
    finally:
        locks.close()


class Locks:
    """Named locks of this process, which the kernel releases when the process ends."""

    def __init__(self) -> None:
        self._held: dict[str, socket.socket] = {}

    def hold(self, keys: list[str]) -> None:
        """Hold exactly these locks: acquire the missing ones, then release all others.

        Raises:
            AlreadyRunning: another process holds one of them; this process keeps its present locks.
            TactileError: the kernel refuses a lock, for example because it forbids Unix sockets.
        """
        got: dict[str, socket.socket] = {}
        try:
            for key in keys:
                if key not in self._held:
                    got[key] = _lock(key)
        except BaseException:
            for handle in got.values():
                handle.close()
            raise
        for key in [k for k in self._held if k not in keys]:
            self._held.pop(key).close()
        self._held.update(got)

    def close(self) -> None:
        """Release all locks."""
        self.hold([])


def _lock(key: str) -> socket.socket:
    name = _make_name(key)
    for _ in range(TRIES):
        handle = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            handle.bind(name)
            handle.listen(WAITING)
            return handle
        except OSError as error:
            handle.close()
            if error.errno != errno.EADDRINUSE:
                raise TactileError(f"no lock for {key}: {error.strerror}") from None
        try:
            who = _describe_holder(name)
        except ConnectionRefusedError:
            time.sleep(PAUSE_S)
            continue
        raise AlreadyRunning(f"{key} is in use by {who}")
    raise AlreadyRunning(f"{key} is in use by an unknown process")


def _make_name(key: str) -> bytes:
    """Return a lock's socket name, which differs between containers, as their paths do."""
    root = os.stat("/")
    text = f"{root.st_dev} {root.st_ino} {key}"
    return b"\0tactile-rt/" + hashlib.sha256(os.fsencode(text)).hexdigest()[:32].encode()


def _describe_holder(name: bytes) -> str:
    """Describe the holder of a lock by the pid and user that the kernel reports."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(name)
        except BlockingIOError:  # the queue is full
            return "another process"
        found = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size)
    pid, uid, _ = CREDENTIALS.unpack(found)
    if pid == 0:
        return "a process that cannot be seen from this container"
    return f"process {pid}" + (f" of user {uid}" if uid != os.getuid() else "")
