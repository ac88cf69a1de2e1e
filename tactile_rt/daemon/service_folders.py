"""Which folders a service of systemd may be given to write into.

What installs the service is root, so it must not be able to hurt. Folders of our own in /var/lib,
/var/log and /run are made by systemd. Any other is the service's user's already, or a new one
where only root can put one; whatever else is there keeps its owner and its mode.
"""

import os
import pwd
import shlex
import stat
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tactile_rt.daemon.config import Config
from tactile_rt.daemon.loading import Loaded
from tactile_rt.errors import ConfigError

__all__ = ["MADE", "check_folders", "made_by_systemd", "written_folders"]

# Where systemd makes a folder for the service.
MADE = {
    "StateDirectory": Path("/var/lib/tactile-rt"),
    "LogsDirectory": Path("/var/log/tactile-rt"),
    "RuntimeDirectory": Path("/run/tactile-rt"),
}
# What belongs to the system, or to a person, whoever owns it.
SYSTEM = (
    "/", "/bin", "/boot", "/etc", "/home", "/lib", "/lib64", "/media", "/mnt", "/opt", "/root",
    "/sbin", "/srv", "/usr", "/usr/local", "/var", "/var/cache", "/var/lib", "/var/log",
    "/var/spool",
)  # fmt: skip
HOMES = "/home"
# Folders below these would be others when the service runs.
FLEETING = {
    "/tmp": "the service has a /tmp of its own",
    "/var/tmp": "the service has a /var/tmp of its own",
    "/run": "/run is empty after each boot",
    "/dev": "/dev holds devices",
    "/proc": "/proc holds processes",
    "/sys": "/sys holds devices",
}


def written_folders(config: Config) -> list[Path]:
    """Folders that the daemon writes into, so configured."""
    return sorted({folder for _, folder in _outputs(config)})


def made_by_systemd(folder: Path) -> bool:
    """Whether systemd makes a folder, and gives it to the service."""
    return any(folder.is_relative_to(base) for base in MADE.values())


def check_folders(loaded: Loaded, user: str) -> None:
    """Refuse a folder that cannot be given to the service without taking it from somebody.

    Args:
        loaded: the configuration.
        user: whose name the service runs under; there may be none yet.

    Raises:
        ConfigError: the folder, whose it is, and what to do; one line.
    """
    read = _read_files(loaded)
    for key, folder in _outputs(loaded.config):
        why = _hindrance(folder, user, read)
        if why:
            loaded.refuse(key, f"folder {folder}: {why}")
    state = MADE["StateDirectory"]
    if why := _hindrance(state, user, read):
        raise ConfigError(f"folder {state}: {why}")


def _outputs(config: Config) -> Iterator[tuple[list[str | int], Path]]:
    """(key, folder that its value has the daemon write into)"""
    if config.recorder is not None:
        yield ["recorder", "folder"], Path(config.recorder.folder)
    if config.log.file:
        yield ["log", "file"], Path(config.log.file).parent
    for i, publisher in enumerate(config.publisher):
        file = publisher.options.get("file")
        if publisher.kind == "jsonl" and isinstance(file, str) and file:
            yield ["publisher", i, "options", "file"], Path(file).parent


def _read_files(loaded: Loaded) -> list[Path]:
    """What decides what the service does, and which it therefore may not write."""
    config = loaded.config
    names = [
        *(node.file for _, node in loaded.nodes.walk()),
        *(m.file for m in config.model),
        *(s.array for s in config.source),
        *(s.calibration for s in config.source),
        str(loaded.path), sys.prefix, sys.executable, __file__,
    ]  # fmt: skip
    return [Path(os.path.realpath(n)) for n in dict.fromkeys(names) if os.path.isabs(n)]


def _hindrance(folder: Path, user: str, read: Sequence[Path]) -> str:
    """Why the service cannot have a folder, and what to do; empty: it can."""
    real = Path(os.path.realpath(folder))
    if real != folder:
        return f"it is {real} in truth: name that"
    for place, why in FLEETING.items():
        if folder.is_relative_to(place) and not made_by_systemd(folder):
            return f"{why}: name another, e.g. {MADE['StateDirectory']}"
    inside = next((file for file in read if file.is_relative_to(folder)), None)
    if inside is not None:
        return f"the service would own {inside}, which it reads: name a folder of its own"
    if str(folder) in SYSTEM or str(folder.parent) == HOMES:
        return f"it is not for one service alone: name one in it, e.g. {folder / 'tactile-rt'}"
    try:
        return _stranger(folder, user)
    except PermissionError as error:
        return f"{error.filename} cannot be looked into: try as root"


def _stranger(folder: Path, user: str) -> str:
    """Whether somebody else has a say in a folder, or in where it is to be made; empty: no."""
    base = next((b for b in MADE.values() if folder.is_relative_to(b)), None)
    # systemd gives all that is in a folder of ours to the service.
    for place in [base, folder] if base else [folder]:
        if place.exists():
            found = place.stat()
            if not stat.S_ISDIR(found.st_mode):
                return f"{place} is not a folder"
            if found.st_uid != _uid(user) or found.st_mode & 0o300 != 0o300:
                return (
                    f"{place} belongs to {_owner(found)} ({stat.filemode(found.st_mode)}), and "
                    f"{user} must own it and write in it: name another, or give it to {user}"
                )
    if base or folder.exists():
        return ""
    for above in folder.parents:
        if not above.is_dir():
            return f"there is no folder {above} to make it in: make that first"
        found = above.stat()
        # Else somebody could put another folder in its place while it is made.
        if found.st_uid != 0 or found.st_mode & 0o022:
            by_hand = f"sudo install -d -o {user} {shlex.quote(str(folder))}"
            if _uid(user) is None:
                by_hand = f"sudo useradd --system --user-group {user}; {by_hand}"
            return f"others than root can write in {above}: make it yourself: {by_hand}"
    return ""


def _uid(user: str) -> int | None:
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        return None


def _owner(found: os.stat_result) -> str:
    try:
        return pwd.getpwuid(found.st_uid).pw_name
    except KeyError:
        return f"user {found.st_uid}"
