"""Graded touches in layer 4: DANDI 000013 (Hires, Gutnisky, Yu, O'Connor and Svoboda 2015).

A mouse with one whisker locates a pole; one cell is recorded at a time. What is compared is the
touch itself, graded by how far it bends the whisker: the touches of a session fall into six
levels of equally many, by the largest change of curvature, from the most negative to the most
positive. A cell's response is its rate in bins of 45 ms from the onset of touch on, until the next
touch. Cells of all mice make two targets, dealt out by mouse, so that a layer that is chosen on one
is scored on the other.

The models' input is the mean course of the curvature in each level, as a moment about z, in the
plane in which a whisker bends, at the base of C2; every other load is zero. The file has curvature
in arbitrary units, so the scale is: the strongest level bends C2 as hard as the six stimuli do.

Read with h5py, where the authors' exporter puts things
(github.com/datajoint-company/DJ-NWB-Hires-Gutnisky-2015; all but the electrode in ``acquisition``):

    SpikeTrain/data, timestamps                             1 where the cell fired
    behavior/touch_onset, touch_offset/data, timestamps     1 where a touch begins, ends
    behavior/delta_kappa/data, timestamps                   change of curvature in a touch
    general/intracellular_ephys/*/location                  text with `depth: ...` in um
"""

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError, name_some
from tactile_rt.extras import lacking
from tactile_rt.models.alignment.datasets import DatasetContents, NeuralDataset
from tactile_rt.models.alignment.neural import Animal, NeuralSession
from tactile_rt.models.alignment.stimuli_input import PERIOD_MS, StimuliInput

if TYPE_CHECKING:
    import h5py

__all__ = ["DANDI_000013", "LEVELS"]

Floats = NDArray[np.float64]

LEVELS = tuple(f"level-{k}" for k in range(1, 7))  # from the most negative to the most positive
BIN_S = 0.045
BINS = 4  # of a response; most touches are followed by another soon after
MINIMUM_TOUCHES = 24  # four of every level
GROUPS = 2  # targets that the cells are dealt into
WHISKER, CHANNEL = "C2", "mz"
DEPTH = re.compile(r"depth:\s*([\d.]+)")


class _Cell(NamedTuple):
    session: NeuralSession
    bent: Floats  # (6, sample), the mean change of curvature in every level, a largest touch = 1


def _read(
    paths: Sequence[Path], stimuli: StimuliInput, progress: Callable[[float], None]
) -> DatasetContents:
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise lacking("reading NWB needs", "align", error) from None
    files = [f for p in paths for f in (sorted(p.rglob("*.nwb")) if p.is_dir() else [p])]
    if not files:
        raise ConfigError(f"no .nwb file in {', '.join(map(str, paths))}")
    samples = stimuli.samples.shape[1] * stimuli.samples.shape[2]
    cells: list[_Cell] = []
    notes: list[str] = []
    for done, path in enumerate(files, start=1):
        try:
            with h5py.File(path, "r") as file:
                cells.append(_cell(file, path, samples))
        except ConfigError as error:
            notes.append(f"{path.name} left out: {error}")
        except Exception as error:  # of a damaged file HDF5 raises a dozen unrelated types
            reason = " ".join(str(error).split()) or type(error).__name__
            notes.append(f"{path.name} left out: it cannot be read as one of these ({reason})")
        progress(done / len(files))
    if not cells:
        raise ConfigError(f"no cell can be used: {name_some(notes, 1)}")
    mice = sorted({cell.session.animal for cell in cells})
    groups = tuple(
        Animal(
            f"cells of {len(mice[k::GROUPS])} mice ({k + 1})",
            tuple(c.session for c in cells if c.session.animal in mice[k::GROUPS]),
        )
        for k in range(min(GROUPS, len(mice)))
    )
    bent = np.mean([cell.bent for cell in cells], axis=0)
    return DatasetContents(groups, _felt(bent, stimuli), tuple(notes))


def _cell(file: "h5py.File", path: Path, samples: int) -> _Cell:
    """One file: a cell's responses to graded touches.

    Raises:
        ConfigError: it has too few touches, or none that bends the whisker.
        Exception: it is not such a file, of whatever type.
    """
    onset, offset = (_events(file, name) for name in ("touch_onset", "touch_offset"))
    bend = file["acquisition/behavior/delta_kappa"]
    clock, kappa = bend["timestamps"][()].astype(float), np.nan_to_num(bend["data"][()])
    end = _next(offset, onset, np.inf)
    following = np.append(onset[1:], np.inf)
    end = np.minimum(end, following)
    kept = (following - onset >= BIN_S) & np.isfinite(end)  # the first bin is whole
    onset, end, following = onset[kept], end[kept], following[kept]
    first, last = np.searchsorted(clock, onset), np.searchsorted(clock, end, side="right")
    peak = np.array([_peak(kappa[a:b]) for a, b in zip(first, last, strict=True)])
    if len(peak) < MINIMUM_TOUCHES:
        raise ConfigError(f"{len(peak)} touches, and {MINIMUM_TOUCHES} are needed")
    rank = np.argsort(np.argsort(peak, kind="stable"), kind="stable")
    level = (rank * len(LEVELS) // len(rank)).astype(np.int64)

    spikes = _events(file, None)
    edges = onset[:, None] + BIN_S * np.arange(BINS + 1)
    course = np.diff(np.searchsorted(spikes, edges), axis=1) / BIN_S
    course[edges[:, 1:] > following[:, None]] = np.nan
    where = "".join(_text(e["location"][()]) for e in file["general/intracellular_ephys"].values())
    depth = DEPTH.search(where)
    session = NeuralSession(
        animal=_text(file["general/subject/subject_id"][()]),
        name=path.stem,
        rates=course[:, :1],
        stimulus=level,
        course=course[..., None],
        depth=np.array([float(depth[1])]) if depth else None,
    )
    largest = float(np.abs(peak).max())
    if not largest > 0:
        raise ConfigError("no touch bends the whisker")
    ticks = PERIOD_MS / 1000 * np.arange(samples)
    bent = np.zeros((len(LEVELS), samples))
    for begin, stop, k in zip(onset, end, level, strict=True):
        inside = ticks < stop - begin
        at = np.clip(np.searchsorted(clock, begin + ticks[inside]), 0, len(kappa) - 1)
        bent[k, inside] += kappa[at] / largest / (level == k).sum()
    return _Cell(session, bent)


def _events(file: "h5py.File", name: str | None) -> Floats:
    """Times in s at which a series is 1: of behaviour by its name, of spikes without one."""
    series = file[f"acquisition/behavior/{name}" if name else "acquisition/SpikeTrain"]
    times = series["timestamps"][()].astype(float)
    return np.sort(times[np.nan_to_num(series["data"][()]) > 0])


def _next(events: Floats, after: Floats, otherwise: float) -> Floats:
    return np.append(events, otherwise)[np.searchsorted(events, after, side="right")]


def _peak(values: Floats) -> float:
    return float(values[np.argmax(np.abs(values))]) if values.size else 0.0


def _text(value: object) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _felt(bent: Floats, stimuli: StimuliInput) -> StimuliInput:
    """The models' input: moments at the base of one whisker."""
    if WHISKER not in stimuli.elements or CHANNEL not in stimuli.channels:
        raise ConfigError(f"000013 is felt by the whisker {WHISKER}, which {stimuli.name} lacks")
    place = stimuli.elements.index(WHISKER), stimuli.channels.index(CHANNEL)
    strongest = np.abs(stimuli.samples[..., place[0], place[1]]).max()
    samples = np.zeros_like(stimuli.samples)
    scaled = bent / np.abs(bent).max() * strongest
    samples[..., place[0], place[1]] = scaled.reshape(samples.shape[:3])
    return replace(
        stimuli,
        samples=samples,
        name="graded touches of 000013",
        sha256=hashlib.sha256(samples.tobytes()).hexdigest(),
    )


# License, citation, size: dandiset.yaml of the draft, github.com/dandisets/000013.
DANDI_000013 = NeuralDataset(
    name="000013",
    title="Low-noise encoding of active touch by layer 4 in the somatosensory cortex",
    citation=(
        "Hires, Samuel; Gutnisky, Diego; Yu, Jianing; O'Connor, Daniel H; Svoboda, Karel (2022). "
        "Low-noise encoding of active touch by layer 4 in the somatosensory cortex. DANDI archive. "
        "https://dandiarchive.org/dandiset/000013; described by doi:10.7554/eLife.06619"
    ),
    license="CC-BY-4.0",
    url="https://dandiarchive.org/dandiset/000013",
    size="11.4 GB in 52 files of 23 mice",
    about=(
        "Single cells of layer 4 while a mouse locates a pole with one whisker. "
        "Touches in six levels of how far they bend it; models feel the mean bending of each level "
        "at C2 alone, in a unit that is not known."
    ),
    conditions=LEVELS,
    read=_read,
)
