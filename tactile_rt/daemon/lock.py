"""One daemon per configuration and per device: a second one is refused, by the first one's pid."""

import fcntl
import hashlib
import os
import stat
import tempfile
from pathlib import Path
from urllib.parse import unquote, urlsplit

from tactile_rt.stream import TactileError

__all__ = ["AlreadyRunning", "Locks", "lock_keys"]

DEVICES = ("serial", "can")


class AlreadyRunning(TactileError):
    """Another process has the configuration, or the device; the message names it."""


def lock_keys(config: Path, urls: list[str]) -> list[str]:
    """What a daemon must have to itself: its configuration, and every device."""
    keys = [f"configuration {os.path.realpath(config)}"]
    for url in urls:
        parts = urlsplit(url, allow_fragments=False)
        if parts.scheme not in DEVICES:
            continue
        target = unquote(parts.netloc + parts.path)
        port = target.removeprefix("slcan:") if target.startswith("slcan:") else target
        # Two names of one port are one port.
        keys.append(f"device {os.path.realpath(port) if port.startswith('/') else target}")
    return list(dict.fromkeys(keys))


class Locks:
    """Locks that the process holds until it ends, however it ends.

    Args:
        folder: where the files are; None: see `lock_folder`.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder or lock_folder()
        self._held: dict[str, int] = {}

    def hold(self, keys: list[str]) -> None:
        """Hold exactly these: get what is missing, then let go of the others.

        Raises:
            AlreadyRunning: another process has one; what was held is still held.
        """
        got: dict[str, int] = {}
        try:
            for key in keys:
                if key not in self._held:
                    got[key] = self._lock(key)
        except BaseException:
            for handle in got.values():
                os.close(handle)
            raise
        for key in [k for k in self._held if k not in keys]:
            os.close(self._held.pop(key))
        self._held.update(got)

    def close(self) -> None:
        """Let go of all."""
        self.hold([])

    def _lock(self, key: str) -> int:
        path = self._folder / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.lock"
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.pread(handle, 20, 0).decode(errors="replace").strip()
            os.close(handle)
            raise AlreadyRunning(
                f"{key} is in use by process {pid or 'unknown'} (lock {path})"
            ) from None
        # The file stays for ever: to remove it would let two processes lock two files of one name.
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"{os.getpid()}\n".encode(), 0)
        return handle


def lock_folder() -> Path:
    """``$XDG_RUNTIME_DIR/tactile-rt``, else ``/run/tactile-rt`` if it can be made, else one of the
    user's own in the folder for temporary files."""
    places = []
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        places.append(Path(runtime) / "tactile-rt")
    places += [Path("/run/tactile-rt"), Path(tempfile.gettempdir()) / f"tactile-rt-{os.getuid()}"]
    for place in places:
        try:
            place.mkdir(mode=0o700, exist_ok=True)
            found = place.lstat()
        except OSError:
            continue
        # Else another user could hold our locks, or have us write where a link of theirs points.
        ours = found.st_uid == os.getuid() and stat.S_ISDIR(found.st_mode)
        if ours and os.access(place, os.W_OK):
            return place
    raise TactileError(f"no folder for the lock: tried {', '.join(map(str, places))}")
