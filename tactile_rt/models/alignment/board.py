"""The board: models by datasets by metrics, each value as a share of what the noise permits.

In every cell a model's layer is chosen on the other animals (`statistics.held_out`), so that the
board tells no maximum. What it is to be read against stands in rows of the same kind: the sensors
themselves, each network before its training, and another animal.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.files import write_whole
from tactile_rt.models.alignment.datasets import NeuralDataset
from tactile_rt.models.alignment.layers import Layers
from tactile_rt.models.alignment.metrics import METRICS, Measure, find_metric
from tactile_rt.models.alignment.metrics.halves import LONGEST, bins_of, means_of, sessions_of
from tactile_rt.models.alignment.neural import Animal
from tactile_rt.models.alignment.statistics import held_out, standard_error
from tactile_rt.models.alignment.stimuli_input import StimuliInput
from tactile_rt.models.alignment.targets import part_of

__all__ = [
    "ANOTHER",
    "Alignments",
    "BoardCell",
    "BoardColumn",
    "BoardDataset",
    "BoardRow",
    "joined",
    "read_board",
    "traces_of",
    "traces_of_stimuli",
    "with_cells",
    "write_board",
]

Floats = NDArray[np.float64]
Traces = Mapping[str, Floats]  # by layer, (6, step, unit), NaN where input cannot reach

KIND = "tactile_rt alignment board"
VERSION = 1
ANOTHER = "another animal"


class BoardRow(msgspec.Struct, frozen=True):
    """What is compared with the recordings.

    Attributes:
        name: The name of the row, as the board prints it.
        kind: The kind of row: ``model``, ``untrained``, ``input`` (the sensors' readings) or
            ``animal``.
        sha256: The SHA-256 sum of the model's file, hex; empty for what has no file.
        parameters: The count of numbers that the model is made of; 0 where there are none.
        notes: Remarks on what could not be had and why, a line each.
    """

    name: str
    kind: str
    sha256: str = ""
    parameters: int = 0
    notes: tuple[str, ...] = ()


class BoardColumn(msgspec.Struct, frozen=True):
    """Part of a dataset under a metric.

    Attributes:
        dataset: The name of the dataset.
        part: The part of cortex, such as ``all`` or ``L4``.
        metric: The name of the metric.
        animals: The number of animals with units of that part.
        usable: The number of animals whose noise is low enough to be corrected for.
        ceiling: The mean over these of the value that a perfect model is expected to reach; None
            without any.
    """

    dataset: str
    part: str
    metric: str
    animals: int
    usable: int
    ceiling: float | None


class BoardCell(msgspec.Struct, frozen=True):
    """A row's value in a column.

    Attributes:
        row, column: The places of the row and the column in the board.
        score: The mean over animals of the value as a share of the ceiling; None without any.
        sem: The standard error of that mean; None with fewer than two animals.
        value: The mean over animals before the division by the ceiling.
        layer: The name of the layer that was chosen most often.
    """

    row: int
    column: int
    score: float | None
    sem: float | None
    value: float | None
    layer: str


class BoardDataset(msgspec.Struct, frozen=True):
    """Where a dataset comes from; attributes as in `datasets.NeuralDataset`, and what was read.

    Attributes:
        animals: The names of the animals that were read.
        units: The number of units of all animals together.
        notes: Remarks on what was left out and why, a line each.
    """

    name: str
    title: str
    citation: str
    license: str
    url: str
    size: str
    about: str
    animals: tuple[str, ...]
    units: int
    notes: tuple[str, ...]


class Alignments(msgspec.Struct, frozen=True):
    """A whole board.

    Attributes:
        rows: The models and what they are read against.
        columns: The datasets' parts under every metric.
        cells: The values, in any order.
        datasets: The datasets of the columns.
        metrics: What each metric is, in a line, by its name.
    """

    rows: tuple[BoardRow, ...]
    columns: tuple[BoardColumn, ...]
    cells: tuple[BoardCell, ...]
    datasets: tuple[BoardDataset, ...]
    metrics: dict[str, str]
    kind: str = KIND
    version: int = VERSION

    def cell(self, row: int, column: int) -> BoardCell:
        """The cell at a place.

        Raises:
            KeyError: there is none.
        """
        for cell in self.cells:
            if (cell.row, cell.column) == (row, column):
                return cell
        raise KeyError((row, column))


def traces_of(layers: Layers) -> Traces:
    """Layers as metrics take them: NaN before the step that input reaches.

    What was computed elsewhere for a whole stimulus, one step, holds at every step.
    """
    out: dict[str, Floats] = {}
    for name, trace in layers.traces.items():
        values = np.asarray(trace, dtype=np.float64).copy()
        values[:, : layers.first[name]] = np.nan
        out[name] = np.repeat(values, LONGEST, axis=1) if values.shape[1] == 1 else values
    return out


def traces_of_stimuli(stimuli: StimuliInput) -> Traces:
    """The loads themselves as a layer, mean over a step's samples, SI."""
    steps = stimuli.samples.astype(np.float64).mean(axis=2)
    return {"raw": steps.reshape(*steps.shape[:2], -1)}


def with_cells(
    rows: Sequence[tuple[BoardRow, Traces]],
    dataset: NeuralDataset,
    animals: Sequence[Animal],
    parts: Sequence[str],
    metrics: Sequence[str],
    notes: Iterable[str] = (),
    progress: Callable[[float], None] = lambda share: None,
) -> Alignments:
    """The board of one dataset; the row of another animal is added to the given ones.

    Args:
        rows: each with its layers for this dataset's conditions.
        dataset: what the animals are of.
        animals: as they were read.
        parts: of cortex, from `targets.TARGET_PARTS`.
        metrics: by name.
        notes: on what was left out.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: no such part or metric.
        ModuleNotFoundError: threadpoolctl is not installed.
    """
    from threadpoolctl import threadpool_limits

    columns: list[BoardColumn] = []
    cells: list[BoardCell] = []
    # Matrices are small: more threads wait for each other, on a busy machine for minutes.
    with threadpool_limits(1):
        for done, (part, metric) in enumerate((p, m) for p in parts for m in metrics):
            targets = part_of(animals, part)
            measures = [find_metric(metric)(target) for target in targets]
            usable = [k for k, measure in enumerate(measures) if measure.usable]
            ceilings = np.array([measures[k].ceiling for k in usable])
            columns.append(
                BoardColumn(dataset.name, part, metric, len(targets), len(usable),
                            _number(ceilings.mean()) if usable else None)
            )  # fmt: skip
            for row, (_, traces) in enumerate(rows):
                cells.append(_cell(row, done, traces, [measures[k] for k in usable]))
            others = [(targets[k], measures[k]) for k in usable]
            cells.append(_another(len(rows), done, others))
            progress((done + 1) / (len(parts) * len(metrics)))
    card = BoardDataset(
        name=dataset.name,
        title=dataset.title,
        citation=dataset.citation,
        license=dataset.license,
        url=dataset.url,
        size=dataset.size,
        about=dataset.about,
        animals=tuple(a.name for a in animals),
        units=sum(s.rates.shape[1] for a in animals for s in a.sessions),
        notes=tuple(notes),
    )
    said = {name: METRICS[name][1] if name in METRICS else "of another package" for name in metrics}
    named = (*(row for row, _ in rows), BoardRow(ANOTHER, "animal"))
    return Alignments(named, tuple(columns), tuple(cells), (card,), said)


def joined(boards: Sequence[Alignments]) -> Alignments:
    """Boards of the same rows side by side."""
    columns: list[BoardColumn] = []
    cells: list[BoardCell] = []
    for board in boards:
        cells += [
            msgspec.structs.replace(cell, column=cell.column + len(columns)) for cell in board.cells
        ]
        columns += board.columns
    return msgspec.structs.replace(
        boards[0],
        columns=tuple(columns),
        cells=tuple(cells),
        datasets=tuple(one for board in boards for one in board.datasets),
    )


def write_board(board: Alignments, path: Path) -> None:
    """Write it whole or not at all, as JSON."""
    text = msgspec.json.format(msgspec.json.encode(board), indent=1)
    write_whole(path, lambda file: file.write(text + b"\n"))


def read_board(path: Path) -> Alignments:
    """Read what `write_board` wrote.

    Raises:
        ConfigError: not there, damaged, or of another version.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    try:
        head = msgspec.json.decode(raw)
        if not isinstance(head, dict) or head.get("kind") != KIND:
            raise ConfigError(f"{path} has no board: write one with `tactile-rt align board`")
        if head.get("version") != VERSION:
            raise ConfigError(
                f"{path} has a board of version {head.get('version')!r}, not {VERSION}"
            )
        return msgspec.json.decode(raw, type=Alignments)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{path} is damaged, or not what `tactile-rt align board --json` wrote: {error}"
        ) from None


def _cell(row: int, column: int, traces: Traces, measures: Sequence[Measure]) -> BoardCell:
    """A model's cell: of each animal the layer that is best on the others."""
    values = np.array([[m.fit(trace) for m in measures] for trace in traces.values()])
    values = values.reshape(len(traces), len(measures))
    there = np.flatnonzero(np.isfinite(values).all(axis=1)) if len(measures) else np.empty(0, int)
    shares = values[there] / [m.ceiling for m in measures]
    scores, best = held_out(shares)
    if not np.isfinite(scores).any():
        return BoardCell(row, column, None, None, None, "")
    names = [tuple(traces)[k] for k in there]
    chosen = [names[k] for k in best]
    raw = values[there][best, np.arange(len(measures))]
    return BoardCell(
        row,
        column,
        _number(scores.mean()),
        _number(standard_error(scores)),
        _number(raw.mean()),
        max(set(chosen), key=chosen.count),
    )


def _another(row: int, column: int, animals: Sequence[tuple[Animal, Measure]]) -> BoardCell:
    """The cell of animals as models of each other: each measured by all others, one at a time."""
    scores, raw = [], []
    for target, measure in animals:
        found = [measure.fit(_as_layer(a)) for a, _ in animals if a is not target]
        there = np.array([value for value in found if np.isfinite(value)])
        if there.size:
            scores.append(float(there.mean()) / measure.ceiling)
            raw.append(float(there.mean()))
    if not scores:
        return BoardCell(row, column, None, None, None, "")
    sem = standard_error(scores)
    return BoardCell(row, column, _number(np.mean(scores)), _number(sem), _number(np.mean(raw)), "")


def _as_layer(animal: Animal) -> Floats:
    """An animal's mean responses, (6, bin, unit); without a time course the same in every bin."""
    sessions = sessions_of(animal)
    means = means_of(sessions, bins_of(sessions))
    return np.repeat(means, LONGEST, axis=1) if means.shape[1] == 1 else means


def _number(value: float | np.floating) -> float | None:
    return float(value) if np.isfinite(value) else None
