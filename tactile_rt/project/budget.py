"""What fits into the time that is given: how many objects and sweeps, how many updates.

Measured on this machine with this array before it is decided, and then kept, so that a project
that is interrupted goes on with the same set and the same training.
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

SWEEPS_SHARE = 0.45  # of the time given; training has as much, and the rest is for the report
PILOTS = 5  # sweeps that are timed
AT_ONCE = 0.85  # what a further core adds
ENOUGH = 60  # objects of a category, before they are swept more often
FEWEST = 5  # objects of a category: three to learn from, one to choose by, one to test on
TEST_OBJECTS = 60  # of all categories, where there is time for them
TEST_SHARE, VALIDATION_SHARE = 0.18, 0.12  # of the objects of a category
MEMORY_SHARE = 0.1  # of the machine's, for the set


class Budget(msgspec.Struct, forbid_unknown_fields=True):
    """What was decided for a project.

    Attributes:
        per_category, validation, test: The numbers of objects of a category, and of those held out.
        updates: The number of updates of the training; 0: not decided yet.
    """

    described: str
    per_category: int
    validation: int
    test: int
    draws: int
    updates: int = 0


def read_budget(project: Project) -> Budget | None:
    """The budget of a project that was begun before; None: it was not."""
    path, anew = project.build / "budget.json", f"remove {project.build} to begin anew"
    if not path.exists():
        return None
    try:
        budget = msgspec.json.decode(path.read_bytes(), type=Budget)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is damaged ({error}): {anew}") from None
    if budget.described != described(project):
        raise ConfigError(
            f"array.toml or sweeps.toml of {project.folder} has been changed since {project.build} "
            f"was begun: {anew}"
        )
    return budget


def write_budget(project: Project, budget: Budget) -> None:
    """Keep a budget."""
    project.build.mkdir(exist_ok=True)
    text = msgspec.json.format(msgspec.json.encode(budget), indent=1)
    write_whole(project.build / "budget.json", lambda file: file.write(text))


def budget_sweeps(project: Project, seconds: float) -> Budget:
    """Time some sweeps, and decide how many fit."""
    recipe = project.recipe()
    each_s = _time_of_a_sweep(recipe)
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
    of_a_kind = max(FEWEST, int(sweeps / kinds / draws))
    if not recipe.objects.generated:  # a folder's own objects: all of them, swept less often
        chosen = recipe.objects
        most = max(1, int(sweeps / max(1, sum(map(len, objects.split.values())))))
        return Budget(described(project), chosen.per_category, 0, 0, min(recipe.sweeps.draws, most))
    per_category = min(of_a_kind, recipe.objects.per_category)
    test = max(round(TEST_SHARE * per_category), math.ceil(TEST_OBJECTS / kinds))
    test = max(1, min(test, per_category // 3))
    validation = max(1, round(VALIDATION_SHARE * per_category))
    return Budget(described(project), per_category, validation, test, draws)


def sized(recipe: SweepRecipe, budget: Budget) -> SweepRecipe:
    """The recipe with the budget's numbers of objects and sweeps."""
    objects = recipe.objects
    if budget.test:
        counts = {k: getattr(budget, k) for k in ("per_category", "validation", "test")}
        objects = msgspec.structs.replace(objects, **counts)
    return replace(recipe, objects=objects, sweeps=replace(recipe.sweeps, draws=budget.draws))


def _time_of_a_sweep(recipe: SweepRecipe) -> float:
    """The time that one takes, s: the mean over some, after a first one for the compiler."""
    objects = choose_objects(recipe.objects)
    names = objects.split["train"][: PILOTS + 1]
    times = []
    for name in names:
        target = objects.load(name)
        began = time.monotonic()
        simulate_sweep(recipe, target, 0)
        times.append(time.monotonic() - began)
    return float(np.mean(times[1:] or times))


def described(project: Project) -> str:
    """The fingerprint of what a project's set is made of."""
    digest = hashlib.sha256()
    for name in ("array.toml", "sweeps.toml"):
        digest.update((project.folder / name).read_bytes())
    return digest.hexdigest()[:16]
