"""Datasets of recordings that models are compared with, by name; each is imported on request.

A dataset states where its recordings come from (title, citation, license, size), and reads the
files that the user downloaded or fetched: animals, and the input of the models if it is not that of
the six stimuli. Recordings are never bundled. Datasets of other packages are found by the entry
points ``tactile_rt.alignment_datasets``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from tactile_rt.alignment.neural import Animal
from tactile_rt.alignment.stimuli_input import StimuliInput
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import added_names, import_addition
from tactile_rt.core.settings import no_such

__all__ = ["DATASETS", "DatasetContents", "NeuralDataset", "dataset_names", "find_dataset"]

ENTRY_POINTS = "tactile_rt.alignment_datasets"  # of other packages


@dataclass(frozen=True, eq=False)
class DatasetContents:
    """The recordings read from a dataset.

    Attributes:
        stimuli: The input of the models for the dataset's conditions; None for the input of the
            six stimuli.
    """

    animals: tuple[Animal, ...]
    stimuli: StimuliInput | None = None
    notes: tuple[str, ...] = ()


Reader = Callable[[Sequence[Path], StimuliInput, Callable[[float], None]], DatasetContents]


@dataclass(frozen=True, eq=False)
class NeuralDataset:
    """The description of a dataset of recordings, with the function that reads it.

    Attributes:
        license: The SPDX name of the license; empty for the user's own recordings.
        about: Sentences on what is compared, and on limits of the comparison.
        read: Function of downloaded files or folders, the input of the six stimuli, and a function
            to call with the share done, 0 to 1. It returns the recordings, or raises `ConfigError`
            if they cannot be used.
        listing: The name of a file in this package that lists the files of one version, of which
            `align fetch` downloads the needed parts; empty if users must download the files.
        counts: The numbers of mice and of units in the published analysis, to compare the fetched
            files with; None if unknown.
    """

    name: str
    title: str
    citation: str
    license: str
    url: str
    size: str
    about: str
    read: Reader
    listing: str = ""
    counts: tuple[int, int] | None = None


# name: module and attribute of the dataset
DATASETS = {
    "000231": f"{__name__}.rodgers:DANDI_000231",
    "example": f"{__name__}.rodgers:EXAMPLE",
    "own": f"{__name__}.own:OWN",
}


def dataset_names() -> tuple[str, ...]:
    """Return the names of all installed datasets, those of this package first."""
    return (*DATASETS, *(name for name in added_names(ENTRY_POINTS) if name not in DATASETS))


def find_dataset(name: str) -> NeuralDataset:
    """Return a dataset by its name."""
    if name in DATASETS:
        module, _, attribute = DATASETS[name].partition(":")
        ours: NeuralDataset = getattr(import_module(module), attribute)
        return ours
    theirs: NeuralDataset | None = import_addition(ENTRY_POINTS, name)
    if theirs is None:
        raise ConfigError(no_such("dataset", name, dataset_names()))
    return theirs
