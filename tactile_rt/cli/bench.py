"""`tactile-rt bench`: measure this installation and compare with the stated limits.

The measuring code is in `bench/AREA/area.py` of a checkout, and in no wheel.
"""

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from tactile_rt.cli.app import app, needing
from tactile_rt.cli.options import Json, Quick, argument, option
from tactile_rt.cli.tables import progress_bar, show_records
from tactile_rt.core.errors import ConfigError, name_some

CHECKOUT = Path(__file__).parents[2]
# Each area, and the extra that its `run(quick) -> list[Record]` needs.
AREAS = {
    "sim": "sim,gym",
    "drivers": "record",
    "models": "train",
    "inference": "",
    "daemon": "train",
    "align": "train,test",
    "perception": "sim,train",
}


FAULTS = "faults"  # of the daemon's surroundings; takes hours


@app.command(epilog="tactile-rt bench inference --quick")
def bench(
    area: Annotated[
        str | None, argument(f"{', '.join(AREAS)}, or {FAULTS}. Default: all but it.")
    ] = None,
    quick: Quick = False,
    json: Json = None,
    resume: Annotated[Path | None, option("With faults: file of results to continue from.")] = None,
) -> None:
    """Measure speed and accuracy against the stated limits.

    Needs a checkout. `faults` takes hours: each fault of the daemon's surroundings, 40 times.
    """
    known = (*AREAS, FAULTS)
    if area is not None and area not in known:
        raise ConfigError(f"no benchmark area {area!r}: there are {name_some(known, 8)}")
    if resume is not None and area != FAULTS:
        raise ConfigError("--resume goes with faults: tactile-rt bench faults --resume FILE")
    records: list[Any] = []
    for name in [area] if area else AREAS:
        with progress_bar(f"measuring {name}"):
            with needing(AREAS.get(name, "train")):
                if name == FAULTS:
                    rig = _load_rig("daemon", "faults")
                    records += rig.faults(2 if quick else rig.TIMES, resume=resume)
                else:
                    records += _load_rig(name).run(quick)
    if show_records(records, json):
        return
    bars = [r for r in records if r.bar]
    typer.echo(f"{sum(bool(r.met) for r in bars)} of {len(bars)} requirements met")


def _load_rig(area: str, module: str = "area") -> Any:
    """Import a module that measures an area, from the checkout's ``bench`` folder."""
    if not (CHECKOUT / "bench" / area / "area.py").is_file():  # another `bench` may exist
        raise ConfigError(
            f"bench {area} measures from a checkout (pip install --editable): "
            f"{Path(__file__).parents[1]} was installed without its rigs"
        )
    if sys.path[0] != str(CHECKOUT):
        sys.path.insert(0, str(CHECKOUT))  # first, or another `bench` is imported
    return import_module(f"bench.{area}.{module}")
