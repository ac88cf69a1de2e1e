"""One object of a sweep set as a stream: its sweeps one after another, with rests between."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk, ConfigError, RecordingError
from tactile_rt.sweep_set import SweepManifest, read_object

__all__ = ["SweepOptions", "sweep_chunks", "sweep_spec"]

CHUNK_NS = 9_000_000  # a chunk's length, as other sources have it


@dataclass(frozen=True)
class SweepOptions:
    """Options of ``replay:`` of a sweep set's object.

    Attributes:
        speed: times real time; 0: as fast as it is read.
        sweep: which, from 0; by default all, one after another.
        rest_s: at rest before each sweep, s, besides the lead that is stored: so that a contact
            ends, and a tare is taken, before the next.
    """

    speed: float = 1.0
    sweep: int | None = None
    rest_s: float = 0.5

    def __post_init__(self) -> None:
        if not 0 <= self.rest_s <= 3600:
            raise ConfigError(f"rest_s must be 0 to 3600 s, not {self.rest_s:g}")


def sweep_spec(path: Path) -> tuple[ArraySpec, SweepManifest]:
    """The array at the rate of the stored sweeps, and the set's manifest.

    Raises:
        ConfigError: no such file.
        RecordingError: it is of no sweep set.
    """
    if not path.is_file():
        raise ConfigError(f"no sweeps {path}")
    manifest = SweepManifest.read(path.parent)
    return replace(manifest.spec, rate_hz=NS_PER_S / manifest.period_ns), manifest


def sweep_chunks(
    path: Path, manifest: SweepManifest, options: SweepOptions
) -> Iterator[tuple[int, Chunk]]:
    """The chunks, times from 0, and when they are due.

    Raises:
        ConfigError: no such sweep.
        RecordingError: the file is damaged, or not of the manifest's array.
    """
    values, _ = read_object(path.parent, path.stem)
    if values.ndim != 4 or values.shape[2:] != manifest.spec.shape or not values.shape[1]:
        raise RecordingError(
            f"{path} holds {values.shape}, not (sweep, sample, *{manifest.spec.shape})"
        )
    which = range(len(values)) if options.sweep is None else [options.sweep]
    if options.sweep is not None and not 0 <= options.sweep < len(values):
        raise ConfigError(f"{path} has sweeps 0 to {len(values) - 1}, not {options.sweep}")
    period = manifest.period_ns
    return _cut(values, which, round(options.rest_s * NS_PER_S / period), manifest)


def _cut(
    values: np.ndarray, which: "range | list[int]", rest: int, manifest: SweepManifest
) -> Iterator[tuple[int, Chunk]]:
    period, size = manifest.period_ns, max(1, CHUNK_NS // manifest.period_ns)
    first = 0
    for k in which:
        sweep = values[k].astype(np.float32)
        # The lead again and again, so that the rest has the noise of the sweep.
        lead = sweep[: max(1, manifest.lead)]
        stream = np.concatenate([np.resize(lead, (rest, *lead.shape[1:])), sweep])
        for at in range(0, len(stream), size):
            piece = stream[at : at + size]
            seq = first + at + np.arange(len(piece), dtype=np.int64)
            t_ns = seq * period
            yield int(t_ns[-1]), Chunk(seq, t_ns, piece, np.isfinite(piece).all(axis=2))
        first += len(stream)
