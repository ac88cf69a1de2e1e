"""What a command run by root changes on the whole file system, and none of it for good.

The command runs in a mount namespace of its own, in a chroot onto an overlay over ``/``: all that
it writes lies in the overlay's upper layer, which is compared with what was there before.
"""

import json
import os
import stat
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

SHORT = 1 << 20  # bytes of a file that are compared; of longer ones the length is


@dataclass(frozen=True)
class Changed:
    """What a command left."""

    code: int  # exit code of the command
    said: str  # output and the errors of the command
    # what each path that differs was: kind and mode, owner, group, content; or None
    before: dict[str, list | None]
    after: dict[str, list | None]  # what each path that differs is now


def changes(setup: str, command: str) -> Changed:
    """Run two shell scripts as root on copies of ``/``; tell what the second one changed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    # Where chroot and the programs of administration are, which not everybody's path names.
    environment["PATH"] = os.pathsep.join(
        [os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"]
    )
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            ["unshare", "--mount", "--propagation", "private", sys.executable, __file__,
             folder, setup, command],
            capture_output=True, text=True, check=False, env=environment,
        )  # fmt: skip
    if done.returncode:
        raise OSError(done.stderr.strip() or "unshare failed")
    return Changed(**json.loads(done.stdout))


def _main(folder: str, setup: str, command: str) -> None:
    _mount("-t", "tmpfs", "tmpfs", folder)
    first, second = Path(folder, "first"), Path(folder, "second")
    _overlay(Path("/"), first)
    prepared = _run(first / "merged", f"set -eu\n{setup}")
    if prepared.returncode:
        sys.exit(f"the preparation failed: {prepared.stdout}")
    _overlay(first / "merged", second)
    done = _run(second / "merged", command)
    before, after = {}, {}
    upper = second / "upper"
    for above, folders, files in os.walk(upper):
        for name in (*folders, *files):
            path = Path(above, name).relative_to(upper)
            was, now = _look(first / "merged" / path), _look(second / "merged" / path)
            if was != now:
                before[f"/{path}"], after[f"/{path}"] = was, now
    told = {"code": done.returncode, "said": done.stdout, "before": before, "after": after}
    sys.stdout.write(json.dumps(told))


def _overlay(lower: Path, place: Path) -> None:
    for name in ("upper", "work", "merged"):
        (place / name).mkdir(parents=True)
    options = f"lowerdir={lower},upperdir={place}/upper,workdir={place}/work"
    _mount("-t", "overlay", "overlay", "-o", options, str(place / "merged"))
    for name in ("dev", "proc", "sys"):
        _mount("--rbind", f"/{name}", str(place / "merged" / name))


def _mount(*arguments: str) -> None:
    done = subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr.strip())


def _run(root: Path, script: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["chroot", str(root), "sh", "-c", script],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False,
    )  # fmt: skip


def _look(path: Path) -> list | None:
    try:
        found = path.lstat()
    except FileNotFoundError:
        return None
    content = ""
    if stat.S_ISLNK(found.st_mode):
        content = os.readlink(path)
    elif stat.S_ISREG(found.st_mode):
        short = found.st_size <= SHORT
        content = path.read_bytes().decode("latin-1") if short else str(found.st_size)
    return [stat.filemode(found.st_mode), found.st_uid, found.st_gid, content]


if __name__ == "__main__":
    _main(*sys.argv[1:])
