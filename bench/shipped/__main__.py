"""Remake the model that ships: objects, sweep sets, three networks, the best of them exported.

python -m bench.shipped FOLDER [--from CLONES] [--name NAME] [--seeds 0 1 2]

It goes on with what is missing of FOLDER. The objects come from GitHub or from clones, every file
checked by its hash. Of the networks the one that is best on validation sweeps goes to
FOLDER/NAME.pt, in half precision, and from there to FOLDER/NAME.onnx.
"""

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import torch

from bench.perception.make import RECIPES as OF_THE_BENCHMARK
from tactile_rt.export.release import release
from tactile_rt.models.checkpoints import save_whole
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list
from tactile_rt.sweep_set import OUTLIERS

RECIPES = Path(__file__).parent / "recipes"
LISTS = ("real", "everyday")
SPLITS = ("train", "validation", OUTLIERS)
STANDING = 12  # further sweeps of every real object that stands


def main() -> int:
    """Make what is missing, then choose and export."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--from", dest="clones", type=Path)
    parser.add_argument("--name", default="mouse44")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    given = parser.parse_args()
    objects = given.folder / "objects"
    for name in LISTS:
        if missing := get_objects(read_list(name), objects / name, given.clones):
            first, why = next(iter(missing.items()))
            print(f"{len(missing)} objects are missing, {first} because: {why}")  # noqa: T201
            return 1
    sets = []
    for recipe in recipes(objects):
        sets.append(given.folder / recipe.name)
        splits = [s for s in SPLITS if s != OUTLIERS or recipe.objects.outliers]
        for swept in make_sweeps(recipe, sets[-1], splits=splits):
            print(recipe.name, swept, flush=True)  # noqa: T201
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        runs = list(pool.map(lambda seed: _trained(given.folder, sets, seed), given.seeds))
    best = max(runs, key=_validated)
    weights = given.folder / f"{given.name}.pt"
    _write_weights(best, weights)
    release(weights, weights.with_suffix(".onnx"), given.name, "fp16")
    return 0


def recipes(objects: Path) -> list[SweepRecipe]:
    """What the model learns from; what is wrong with the sensor is drawn as the first says.

    Real things are those that the benchmark gives to learn from, swept as it sweeps its own, then
    oftener, then in the wide world. Generated ones come in any pose, then of any plan in the wide
    world, then upright, as most things stand.
    """
    wide = read_recipe("wide24")
    real = _of(read_recipe(str(OF_THE_BENCHMARK / "real27.toml")), objects / "real")
    everyday = _of(read_recipe(str(RECIPES / "everyday.toml")), objects / "everyday")
    again = replace(real.sweeps, draws=STANDING)
    fallen = replace(wide.sweeps, draws=real.sweeps.draws)
    return [
        read_recipe("poses24"),
        everyday,
        real,
        replace(real, name="standing27", seed=1, sweeps=again),
        replace(real, name="wide27", sweeps=fallen),
        wide,
        read_recipe("default24"),
    ]


def _of(recipe: SweepRecipe, objects: Path) -> SweepRecipe:
    return replace(recipe, objects=replace(recipe.objects, source=str(objects)))


def _trained(folder: Path, sets: list[Path], seed: int) -> Path:
    """A network's checkpoint; each is trained by a process of its own."""
    run = folder / f"run-{seed}"
    first, *others = map(str, sets)
    also = [part for other in others for part in ("--also", other)]
    program = (sys.executable, "-c", "from tactile_rt.cli import main; main()")
    command = [*program, "train", first, str(run), *also]
    subprocess.run([*command, "--recipe", "mouse44", "--seed", str(seed)], check=True)
    return run / "best.pt"


def _validated(checkpoint: Path) -> float:
    """By what the epoch was chosen, too."""
    metrics = torch.load(checkpoint, map_location="cpu", weights_only=True)["metrics"]
    return float(metrics["validation_top1"] + metrics["validation_top1_noisy"])


def _write_weights(checkpoint: Path, path: Path) -> None:
    """The checkpoint with its numbers in half precision."""
    saved = torch.load(checkpoint, map_location="cpu", weights_only=True)
    saved["model"] = {
        name: value.half()
        if value.is_floating_point() and not name.startswith("inputs.")
        else value
        for name, value in saved["model"].items()
    }
    save_whole(path, saved)


if __name__ == "__main__":
    sys.exit(main())
