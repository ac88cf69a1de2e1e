"""What a grid trains: a TOML file of encoder x attender x objective under one budget.

data = "data/default24"
updates = 600
[[cell]]
encoder = "zhuang-gru"
"""

from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.models.ead import EADConfig
from tactile_rt.models.training import TrainingConfig
from tactile_rt.settings import convert, make_node, parse_toml, read_toml
from tactile_rt.stream import ConfigError

__all__ = [
    "Candidate",
    "Grid",
    "Pair",
    "Question",
    "SweepCounts",
    "Task",
    "read_grid",
    "shipped_grids",
]

SHIPPED = resources.files("tactile_rt.models.grid")
SUPERVISED, RANDOM, SVM = "supervised", "random", "svm"


class Candidate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One network and how it learns.

    Attributes:
        encoder, attender: Names of the encoder and the attender, as in `EADConfig`.
        objective: The objective, "supervised", or a self-supervised one, whose features a linear
            probe reads.
        augmentation: The augmentation that makes the views of a self-supervised objective.
        masking: The share of the steps of a view that is blanked, 0 to 1.
        width: The width of this network; 0 takes the grid's.
        options: Further fields of `TrainingConfig`, for this cell alone.
    """

    encoder: str
    attender: str = "none"
    objective: str = SUPERVISED
    augmentation: str = "none"
    masking: float = 0.0
    width: float = 0.0
    options: dict[str, Any] = {}

    @property
    def network(self) -> str:
        """Encoder, attender and a width of its own: ``zhuang-gru+gpt@0.125``."""
        attender = f"+{self.attender}" if self.attender != "none" else ""
        return self.encoder + attender + (f"@{self.width:g}" if self.width else "")

    @property
    def learning(self) -> str:
        """Objective and views: ``simclr tactile+masking``."""
        views = [self.augmentation] if self.augmentation != "none" else []
        views += ["masking"] if self.masking else []
        return " ".join([self.objective, "+".join(views)]).strip()

    @property
    def name(self) -> str:
        """Unique in a grid; a supervised cell goes by its network alone."""
        return self.network + ("" if self.objective == SUPERVISED else f" {self.learning}")


class SweepCounts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How many sweeps of each object are taken; 0: all."""

    train: int = 0
    validation: int = 0
    test: int = 0


class Pair(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two cells to compare, by name; "svm" and "random NETWORK" are names too."""

    better: str
    than: str


class Question(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question to the grid and the comparisons that answer it."""

    text: str
    pairs: tuple[Pair, ...]


class Task(msgspec.Struct, frozen=True):
    """One thing to do: a cell with a seed, a network's random initialisation, or the SVM.

    Attributes:
        name: The name of the cell, "random NETWORK" or "svm".
        seed: The seed of the weights, the windows and the noise.
        cell: The cell to train; None for the support vector machine.
    """

    name: str
    seed: int
    cell: Candidate | None

    @property
    def slug(self) -> str:
        """A name for files."""
        return f"{self.name.replace(' ', '_')}_seed{self.seed}"

    @property
    def random(self) -> bool:
        """Whether the network stays as it was initialised."""
        return self.name.startswith(RANDOM)


class Grid(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole grid.

    Attributes:
        data: The folder of the sweep set.
        cells: The cells, in the order in which they are trained.
        width: The width of every network that has none of its own.
        updates, batch: The budget of every cell: updates, and sweeps per update.
        seeds: The number of seeds; all cells are trained with the first before any with the second.
        sweeps: The number of sweeps of each object that are used, by split.
        supervised, self_supervised: Fields of `TrainingConfig` for cells of either kind.
        probe: Fields of `ProbeConfig` for cells whose features a probe reads.
        svm: Whether a support vector machine is fitted too.
        questions: The questions that the report answers.
    """

    data: str
    cells: tuple[Candidate, ...] = msgspec.field(name="cell")
    width: float = 0.125
    updates: int = 600
    batch: int = 32
    seeds: int = 3
    sweeps: SweepCounts = SweepCounts()
    supervised: dict[str, Any] = {}
    self_supervised: dict[str, Any] = {}
    probe: dict[str, Any] = {}
    svm: bool = True
    questions: tuple[Question, ...] = msgspec.field(name="question", default=())

    def config(self, task: Task, data: Path) -> TrainingConfig:
        """How a task is trained on the sweep set at `data`.

        Raises:
            ConfigError: an option that there is not, or a value that it cannot have.
        """
        cell = task.cell
        assert cell is not None
        common = self.supervised if cell.objective == SUPERVISED else self.self_supervised
        options: dict[str, Any] = {
            "data": str(data),
            "encoder": cell.encoder,
            "attender": cell.attender,
            "objective": cell.objective,
            "augmentation": cell.augmentation,
            "masking": cell.masking,
            "width": cell.width or self.width,
            "updates": self.updates,
            "batch": self.batch,
            "seed": task.seed,
            **common,
            **cell.options,
        }
        convert(make_node(options, f"cell {cell.name!r}", 0, Path()), TrainingConfig)
        # As it is written: whole numbers stay whole in what is stored of a run.
        return TrainingConfig(**options)

    def tasks(self) -> list[Task]:
        """Everything to do, the first seed of all first."""
        tasks = [Task(SVM, 0, None)] if self.svm else []
        for seed in range(self.seeds):
            seen: set[str] = set()
            for cell in self.cells:
                tasks.append(Task(cell.name, seed, cell))
                if cell.network not in seen:
                    seen.add(cell.network)
                    bare = Candidate(cell.encoder, cell.attender, width=cell.width)
                    tasks.append(Task(f"{RANDOM} {cell.network}", seed, bare))
        return tasks


def shipped_grids() -> tuple[str, ...]:
    """Names that `read_grid` takes in place of a path."""
    files = (entry.name for entry in SHIPPED.iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in files if name.endswith(".toml")))


def read_grid(name: str | Path) -> Grid:
    """Read a grid file, or a shipped one by its name, and check every cell of it.

    Raises:
        ConfigError: there is none, or it is not such a file.
    """
    if str(name) in shipped_grids():
        nodes = parse_toml((SHIPPED / f"{name}.toml").read_text(), str(name))
    elif Path(name).exists():
        nodes = read_toml(Path(name))
    else:
        raise ConfigError(
            f"no grid {name}: name a TOML file, or one of {', '.join(shipped_grids())}"
        )
    grid: Grid = convert(nodes, Grid)
    names = [cell.name for cell in grid.cells]
    for cell in grid.cells:
        if names.count(cell.name) > 1:
            raise ConfigError(f"{name}: two cells are {cell.name!r}")
        try:
            config = grid.config(Task(cell.name, 0, cell), Path(grid.data))
            try:
                EADConfig(2, cell.encoder, cell.attender, config.decoder, config.width)
            except ConfigError as error:
                raise ConfigError(f"cell {cell.name!r}: {error}") from None
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    known = {task.name for task in grid.tasks()}
    for question in grid.questions:
        for one in (name for pair in question.pairs for name in (pair.better, pair.than)):
            if one not in known:
                raise ConfigError(f"{name}: {question.text!r} compares {one!r}, which no cell is")
    if not grid.cells or grid.seeds < 1 or grid.updates < 1:
        raise ConfigError(f"{name}: a grid needs a cell, a seed and an update")
    return grid
