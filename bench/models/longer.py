"""Where do the curves end? Networks of the grid trained longer than the grid has trained them.

Run: python -m bench.models.longer SWEEP_SET FOLDER [--network NAME ...] [--updates N ...]

Each is trained from the seed, at the rate and with the warm-up that its first task in
`bench/models/wide24` has found, and its validation top-1 stands beside what that task's shorter
trainings had. The test objects are not looked at. What a folder holds is not trained again, and
what was interrupted goes on.
"""

import argparse
from pathlib import Path

import torch
import typer

from tactile_rt.errors import TactileError
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.grid.outcomes import read_outcome
from tactile_rt.models.grid.plan import SUPERVISED, Task, read_grid
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import read_splits, train

KEPT = Path(__file__).parent / "wide24"
FOUR = ["gru", "s4", "mamba", "mamba+gpt"]


def whole(task: Task) -> bool:
    """Whether it learns from all objects and their labels, from nothing learnt before."""
    cell = task.cell
    plain = cell is not None and (cell.objective, cell.share, cell.begin) == (SUPERVISED, 1, "")
    return plain and not task.random


def main() -> None:
    grid = read_grid("wide24")
    tasks = {t.name: t for t in grid.tasks() if t.seed == 0 and whole(t)}
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("data", type=Path, help="the sweep set")
    parser.add_argument("folder", type=Path, help="where the runs go")
    parser.add_argument("--network", nargs="+", choices=list(tasks), default=FOUR)
    parser.add_argument("--updates", nargs="+", type=int, default=[8000])
    asked = parser.parse_args()
    torch.set_num_threads(1)
    splits = read_splits(TrainingConfig(str(asked.data)))
    typer.echo("| network | updates | training loss | validation top-1 (%) |")
    typer.echo("|---|---|---|---|")
    for name in asked.network:
        found = read_outcome(grid, KEPT, tasks[name])
        assert found is not None and found.chosen is not None
        for point in found.growth:
            typer.echo(f"| {name} | {point.updates:,} |  | {100 * point.score:.1f} |")
        for updates in asked.updates:
            config = grid.config(
                tasks[name], asked.data, learning_rate=found.chosen.learning_rate,
                warmup=found.chosen.warmup, updates=updates,
            )  # fmt: skip
            best = train(config, asked.folder / f"{name}_{updates}", device="cpu", splits=splits)
            metrics = load_checkpoint(best)[1]["metrics"]
            top1 = 50 * (metrics["validation_top1"] + metrics["validation_top1_noisy"])
            typer.echo(f"| {name} | {updates:,} | {metrics['loss']:.3f} | {top1:.1f} |")


if __name__ == "__main__":
    try:
        main()
    except TactileError as error:  # such as a set with fewer sweeps than a batch
        raise SystemExit(str(error)) from None
