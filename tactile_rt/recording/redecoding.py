"""How do samples differ when their packets are decoded again, by this release or another codec?"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, concatenate
from tactile_rt.recording.layout import WIRE
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.replay import open_replay

__all__ = ["Redecoded", "compare_decoding"]

Pairs = tuple[NDArray[np.intp], NDArray[np.intp]]


@dataclass(frozen=True)
class Redecoded:
    """Recorded samples beside those that the packets decode to.

    Attributes:
        equal: The number of samples of both whose values and validity are the same, bit for bit.
        differing: The number of samples of both whose values or validity are not the same.
        validity: The number of differing samples in which an element is valid in one of both alone.
        largest: Each channel that differs, its unit, and the largest difference where both samples
            are valid.
        time_ns: The largest difference between the two times of one sample, ns.
        array: The differences between the two arrays, in words; values then are not compared.
    """

    recorded: int
    decoded: int
    equal: int = 0
    differing: int = 0
    validity: int = 0
    largest: tuple[tuple[str, str, float], ...] = ()
    time_ns: int = 0
    array: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """It in words."""
        if self.array:
            return [
                f"{self.recorded} samples recorded, {self.decoded} decoded",
                f"another array: {'; '.join(self.array)}",
            ]
        both = self.equal + self.differing
        said = [
            f"{self.recorded} samples recorded, {self.decoded} decoded: {self.equal} are the same, "
            f"bit for bit, {self.differing} differ, {self.recorded - both} were recorded alone, "
            f"{self.decoded - both} decoded alone"
        ]
        if self.largest:
            parts = [f"{channel} {most:.3g} {unit}" for channel, unit, most in self.largest]
            said.append(f"they differ by at most {', '.join(parts)}")
        if self.validity:
            said.append(f"{self.validity} have elements that are valid in one of them alone")
        if self.time_ns:
            said.append(f"their times differ by at most {self.time_ns / 1e6:.3g} ms")
        return said


def compare_decoding(path: str | Path, options: Mapping[str, str] | None = None) -> Redecoded:
    """Decode a recording's packets again, and compare with its samples.

    Args:
        options: ``codec`` and the codec's own, as in a ``replay:`` URL; None: as recorded.

    Raises:
        ConfigError: there are no packets, or the codec cannot be.
        RecordingError: the codec finds no sample in them.
    """
    recording = Recording(path)
    recorded = list(recording)
    with open_replay(str(path), {**(options or {}), "from": WIRE, "speed": "0"}) as source:
        spec, decoded = source.spec, list(source)
    if not recorded or not decoded:
        raise RecordingError(
            f"{path}: {sum(map(len, recorded))} samples recorded, {sum(map(len, decoded))} decoded"
        )
    return _compared(recording.spec, concatenate(recorded), spec, concatenate(decoded))


def _compared(old_spec: ArraySpec, old: Chunk, new_spec: ArraySpec, new: Chunk) -> Redecoded:
    array = tuple(old_spec.differences(new_spec))
    if array:
        return Redecoded(len(old), len(new), array=array)
    ways = [_by_number(old, new, old_spec.rate_hz), _by_time(old, new, old_spec.rate_hz)]
    # Numbers begin anew in a file that goes on with a stream; those of a device that does not
    # count shift with each sample that one of both has not.
    at, same = max(((way, _same(old, new, way)) for way in ways), key=lambda w: int(w[1].sum()))
    i, j = at[0][~same], at[1][~same]
    both = (old.valid[i] & new.valid[j])[..., None]
    apart = np.where(both, np.abs(old.values[i] - new.values[j]), 0.0)
    most = np.fmax.reduce(apart, axis=(0, 1), initial=0.0)
    named = zip(old_spec.channels, old_spec.units, most.tolist(), strict=True)
    return Redecoded(
        len(old), len(new), int(same.sum()), len(i),
        int((old.valid[i] != new.valid[j]).any(axis=1).sum()),
        tuple((channel, unit, x) for channel, unit, x in named if x),
        int(np.abs(old.t_ns[at[0]] - new.t_ns[at[1]]).max(initial=0)),
    )  # fmt: skip


def _same(old: Chunk, new: Chunk, at: Pairs) -> NDArray[np.bool_]:
    i, j = at
    bits = old.values[i].view(np.uint32) == new.values[j].view(np.uint32)
    same: NDArray[np.bool_] = bits.all(axis=(1, 2)) & (old.valid[i] == new.valid[j]).all(axis=1)
    return same


def _by_number(old: Chunk, new: Chunk, rate_hz: float) -> Pairs:
    """Samples of the same number, but for what most numbers differ by."""
    rows = {row.tobytes(): k for k, row in enumerate(old.values)}
    like = [(rows[bits], k) for k, row in enumerate(new.values) if (bits := row.tobytes()) in rows]
    i, j = np.array(like, np.intp).T if like else _by_time(old, new, rate_hz)
    shifts, counts = np.unique(new.seq[j] - old.seq[i], return_counts=True)
    shift = shifts[counts.argmax()] if len(shifts) else 0
    _, i, j = np.intersect1d(old.seq, new.seq - shift, return_indices=True)
    return i, j


def _by_time(old: Chunk, new: Chunk, rate_hz: float) -> Pairs:
    """Samples of the same moment: no further apart than half a period."""
    middle = (old.t_ns[1:] + old.t_ns[:-1]) // 2
    nearest = np.searchsorted(middle, new.t_ns)
    near = np.abs(old.t_ns[nearest] - new.t_ns) <= NS_PER_S / rate_hz / 2
    i, first = np.unique(nearest[near], return_index=True)
    return i, np.flatnonzero(near)[first]
