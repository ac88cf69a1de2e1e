"""Recordings that models are compared with, by name; each is imported on request.

A dataset states where its recordings come from (title, citation, license, size), and reads the
files that its user downloaded or fetched: animals, and the input of the models if it is not the six
stimuli that ship. Recordings are never bundled. Datasets of other packages are found by the entry
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
    """The recordings that were read from a dataset.

    Attributes:
        stimuli: The input of the models for the dataset's conditions; None for the six stimuli
            that ship or that the user names.
    """

    animals: tuple[Animal, ...]
    stimuli: StimuliInput | None = None
    notes: tuple[str, ...] = ()


Reader = Callable[[Sequence[Path], StimuliInput, Callable[[float], None]], DatasetContents]


@dataclass(frozen=True, eq=False)
class NeuralDataset:
    """A public set of recordings, and how to read it.

    Attributes:
        license: The SPDX name of its license; empty for a set of the user's own.
        about: Sentences on what is compared and what that leaves out.
        read: The function that reads downloaded files or folders. It takes them, the input of the
            six stimuli, and a function to call with the share done, 0 to 1, and raises
            `ConfigError` where they cannot be used.
        listing: The file beside `fetching` that lists the files of one version, from which
            `align fetch` gets the needed parts; empty if users must download the files.
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
