"""Checksums of a sweep set, in the format of `sha256sum`."""

import hashlib
from pathlib import Path

from tactile_rt.files import write_whole
from tactile_rt.stream import RecordingError
from tactile_rt.sweep_set import MANIFEST, SKIPPED, SweepManifest, has_object

__all__ = ["SUMS", "check_sums", "write_sums", "written_sum"]

SUMS = "SHA256SUMS"


def write_sums(folder: Path) -> None:
    """Write SHA256SUMS of the set's files; sums that are there already stay.

    A file that has rotted since is thereby never declared sound; one that was made anew has the
    same content, because sweeps depend on nothing but their recipe.
    """
    known = _read_sums(folder) if (folder / SUMS).exists() else {}
    names = [MANIFEST, *([SKIPPED] if (folder / SKIPPED).exists() else [])]
    for objects in SweepManifest.read(folder).split.values():
        names += [f"{name}.npz" for name in objects if has_object(folder, name)]
    known.pop(SKIPPED, None)  # the one file that grows
    lines = [f"{known.get(n) or _sha256(folder / n)}  {n}\n" for n in sorted(names)]
    write_whole(folder / SUMS, lambda file: file.write("".join(lines).encode()))


def written_sum(folder: Path, name: str) -> str | None:
    """The checksum that a file of a finished set had; None if there is none."""
    return _read_sums(folder).get(name) if (folder / SUMS).exists() else None


def check_sums(folder: Path) -> int:
    """Compare every file with SHA256SUMS.

    Returns:
        How many files are as they were written.

    Raises:
        RecordingError: there are no sums yet, or a file is missing or another than it was: all
            such files are named.
    """
    sums = _read_sums(folder)
    bad = [n for n, s in sums.items() if not (folder / n).exists() or _sha256(folder / n) != s]
    if bad:
        raise RecordingError(
            f"{folder}: {len(bad)} of {len(sums)} files are missing or damaged: "
            f"{', '.join(bad)}; delete them and sweep again"
        )
    return len(sums)


def _read_sums(folder: Path) -> dict[str, str]:
    path = folder / SUMS
    try:
        pairs = [line.split("  ", 1) for line in path.read_text().splitlines()]
        return {name: digest for digest, name in pairs}
    except FileNotFoundError:
        raise RecordingError(
            f"{folder} has no {SUMS}: it is unfinished, or older than they are"
        ) from None
    except (ValueError, UnicodeDecodeError):
        raise RecordingError(f"{path} is damaged: delete it and sweep again") from None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
