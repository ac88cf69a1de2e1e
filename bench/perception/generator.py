"""What a method makes of generated objects when the world or the sensor is not as it was taught.

The objects are the plain shapes, 4 of each of their 24 kinds that no method has seen, 3 sweeps
each, labelled by their shape. Every row changes one thing.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from msgspec.structs import replace as change

from bench.perception.methods import Method, of_kinds
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.models.onsets import find_onsets
from tactile_rt.sets.objects import Sweeps
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.datasets.recipes import Choice, Range

RECIPE = str(Path(__file__).parents[1] / "shipped" / "recipes" / "upright24.toml")
FIRST, OBJECTS, DRAWS = 48, 4, 3
UPRIGHT = "upright, 40 mm large, 28 to 40 mm/s"
SHAKEN = "head shaken with 0.5 g, 10 to 100 Hz"
FAR_MM = 80.0  # where no whisker reaches
LEAN = 14.1  # degrees about either axis: 20 in all
WORLDS: dict[str, dict[str, Choice]] = {
    UPRIGHT: {},
    "leaning by 20 degrees": {"roll_deg": LEAN, "pitch_deg": LEAN},
    "in any orientation": {"roll_deg": Range((-180, 180)), "pitch_deg": Range((-90, 90))},
    "20 mm/s": {"speed_mm_s": 20.0},
    "60 mm/s": {"speed_mm_s": 60.0},
    "30 mm large": {"size_mm": 30.0},
    "55 mm large": {"size_mm": 55.0},
    "4 to 10 mm high": {"height_mm": Range((4, 10))},
    "8 to 10 mm away": {"distance_mm": Range((8, 10))},
    "a tenth of the friction": {"surface_friction": 0.1},
    "2.5 times the friction": {"surface_friction": 2.5},
    SHAKEN: {"shake_g": 0.5, "shake_hz": Range((10, 100))},
}
# on upright sweeps; an amount of 1 is 20 uN and 0.1 uN m, 10 uN being the rated noise
SENSORS = {
    "rated noise": Disturbance(noise=1),
    "twice the rated noise": Disturbance(noise=2),
    "six dead whiskers": Disturbance(dead=6),
    "gain error of 20 %": Disturbance(gain=0.2),
    "offset of 5 uN since the baseline": Disturbance(offset=0.25),
    "the same, and rated noise": Disturbance(offset=0.25, noise=1),
    "offset of 20 uN": Disturbance(offset=1),
    "drift of 10 uN/s": Disturbance(drift=0.5),
    "the same drift, and rated noise": Disturbance(drift=0.5, noise=1),
    "x and y connected the wrong way round": Disturbance(swapped=True),
}
WORST = "a dead row, the worst of them"

Condition = tuple[SweepSet, Disturbance]


def rows(
    folder: Path, progress: Callable[[str], None] = lambda line: None
) -> dict[str, list[Condition]]:
    """The sweeps and disturbances of every row; of several the worst is meant.

    Args:
        folder: where the sweeps are, and are made if they are not.
        progress: told of what is made.
    """
    found = {}
    for name, changed in WORLDS.items():
        recipe = read_recipe(RECIPE)
        objects = change(
            recipe.objects, per_category=FIRST + OBJECTS, test=OBJECTS, withheld=(), per_withheld=0
        )
        sweeps = replace(recipe.sweeps, draws=DRAWS, **changed)
        recipe = replace(recipe, name=f"generator: {name}", objects=objects, sweeps=sweeps)
        there = folder / "generator" / name.replace(" ", "-").replace("/", "-per-").replace(",", "")
        for _ in make_sweeps(recipe, there, splits=("test",)):
            pass
        progress(recipe.name)
        found[name] = [(SweepSet.read(there, "test"), CLEAN)]
    plain = found[UPRIGHT][0][0]
    found |= {name: [(plain, disturbance)] for name, disturbance in SENSORS.items()}
    of_row = np.array(plain.manifest.spec.grid)[:, 0]
    found[WORST] = [(_without(plain, of_row == row), CLEAN) for row in np.unique(of_row)]
    return found


def false_touches(folder: Path, noise: float) -> float:
    """Touches a minute that are found while the head is shaken with 0.5 g and nothing is near.

    Args:
        folder: where the sweeps are, and are made if they are not.
        noise: of the sensor, in units of the rated.
    """
    recipe = read_recipe(RECIPE)
    objects = change(recipe.objects, per_category=3, validation=1, test=1, withheld=(),
                      per_withheld=0)  # fmt: skip
    sweeps = replace(
        recipe.sweeps, draws=DRAWS, distance_mm=Range(each=(FAR_MM,)), **WORLDS[SHAKEN]
    )
    recipe = replace(recipe, name="generator: shaken in the air", objects=objects, sweeps=sweeps)
    there = folder / "generator" / "shaken-in-the-air"
    for _ in make_sweeps(recipe, there, splits=("test",)):
        pass
    data = SweepSet.read(there, "test")
    values = Disturbance(noise=noise).disturb_samples(
        data.sweeps.values, data, np.random.default_rng(0)
    )
    found = find_onsets(values, data.floor).start >= 0
    moving_s = (values.shape[1] - data.manifest.lead) * data.manifest.period_ns / 1e9
    return float(found.sum() / (len(found) * moving_s / 60))


def measured(method: Method, wanted: dict[str, list[Condition]]) -> dict[str, Interval]:
    """A method's top-1 by row; nothing of one that does not know all of the kinds."""
    kinds = next(iter(wanted.values()))[0][0].manifest.categories
    if not set(kinds) <= set(method.kinds):
        return {}

    def right(data: SweepSet, disturbance: Disturbance) -> Interval:
        own = of_kinds(data, method.kinds)
        hits = measures.hits(method.posteriors(own, disturbance), own.sweeps.labels)
        return measures.accuracy(hits, own.sweeps.objects)

    return {
        name: min((right(*one) for one in several), key=lambda found: found.value)
        for name, several in wanted.items()
    }


def _without(data: SweepSet, whiskers: np.ndarray) -> SweepSet:
    """The sweeps of an array whose whiskers (element,) of these are dead."""
    sweeps = data.sweeps
    values = sweeps.values * ~whiskers[:, None]
    return replace(data, sweeps=Sweeps(values, sweeps.labels, sweeps.objects))
