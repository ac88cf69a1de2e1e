"""One process per configuration, device and folder: a second is refused, by the first one's pid.

A lock is a name in the kernel's abstract namespace of Unix sockets (unix(7)), which ends with the
process that has it. No file is written, so that neither the environment, nor a read-only system,
nor what another user left behind decides who is alone.
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
TRIES = 20  # at a name whose holder does not answer: it has just begun, or has just ended
PAUSE_S = 0.01
CREDENTIALS = struct.Struct("3i")  # pid, uid, gid
WAITING = 4096  # who has asked for the pid stays in a queue that nobody empties


class AlreadyRunning(TactileError):
    """Another process has the configuration, or the device; the message names it."""


def lock_keys(config: Path, urls: list[str]) -> list[str]:
    """What a daemon must have to itself: its configuration, and every device."""
    # As it is named, too: a link may lead to another file by the time a second one starts.
    paths = [os.path.realpath(config), os.path.abspath(config)]
    return list(dict.fromkeys([*(f"configuration {p}" for p in paths), *device_keys(urls)]))


def device_keys(urls: list[str]) -> list[str]:
    """The devices of some sources; two names of one port are one device."""
    keys = []
    for url in urls:
        parts = urlsplit(url, allow_fragments=False)
        if parts.scheme not in DEVICES:
            continue
        target = unquote(parts.netloc + parts.path)
        port = target.removeprefix("slcan:") if target.startswith("slcan:") else target
        # A bus of CAN has a name; a serial line is a file, which may be named from the folder here.
        line = port != target or parts.scheme == "serial"
        there = port.startswith("/") or (line and os.path.exists(port))
        keys.append(f"device {os.path.realpath(port) if there else target}")
    return list(dict.fromkeys(keys))


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Have a folder to oneself while the block runs; by all its names, and before it is there.

    Only processes of one computer see each other.

    Raises:
        ConfigError: another process has it.
        TactileError: as `Locks.hold`.
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
    """Locks that the process holds until it ends, however it ends."""

    def __init__(self) -> None:
        self._held: dict[str, socket.socket] = {}

    def hold(self, keys: list[str]) -> None:
        """Hold exactly these: get what is missing, then let go of the others.

        Raises:
            AlreadyRunning: another process has one; what was held is still held.
            TactileError: the kernel gives none, which is so where Unix sockets are forbidden.
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
        """Let go of all."""
        self.hold([])


def _lock(key: str) -> socket.socket:
    name = _name(key)
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
            who = _holder(name)
        except ConnectionRefusedError:
            time.sleep(PAUSE_S)
            continue
        raise AlreadyRunning(f"{key} is in use by {who}")
    raise AlreadyRunning(f"{key} is in use by a process that does not tell who it is")


def _name(key: str) -> bytes:
    """The same wherever it is asked for, but in a container: its paths are others."""
    root = os.stat("/")
    told = f"{root.st_dev} {root.st_ino} {key}"
    return b"\0tactile-rt/" + hashlib.sha256(os.fsencode(told)).hexdigest()[:32].encode()


def _holder(name: bytes) -> str:
    """Who listens at a name; the kernel says so, nobody can say it of another."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(name)
        except BlockingIOError:  # very many have asked
            return "another process"
        found = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size)
    pid, uid, _ = CREDENTIALS.unpack(found)
    if pid == 0:
        return "a process that cannot be seen from this container"
    return f"process {pid}" + (f" of user {uid}" if uid != os.getuid() else "")
