"""Why does a GPT cost so much? An encoder alone, with a GPT, and with one of which a part differs.

Run: python -m bench.models.past_gpt SWEEP_SET FOLDER [--encoder NAME] [--only KIND ...]

Each is trained from the same seed at two peak rates with their warm-ups, those that the grid has
found for the encoder and for the encoder with a GPT. What a folder holds is not trained again.
"""

import argparse
import csv
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import typer
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.errors import TactileError
from tactile_rt.models import attenders
from tactile_rt.models.attenders.gpt import GPT, LAYERS, TOKENS, TransformerBlock
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import read_splits, train

RATES = {  # peak rate, warm-up; alone, and with a GPT
    "gru": ((5e-3, 0.3), (1.5e-3, 0.05)),
    "zhuang-intersection-ln": ((5e-3, 0.05), (5e-4, 0.3)),
}


class PastGPT(GPT):
    """features + weight * GPT(features), the weight 0 at first."""

    def __init__(self, *args: Any, **keywords: Any) -> None:
        super().__init__(*args, **keywords)
        self.weight = nn.Parameter(torch.zeros(()))

    def forward(self, features: Tensor) -> Tensor:
        out: Tensor = features + self.weight * super().forward(features)
        return out


class OfObservation(GPT):
    """Its outputs are those of the observations' tokens, which start from the features."""

    def forward(self, features: Tensor) -> Tensor:
        steps = features.shape[1]
        x = self._embed(features) + self.positions[: TOKENS * steps].unflatten(0, (steps, TOKENS))
        x = F.dropout(x.flatten(1, 2), self.dropout, self.training)  # (batch, token, width)
        for block in self.blocks:
            x = block(x)
        out: Tensor = self.project_out(self.norm(x[:, ::TOKENS]))
        return out


def gpt(
    kind: type[GPT] = GPT,
    layers: int = LAYERS,
    without: tuple[str, ...] = (),
    dropped: bool = True,
    zero: bool = False,
) -> type[GPT]:
    """A GPT that differs.

    Args:
        kind: what it is but for that.
        layers: how many it has.
        without: the linear layers whose output is always 0: "proj" for one without attention,
            "mlp_out" for one without MLPs.
        dropped: whether there is dropout.
        zero: whether its layers add nothing at first.
    """

    class Changed(kind):  # type: ignore[misc, valid-type]
        def __init__(self, width: int, dropout: float, *args: Any, **keywords: Any) -> None:
            super().__init__(width, dropout if dropped else 0.0, *args, **keywords)
            del self.blocks[layers:]
            for block in self.blocks:
                assert isinstance(block, TransformerBlock)
                for name in ("proj", "mlp_out"):
                    linear = getattr(block, name)
                    if zero or name in without:
                        nn.init.zeros_(linear.weight)
                    linear.requires_grad_(name not in without)

    return Changed


KINDS: dict[str, type[GPT] | None] = {
    "nothing": None,
    "a GPT": GPT,
    "a path past a GPT": PastGPT,
    "one layer": gpt(layers=1),
    "a GPT read at observations": OfObservation,
    "the same, its layers 0 at first": gpt(OfObservation, zero=True),
    "one layer read at observations": gpt(OfObservation, 1),
    "the same without dropout": gpt(OfObservation, 1, dropped=False),
    "the same without its MLP": gpt(OfObservation, 1, ("mlp_out",)),
    "the same without attention": gpt(OfObservation, 1, ("proj",)),
    "no layer read at observations": gpt(OfObservation, 0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("data", type=Path, help="the sweep set")
    parser.add_argument("folder", type=Path, help="where the runs go")
    parser.add_argument("--encoder", choices=list(RATES), default="gru")
    parser.add_argument("--updates", type=int, default=1000)
    parser.add_argument("--only", nargs="+", choices=list(KINDS), default=list(KINDS))
    asked = parser.parse_args()
    torch.set_num_threads(1)
    columns = "rate", "training loss", "validation top-1, clean, at rated noise (%)"
    typer.echo(f"| {asked.encoder} and | {' | '.join(columns)} |")
    typer.echo("|---|---|---|---|")
    splits = read_splits(TrainingConfig(str(asked.data)))
    for name in asked.only:
        kind = KINDS[name]
        for rate, warmup in RATES[asked.encoder]:
            config = TrainingConfig(
                str(asked.data), encoder=asked.encoder, attender="gpt" if kind else "none",
                width=1 / 16, batch=64, precision="fp32", learning_rate=rate, warmup=warmup,
                updates=asked.updates,
            )  # fmt: skip
            called = f"{asked.encoder}, {name}, {rate:g}, {asked.updates}"
            run = asked.folder / called.replace(" ", "_")
            with mock.patch.object(attenders, "GPT", kind or GPT):
                train(config, run, device="cpu", splits=splits)
            with (run / "history.csv").open(newline="") as file:
                *_, last = csv.DictReader(file)
            clean, noisy = (100 * float(last[f"validation_top1{end}"]) for end in ("", "_noisy"))
            loss = float(last["loss"])
            typer.echo(f"| {name} | {rate:g} | {loss:.3f} | {clean:.1f}, {noisy:.1f} |")


if __name__ == "__main__":
    try:
        main()
    except TactileError as error:  # such as a set with fewer sweeps than a batch
        raise SystemExit(str(error)) from None
