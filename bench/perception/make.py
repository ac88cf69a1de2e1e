"""Make the benchmark's data anew: real objects, their sweeps, and the file of `data`.

python -m bench.perception.make FOLDER [--from CLONES] [--processes N]

It goes on with what is missing of FOLDER. The objects come from GitHub or from clones, every file
checked by its hash; the sweeps are those of `recipes/`, and for the wide world the objects that are
tested on are swept once more as the recipe `wide24` sweeps its own.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as change

from bench.perception.data import FILE, SOURCE, Portion, pack
from tactile_rt.sets.manifest import OUTLIERS, WITHHELD
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import DEFAULT_RECIPE, read_recipe
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list
from tactile_rt.sim_backend.objects.object_sets import open_objects

RECIPES = Path(__file__).parent / "recipes"
INSTANCES, ANOTHER, WIDE = "real27", "real27-source", "-wide"


def main() -> int:
    """Make what is missing, then the file."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--from", dest="clones", type=Path)
    parser.add_argument("--processes", type=int)
    given = parser.parse_args()
    objects = given.folder / "objects"
    if missing := get_objects(read_list("real"), objects, given.clones):
        name, why = next(iter(missing.items()))
        print(f"{len(missing)} objects are missing, {name} because: {why}")  # noqa: T201
        return 1
    for recipe, splits in _recipes(objects):
        for swept in make_sweeps(recipe, given.folder / recipe.name, given.processes, splits):
            print(recipe.name, swept, flush=True)  # noqa: T201
    _write(given.folder, objects)
    return 0


def _recipes(objects: Path) -> Iterator[tuple[SweepRecipe, tuple[str, ...]]]:
    """Each recipe for these objects, and which of its splits are wanted: none for all."""
    wide = read_recipe(DEFAULT_RECIPE).sweeps
    for name in (INSTANCES, ANOTHER):
        recipe = read_recipe(str(RECIPES / f"{name}.toml"))
        recipe = replace(recipe, objects=change(recipe.objects, source=str(objects)))
        yield recipe, ()
        sweeps = replace(wide, draws=recipe.sweeps.draws)
        yield replace(recipe, name=name + WIDE, sweeps=sweeps), ("test",)


def _write(folder: Path, objects: Path) -> None:
    """The file, of the sets in a folder."""
    origins = {
        name.replace("/", "-"): (origin.source, origin.licence)
        for name, origin in open_objects(objects).origins.items()
    }
    one, other = folder / INSTANCES, folder / ANOTHER
    parts = [Portion(split, one, split) for split in ("train", "validation", "test")]
    parts += [Portion(split, one, split) for split in (OUTLIERS, WITHHELD)]
    parts += [Portion(SOURCE, other, "test"), Portion(WITHHELD, other, WITHHELD)]
    parts.append(Portion("test", folder / (INSTANCES + WIDE), "test", wide=True))
    parts.append(Portion(SOURCE, folder / (ANOTHER + WIDE), "test", wide=True))
    content = pack(parts, origins)
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_bytes(content)
    print(f"{FILE}: {len(content) / 1e6:.2f} MB")  # noqa: T201


if __name__ == "__main__":
    sys.exit(main())
