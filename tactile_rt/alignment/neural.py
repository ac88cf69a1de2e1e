"""Neural recordings, the input of both protocols: animals, sessions, rates and stimuli by trial."""

import hashlib
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.rdm import Floats
from tactile_rt.core.errors import ConfigError, describe_error, name_some
from tactile_rt.core.files import refuse_lfs_pointer
from tactile_rt.core.stream.stimuli import STIMULI


@dataclass(frozen=True, eq=False)
class NeuralSession:
    """One recorded session of one animal: rates and stimuli by trial.

    Attributes:
        rates: (trial, unit) Firing rates in spikes per second, in the order of the trials.
        stimulus: (trial,) The stimulus of each trial, as an index into `stimuli`.
        course: (trial, bin, unit) Firing rates in spikes per second in 22 bins of 45 ms, as many as
            a model has steps, from the start of the window; NaN from the bin that includes the
            choice on. None if unknown.
        depth: (unit,) The depth of each unit below the pia in um, NaN where unknown; None if
            unknown for all units.
        inhibitory: (unit,) True for a putative inhibitory neuron; None if unknown.
        begin: (trial,) The start time of each trial on the session's clock in s, used to recognise
            two sortings of one recording; None if unknown.
        stimuli: The names of the stimuli.
    """

    animal: str
    name: str
    rates: Floats
    stimulus: NDArray[np.int64]
    course: Floats | None = None
    depth: Floats | None = None
    inhibitory: NDArray[np.bool_] | None = None
    begin: Floats | None = None
    stimuli: tuple[str, ...] = STIMULI

    def __post_init__(self) -> None:
        rates, stimulus = self.rates, self.stimulus
        if rates.ndim != 2 or stimulus.shape != rates.shape[:1]:
            raise ConfigError(
                f"session {self.name}: {rates.shape} rates need a stimulus per trial, not "
                f"{stimulus.shape}"
            )
        if not np.isfinite(rates).all():
            raise ConfigError(f"session {self.name}: a rate is not finite")
        if stimulus.dtype.kind not in "iu" or not np.isin(stimulus, range(len(self.stimuli))).all():
            raise ConfigError(
                f"session {self.name}: stimuli must be numbers from 0 to {len(self.stimuli) - 1}"
            )
        trials, units = rates.shape
        for what, shape in (("depth", (units,)), ("inhibitory", (units,)), ("begin", (trials,))):
            value = getattr(self, what)
            if value is not None and value.shape != shape:
                raise ConfigError(f"session {self.name}: {what} is {value.shape}, not {shape}")
        if self.course is not None and self.course.shape[::2] != rates.shape:
            raise ConfigError(
                f"session {self.name}: course is {self.course.shape}, not (trial, bin, unit)"
            )

    @property
    def trials(self) -> NDArray[np.int64]:
        """Number of trials of every stimulus (stimulus,)."""
        return np.bincount(self.stimulus, minlength=len(self.stimuli))


@dataclass(frozen=True)
class Animal:
    """An animal and its recorded sessions, each with different units."""

    name: str
    sessions: tuple[NeuralSession, ...]


def by_animal(sessions: Sequence[NeuralSession]) -> tuple[Animal, ...]:
    """Group sessions by animal; return the animals, sorted by name."""
    names = sorted({session.animal for session in sessions})
    return tuple(Animal(n, tuple(s for s in sessions if s.animal == n)) for n in names)


def published_layout(animal: Animal) -> Floats:
    """Arrange an animal's rates as the published analysis does, with its two mistakes.

    - The stimulus axis follows the order in which stimuli first appear in each session, so that
      the same index means different stimuli in different sessions.
    - A trial is zero, not missing, for the five stimuli that it did not show: means over trials
      are rates times the share of trials that showed the stimulus.

    Returns:
        (row, 6, unit): row k holds the k-th trial of every session, NaN after a session's last.

    Raises:
        ConfigError: a session lacks a stimulus, for which the published code fails as well.
    """
    blocks = []
    for session in animal.sessions:
        missing = [name for name, n in zip(STIMULI, session.trials, strict=True) if not n]
        if missing:
            raise ConfigError(
                f"session {session.name} has no correct trial of {name_some(missing)}, which "
                "protocol paper-code needs; leave it out, or use --protocol strict"
            )
        _, first = np.unique(session.stimulus, return_index=True)
        place = np.argsort(np.argsort(first))  # of each stimulus, by first appearance
        trials, units = session.rates.shape
        block = np.zeros((trials, len(STIMULI), units))
        block[np.arange(trials), place[session.stimulus]] = session.rates
        blocks.append(block)
    return pad(blocks)


def pad(blocks: Sequence[Floats]) -> Floats:
    """Concatenate arrays (row, 6, unit) along units; pad shorter arrays with rows of NaN."""
    rows = max(block.shape[0] for block in blocks)
    return np.concatenate(
        [np.pad(b, ((0, rows - len(b)), (0, 0), (0, 0)), constant_values=np.nan) for b in blocks],
        axis=2,
    )


def rates_sha256(arrays: Mapping[str, NDArray[np.generic]]) -> str:
    """Return the SHA-256 hash of named arrays, from names, shapes, types and values."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


# The published code saved this option of `numpy.savez` as if it were an animal.
NOT_AN_ANIMAL = "allow_pickle"
LARGEST = 1 << 30  # most bytes in an archive; the published archives have tens of millions


def read_published(path: Path) -> dict[str, Floats]:
    """Read every animal's rates (row, 6, unit), NaN-padded, from an ``.npz`` as published.

    The published file has an entry ``allow_pickle``, an option that was saved as if it were an
    animal: it is ignored, and nothing is ever unpickled.

    The stimulus axis has no names in such a file, so only protocol paper-code can use it; see
    `published_layout`.
    """
    refuse_lfs_pointer(path)
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > LARGEST:
            raise ValueError(f"it unpacks to {size} bytes")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name != NOT_AN_ANIMAL}
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        reason = describe_error(error)
        raise ConfigError(f"{path}: not an npz file of numbers ({reason})") from None
    if not arrays:
        raise ConfigError(f"{path}: holds no animal")
    for name, array in arrays.items():
        if array.ndim != 3 or array.shape[1] != len(STIMULI) or array.dtype.kind not in "fiu":
            raise ConfigError(
                f"{path}: {name} is {array.dtype} {array.shape}, not numbers "
                f"(row, {len(STIMULI)} stimuli, unit)"
            )
        if array.shape[0] < 2 or array.shape[2] < 2:
            raise ConfigError(f"{path}: {name} {array.shape} has fewer than two rows or units")
        if np.isinf(array).any():
            raise ConfigError(f"{path}: {name} holds an infinite rate")
    return {name: array.astype(np.float64) for name, array in arrays.items()}
