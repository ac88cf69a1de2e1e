"""`tactile-rt bench`: measure this installation and compare with what is promised."""

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from tactile_rt.cli.app import app, check_output, needs
from tactile_rt.stream import ConfigError

CHECKOUT = Path(__file__).parents[2]
# area: (module with `run(quick) -> list[Record]`, extra that it needs), None: no figures yet
AREAS: dict[str, tuple[str, str] | None] = {
    "sim": ("bench.sim.area", "sim"),
    "drivers": ("bench.drivers.area", "record"),
    "models": ("bench.models.area", "train"),
    "inference": ("bench.inference.area", ""),
    "daemon": ("bench.daemon.area", "train"),
    "align": ("bench.align.area", ""),
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
    from tactile_rt.evidence.records import show, write

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
                records += _rig(name, module).run(quick)
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


def _rig(area: str, module: str) -> Any:
    """The rig of an area: it stands beside the package in a checkout, and in no wheel."""
    if not (CHECKOUT / "bench" / "__init__.py").is_file():
        raise ConfigError(f"bench {area} measures from a checkout: this install has no rigs")
    if str(CHECKOUT) not in sys.path:
        sys.path.insert(0, str(CHECKOUT))
    return import_module(module)
