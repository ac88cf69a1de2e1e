"""The numbers of objects, sweeps and training updates that fit into the given time.

Sweeps and updates are timed on this machine with this array. The numbers are stored, so that an
interrupted project continues with the same set and the same training.
"""

import hashlib
import math
import os
import time
from dataclasses import replace

import msgspec
import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.project.folder import Project
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.datasets.dataset import simulate_sweep
from tactile_rt.sim_backend.datasets.recipe_objects import choose_objects
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.transducer import device_spec

SWEEPS_SHARE = 0.45  # of the given time; training gets about as much, and the report the rest
PILOTS = 5  # sweeps that are timed
AT_ONCE = 0.85  # speed that each further core adds, in parts of the first core's
ENOUGH = 60  # objects of a category above which each object is swept more often
FEWEST = 5  # objects of a category: three for training, one for validation, one for test
TEST_OBJECTS = 60  # of all categories together, if there is time for them
TEST_SHARE, VALIDATION_SHARE = 0.18, 0.12  # of the objects of a category
MEMORY_SHARE = 0.1  # of the machine's memory, for the sweep set


class Budget(msgspec.Struct, forbid_unknown_fields=True):
    """The numbers of objects, sweeps and updates chosen for a project.

    Attributes:
        per_category, validation, test: Objects per category: in all, for validation, for test.
        updates: Number of training updates; 0 until it is chosen.
    """

    described: str  # fingerprint of array.toml and sweeps.toml
    per_category: int
    validation: int
    test: int
    draws: int  # sweeps of every combination of the recipe's `each` values
    updates: int = 0


def read_budget(project: Project) -> Budget | None:
    """Return the stored budget of a project, or None if none is stored yet."""
    path, anew = project.build / "budget.json", f"remove {project.build} to begin anew"
    if not path.exists():
        return None
    try:
        budget = msgspec.json.decode(path.read_bytes(), type=Budget)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged ({error}): {anew}") from None
    if budget.described != fingerprint_set(project):
        raise ConfigError(
            f"array.toml or sweeps.toml of {project.folder} has been changed since {project.build} "
            f"was begun: {anew}"
        )
    return budget


def write_budget(project: Project, budget: Budget) -> None:
    """Write the budget into the project folder."""
    project.build.mkdir(exist_ok=True)
    text = msgspec.json.format(msgspec.json.encode(budget), indent=1)
    write_whole(project.build / "budget.json", lambda file: file.write(text))


def budget_sweeps(project: Project, seconds: float) -> Budget:
    """Time some sweeps; return how many objects and draws fit if all stages share `seconds`."""
    recipe = project.recipe()
    each_s = _time_sweep(recipe)
    cores = 1 + AT_ONCE * ((os.cpu_count() or 1) - 1)
    sweeps = SWEEPS_SHARE * seconds * cores / each_s
    elements, channels = device_spec(load_animals(recipe.array)).shape
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    sweeps = min(sweeps, MEMORY_SHARE * memory / (4 * recipe.samples * elements * channels))
    objects = choose_objects(recipe.objects)
    kinds = len(objects.categories)
    draws = recipe.sweeps.draws
    while draws > 1 and sweeps < kinds * ENOUGH * draws:
        draws -= 1
    affordable = max(FEWEST, int(sweeps / kinds / draws))
    if not recipe.objects.generated:  # objects of a folder are all used, but swept less often
        chosen = recipe.objects
        most = max(1, int(sweeps / max(1, sum(map(len, objects.split.values())))))
        return Budget(
            fingerprint_set(project), chosen.per_category, 0, 0, min(recipe.sweeps.draws, most)
        )
    per_category = min(affordable, recipe.objects.per_category)
    test = max(round(TEST_SHARE * per_category), math.ceil(TEST_OBJECTS / kinds))
    test = max(1, min(test, per_category // 3))
    validation = max(1, round(VALIDATION_SHARE * per_category))
    return Budget(fingerprint_set(project), per_category, validation, test, draws)


def apply_budget(recipe: SweepRecipe, budget: Budget) -> SweepRecipe:
    """Return a copy of the recipe with the budget's numbers of objects and sweeps."""
    objects = recipe.objects
    if budget.test:
        counts = {k: getattr(budget, k) for k in ("per_category", "validation", "test")}
        objects = msgspec.structs.replace(objects, **counts)
    return replace(recipe, objects=objects, sweeps=replace(recipe.sweeps, draws=budget.draws))


def _time_sweep(recipe: SweepRecipe) -> float:
    """Simulate some sweeps; return their mean time, s, without the first, which compiles."""
    objects = choose_objects(recipe.objects)
    names = objects.split["train"][: PILOTS + 1]
    times = []
    for name in names:
        target = objects.load(name)
        began = time.monotonic()
        simulate_sweep(recipe, target, 0)
        times.append(time.monotonic() - began)
    return float(np.mean(times[1:] or times))


def fingerprint_set(project: Project) -> str:
    """Return a fingerprint of the files that define a project's sweep set."""
    digest = hashlib.sha256()
    for name in ("array.toml", "sweeps.toml"):
        digest.update((project.folder / name).read_bytes())
    return digest.hexdigest()[:16]
