"""The board: a table of models by datasets and metrics, in shares of the noise ceiling.

In every cell a model's layer is chosen on the other animals (`statistics.held_out`), so that no
value is a maximum over layers. Controls are rows as well: the sensors' readings, each network
before its training, and another animal.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import msgspec
import numpy as np

from tactile_rt.alignment.datasets import NeuralDataset
from tactile_rt.alignment.json_file import Number
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.metrics import METRICS, Measure, find_metric
from tactile_rt.alignment.metrics.noise_ceiling import LONGEST, bins_of, means_of, sessions_of
from tactile_rt.alignment.neural import Animal
from tactile_rt.alignment.rdm import Floats
from tactile_rt.alignment.selection import part_of
from tactile_rt.alignment.statistics import held_out, standard_error
from tactile_rt.alignment.stimuli_input import StimuliInput

Traces = Mapping[str, Floats]  # by layer, (6, step, unit), NaN in steps that no input reaches

ANOTHER = "another animal"


class BoardRow(msgspec.Struct, frozen=True):
    """A row of a board: a model or control that is compared with the recordings."""

    name: str
    # kind of row: ``model``, ``untrained``, ``input`` (the sensors' readings) or ``animal``
    kind: str
    sha256: str = ""
    parameters: int = 0
    notes: tuple[str, ...] = ()


class BoardColumn(msgspec.Struct, frozen=True):
    """A column of a board: one part of a dataset, under one metric."""

    dataset: str
    part: str
    metric: str
    animals: int
    usable: int  # number of animals with a usable noise ceiling, see `Measure`
    # mean ceiling of these animals, which a perfect model is expected to reach; NaN without any
    ceiling: Number


class BoardCell(msgspec.Struct, frozen=True):
    """The value of one row in one column of a board."""

    # mean over animals of the value as a share of the ceiling; NaN without a value
    score: Number = math.nan
    sem: Number = math.nan  # standard error of `score`; NaN with fewer than two animals
    value: Number = math.nan  # mean over animals of the metric's value
    layer: str = ""  # layer that is chosen for most animals


class BoardDataset(msgspec.Struct, frozen=True):
    """A dataset's origin, as in `datasets.NeuralDataset`, and its animals and number of units."""

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


class Alignments(msgspec.Struct, frozen=True, tag_field="kind", tag="tactile_rt board 2"):
    """The content of a board: its rows, columns and cells, and its datasets and metrics."""

    rows: tuple[BoardRow, ...]
    columns: tuple[BoardColumn, ...]
    cells: tuple[tuple[BoardCell, ...], ...]  # (row, column) value of each row in each column
    datasets: tuple[BoardDataset, ...]
    metrics: dict[str, str]


def traces_of(layers: Layers) -> Traces:
    """Convert layers to traces for metrics: NaN in the steps that input has not reached.

    A layer with one response per stimulus, computed elsewhere, gets that response in every step.
    """
    out: dict[str, Floats] = {}
    for name, trace in layers.traces.items():
        values = np.asarray(trace, dtype=np.float64).copy()
        values[:, : layers.first[name]] = np.nan
        out[name] = np.repeat(values, LONGEST, axis=1) if values.shape[1] == 1 else values
    return out


def traces_of_stimuli(stimuli: StimuliInput) -> Traces:
    """Return the loads, averaged over each step's samples, SI, as a layer "raw"."""
    steps = stimuli.samples.astype(np.float64).mean(axis=2)
    return {"raw": steps.reshape(*steps.shape[:2], -1)}


def compute_board(
    rows: Sequence[tuple[BoardRow, Traces]],
    dataset: NeuralDataset,
    animals: Sequence[Animal],
    parts: Sequence[str],
    metrics: Sequence[str],
    notes: Iterable[str] = (),
    progress: Callable[[float], None] = lambda share: None,
) -> Alignments:
    """Compute the board of one dataset: the given rows, and another animal last.

    Args:
        rows: models and controls, each with its layers' responses to the dataset's conditions.
    """
    from threadpoolctl import threadpool_limits

    columns: list[BoardColumn] = []
    cells: list[list[BoardCell]] = [[] for _ in range(len(rows) + 1)]
    # One thread: matrices are small, and more threads would wait for each other, maybe minutes.
    with threadpool_limits(1):
        for done, (part, metric) in enumerate((p, m) for p in parts for m in metrics):
            targets = part_of(animals, part)
            measured = [(target, find_metric(metric)(target)) for target in targets]
            usable = [(target, measure) for target, measure in measured if measure.usable]
            measures = [measure for _, measure in usable]
            ceiling = float(np.mean([m.ceiling for m in measures])) if measures else math.nan
            columns.append(
                BoardColumn(dataset.name, part, metric, len(targets), len(usable), ceiling)
            )
            for row, (_, traces) in zip(cells, rows, strict=False):
                row.append(_make_cell(traces, measures))
            cells[-1].append(_compare_animals(usable))
            progress((done + 1) / (len(parts) * len(metrics)))
    card = BoardDataset(
        **{key: getattr(dataset, key) for key in BoardDataset.__struct_fields__[:7]},
        animals=tuple(a.name for a in animals),
        units=sum(s.rates.shape[1] for a in animals for s in a.sessions),
        notes=tuple(notes),
    )
    texts = {n: METRICS[n][1] if n in METRICS else "of another package" for n in metrics}
    every = (*(row for row, _ in rows), BoardRow(ANOTHER, "animal"))
    return Alignments(every, tuple(columns), tuple(map(tuple, cells)), (card,), texts)


def join_boards(boards: Sequence[Alignments]) -> Alignments:
    """Join boards with the same rows into one, with the columns of all."""
    return msgspec.structs.replace(
        boards[0],
        columns=tuple(column for board in boards for column in board.columns),
        cells=tuple(sum(rows, ()) for rows in zip(*(b.cells for b in boards), strict=True)),
        datasets=tuple(one for board in boards for one in board.datasets),
    )


def _make_cell(traces: Traces, measures: Sequence[Measure]) -> BoardCell:
    """Score a model on each animal by the layer that fits the others best."""
    values = np.array([[m.fit(trace) for m in measures] for trace in traces.values()])
    values = values.reshape(len(traces), len(measures))
    finite = np.flatnonzero(np.isfinite(values).all(axis=1)) if len(measures) else np.empty(0, int)
    shares = values[finite] / [m.ceiling for m in measures]
    scores, best = held_out(shares)
    if not np.isfinite(scores).any():
        return BoardCell()
    names = [tuple(traces)[k] for k in finite]
    chosen = [names[k] for k in best]
    raw = values[finite][best, np.arange(len(measures))]
    layer = max(set(chosen), key=chosen.count)
    return BoardCell(float(scores.mean()), standard_error(scores), float(raw.mean()), layer)


def _compare_animals(animals: Sequence[tuple[Animal, Measure]]) -> BoardCell:
    """Score the other animals as models of each animal: the mean of their fits."""
    scores, raw = [], []
    for target, measure in animals:
        found = [measure.fit(_convert_to_layer(a)) for a, _ in animals if a is not target]
        fits = np.array([value for value in found if np.isfinite(value)])
        if fits.size:
            scores.append(float(fits.mean()) / measure.ceiling)
            raw.append(float(fits.mean()))
    if not scores:
        return BoardCell()
    return BoardCell(float(np.mean(scores)), standard_error(scores), float(np.mean(raw)))


def _convert_to_layer(animal: Animal) -> Floats:
    """Return an animal's mean responses (stimulus, bin, unit), to be scored as a layer."""
    sessions = sessions_of(animal)
    means = means_of(sessions, bins_of(sessions))
    return np.repeat(means, LONGEST, axis=1) if means.shape[1] == 1 else means
