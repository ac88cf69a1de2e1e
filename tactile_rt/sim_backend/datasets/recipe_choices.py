"""A recipe's choices: which objects there are, and how each of them is swept."""

from dataclasses import dataclass, fields
from itertools import product

import numpy as np

from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.stream import ConfigError

__all__ = [
    "PARAMETERS",
    "SHAPES",
    "Between",
    "Choice",
    "Each",
    "ObjectChoice",
    "SweepChoice",
]

SHAPES = "shapes"
MOST_OBJECTS = 100_000
LARGEST = 1e4  # of any of the sweep's parameters: beyond it is a slip of the pen
POSITIVE = ("size_mm", "speed_mm_s")  # of the sweep's parameters; a gap may also be 0


@dataclass(frozen=True)
class Between:
    """Drawn evenly from an interval, afresh for every sweep."""

    low: float
    high: float


@dataclass(frozen=True)
class Each:
    """Every one of these values, with every one of the other parameters'."""

    values: tuple[float, ...]


Choice = float | Between | Each


@dataclass(frozen=True)
class ObjectChoice:
    """Which objects, and who is held out.

    Attributes:
        source: "shapes" (the parametric ones) or a folder of meshes.
        categories: class names; empty: all that there are.
        withheld: categories of the extra split "withheld", which is for open-set tests: their
            objects are in no other split. Empty: none, or `objects.WITHHELD` if `per_withheld`
            asks for some.
        per_category: objects of every category; 0: all that the folder has.
        validation, test: how many of every category are held out; below 1 a fraction.
        per_withheld: objects of every withheld category; 0: 12, or all that the folder has.
    """

    source: str = SHAPES
    categories: tuple[str, ...] = ()
    withheld: tuple[str, ...] = ()
    per_category: int = 60
    validation: float = 4
    test: float = 12
    per_withheld: int = 0

    def check(self) -> None:
        """Raise a ConfigError for values that cannot be."""
        both = sorted(set(self.categories) & set(self.withheld))
        if both:
            raise ConfigError(f"objects.withheld: {both[0]!r} is also one of the categories")
        whole = self.source == SHAPES
        if self.per_withheld < 0:
            raise ConfigError(f"objects.per_withheld must be 0 or more, not {self.per_withheld}")
        for name in ("per_category", "validation", "test"):
            value = getattr(self, name)
            if not value <= MOST_OBJECTS:
                raise ConfigError(f"objects.{name} must be at most {MOST_OBJECTS}, not {value:g}")
            if value < 0 or (whole and value < 1) or (value >= 1 and value != int(value)):
                kinds = "a whole number" if whole else "a whole number, or a fraction below 1"
                raise ConfigError(f"objects.{name} must be {kinds}, at least 1, not {value:g}")


@dataclass(frozen=True)
class SweepChoice:
    """How every object is swept: see `sweep.Sweep` for the parameters.

    Attributes:
        draws: sweeps of every combination of the `Each` values.
        held_out_draws: as many more, marked by a `draw` of `draws` and above.
    """

    size_mm: Choice = 40.0
    speed_mm_s: Choice = 34.0
    yaw_deg: Choice = 0.0
    height_mm: Choice = -2.0
    distance_mm: Choice = 6.5
    gap_mm: Choice = 2.0
    draws: int = 1
    held_out_draws: int = 0

    def check(self) -> None:
        """Raise a ConfigError for values that cannot be."""
        if self.draws < 1:
            raise ConfigError(f"sweeps.draws must be at least 1, not {self.draws}")
        if self.held_out_draws < 0:
            raise ConfigError(f"sweeps.held_out_draws must be 0 or more, not {self.held_out_draws}")
        for name in PARAMETERS:
            choice = getattr(self, name)
            if isinstance(choice, Between) and choice.low > choice.high:
                raise ConfigError(
                    f"sweeps.{name}: between has its lower end first, not {choice.low:g}, "
                    f"{choice.high:g}"
                )
            ends = _ends(choice)
            least = min(ends)
            if (name in POSITIVE and least <= 0) or (name == "gap_mm" and least < 0):
                bound = "0 or more" if name == "gap_mm" else "positive"
                raise ConfigError(f"sweeps.{name} must be {bound}, not {least:g}")
            for value in ends:
                if not abs(value) <= LARGEST:
                    raise ConfigError(f"sweeps.{name} must be within +-{LARGEST:g}, not {value:g}")

    def combinations(self) -> list[dict[str, float]]:
        """The `Each` values, in every combination; the last parameter varies fastest."""
        each = {n: c.values for n in PARAMETERS if isinstance(c := getattr(self, n), Each)}
        return [dict(zip(each, values, strict=True)) for values in product(*each.values())]

    def __len__(self) -> int:
        return len(self.combinations()) * (self.draws + self.held_out_draws)

    @property
    def is_grid(self) -> bool:
        """Whether a sweep that misses the array stays: a grid is to have all its points."""
        return any(isinstance(getattr(self, n), Each) for n in PARAMETERS)

    def draw_index(self, index: int) -> int:
        """Which draw of its combination sweep `index` of an object is, from 0."""
        return index % (self.draws + self.held_out_draws)

    def draw(self, rng: np.random.Generator, index: int) -> Sweep:
        """Draw the parameters of sweep `index`."""
        values = self.combinations()[index // (self.draws + self.held_out_draws)]
        for name in PARAMETERS:
            choice = getattr(self, name)
            if isinstance(choice, Between):
                values[name] = float(rng.uniform(choice.low, choice.high))
            elif not isinstance(choice, Each):
                values[name] = float(choice)
        return Sweep(**values)


PARAMETERS = tuple(f.name for f in fields(SweepChoice) if not f.name.endswith("draws"))


def _ends(choice: Choice) -> tuple[float, ...]:
    """What may be drawn, or the ends of it."""
    if isinstance(choice, Between):
        return choice.low, choice.high
    return choice.values if isinstance(choice, Each) else (choice,)
