"""Make the benchmarks' data anew: real objects, their sweeps, and the files of `data`.

python -m bench.perception.make FOLDER [--only realtouch-2] [--from CLONES] [--processes N]

It goes on with what is missing of FOLDER. The objects come from GitHub or from clones, every file
checked by its hash; the sweeps are those of `recipes/`. For the wide world of realtouch 1 the
objects that are tested on are swept once more as the recipe `wide24` sweeps its own.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from msgspec.structs import replace as change

from bench.perception.data import FILE, SHAPES_FILE, SOURCE, Portion, pack
from bench.perception.folds import EVERYONE, KINDS, read_origins, write_views
from tactile_rt.sets.manifest import OUTLIERS, WITHHELD
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import DEFAULT_RECIPE, read_recipe
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list
from tactile_rt.sim_backend.objects.object_sets import Origin

RECIPES = Path(__file__).parent / "recipes"
INSTANCES, ANOTHER, WIDE = "real27", "real27-source", "-wide"
SHAPES, LEANING = "real2", "-leaning"


def main() -> int:
    """Make what is missing, then the files."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", choices=[file.stem for file in FILES])
    parser.add_argument("--from", dest="clones", type=Path)
    parser.add_argument("--processes", type=int)
    given = parser.parse_args()
    for file, (name, recipes, parts) in FILES.items():
        if given.only not in (None, file.stem):
            continue
        objects = given.folder / "objects" / name
        if missing := get_objects(read_list(name), objects, given.clones):
            first, why = next(iter(missing.items()))
            print(f"{len(missing)} objects are missing, {first} because: {why}")  # noqa: T201
            return 1
        for recipe, splits in recipes(objects):
            for swept in make_sweeps(recipe, given.folder / recipe.name, given.processes, splits):
                print(recipe.name, swept, flush=True)  # noqa: T201
        origins = read_origins(objects)
        content = pack(parts(given.folder, origins), origins)
        file.parent.mkdir(exist_ok=True)
        file.write_bytes(content)
        print(f"{file}: {len(content) / 1e6:.2f} MB")  # noqa: T201
    return 0


def _recipes(objects: Path) -> Iterator[tuple[SweepRecipe, tuple[str, ...]]]:
    """Each recipe for these objects, and which of its splits are wanted: none for all."""
    wide = read_recipe(DEFAULT_RECIPE).sweeps
    for name in (INSTANCES, ANOTHER):
        recipe = read_for(objects, name)
        yield recipe, ()
        sweeps = replace(wide, draws=recipe.sweeps.draws)
        yield replace(recipe, name=name + WIDE, sweeps=sweeps), ("test",)


def _shape_recipes(objects: Path) -> Iterator[tuple[SweepRecipe, tuple[str, ...]]]:
    yield read_for(objects, SHAPES), ()
    yield read_for(objects, SHAPES + LEANING), ()


def read_for(objects: Path, name: str) -> SweepRecipe:
    """Read one of the benchmarks' recipes, for the objects of a folder."""
    recipe = read_recipe(str(RECIPES / f"{name}.toml"))
    return replace(recipe, objects=change(recipe.objects, source=str(objects)))


def _parts(folder: Path, origins: Mapping[str, Origin]) -> list[Portion]:
    one, other = folder / INSTANCES, folder / ANOTHER
    parts = [Portion(split, one, split) for split in ("train", "validation", "test")]
    parts += [Portion(split, one, split) for split in (OUTLIERS, WITHHELD)]
    parts += [Portion(SOURCE, other, "test"), Portion(WITHHELD, other, WITHHELD)]
    parts.append(Portion("test", folder / (INSTANCES + WIDE), "test", wide=True))
    parts.append(Portion(SOURCE, folder / (ANOTHER + WIDE), "test", wide=True))
    return parts


def _shape_parts(folder: Path, origins: Mapping[str, Origin]) -> list[Portion]:
    """Write every view of the two sets, and take the file's sweeps of that of all makers."""
    for name in (SHAPES, SHAPES + LEANING):
        write_views(folder / name, origins, folder / "views" / name)
    upright, leaning = (folder / "views" / n / EVERYONE for n in (SHAPES, SHAPES + LEANING))
    most = {"train": 3, "validation": 3, "test": 4, KINDS: 4}
    parts = [Portion(split, upright, split, most=n) for split, n in most.items()]
    return [*parts, Portion("test", leaning, "test", wide=True, most=4)]


FILES = {
    FILE: ("real", _recipes, _parts),
    SHAPES_FILE: ("real2", _shape_recipes, _shape_parts),
}

if __name__ == "__main__":
    sys.exit(main())
