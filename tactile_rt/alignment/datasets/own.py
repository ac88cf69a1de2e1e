"""The dataset of the user's own recordings, of any named stimuli (`named_recordings`)."""

from collections.abc import Callable, Sequence
from pathlib import Path

from tactile_rt.alignment.building import refuse_copies
from tactile_rt.alignment.datasets import DatasetContents, NeuralDataset
from tactile_rt.alignment.named_recordings import read_named_npz, read_spike_tables
from tactile_rt.alignment.neural import by_animal
from tactile_rt.alignment.stimuli_input import StimuliInput


def _read(
    paths: Sequence[Path], stimuli: StimuliInput, progress: Callable[[float], None]
) -> DatasetContents:
    (path,) = paths
    tables = sorted(path.glob("*.csv")) if path.is_dir() else []
    sessions = read_spike_tables(tables) if tables else read_named_npz(path)
    refuse_copies(sessions)
    return DatasetContents(by_animal(sessions))


OWN = NeuralDataset(
    name="own",
    title="Recordings of your own",
    citation="as their owner asks for",
    license="",
    url="",
    size="as recorded",
    about=(
        "Any 3 to 50 named stimuli: an .npz of rates by session, or a folder with a table of "
        "spikes and one of events. Models are given as their responses to the same stimuli."
    ),
    read=_read,
)
