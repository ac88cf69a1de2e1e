"""Recipes of sweep sets: the objects, their split, and how each is swept past the array.

`recipe_files` reads recipes, by name or from TOML:

    name = "mine"
    array = "mouse"
    profile = "realtime"
    seed = 0
    period_ms = 9             # of the stored samples; 1 keeps the simulator's own 1 kHz
    contacts = true           # also store where each whisker touches; left out: false
    every_nth = true          # store one sample of each period, not resampled (the paper)
    [objects]
    from = "shapes"           # the parametric ones, "varied-shapes", or a folder of meshes
    per_category = 60
    [sweeps]
    draws = 12                # for every combination of the `each` values
    height_mm = { each = [-5, 0] }
    distance_mm = 6.5         # left out: in proportion to the reach of the array's whiskers
    speed_mm_s = { between = [28, 40] }
    yaw_deg = { between = [0, 89], plus = [0, 90] }    # two sweeps, a quarter turn apart
    size_mm = { between = [20, 60], once = true }      # the same for all combinations of a draw
    roll_deg = { between = [-180, 180], peak = 3 }     # mostly near the middle

Every sweep is drawn from (seed, object, sweep index) alone, so that any sweep can be made again
by itself, and a set at another profile holds the same sweeps (except for the few that one of the
profiles cannot simulate, which are drawn again).
"""

import zlib
from dataclasses import asdict, dataclass, field, fields
from itertools import product
from typing import Annotated, Any

import msgspec
import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import no_such
from tactile_rt.sets.sensor_faults import SensorFaults
from tactile_rt.sim_backend.objects.mesh_detail import STANDARD, MeshDetail
from tactile_rt.sim_backend.randomisation import Randomisation
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS

SHAPES, VARIED_SHAPES = "shapes", "varied-shapes"
GENERATED = (SHAPES, VARIED_SHAPES)  # sources of objects; any other is a folder
MOST_OBJECTS = 100_000
LONGEST_MS = 600_000.0
STEEPEST = 10.0  # largest `Range.peak`: beyond it nearly all draws are in the middle
OF_SHAPES = {"per_category": 60, "validation": 4, "test": 12}
OF_A_FOLDER = {"per_category": 0, "validation": 0.1, "test": 0.1}  # all; the published 8 : 1 : 1

Text = Annotated[str, msgspec.Meta(min_length=1)]


class Range(msgspec.Struct, frozen=True, omit_defaults=True):
    """The values of a sweep parameter: an interval to draw from, or a list.

    Attributes:
        between: The ends of the interval, the lower first.
        each: The list of values, each combined with every value of the other parameters.
        once: Whether all combinations of a draw share one value; else every sweep has its own.
        plus: The offsets to add to a draw, each combined with every value of the other parameters.
        peak: The exponent of the drawn distance from the middle (in half intervals): 1 draws
            uniformly; at 3, half of the draws are in the middle eighth of the interval.

    Raises:
        ConfigError: neither an interval nor values, ends in the wrong order, or a peak out of
            range.
    """

    between: tuple[float, ...] = ()
    each: tuple[float, ...] = ()
    once: bool = False
    plus: tuple[float, ...] = ()
    peak: float = 1.0

    def __post_init__(self) -> None:
        alone = not (self.once or self.plus or self.between) and self.peak == 1
        if not (alone if self.each else len(self.between) == 2):
            raise ConfigError(
                "expected a number, { between = [low, high] } (with once = true or plus = "
                "[a number, ...]) or { each = [a number, ...] }"
            )
        if self.between and not self.between[0] <= self.between[1]:
            low, high = self.between
            raise ConfigError(f"between must begin with its lower end, not {low:g}, {high:g}")
        if not 1 <= self.peak <= STEEPEST:
            raise ConfigError(f"peak must be from 1 to {STEEPEST:g}, not {self.peak:g}")

    @property
    def combined(self) -> tuple[float, ...]:
        """Values (`each`) or offsets (`plus`) to combine with those of other parameters."""
        return self.each or self.plus

    @property
    def ends(self) -> tuple[float, ...]:
        """All listed values, or the least and the greatest possible draw."""
        if self.each:
            return self.each
        more = self.plus or (0.0,)
        return self.between[0] + min(more), self.between[1] + max(more)

    def draw(self, rng: np.random.Generator) -> float:
        """Draw a random value from the interval."""
        low, high = self.between
        if self.peak == 1:
            return float(rng.uniform(low, high))
        away = float(rng.uniform(-1, 1))
        half = (high - low) / 2
        return low + half + half * float(np.copysign(abs(away) ** self.peak, away))


Choice = float | Range


class ObjectChoice(msgspec.Struct, frozen=True):
    """The choice of a set's objects, their split, and how meshes are cut.

    Attributes:
        source: The origin of the objects: "shapes" (parametric, one plan for each kind),
            "varied-shapes" (parametric, of any plan) or a folder of meshes.
        categories: The names of the classes; if empty, all that exist.
        classes: The categories that are merged into a class, by the class's name; an object's own
            category is then its kind. Any other category is a class by itself.
        withheld: The categories of the extra split "withheld", which is for open-set tests: their
            objects are in no other split. If empty, `catalogue.WITHHELD` if `per_withheld` is above
            0, else none.
        outliers: The categories of the extra split "outliers": unknown objects, too, but for
            training a model to refuse; those of `withheld` test whether it does.
        per_category: The number of objects in each category; 0 for all that the folder has.
        validation, test: The number of held-out objects of every category; if below 1, the
            fraction.
        per_withheld: The number of objects in each category of `withheld` and `outliers`; 0 for 12,
            or for all that the folder has.
        labels: The JSON file with the labels of ShapeNet objects, ``{"02958343/1a0b": 17}``, that
            replace their synsets, if any. Objects without a label are left out.
        without_source: The source, in a folder's `objects.csv`, whose objects are left out, if any.
        only_source: The only source to use objects of, if any. All are for the test split, without
            those of the same shape as an object from another source.
        surface_error_mm, max_pieces, hull, up: The settings of `MeshDetail`, for a folder.
    """

    source: Text = msgspec.field(name="from", default=SHAPES)
    categories: tuple[str, ...] = ()
    classes: dict[str, tuple[str, ...]] = {}
    withheld: tuple[str, ...] = ()
    outliers: tuple[str, ...] = ()
    # None if left out: then the value of `OF_SHAPES` or `OF_A_FOLDER`.
    per_category: int = None  # type: ignore[assignment]
    validation: float = None  # type: ignore[assignment]
    test: float = None  # type: ignore[assignment]
    per_withheld: int = 0
    labels: str = ""
    without_source: str = ""
    only_source: str = ""
    surface_error_mm: float = STANDARD.surface_error_mm
    max_pieces: int = STANDARD.max_pieces
    hull: bool = STANDARD.hull
    up: str = STANDARD.up

    @property
    def generated(self) -> bool:
        """True if the objects are parametric, False if they are from a folder."""
        return self.source in GENERATED

    @property
    def class_of(self) -> dict[str, str]:
        """Class by category, for categories that `classes` merges."""
        return {own: name for name, categories in self.classes.items() for own in categories}

    @property
    def mesh(self) -> MeshDetail:
        """Settings for cutting meshes into pieces."""
        return MeshDetail(**{f.name: getattr(self, f.name) for f in fields(MeshDetail)})

    def __post_init__(self) -> None:
        for name, usual in (OF_SHAPES if self.generated else OF_A_FOLDER).items():
            if getattr(self, name) is None:
                msgspec.structs.force_setattr(self, name, usual)
        _ = self.mesh  # checks the settings
        for key in ("categories", "withheld", "outliers"):
            names = getattr(self, key)
            if twice := [n for i, n in enumerate(names) if n in names[:i]]:
                raise ConfigError(f"{key}: {twice[0]!r} appears twice; remove one")
        for key, others in (("withheld", "categories"), ("outliers", "categories withheld")):
            for other in others.split():
                if both := sorted(set(getattr(self, key)) & set(getattr(self, other))):
                    raise ConfigError(f"{key}: {both[0]!r} is also one of the {other}")
        whole = self.generated
        if whole and self.labels:
            raise ConfigError(f"labels are for a folder of ShapeNet objects, not {self.source}")
        if self.per_withheld < 0:
            raise ConfigError(f"per_withheld must be 0 or more, not {self.per_withheld}")
        for name in ("per_category", "validation", "test"):
            value = getattr(self, name)
            if not value <= MOST_OBJECTS:
                raise ConfigError(f"{name} must be at most {MOST_OBJECTS}, not {value:g}")
            if value < 0 or (whole and value < 1) or (value >= 1 and value != int(value)):
                kinds = "a whole number" if whole else "a whole number, or a fraction below 1"
                raise ConfigError(f"{name} must be {kinds}, at least 1, not {value:g}")


@dataclass(frozen=True)
class SweepChoice:
    """The sweeps to make of every object; see `sweep.Sweep` for the parameters.

    Attributes:
        draws: The number of sweeps of every combination of the `each` values.
        held_out_draws: The number of further sweeps of each combination, marked by a `draw` of
            `draws` and above.
        held_out: The number of sweeps of every training object, drawn at random, that form the
            split ``new-sweeps`` instead of training.
        least_whiskers: The least number of whiskers that can reach the object as it passes; sweeps
            that fewer reach are drawn again.
    """

    size_mm: Choice = 40.0
    speed_mm_s: Choice = 34.0
    yaw_deg: Choice = 0.0
    height_mm: Choice = -2.0
    distance_mm: Choice = 6.5
    gap_mm: Choice = 2.0
    roll_deg: Choice = 0.0
    pitch_deg: Choice = 0.0
    heading_deg: Choice = 0.0
    climb_deg: Choice = 0.0
    ramp_ms: Choice = 0.0
    head_moves: Choice = 0.0
    surface_friction: Choice = 1.0
    shake_g: Choice = 0.0
    shake_hz: Choice = 30.0
    gravity_x_g: Choice = 0.0
    gravity_y_g: Choice = 0.0
    gravity_z_g: Choice = 0.0
    tilt_deg: Choice = 0.0
    tilt_axis_deg: Choice = 0.0
    tilt_ms: Choice = 0.0
    draws: int = 1
    held_out_draws: int = 0
    held_out: int = 0
    least_whiskers: int = 1

    def __post_init__(self) -> None:
        for name, fewest in (
            ("draws", 1),
            ("held_out_draws", 0),
            ("held_out", 0),
            ("least_whiskers", 1),
        ):
            if getattr(self, name) < fewest:
                bound = f"at least {fewest}" if fewest else "0 or more"
                raise ConfigError(f"{name} must be {bound}, not {getattr(self, name)}")
        if self.held_out >= len(self):
            raise ConfigError(f"held_out is {self.held_out} of {len(self)} sweeps: none is left")
        for name in PARAMETERS:
            choice = getattr(self, name)
            for value in choice.ends if isinstance(choice, Range) else (choice,):
                Sweep(**{name: value})  # checks the value

    def combinations(self) -> list[dict[str, float]]:
        """Return all combinations of listed values, by parameter; the last varies fastest."""
        ranges = {n: c for n in PARAMETERS if isinstance(c := getattr(self, n), Range)}
        each = {name: chosen.combined for name, chosen in ranges.items() if chosen.combined}
        return [dict(zip(each, values, strict=True)) for values in product(*each.values())]

    def __len__(self) -> int:
        return len(self.combinations()) * (self.draws + self.held_out_draws)

    def draw_index(self, index: int) -> int:
        """Return which draw, from 0, sweep `index` is of its combination of listed values."""
        return index % (self.draws + self.held_out_draws)

    def draw(self, rng: np.random.Generator, index: int, shared: np.random.Generator) -> Sweep:
        """Draw the parameters of sweep `index` of an object.

        Args:
            shared: a generator in the same state for all sweeps of a draw, see `Range.once`.
        """
        values = self.combinations()[index // (self.draws + self.held_out_draws)]
        for name in PARAMETERS:
            choice = getattr(self, name)
            if not isinstance(choice, Range):
                values[name] = float(choice)
            elif choice.between:
                drawn = choice.draw(shared if choice.once else rng)
                values[name] = drawn + (values[name] if choice.plus else 0.0)
        return Sweep(**values)


COUNTS = ("draws", "held_out_draws", "held_out", "least_whiskers")
PARAMETERS = tuple(f.name for f in fields(SweepChoice) if f.name not in COUNTS)


@dataclass(frozen=True)
class SweepRecipe:
    """The recipe of a sweep set: array, objects, sweeps, sensors and seed.

    Attributes:
        array: The name or file of the array, see `files.load_animals`.
        profile: The name of the simulation profile, one of `world.PROFILES`.
        seed: The seed of the drawn parameters, 0 or more.
        period_ms: The period of the stored samples, ms.
        lead_ms: The time at rest before the simulation starts, ms: enough for a baseline.
        length_ms: The length of one sweep with its lead, ms.
        contacts: Whether to store, with the loads, where along its length each whisker touches.
        every_nth: Whether to store every n-th of the simulator's samples as it is, with aliasing,
            as the paper does; else they go through the live stream's resampler.
        sensor: The model of the sensors; perfect ones by default.
        randomisation: The deviations of each sweep's array from its description; none by default.
        faults: The sensor faults that training draws each time that it uses a sweep; no file of the
            set contains them.
    """

    name: Text = "unnamed"
    array: Text = "mouse"
    profile: Text = "realtime"
    seed: int = 0
    period_ms: float = 9.0  # five of them make one network step (Chung et al. 2025)
    lead_ms: float = 216.0
    length_ms: float = 1476.0  # 22 network steps from onset and to spare
    contacts: bool = False
    every_nth: bool = False
    objects: ObjectChoice = field(default_factory=ObjectChoice)
    sweeps: SweepChoice = field(default_factory=SweepChoice)
    sensor: SensorModel = field(default_factory=SensorModel)
    randomisation: Randomisation = field(default_factory=Randomisation)
    faults: SensorFaults = field(default_factory=SensorFaults)

    def __post_init__(self) -> None:
        if self.profile not in PROFILES:
            raise ConfigError(no_such("profile", self.profile, tuple(PROFILES)))
        if self.seed < 0:
            raise ConfigError(f"seed must be 0 or more, not {self.seed}")
        if self.period_ms < SAMPLE_MS:
            raise ConfigError(
                f"period_ms must be {SAMPLE_MS:g} or more, the simulator's own, not "
                f"{self.period_ms}"
            )
        if not self.length_ms <= LONGEST_MS:
            raise ConfigError(f"length_ms must be at most {LONGEST_MS:g}, not {self.length_ms:g}")
        if not 0 <= self.lead < self.samples:
            raise ConfigError(
                f"length_ms ({self.length_ms:g}) must exceed lead_ms ({self.lead_ms:g}), which "
                "must be 0 or more"
            )

    @property
    def period_ns(self) -> int:
        """Period of the stored samples, ns."""
        return round(self.period_ms * 1e6)

    @property
    def lead(self) -> int:
        """Number of stored samples before the object can touch."""
        return round(self.lead_ms / self.period_ms)

    @property
    def samples(self) -> int:
        """Number of stored samples of one sweep."""
        return round(self.length_ms / self.period_ms)

    def rng(self, name: str, index: int, stream: int = 0) -> np.random.Generator:
        """Return a random generator for sweep `index` of an object, seeded by `key`."""
        return np.random.default_rng(self.key(name, index, stream))

    def key(self, name: str, index: int, stream: int = 0) -> list[int]:
        """Return the seed of the random numbers for sweep `index` of an object.

        Args:
            stream: 0 for the sweep's parameters; others for optional models, so that a sensor model
                changes no sweep.
        """
        # crc32 because hash() of a string differs from one process to the next
        return [self.seed, zlib.crc32(name.encode()), index, *([stream] if stream else [])]

    def to_dict(self) -> dict[str, Any]:
        """Return the recipe with all values as a dictionary, for `recipe_files.recipe_of_set`."""
        # asdict, as msgspec leaves out fields that it filled with a default
        plain: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(asdict(self)))
        if not self.sweeps.held_out:
            del plain["sweeps"]["held_out"]  # manifests without held-out sweeps stay the same
        return plain
