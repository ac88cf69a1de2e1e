"""Recipes from files: a user's own in TOML, those that ship, and those that a set was made by."""

from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec

from tactile_rt.errors import ConfigError
from tactile_rt.sensor_faults import SensorFaults
from tactile_rt.settings import (
    SettingNode,
    convert,
    make_node,
    no_such,
    parse_toml,
    read_toml,
    refusal,
    set_keys,
)
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.datasets.recipes import (
    GENERATED,
    PARAMETERS,
    SHAPES,
    Between,
    Choice,
    Each,
    ObjectChoice,
    SweepChoice,
    SweepRecipe,
)
from tactile_rt.sim_backend.objects.mesh_detail import STANDARD, MeshDetail
from tactile_rt.sim_backend.randomisation import Randomisation
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.sweep import usual_distance
from tactile_rt.sim_backend.transducer import device_spec
from tactile_rt.timing import STEP_MS, Timing

__all__ = [
    "DEFAULT_RECIPE",
    "read_recipe",
    "recipe_from_dict",
    "recipe_of_set",
    "shipped_recipes",
]

DEFAULT_RECIPE = "wide24"

Text = Annotated[str, msgspec.Meta(min_length=1)]


class _Objects(msgspec.Struct):
    source: Text = msgspec.field(name="from", default=SHAPES)
    categories: tuple[str, ...] = ()
    withheld: tuple[str, ...] = ()
    outliers: tuple[str, ...] = ()
    per_category: int | None = None
    validation: float | None = None
    test: float | None = None
    per_withheld: int = 0
    without_source: str = ""
    only_source: str = ""
    surface_error_mm: float = STANDARD.surface_error_mm
    max_pieces: int = STANDARD.max_pieces
    hull: bool = STANDARD.hull
    up: str = STANDARD.up


class _Range(msgspec.Struct):
    between: tuple[float, ...] | None = None
    each: tuple[float, ...] | None = None
    once: bool = False
    plus: tuple[float, ...] = ()
    peak: float = 1.0


class _Sweeps(msgspec.Struct):
    size_mm: float | _Range | None = None
    speed_mm_s: float | _Range | None = None
    yaw_deg: float | _Range | None = None
    height_mm: float | _Range | None = None
    distance_mm: float | _Range | None = None
    gap_mm: float | _Range | None = None
    roll_deg: float | _Range | None = None
    pitch_deg: float | _Range | None = None
    heading_deg: float | _Range | None = None
    climb_deg: float | _Range | None = None
    ramp_ms: float | _Range | None = None
    head_moves: float | _Range | None = None
    surface_friction: float | _Range | None = None
    shake_g: float | _Range | None = None
    shake_hz: float | _Range | None = None
    draws: int = 1
    held_out_draws: int = 0
    least_whiskers: int = 1


class _File(msgspec.Struct):
    name: Text = SweepRecipe.name
    array: Text = SweepRecipe.array
    profile: Text = SweepRecipe.profile
    seed: int = SweepRecipe.seed
    period_ms: float | None = None
    lead_ms: float | None = None
    length_ms: float | None = None
    contacts: bool = False
    every_nth: bool = False
    objects: _Objects = msgspec.field(default_factory=_Objects)
    sweeps: _Sweeps = msgspec.field(default_factory=_Sweeps)
    sensor: SensorModel = msgspec.field(default_factory=SensorModel)
    randomisation: Randomisation = msgspec.field(default_factory=Randomisation)
    faults: SensorFaults = msgspec.field(default_factory=SensorFaults)


def shipped_recipes() -> tuple[str, ...]:
    """Names of the recipes that ship with the package."""
    folder = resources.files(__package__) / "recipes"
    return tuple(sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".toml")))


def read_recipe(name: str, folder: Path | None = None, sets: Sequence[str] = ()) -> SweepRecipe:
    """The recipe of this name that ships with the package, or the one in a TOML file.

    Args:
        name: of the recipe, or its file.
        folder: where folders and files in it are found from; None: the working directory, as they
            are on a command line.
        sets: ``key=value`` each, of which ``objects.test=3`` is one of a table.

    Raises:
        ConfigError: no such recipe, or something in it is wrong.
    """
    if Path(name).suffix == ".toml":
        return _recipe(set_keys(read_toml(Path(name)), sets, _File), folder)
    if name not in shipped_recipes():
        known = no_such("recipe", name, shipped_recipes())
        raise ConfigError(f"{known} (or give a file that ends in .toml)")
    shipped = resources.files(__package__) / "recipes" / f"{name}.toml"
    nodes = parse_toml(shipped.read_text(encoding="utf-8"), name)
    return _recipe(set_keys(nodes, sets, _File))


def recipe_of_set(
    recipe: dict[str, Any], categories: Sequence[str], sets: Sequence[str] = ()
) -> SweepRecipe:
    """The recipe that a set's manifest or a model's card holds.

    One of version 1, which knew fewer settings, comes to the same objects, split and ranges; its
    sweeps were drawn otherwise.

    Args:
        recipe: as stored.
        categories: class names of the set.
        sets: ``key=value`` each, as `read_recipe` takes them.

    Raises:
        ConfigError: it is not one that this release knows.
    """
    if isinstance(recipe.get("objects"), int):
        old = read_recipe("mouse12").to_dict()
        counts: dict[str, Any] = {
            "categories": tuple(categories),
            "per_category": recipe["objects"],
            **{name: recipe[name] for name in ("validation", "test") if name in recipe},
        }
        recipe = {
            **old,
            **{name: recipe[name] for name in ("profile", "seed") if name in recipe},
            "objects": {**old["objects"], **counts},
            "sweeps": {**old["sweeps"], "draws": recipe.get("sweeps", 8)},
        }
    return _recipe(set_keys(make_node(recipe, "the set's recipe", 0, Path()), sets, _File))


def recipe_from_dict(raw: dict[str, Any], where: str = "recipe") -> SweepRecipe:
    """Read what a recipe file holds.

    Args:
        raw: the file's tables.
        where: the file, for complaints.

    Raises:
        ConfigError: a key is unknown or of the wrong kind, or a value out of range: one line
            that says which, where.
    """
    return _recipe(make_node(raw, where, 0, Path()))


def _recipe(nodes: SettingNode, folder: Path | None = None) -> SweepRecipe:
    file: _File = convert(nodes, _File)
    objects, array = file.objects, file.array
    for key in ("categories", "withheld", "outliers"):
        names = getattr(objects, key)
        if len(set(names)) < len(names):
            twice = next(n for i, n in enumerate(names) if n in names[:i])
            raise refusal(nodes, ["objects", key], f"{twice!r} is there twice; remove one")
    array = _absolute(array, folder) if Path(array).suffix else array
    usual = {name: getattr(SweepChoice, name) for name in PARAMETERS}
    period_ms = SweepRecipe.period_ms
    with suppress(ConfigError):  # of an array that is not there: told when it is needed
        animals = load_animals(array)
        period_ms = max(period_ms, 1e3 / device_spec(animals).rate_hz)
        if file.sweeps.distance_mm is None:
            usual["distance_mm"] = usual_distance(animals)
    period_ms = period_ms if file.period_ms is None else file.period_ms
    lead_ms, length_ms = _usual_lengths(period_ms)
    # a folder's own counts; the published split is 8 : 1 : 1
    all_of_it = objects.source not in GENERATED

    slip = get_close_matches(objects.source, GENERATED, 1, 0.8)
    if all_of_it and slip and not Path(_absolute(objects.source, folder)).exists():
        why = f"no such folder {objects.source!r}; did you mean {slip[0]}?"
        raise refusal(nodes, ["objects", "from"], why)

    def counted(given: float | None, of_a_folder: float, of_shapes: float) -> float:
        return (of_a_folder if all_of_it else of_shapes) if given is None else given

    drawn = {name: _choice(nodes, name, file.sweeps, usual[name]) for name in PARAMETERS}
    try:
        return SweepRecipe(
            name=file.name,
            array=array,
            profile=file.profile,
            seed=file.seed,
            period_ms=period_ms,
            lead_ms=lead_ms if file.lead_ms is None else file.lead_ms,
            length_ms=length_ms if file.length_ms is None else file.length_ms,
            contacts=file.contacts,
            every_nth=file.every_nth,
            objects=ObjectChoice(
                source=_absolute(objects.source, folder) if all_of_it else objects.source,
                categories=objects.categories,
                withheld=objects.withheld,
                outliers=objects.outliers,
                per_category=int(counted(objects.per_category, 0, 60)),
                validation=counted(objects.validation, 0.1, 4),
                test=counted(objects.test, 0.1, 12),
                per_withheld=objects.per_withheld,
                without_source=objects.without_source,
                only_source=objects.only_source,
                mesh=MeshDetail(
                    surface_error_mm=objects.surface_error_mm,
                    max_pieces=objects.max_pieces,
                    hull=objects.hull,
                    up=objects.up,
                ),
            ),
            sweeps=SweepChoice(
                **drawn,
                draws=file.sweeps.draws,
                held_out_draws=file.sweeps.held_out_draws,
                least_whiskers=file.sweeps.least_whiskers,
            ),
            sensor=file.sensor,
            randomisation=file.randomisation,
            faults=file.faults,
        )
    except ConfigError as error:  # how its parts fit together
        raise ConfigError(f"{nodes.where}: {error}") from None


def _usual_lengths(period_ms: float) -> tuple[float, float]:
    """Lead and length of a sweep whose samples are so far apart, ms, enough for tare and window."""
    # A tare takes so many samples, however long they last; a window so many steps, and some spare.
    lead_ms = max(SweepRecipe.lead_ms, SweepRecipe.lead_ms / SweepRecipe.period_ms * period_ms)
    after_ms = SweepRecipe.length_ms - SweepRecipe.lead_ms
    step_ms = Timing.of(round(period_ms * 1e6)).substeps * period_ms
    return lead_ms, lead_ms + after_ms * max(1.0, step_ms / STEP_MS)


def _absolute(path: str, folder: Path | None) -> str:
    """Whoever makes a part of the set may do so from another folder."""
    try:
        return str(((folder or Path()) / Path(path).expanduser()).absolute())
    except RuntimeError:  # no such user, or one without a home
        raise ConfigError(f"{path} is no path of a user here") from None


def _choice(nodes: SettingNode, name: str, sweeps: _Sweeps, usual: Choice) -> Choice:
    written: float | _Range | None = getattr(sweeps, name)
    if not isinstance(written, _Range):
        return usual if written is None else written
    if len(written.between or ()) == 2 and written.each is None:
        assert written.between is not None
        low, high = written.between
        return Between(low, high, written.once, written.plus, written.peak)
    alone = written.between is None and not (written.once or written.plus) and written.peak == 1
    if written.each and alone:
        return Each(written.each)
    found = nodes.at(["sweeps", name]).plain()
    wanted = (
        "a number, { between = [low, high] } (with once = true or plus = [a number, ...]) "
        "or { each = [a number, ...] }"
    )
    raise refusal(nodes, ["sweeps", name], f"expected {wanted}, got {found!r:.60}")
