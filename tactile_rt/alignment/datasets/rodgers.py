"""The dataset DANDI 000231 (Rodgers 2022), and synthetic recordings in its format."""

from collections.abc import Callable, Sequence
from pathlib import Path

from tactile_rt.alignment.building import checked_sessions
from tactile_rt.alignment.datasets import DatasetContents, NeuralDataset
from tactile_rt.alignment.neural import by_animal
from tactile_rt.alignment.nwb import find_nwb
from tactile_rt.alignment.stimuli_input import StimuliInput


def _read(
    paths: Sequence[Path], stimuli: StimuliInput, progress: Callable[[float], None]
) -> DatasetContents:
    sessions, notes = checked_sessions(find_nwb(paths), progress=progress)
    return DatasetContents(by_animal(sessions), None, tuple(notes))


# Title, citation, license, size: dandiset.yaml of the draft, github.com/dandisets/000231. Listing:
# its tag 0.220904.1554, which has the size, SHA-256 and address of every file. Counts: Chung et al.
# (2025), units with valid trials.
DANDI_000231 = NeuralDataset(
    name="000231",
    title="A detailed behavioral, videographic, and neural dataset on object recognition in mice",
    citation=(
        "Rodgers, Chris (2022). A detailed behavioral, videographic, and neural dataset on object "
        "recognition in mice (version 0.220904.1554). DANDI archive. "
        "https://dandiarchive.org/dandiset/000231/0.220904.1554"
    ),
    license="CC0-1.0",
    url="https://dandiarchive.org/dandiset/000231",
    size="2.0 TB in 4,228 files of 15 mice, most of it video; `align fetch` gets the MB needed",
    about=(
        "Mice whisk a convex or a concave surface, close, at a medium distance or far. Rates of "
        "correct trials count from first contact to choice."
    ),
    read=_read,
    listing="dandi_000231.csv",
    counts=(11, 999),
)
EXAMPLE = NeuralDataset(
    name="example",
    title="A made-up brain of known truth",
    citation="made by `tactile-rt align example`: no animal",
    license="",
    url="",
    size="as it was asked for",
    about=(
        "Recordings in the form of 000231. Units mix features that follow distance and shape and "
        "are else drawn at random; nothing in them knows what a whisker feels."
    ),
    read=_read,
)
