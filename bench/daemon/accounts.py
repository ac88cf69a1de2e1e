"""Whether every sample that an array took is delivered, or counted for what became of it."""

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.emulated import Played
from tactile_rt.drivers.emulation.faults import Fate
from tactile_rt.recording.reader import Recording

GONE = (Fate.DROPPED, Fate.OVERFLOWED, Fate.UNHEARD)
HURT = (Fate.CORRUPTED, Fate.TRUNCATED)


@dataclass(frozen=True)
class RecordedSamples:
    """All samples of one array in its recordings.

    Attributes:
        seq: (m,) number of each sample.
        t_ns: (m,) stream time of each sample, ns.
    """

    seq: NDArray[np.int64]
    t_ns: NDArray[np.int64]


@dataclass(frozen=True)
class Account:
    """One array's samples.

    Attributes:
        unbalanced: Samples by which sent + duplicated differs from the sum of all that is counted.
        unexplained: Samples sent whole over a line that was up, and not recorded; or recorded
            though they were not sent, twice, or though they were never measured.
        miscounted: Samples by which the count of a cause differs from what the array did.
        told: The account in words.
    """

    unbalanced: int
    unexplained: int
    miscounted: int
    told: str


def recorded(files: list[Path], source: str) -> RecordedSamples:
    """What is in the recordings of one array."""
    seq, t_ns = array("q"), array("q")  # an hour's chunks would not fit into memory
    for chunk in (c for f in files if f.name.startswith(f"{source}-") for c in Recording(f)):
        seq.frombytes(chunk.seq.tobytes())
        t_ns.frombytes(chunk.t_ns.tobytes())
    return RecordedSamples(np.array(seq, np.int64), np.array(t_ns, np.int64))


def account(wire: str, played: Played, stats: Mapping[str, int], seq: NDArray[np.int64]) -> Account:
    """Compare what an array did with what the daemon counted and recorded.

    Args:
        wire: ``serial`` or ``slcan``.
        played: by the array.
        stats: `SourceStats` of the daemon.
        seq: (m,) sequence numbers of all samples in the recording.
    """
    fate, n = played.fate, len(played.fate)
    counted = sum(stats.values())
    known = np.unique(seq[(seq >= 0) & (seq < n)])
    came = np.zeros(n, np.bool_)
    came[known] = True
    hurt, gone = np.isin(fate, HURT), np.isin(fate, GONE)
    on_the_way = _around_unplugging(fate, came)
    unexplained = int((~came & ~hurt & ~gone & ~on_the_way).sum()) + int((came & gone).sum())
    unexplained += len(seq) - len(known)
    # Copies that were on the line when the plug was pulled came to nobody.
    gone_copies = played.duplicated - stats["duplicates"]
    if not 0 <= gone_copies <= _copies_pulled(played, on_the_way):
        gone_copies = 0
    miscounted = abs(stats["duplicates"] + gone_copies - played.duplicated)
    miscounted += abs(stats["delivered"] - len(seq)) + stats["dropped"]
    miscounted += abs(stats["corrupt"] + stats["missing"] - int((~came).sum()))
    if wire == "serial":  # of a CAN sample that lost a frame the rest is delivered
        unexplained += int((came & hurt).sum())
        least, most = int((hurt & ~on_the_way).sum()), int(hurt.sum())
        miscounted += max(0, least - stats["corrupt"], stats["corrupt"] - most)
    kinds = {f.name.lower(): int((fate == f).sum()) for f in Fate if (fate == f).any()}
    told = (
        f"{n} measured, {played.duplicated} copies: "
        f"{', '.join(f'{count} {kind}' for kind, count in kinds.items())}; counted: "
        f"{', '.join(f'{count} {kind}' for kind, count in stats.items())}; recorded: {len(seq)}"
    )
    return Account(
        abs(n + played.duplicated - gone_copies - counted), unexplained, miscounted, told
    )


def _copies_pulled(played: Played, on_the_way: NDArray[np.bool_]) -> int:
    """Most copies that may have been on the line: also of the last sample that came."""
    twice = played.fate == Fate.DUPLICATED
    pulled = twice & (on_the_way | np.append(on_the_way[1:], False))
    return -(-played.duplicated * int(pulled.sum()) // max(1, int(twice.sum())))


def _around_unplugging(fate: NDArray[np.uint8], came: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) sent, and lost on the way: nothing came between them and the plug being pulled, or
    nothing between the line being opened and them: who opens a port throws away what is there."""
    lost = np.zeros(len(fate), np.bool_)
    away = np.concatenate([[False], fate == Fate.UNHEARD, [False]])
    pulled, back = np.flatnonzero(~away[:-1] & away[1:]), np.flatnonzero(away[:-1] & ~away[1:])
    for at in pulled.tolist():
        start = at
        while start > 0 and not came[start - 1]:
            start -= 1
        lost[start:at] = True
    for at in back.tolist():
        end = at
        while end < len(fate) and not came[end]:
            end += 1
        lost[at:end] = True
    lost[np.isin(fate, GONE)] = False
    return lost
