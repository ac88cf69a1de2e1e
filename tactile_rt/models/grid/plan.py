"""The plan of a grid: a TOML file of cells (encoder, attender, objective), tuned equally.

Every cell is tuned by the same number of short trials, then trained with more and more updates
until further updates gain nothing, then with further seeds. A cell with a recipe is not tuned:

data = "data/wide24"
search = { learning_rate = [1e-3, 5e-3], warmup = [0.05, 0.3], updates = 500 }
growth = { first = 1000, most = 8000, gain = 0.01 }
[[cell]]
encoder = "zhuang-gru"
"""

from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.settings import convert, make_node, parse_toml, read_toml
from tactile_rt.models.training.config import ProbeConfig, TrainingConfig
from tactile_rt.models.training.recipes import load_recipe

SHIPPED = resources.files("tactile_rt.models.grid")
# fields of a training's configuration that a grid sets task by task
OWN = ("data", "also", "begin", "seed", "learning_rate", "warmup", "epochs", "updates")
OF_CELL = ("encoder", "attender", "objective", "augmentation", "masking")
SUPERVISED, RANDOM, SVM = "supervised", "random", "svm"
NAMING = ("pairs",)  # options whose value is part of a cell's name
# fields of a training's configuration that an untrained network and its probe also depend on
OF_UNTRAINED = (
    "decoder", "readout", "dropout", "graph", "norm_epsilon", "preprocessing", "first_weights",
    "window", "jitter", "faults",
)  # fmt: skip


class Candidate(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One cell of a grid: a network and its training, with values as in `TrainingConfig`.

    Attributes:
        objective: "supervised", or a self-supervised objective, which is scored by a linear probe.
        width: The width of this network; 0: the grid's width.
        share: The share of each category's training objects to train on, at least one object.
        begin: The name of a cell whose trained network of the same seed provides the initial
            weights; empty: random initial weights.
        seeds: The number of seeds of this cell; 0: the grid's number.
        options: Further fields of `TrainingConfig`, which override the grid's or the recipe's.
        recipe: A recipe of `tactile-rt train`, by which this cell is trained without a search.
    """

    encoder: str
    attender: str = "none"
    objective: str = SUPERVISED
    augmentation: str = "none"
    masking: float = 0.0
    width: float = 0.0
    share: float = 1.0
    begin: str = ""
    seeds: int = 0
    options: dict[str, Any] = {}
    recipe: str = ""

    @property
    def network(self) -> str:
        """Name of the network, from encoder, attender and the cell's width: ``s4+gpt@0.125``."""
        attender = f"+{self.attender}" if self.attender != "none" else ""
        return self.encoder + attender + (f"@{self.width:g}" if self.width else "")

    @property
    def learning(self) -> str:
        """Name of the training, from objective, augmentations, initial weights and share."""
        views = [self.augmentation] if self.augmentation != "none" else []
        views += ["masking"] if self.masking else []
        views += [str(self.options[key]) for key in NAMING if key in self.options]
        views += [self.recipe] if self.recipe else []
        before = f"after {self.begin.removeprefix(self.network).strip()}" if self.begin else ""
        share = f"of {self.share:g}" if self.share < 1 else ""
        return " ".join(filter(None, [self.objective, "+".join(views), before, share]))

    @property
    def name(self) -> str:
        """Name, unique in a grid: `network` and `learning` without "supervised"."""
        return f"{self.network} {self.learning.removeprefix(SUPERVISED).strip()}".strip()


class SweepCounts(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Numbers of sweeps of each object to use, by split; 0: all."""

    train: int = 0
    validation: int = 0
    test: int = 0


class Search(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the trials that choose a cell's learning rate and warm-up by validation.

    Attributes:
        learning_rate: The peak learning rates to try, all with the first warm-up.
        warmup: The shares of updates in which the rate rises; all but the first are tried only
            with the best peak.
    """

    learning_rate: tuple[float, ...] = (5e-4, 1.5e-3, 5e-3, 1.5e-2)
    warmup: tuple[float, ...] = (0.05, 0.3)
    updates: int = 500


class Growth(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the numbers of updates to try: doubled until the gain is below `gain`.

    Each training starts anew, with a whole schedule of its learning rate.

    Attributes:
        first, most: The first and the largest number of updates.
        gain: The smallest gain in validation score, 0 to 1, for which doubling goes on.
    """

    first: int = 1000
    most: int = 8000
    gain: float = 0.01


class Pair(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Two cells to compare, by name: a cell's name, "svm" or "random NETWORK"."""

    better: str
    than: str


class Question(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A question about the grid's results, and the pairs of cells whose comparison answers it."""

    text: str
    pairs: tuple[Pair, ...]


class Task(msgspec.Struct, frozen=True):
    """One task of a grid: a cell and seed, an untrained network, or the SVM.

    Attributes:
        name: The name of the cell, "random NETWORK" or "svm".
        cell: The cell to train or to leave untrained; None for the support vector machine.
    """

    name: str
    seed: int
    cell: Candidate | None

    @property
    def slug(self) -> str:
        """Base name of the task's files, from its name and seed."""
        return f"{self.name.replace(' ', '_')}_seed{self.seed}"

    @property
    def random(self) -> bool:
        """True if the network is left untrained, with random weights."""
        return self.name.startswith(RANDOM)


class Grid(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The plan of a whole grid, as read from its TOML file.

    Attributes:
        width, seeds: The width and the number of seeds of a cell that does not set its own.
    """

    data: str
    cells: tuple[Candidate, ...] = msgspec.field(name="cell")
    width: float = 0.125
    batch: int = 32
    search: Search = Search()
    growth: Growth = Growth()
    seeds: int = 3
    sweeps: SweepCounts = SweepCounts()
    supervised: dict[str, Any] = {}
    self_supervised: dict[str, Any] = {}
    probe: dict[str, Any] = {}
    svm: bool = True
    questions: tuple[Question, ...] = msgspec.field(name="question", default=())

    def config(self, task: Task, data: Path, **chosen: Any) -> TrainingConfig:
        """Return a task's training configuration on `data`; fields in `chosen` take precedence."""
        cell = task.cell
        assert cell is not None
        options: dict[str, Any] = {
            "data": str(data),
            **{name: getattr(cell, name) for name in OF_CELL},
            "width": cell.width or self.width,
            "batch": self.batch,
            "seed": task.seed,
            **self._collect_options(cell),
            **chosen,
        }
        convert(make_node(options, f"cell {cell.name!r}", 0, Path()), TrainingConfig)
        # With the values as written: whole numbers stay whole in a run's stored configuration.
        return TrainingConfig(**options)

    def tasks(self) -> list[Task]:
        """List all tasks, cell by cell, so that an unfinished grid has complete rows."""
        tasks = {(SVM, 0): Task(SVM, 0, None)} if self.svm else {}
        for cell in self.cells:
            for seed in range(cell.seeds or self.seeds):
                random = Task(f"{RANDOM} {cell.network}", seed, self.make_untrained(cell))
                for task in (Task(cell.name, seed, cell), random):
                    tasks.setdefault((task.name, seed), task)
        return list(tasks.values())

    def make_untrained(self, cell: Candidate) -> Candidate:
        """Return a candidate with a cell's network and probe settings, but without training."""
        own, usual = self._collect_options(cell), TrainingConfig("")
        names = (k for k in OF_UNTRAINED if k in own or k in self.supervised)
        kept = {k: own.get(k, getattr(usual, k)) for k in names}
        return Candidate(cell.encoder, cell.attender, width=cell.width, options=kept)

    def _collect_options(self, cell: Candidate) -> dict[str, Any]:
        common = self.supervised if cell.objective == SUPERVISED else self.self_supervised
        if cell.recipe:
            train = load_recipe(cell.recipe).train
            common = {k: v for k, v in train.items() if k not in (*OF_CELL, "width")}
        return {**common, **cell.options}

    def find_beginning(self, task: Task) -> Task:
        """Return the task whose trained network provides a task's initial weights."""
        assert task.cell is not None
        (cell,) = (one for one in self.cells if one.name == task.cell.begin)
        return Task(cell.name, task.seed, cell)

    def list_dependencies(self, task: Task) -> tuple[str, ...]:
        """Return the slugs of a task's dependencies: the tuning seed and the initial weights."""
        cell = task.cell
        if cell is None or task.random:
            return ()
        tuned = (Task(task.name, 0, cell),) if task.seed and not cell.recipe else ()
        begun = (self.find_beginning(task),) if cell.begin else ()
        return tuple(one.slug for one in (*tuned, *begun))


def shipped_grids() -> tuple[str, ...]:
    """Return the names of the grids in this package, which `read_grid` accepts."""
    files = (entry.name for entry in SHIPPED.iterdir())
    return tuple(sorted(name.removesuffix(".toml") for name in files if name.endswith(".toml")))


def read_grid(name: str | Path) -> Grid:
    """Read and check a grid from a TOML file, or from this package by name."""
    if str(name) in shipped_grids():
        nodes = parse_toml((SHIPPED / f"{name}.toml").read_text(), str(name))
    elif Path(name).exists():
        nodes = read_toml(Path(name))
    else:
        known = ", ".join(shipped_grids())
        raise ConfigError(f"no grid {name}: name a TOML file, or one of {known}")
    grid: Grid = convert(nodes, Grid)
    try:
        _check_grid(grid)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    return grid


def _check_grid(grid: Grid) -> None:
    """Check a grid for errors that would appear only after hours of training, or never."""
    search, growth = grid.search, grid.growth
    if not grid.cells or min(grid.seeds, search.updates, growth.first) < 1:
        raise ConfigError("a grid needs a cell, a seed and an update")
    if not search.learning_rate or not search.warmup:
        raise ConfigError("search needs a learning_rate and a warmup")
    if growth.most < growth.first:
        span = f"{growth.first} updates to {growth.most}"
        raise ConfigError(f"growth must not go from {span}")
    if min(grid.sweeps.train, grid.sweeps.validation, grid.sweeps.test) < 0:
        raise ConfigError("sweeps must be 0 (all) or more")
    convert(make_node(grid.probe, "probe", 0, Path()), ProbeConfig)
    tables = {"supervised": grid.supervised, "self_supervised": grid.self_supervised}
    tables |= {f"options of cell {cell.name!r}": cell.options for cell in grid.cells}
    own = {f"options of cell {cell.name!r}": OWN[:4] for cell in grid.cells if cell.recipe}
    for table, fields in tables.items():
        if taken := [key for key in fields if key in own.get(table, OWN)]:
            raise ConfigError(f"{table}: {name_some(taken)} is set by the grid itself")
    if "data" in grid.probe:
        raise ConfigError("probe: data is set by the grid itself")
    before: dict[str, Candidate] = {}
    untrained: dict[str, Candidate] = {}
    for cell in grid.cells:
        if cell.name in before:
            raise ConfigError(f"two cells are named {cell.name!r}")
        _check_cell(grid, cell, before)
        bare = grid.make_untrained(cell)
        if untrained.setdefault(cell.network, bare) != bare:
            raise ConfigError(
                f"cell {cell.name!r}: its network differs from that of an earlier cell that is "
                f"also called {cell.network!r}: give one a width"
            )
        before[cell.name] = cell
    known = {task.name for task in grid.tasks()}
    for question in grid.questions:
        for one in (name for pair in question.pairs for name in (pair.better, pair.than)):
            if one not in known:
                raise ConfigError(f"{question.text!r} compares {one!r}, but no cell has that name")


def _check_cell(grid: Grid, cell: Candidate, before: dict[str, Candidate]) -> None:
    called = f"cell {cell.name!r}"
    if not 0 < cell.share <= 1:
        raise ConfigError(f"{called}: share must be above 0, at most 1, not {cell.share}")
    if cell.seeds < 0:
        raise ConfigError(
            f"{called}: seeds must be 0 (the grid's number) or more, not {cell.seeds}"
        )
    if cell.begin:
        if cell.begin not in before:
            raise ConfigError(
                f"{called} begins with {cell.begin!r}, but no earlier cell has that name"
            )
        has, wants = (one.seeds or grid.seeds for one in (before[cell.begin], cell))
        if has < wants:
            raise ConfigError(
                f"{called} begins with {cell.begin!r}, which is trained with {has} of {wants} seeds"
            )
    task, search = Task(cell.name, 0, cell), grid.search
    if cell.recipe:
        config, said = grid.config(task, Path(grid.data)), load_recipe(cell.recipe).train
        for name in OF_CELL[2:]:
            if name in said and getattr(config, name) != said[name]:
                raise ConfigError(f"{called}: {name} is {said[name]!r} in recipe {cell.recipe}")
    for rate in search.learning_rate if not cell.recipe else ():
        for warmup in search.warmup:
            config = grid.config(task, Path(grid.data), learning_rate=rate, warmup=warmup)
    if config.encoder != "graph":  # its frame is the array's, which is not read here
        try:
            config.network(2)
        except ConfigError as error:
            raise ConfigError(f"{called}: {error}") from None
