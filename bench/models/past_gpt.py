"""Why does a GPT cost so much? A GRU alone, with a GPT, and with a path past the GPT.

Run: python -m bench.models.past_gpt SWEEP_SET FOLDER [--updates N]

The path adds the GRU's features to the GPT's output, whose weight in the sum begins at 0 and is
learnt. Each is trained with the rate and the warm-up that its cell of the grid has found.
"""

import argparse
import csv
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import typer
from torch import Tensor, nn

from tactile_rt.models import attenders
from tactile_rt.models.attenders.gpt import GPT
from tactile_rt.models.training import TrainingConfig, train

ALONE, CELL, PATH = "a GRU alone", "a GRU and a GPT", "a GRU and a path past the GPT"
FOUND = {ALONE: (5e-3, 0.3), CELL: (1.5e-3, 0.05), PATH: (5e-3, 0.3)}  # rate, warm-up


class PastGPT(GPT):
    """features + weight * GPT(features), the weight 0 at first."""

    def __init__(self, *args: Any, **keywords: Any) -> None:
        super().__init__(*args, **keywords)
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, features: Tensor) -> Tensor:
        out: Tensor = features + self.weight * super().forward(features)
        return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("data", type=Path, help="the sweep set")
    parser.add_argument("folder", type=Path, help="where the runs go")
    parser.add_argument("--updates", type=int, default=1000)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    typer.echo("| network | training loss | validation top-1, clean, at rated noise (%) |")
    typer.echo("|---|---|---|")
    for name, (rate, warmup) in FOUND.items():
        config = TrainingConfig(
            str(asked.data), encoder="gru", attender="none" if name == ALONE else "gpt",
            width=1 / 16, batch=64, precision="fp32", learning_rate=rate, warmup=warmup,
            updates=asked.updates,
        )  # fmt: skip
        run = asked.folder / name.replace(" ", "_")
        with mock.patch.object(attenders, "GPT", PastGPT if name == PATH else GPT):
            train(config, run, device="cpu")
        with (run / "history.csv").open(newline="") as file:
            *_, last = csv.DictReader(file)
        clean, noisy = (100 * float(last[f"validation_top1{end}"]) for end in ("", "_noisy"))
        typer.echo(f"| {name} | {float(last['loss']):.3f} | {clean:.1f}, {noisy:.1f} |")


if __name__ == "__main__":
    main()
