"""Inventory of a sweep set: counts of its sweeps, and checksums of its files.

The loads are not decoded. The checksums have the file format of the program sha256sum.
"""

import hashlib
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tactile_rt.core.errors import RecordingError, name_some
from tactile_rt.core.files import write_whole
from tactile_rt.sets.manifest import MANIFEST, SKIPPED, SweepManifest, has_object, object_path
from tactile_rt.sets.objects import read_arrays, read_skipped

SUMS = "SHA256SUMS"
COUNTED = ("touches", "unstable", "wedged", "saturated")  # of each sweep
STALE_S = 60  # no file of a set takes this long to write


@dataclass(frozen=True)
class Tally:
    """Counts of a set's sweeps, of problems among them, and of skipped objects."""

    sweeps: int = 0
    misses: int = 0
    unstable: int = 0
    wedged: int = 0
    saturated: int = 0
    skipped: int = 0

    @property
    def shares(self) -> tuple[float, float]:
        """Shares of sweeps that touch a whisker and that saturate the sensor, 0 to 1."""
        sweeps = max(1, self.sweeps)
        return (self.sweeps - self.misses) / sweeps, self.saturated / sweeps

    @property
    def shortcomings(self) -> str:
        """Text that counts the set's problems, with hints at remedies; empty without problems."""
        problems = {
            f"{self.misses} miss the array (larger `size_mm`, less `distance_mm`, other "
            "`height_mm`)": self.misses,
            f"{self.saturated} exceed the sensor's `range` (more `distance_mm`)": self.saturated,
            f"{self.unstable} could not be simulated": self.unstable,
            f"{self.wedged} leave no room for a whisker (more `distance_mm`)": self.wedged,
            f"{self.skipped} objects are left out ({SKIPPED} says why)": self.skipped,
        }
        return ", ".join(text for text, count in problems.items() if count)


def tally(folder: Path, names: Iterable[str], sweeps: int) -> Tally:
    """Count sweeps and problems of the named objects in a folder; each has `sweeps` sweeps."""
    existing = [name for name in names if has_object(folder, name)]
    counts = dict.fromkeys(COUNTED, 0)
    for name in existing:
        for key, each in read_arrays(object_path(folder, name), *COUNTED).items():
            counts[key] += int((~each if key == "touches" else each > 0).sum())
    misses, unstable, wedged, saturated = counts.values()
    skipped = len(read_skipped(folder))
    return Tally(len(existing) * sweeps, misses, unstable, wedged, saturated, skipped)


def remove_leftovers(folder: Path) -> None:
    """Delete half-written hidden files that killed processes left over a minute ago."""
    names = (MANIFEST, SKIPPED, SUMS, "*.npz")
    for path in (path for name in names for path in folder.glob(f".{name}.*")):
        if time.time() - path.stat().st_mtime > STALE_S:
            path.unlink(missing_ok=True)


def write_sums(folder: Path) -> None:
    """Write the checksums of a set's files to SHA256SUMS; existing checksums stay.

    So a file damaged since then never counts as intact; a file made anew has the same content,
    because sweeps depend only on their recipe.
    """
    known = _read_sums(folder) if (folder / SUMS).exists() else {}
    names = [MANIFEST, *([SKIPPED] if (folder / SKIPPED).exists() else [])]
    for objects in SweepManifest.read(folder).split.values():
        names += [f"{name}.npz" for name in objects if has_object(folder, name)]
    known.pop(SKIPPED, None)  # the one file that grows
    lines = [f"{known.get(n) or _sha256(folder / n)}  {n}\n" for n in sorted(names)]
    write_whole(folder / SUMS, lambda file: file.write("".join(lines).encode()))


def written_sum(folder: Path, name: str) -> str | None:
    """Return a file's checksum in the set's SHA256SUMS; None if none is recorded."""
    return _read_sums(folder).get(name) if (folder / SUMS).exists() else None


def check_sums(folder: Path) -> int:
    """Compare the checksum of every listed file with SHA256SUMS.

    Returns:
        The number of files, all of which are intact.

    Raises:
        RecordingError: no sums exist yet, or files are missing or changed: the error names them.
    """
    sums = _read_sums(folder)
    bad = [n for n, s in sums.items() if not (folder / n).exists() or _sha256(folder / n) != s]
    if bad:
        raise RecordingError(
            f"{folder}: {len(bad)} of {len(sums)} files are missing or damaged: "
            f"{name_some(bad)}; delete them and sweep again"
        )
    return len(sums)


def _read_sums(folder: Path) -> dict[str, str]:
    path = folder / SUMS
    try:
        pairs = [line.split("  ", 1) for line in path.read_text().splitlines()]
        return {name: digest for digest, name in pairs}
    except FileNotFoundError:
        raise RecordingError(
            f"{folder} has no {SUMS}: the set is unfinished (sweep again), or of an older release"
        ) from None
    except (ValueError, UnicodeDecodeError):
        raise RecordingError(f"{path} is damaged: delete it and sweep again") from None


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
