"""Remake the model that ships: objects, sweep sets, networks, the best of them exported.

python -m bench.shipped FOLDER [--from CLONES] [--without FOLD] [--name NAME] [--seeds 0]

It goes on with what is missing of FOLDER. The objects come from GitHub or from clones, every file
checked by its hash. A network learns from real things, upright and leaning, and from generated
ones, with smoothed labels; then it goes on with sharp ones. Of the seeds the one that is best on
validation sweeps goes to FOLDER/NAME.pt, in half precision, and from there to FOLDER/NAME.onnx.

The makers of a fold, see `bench.perception.folds`, are left out where one is said: what is learnt
then is for the benchmark, which tests it on these makers' things.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

from bench.perception.folds import EVERYONE, FOLDS, read_origins, write_views
from bench.perception.make import LEANING, SHAPES, read_for
from tactile_rt.export.release import release
from tactile_rt.models.checkpoints import save_whole
from tactile_rt.sets.manifest import OUTLIERS
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list

UPRIGHT = Path(__file__).parent / "recipes" / "upright24.toml"
SPLITS = ("train", "validation", OUTLIERS)
GOING_ON = ("--recipe", "sharpen", "--epochs", "20", "--set", "names=0.5", "--set", "identity=0.3")


def main() -> int:
    """Make what is missing, then choose and export."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--from", dest="clones", type=Path)
    parser.add_argument("--without", choices=FOLDS, default=EVERYONE)
    parser.add_argument("--name", default="mouse13")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    given = parser.parse_args()
    objects = given.folder / "objects" / SHAPES
    if missing := get_objects(read_list(SHAPES), objects, given.clones):
        first, why = next(iter(missing.items()))
        print(f"{len(missing)} objects are missing, {first} because: {why}")  # noqa: T201
        return 1
    sets = make_sets(given.folder, objects, given.without)
    name = given.name if given.without == EVERYONE else given.without
    runs = [_trained(given.folder / name, sets, seed) for seed in given.seeds]
    weights = given.folder / f"{name}.pt"
    _write_weights(max(runs, key=_validated), weights)
    release(weights, weights.with_suffix(".onnx"), name, "fp16", licence="Apache-2.0")
    return 0


def make_sets(folder: Path, objects: Path, view: str) -> list[Path]:
    """Make what the model learns from.

    What is wrong with the sensor is drawn as the first set's recipe says, which is the severest.

    Args:
        view: whose real things, of `write_views`.
    """
    origins, sets = read_origins(objects), []
    for name in ("shapes24", str(UPRIGHT)):
        recipe = read_recipe(name)
        sets.append(folder / recipe.name)
        splits = [s for s in SPLITS if s != OUTLIERS or recipe.objects.outliers]
        for swept in make_sweeps(recipe, sets[-1], splits=splits):
            print(recipe.name, swept, flush=True)  # noqa: T201
    for name in (SHAPES, SHAPES + LEANING):
        for swept in make_sweeps(read_for(objects, name), folder / name):
            print(name, swept, flush=True)  # noqa: T201
        write_views(folder / name, origins, folder / "views" / name)
        sets.append(folder / "views" / name / view)
    return sets


def _trained(folder: Path, sets: list[Path], seed: int) -> Path:
    """The checkpoint that a seed leads to."""
    run, sharp = folder / f"run-{seed}", folder / f"sharp-{seed}"
    _train(sets, run, "--recipe", "shapes", "--seed", str(seed))
    _train(sets, sharp, "--from", str(run / "best.pt"), *GOING_ON, "--seed", str(seed))
    return sharp / "best.pt"


def _train(sets: list[Path], run: Path, *options: str) -> None:
    first, *others = map(str, sets)
    also = [part for other in others for part in ("--also", other)]
    program = (sys.executable, "-c", "from tactile_rt.cli import main; main()")
    subprocess.run([*program, "train", first, str(run), *also, *options], check=True)


def _validated(checkpoint: Path) -> float:
    """By what its epochs were chosen, too."""
    metrics = _read(checkpoint)["metrics"]
    return float(metrics["validation_top1"] + metrics["validation_top1_noisy"])


def _write_weights(checkpoint: Path, path: Path) -> None:
    """The checkpoint in half precision."""
    saved = _read(checkpoint)
    weights = {
        name: value.half()
        if value.is_floating_point() and not name.startswith("inputs.")
        else value
        for name, value in saved["model"].items()
    }
    save_whole(path, {**saved, "model": weights})


def _read(checkpoint: Path) -> dict[str, Any]:
    saved: dict[str, Any] = torch.load(checkpoint, map_location="cpu", weights_only=True)
    return saved


if __name__ == "__main__":
    sys.exit(main())
