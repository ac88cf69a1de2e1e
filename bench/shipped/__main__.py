"""Remake the model that ships: objects, sweep sets, three networks, the best of them exported.

python -m bench.shipped FOLDER [--from CLONES] [--name NAME] [--seeds 0 1 2]

It goes on with what is missing of FOLDER. The objects come from GitHub or from clones, every file
checked by its hash. A network learns from all sets, with smoothed labels; then it goes on with
sharp ones, once on the sets as they are and once mostly on real things, and the mean of the two
networks' weights is taken (Wortsman et al. 2022, model soups). Of the seeds the one that is best on
validation sweeps goes to FOLDER/NAME.pt, in half precision, and from there to FOLDER/NAME.onnx.
"""

import argparse
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from msgspec.structs import replace as change

from bench.perception.make import RECIPES as OF_THE_BENCHMARK
from tactile_rt.export.release import release
from tactile_rt.models.checkpoints import save_whole
from tactile_rt.sets.manifest import OUTLIERS
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list

RECIPES = Path(__file__).parent / "recipes"
LISTS = ("real", "everyday")
SPLITS = ("train", "validation", OUTLIERS)
WIDE = "wide27"  # real things in the wide world
OFTEN = "standing27"  # real things as they stand, once more
STANDING = 12  # further sweeps of every real object that stands
AGAIN = (3, 1)  # times these are learnt from in the second stage, by network


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
    release(weights, weights.with_suffix(".onnx"), given.name, "fp16", licence="Apache-2.0")
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
        replace(real, name=OFTEN, seed=1, sweeps=again),
        replace(real, name=WIDE, sweeps=fallen),
        wide,
        read_recipe("default24"),
    ]


def _of(recipe: SweepRecipe, objects: Path) -> SweepRecipe:
    return replace(recipe, objects=change(recipe.objects, source=str(objects)))


def _trained(folder: Path, sets: list[Path], seed: int) -> list[Path]:
    """The checkpoints of which the mean is taken.

    What a network says of real things in the wide world is little more than a guess. So that its
    candidates are not judged by these, it goes on without them.
    """
    run = folder / f"run-{seed}"
    _train(sets, run, "--recipe", "mouse44", "--seed", str(seed))
    begun = ("--from", str(run / "best.pt"), "--recipe", "sharpen", "--seed", str(seed))
    for times in AGAIN:
        again = [one for one in sets for _ in range(times if one.name == OFTEN else 1)]
        _train([s for s in again if s.name != WIDE], folder / f"sharp-{seed}-{times}", *begun)
    return [folder / f"sharp-{seed}-{times}" / "best.pt" for times in AGAIN]


def _train(sets: list[Path], run: Path, *options: str) -> None:
    first, *others = map(str, sets)
    also = [part for other in others for part in ("--also", other)]
    program = (sys.executable, "-c", "from tactile_rt.cli import main; main()")
    subprocess.run([*program, "train", first, str(run), *also, *options], check=True)


def _validated(checkpoints: list[Path]) -> float:
    """By what their epochs were chosen, too."""
    metrics = [_read(checkpoint)["metrics"] for checkpoint in checkpoints]
    return sum(m["validation_top1"] + m["validation_top1_noisy"] for m in metrics)


def _write_weights(checkpoints: list[Path], path: Path) -> None:
    """The last checkpoint with the mean of all numbers, in half precision."""
    saved = [_read(checkpoint) for checkpoint in checkpoints]
    weights = {}
    for name, value in saved[-1]["model"].items():
        if value.is_floating_point() and not name.startswith("inputs."):
            weights[name] = torch.stack([s["model"][name].double() for s in saved]).mean(0).half()
        else:
            weights[name] = value
    save_whole(path, {**saved[-1], "model": weights})


def _read(checkpoint: Path) -> dict[str, Any]:
    saved: dict[str, Any] = torch.load(checkpoint, map_location="cpu", weights_only=True)
    return saved


if __name__ == "__main__":
    sys.exit(main())
