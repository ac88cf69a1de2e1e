"""What do pairs of two sweeps need? A GRU that learns by contrast, with and without image
augmentations, at several temperatures.

Run: python -m bench.models.pairs SWEEP_SET FOLDER [--updates N]

Each is trained from the same seed at the peak rate and warm-up that the grid has found for pairs
without augmentations, then a linear probe is fitted on what it has learnt. What a folder holds is
not trained again.
"""

import argparse
from pathlib import Path

import torch
import typer

from tactile_rt.errors import TactileError
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.training.config import ONE_SWEEP, TWO_SWEEPS, ProbeConfig, TrainingConfig
from tactile_rt.models.training.loop import read_splits, train
from tactile_rt.models.training.probing import probe

RATE, WARMUP = 5e-3, 0.3
KINDS = (  # pairs, augmentation, temperatures
    (TWO_SWEEPS, "none", (0.1, 0.5, 1.0, 2.0)),
    (TWO_SWEEPS, "image", (0.1, 1.0)),
    (ONE_SWEEP, "image", (0.1, 1.0)),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("data", type=Path, help="the sweep set")
    parser.add_argument("folder", type=Path, help="where the runs go")
    parser.add_argument("--updates", type=int, default=500)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    typer.echo("| pairs | augmentation | temperature | validation top-1 of the probe (%) |")
    typer.echo("|---|---|---|---|")
    splits = read_splits(TrainingConfig(str(asked.data)))
    probing = ProbeConfig(epochs=60, drop_epochs=20, readout="mean")
    for pairs, augmentation, temperatures in KINDS:
        for temperature in temperatures:
            config = TrainingConfig(
                str(asked.data), encoder="gru", width=1 / 8, batch=64, precision="fp32",
                objective="simclr", pairs=pairs, augmentation=augmentation,
                temperature=temperature, learning_rate=RATE, warmup=WARMUP, updates=asked.updates,
            )  # fmt: skip
            run = asked.folder / f"{pairs}_{augmentation}_{temperature:g}_{asked.updates}"
            best = train(config, run, device="cpu", splits=splits)
            if not (fitted := run / "probe" / "best.pt").exists():
                fitted = probe(best, run / "probe", probing, splits=splits)
            metrics = load_checkpoint(fitted)[1]["metrics"]
            top1 = 50 * (metrics["validation_top1"] + metrics["validation_top1_noisy"])
            typer.echo(f"| {pairs} | {augmentation} | {temperature:g} | {top1:.1f} |")


if __name__ == "__main__":
    try:
        main()
    except TactileError as error:  # such as a set with fewer sweeps than a batch
        raise SystemExit(str(error)) from None
