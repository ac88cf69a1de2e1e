"""What a sweep set is: its objects and their split, and how each is swept past the array.

`recipe_files` reads them, by name or from TOML:

    name = "mine"
    array = "mouse"
    profile = "realtime"
    seed = 0
    period_ms = 9             # of the stored samples; 1 keeps the simulator's own 1 kHz
    contacts = true           # keep where each whisker touches, too; left out, it is not kept
    [objects]
    from = "shapes"           # the parametric ones, or a folder of meshes
    per_category = 60
    [sweeps]
    draws = 12                # for every combination of the `each` values
    height_mm = { each = [-5, 0] }
    distance_mm = 6.5         # left out, in proportion to how far the array's whiskers reach
    speed_mm_s = { between = [28, 40] }
    size_mm = 40

Every sweep is drawn from (seed, object, sweep index) alone, so that any one of them can be made
again by itself, and a set at another profile holds the very same sweeps (but for the few that
one of the profiles cannot simulate, which are drawn again).
"""

import zlib
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from tactile_rt.settings import no_such
from tactile_rt.sim_backend.datasets.recipe_choices import (
    PARAMETERS,
    SHAPES,
    Between,
    Choice,
    Each,
    ObjectChoice,
    SweepChoice,
)
from tactile_rt.sim_backend.randomisation import Randomisation
from tactile_rt.sim_backend.sensor import SensorModel
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS
from tactile_rt.stream import ConfigError

__all__ = [
    "PARAMETERS",
    "SHAPES",
    "Between",
    "Choice",
    "Each",
    "ObjectChoice",
    "SweepChoice",
    "SweepRecipe",
]

OBJECTS, SWEEPS = ObjectChoice(), SweepChoice()
PERFECT, UNVARIED = SensorModel(), Randomisation()
LONGEST_MS = 600_000.0


@dataclass(frozen=True)
class SweepRecipe:
    """How a sweep set is made.

    Attributes:
        name: what the set is called.
        array: which whiskers, see `whisker_array.load_animals`.
        profile: simulation profile, see `array.PROFILES`.
        seed: of the drawn parameters.
        period_ms: of the stored samples, ms.
        lead_ms: at rest, before the simulation starts, ms: enough for a tare.
        length_ms: of one sweep, the lead included, ms.
        contacts: store where along each whisker it touches, beside the loads.
        objects: what is swept.
        sweeps: how it is swept.
        sensor: what the sensors make of the loads; perfect ones unless it says otherwise.
        randomisation: how the array of each sweep differs from its description; not at all unless
            it says so.

    Raises:
        ConfigError: values that cannot be, or contradict each other.
    """

    name: str = "unnamed"
    array: str = "mouse"
    profile: str = "realtime"
    seed: int = 0
    period_ms: float = 9.0  # five of them make one network step (Chung et al. 2025)
    lead_ms: float = 216.0
    length_ms: float = 1476.0  # 22 network steps from onset and to spare
    contacts: bool = False
    objects: ObjectChoice = OBJECTS
    sweeps: SweepChoice = SWEEPS
    sensor: SensorModel = PERFECT
    randomisation: Randomisation = UNVARIED

    def __post_init__(self) -> None:
        _check_recipe(self)

    @property
    def period_ns(self) -> int:
        """Period of the stored samples, ns."""
        return round(self.period_ms * 1e6)

    @property
    def lead(self) -> int:
        """Stored samples before the object can touch."""
        return round(self.lead_ms / self.period_ms)

    @property
    def samples(self) -> int:
        """Stored samples of one sweep."""
        return round(self.length_ms / self.period_ms)

    def rng(self, name: str, index: int, stream: int = 0) -> np.random.Generator:
        """The random numbers of sweep `index` of an object, see `key`."""
        return np.random.default_rng(self.key(name, index, stream))

    def key(self, name: str, index: int, stream: int = 0) -> list[int]:
        """What the random numbers of a sweep are seeded with.

        Args:
            name: the object.
            index: the sweep.
            stream: 0 for the sweep's parameters; others are for what may be added to them, so
                that a sensor model changes no sweep.
        """
        # crc32 because hash() of a string differs from one process to the next
        return [self.seed, zlib.crc32(name.encode()), index, *([stream] if stream else [])]

    def to_dict(self) -> dict[str, Any]:
        """As a recipe file has it; `recipe_files.recipe_from_dict` takes it back."""
        objects = {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self.objects).items()
        }
        sweeps = {name: _written(getattr(self.sweeps, name)) for name in PARAMETERS}
        top = {f.name: getattr(self, f.name) for f in fields(self)}
        if not self.contacts:  # unsaid, as in sets of releases that knew of none
            del top["contacts"]
        return {
            **top,
            "objects": {"from": objects.pop("source"), **objects},
            "sweeps": {
                "draws": self.sweeps.draws,
                "held_out_draws": self.sweeps.held_out_draws,
                **sweeps,
            },
            "sensor": _differing_from_default(self.sensor),
            "randomisation": _differing_from_default(self.randomisation),
        }


def _differing_from_default(settings: SensorModel | Randomisation) -> dict[str, float]:
    default = type(settings)()
    return {k: v for k, v in asdict(settings).items() if v != getattr(default, k)}


def _written(choice: Choice) -> Any:
    if isinstance(choice, Between):
        return {"between": [choice.low, choice.high]}
    return {"each": list(choice.values)} if isinstance(choice, Each) else choice


def _check_recipe(recipe: SweepRecipe) -> None:
    if recipe.profile not in PROFILES:
        raise ConfigError(no_such("profile", recipe.profile, tuple(PROFILES)))
    if recipe.seed < 0:
        raise ConfigError(f"seed must be 0 or more, not {recipe.seed}")
    if recipe.period_ms < SAMPLE_MS:
        raise ConfigError(
            f"period_ms must be {SAMPLE_MS:g} or more, the simulator's own, not {recipe.period_ms}"
        )
    if not recipe.length_ms <= LONGEST_MS:
        raise ConfigError(f"length_ms must be at most {LONGEST_MS:g}, not {recipe.length_ms:g}")
    if not 0 <= recipe.lead < recipe.samples:
        raise ConfigError(
            f"length_ms ({recipe.length_ms:g}) must exceed lead_ms ({recipe.lead_ms:g}), which "
            "must be 0 or more"
        )
    recipe.objects.check()
    recipe.sweeps.check()
