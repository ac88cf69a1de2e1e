"""Read a plan, and refuse what could else be told only after hours of training, or never."""

from importlib import resources
from pathlib import Path

from tactile_rt.errors import ConfigError, name_some
from tactile_rt.models.grid.plan import Candidate, Grid, Task
from tactile_rt.models.training.config import ProbeConfig
from tactile_rt.settings import convert, make_node, parse_toml, read_toml

__all__ = ["read_grid", "shipped_grids"]

SHIPPED = resources.files("tactile_rt.models.grid")
# of a training's configuration, what a grid sets task by task
OWN = ("data", "also", "begin", "seed", "learning_rate", "warmup", "epochs", "updates")


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
    try:
        _check(grid)
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None
    return grid


def _check(grid: Grid) -> None:
    """Refuse what could only be told after hours of training, or never."""
    search, growth = grid.search, grid.growth
    if not grid.cells or min(grid.seeds, search.updates, growth.first) < 1:
        raise ConfigError("a grid needs a cell, a seed and an update")
    if not search.learning_rate or not search.warmup:
        raise ConfigError("search needs a learning_rate and a warmup")
    if growth.most < growth.first:
        raise ConfigError(
            f"growth goes from {growth.first} updates to {growth.most}, which is less"
        )
    if min(grid.sweeps.train, grid.sweeps.validation, grid.sweeps.test) < 0:
        raise ConfigError("sweeps are counted from 0, which takes all")
    convert(make_node(grid.probe, "probe", 0, Path()), ProbeConfig)
    tables = {"supervised": grid.supervised, "self_supervised": grid.self_supervised}
    tables |= {f"options of cell {cell.name!r}": cell.options for cell in grid.cells}
    for table, fields in tables.items():
        if taken := [key for key in fields if key in OWN]:
            raise ConfigError(f"{table}: {name_some(taken)} is what the grid itself decides")
    if "data" in grid.probe:
        raise ConfigError("probe: data is what the grid itself decides")
    before: dict[str, Candidate] = {}
    untrained: dict[str, Candidate] = {}
    for cell in grid.cells:
        if cell.name in before:
            raise ConfigError(f"two cells are {cell.name!r}")
        _check_cell(grid, cell, before)
        bare = grid.untrained(cell)
        if untrained.setdefault(cell.network, bare) != bare:
            raise ConfigError(
                f"cell {cell.name!r}: the network is another than that of a cell before it that "
                f"is called {cell.network!r} too: give one a width"
            )
        before[cell.name] = cell
    known = {task.name for task in grid.tasks()}
    for question in grid.questions:
        for one in (name for pair in question.pairs for name in (pair.better, pair.than)):
            if one not in known:
                raise ConfigError(f"{question.text!r} compares {one!r}, which no cell is")


def _check_cell(grid: Grid, cell: Candidate, before: dict[str, Candidate]) -> None:
    called = f"cell {cell.name!r}"
    if not 0 < cell.share <= 1:
        raise ConfigError(f"{called}: share must be above 0, at most 1, not {cell.share}")
    if cell.seeds < 0:
        raise ConfigError(f"{called}: seeds must be 0 (the grid's) or more, not {cell.seeds}")
    if cell.begin:
        if cell.begin not in before:
            raise ConfigError(f"{called} begins with {cell.begin!r}, which no cell before it is")
        has, wants = (one.seeds or grid.seeds for one in (before[cell.begin], cell))
        if has < wants:
            raise ConfigError(
                f"{called} begins with {cell.begin!r}, which is trained with {has} of {wants} seeds"
            )
    task, search = Task(cell.name, 0, cell), grid.search
    for rate in search.learning_rate:
        for warmup in search.warmup:
            config = grid.config(task, Path(grid.data), learning_rate=rate, warmup=warmup)
    if config.encoder != "graph":  # whose frame is that of an array, which is not read here
        try:
            config.network(2)
        except ConfigError as error:
            raise ConfigError(f"{called}: {error}") from None
