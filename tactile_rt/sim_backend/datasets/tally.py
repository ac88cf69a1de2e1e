"""What became of the objects and sweeps of a set, counted without reading the loads."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_rt.stream import RecordingError
from tactile_rt.sweep_set import SKIPPED, has_object, object_path, read_skipped

__all__ = ["Tally", "tally"]


@dataclass(frozen=True)
class Tally:
    """Counts of a set.

    Attributes:
        sweeps: that are there.
        misses: of these, pass beside the array.
        unstable: of these, could not be simulated at the set's profile, and are empty.
        skipped: objects that could not be made.
    """

    sweeps: int = 0
    misses: int = 0
    unstable: int = 0
    skipped: int = 0

    @property
    def shortcomings(self) -> str:
        """What is to be told beside the number of sweeps; nothing if all is well."""
        parts = [
            *([f"{self.misses} miss the array"] if self.misses else []),
            *([f"{self.unstable} could not be simulated"] if self.unstable else []),
            *([f"{self.skipped} objects could not be made ({SKIPPED})"] if self.skipped else []),
        ]
        return ", ".join(parts)


def tally(folder: Path, names: Iterable[str], sweeps: int) -> Tally:
    """Count what there is of these objects.

    Args:
        folder: the set.
        names: objects.
        sweeps: of each of them.

    Raises:
        RecordingError: an object's file is damaged.
    """
    there = [name for name in names if has_object(folder, name)]
    misses = unstable = 0
    for name in there:
        path = object_path(folder, name)
        try:
            with path.open("rb") as file, np.load(file) as arrays:
                known = set(arrays.files)
                misses += int((~arrays["touches"]).sum()) if "touches" in known else 0
                unstable += int(arrays["unstable"].sum()) if "unstable" in known else 0
        except Exception as error:  # numpy and zipfile raise a dozen unrelated types
            reason = str(error) or type(error).__name__
            raise RecordingError(
                f"{path} is damaged ({reason}): delete it and sweep again"
            ) from None
    return Tally(len(there) * sweeps, misses, unstable, len(read_skipped(folder)))
