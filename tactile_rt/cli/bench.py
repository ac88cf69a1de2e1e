"""`tactile-rt bench`: measure this installation and compare with what is promised."""

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from tactile_rt.cli import app, check_output, needs
from tactile_rt.stream import ConfigError

# area: (module with `run(quick) -> list[Record]`, extra that it needs), None: no figures yet
AREAS: dict[str, tuple[str, str] | None] = {
    "sim": ("tactile_rt.benchmarks.sim", "sim"),
    "drivers": ("tactile_rt.benchmarks.drivers.area", "record"),
    "models": ("tactile_rt.benchmarks.models", "train"),
    "inference": ("tactile_rt.benchmarks.inference", ""),
    "daemon": ("tactile_rt.benchmarks.daemon.area", "train"),
    "align": ("tactile_rt.benchmarks.alignment", ""),
}


@app.command()
def bench(
    area: Annotated[str | None, typer.Argument(help=f"{', '.join(AREAS)}; default: all.")] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer repetitions: a look, not a figure.")
    ] = False,
    json: Annotated[Path | None, typer.Option(help="Write the figures here too.")] = None,
) -> None:
    """Measure speed and accuracy, each figure beside its bar and what it is compared to."""
    from tactile_rt.benchmarks.records import show, write

    if area is not None and area not in AREAS:
        raise ConfigError(f"no benchmark area {area!r}: there are {', '.join(AREAS)}")
    check_output(json)
    progress, records, without = Console(stderr=True), [], []
    for name in [area] if area else AREAS:
        there = AREAS[name]
        if there is None:
            without.append(name)
            continue
        module, extra = there
        with progress.status(f"measuring {name}"):
            try:
                records += import_module(module).run(quick)
            except ModuleNotFoundError as error:
                raise needs(extra, error) from None
    if records:
        show(records, Console())
        bars = [r for r in records if r.bar]
        typer.echo(f"{sum(bool(r.met) for r in bars)} of {len(bars)} bars met")
    if without:
        typer.echo(f"no figures yet for: {', '.join(without)}")
    if json:
        write(records, json)
