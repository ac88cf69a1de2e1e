"""Options that several commands share: one name has one meaning, one help and one check."""

from pathlib import Path
from typing import Annotated, Any

import typer

from tactile_rt.cli.app import check_named_once, check_output
from tactile_rt.core.errors import ConfigError

STDOUT = Path("-")
LARGEST_SEED = 2**32 - 1  # every generator of random numbers takes it


def _check_json(file: Path | None) -> Path | None:
    """Refuse a file that cannot be written, or that the command names twice."""
    if file is not None and file != STDOUT:
        try:
            check_named_once(file)
            check_output(file)
        except (ConfigError, OSError) as error:  # such as a name that is too long
            raise typer.BadParameter(getattr(error, "strerror", None) or str(error)) from None
    return file


def option(help: str, *names: str, **more: Any) -> Any:
    """Return an option of a command, named after its parameter if ``names`` is empty."""
    return typer.Option(*names, help=help, **more)


def argument(help: str, **more: Any) -> Any:
    """Return a positional argument of a command."""
    return typer.Argument(help=help, **more)


def set_option(help: str) -> Any:
    """Return the option ``--set KEY=VALUE`` of a command, which may be repeated."""
    return option(f"{help}; may be repeated.", "--set", metavar="KEY=VALUE")


Url = Annotated[str, argument("URL of a source, e.g. serial:///dev/ttyUSB0?codec=bota.")]
Json = Annotated[
    Path | None, option("Also write results as JSON; `-` prints JSON only.", callback=_check_json)
]
Model = Annotated[Path | None, option("Model file, .onnx. Default: the shipped model.")]
Seconds = Annotated[float | None, option("Stop after this many seconds.", min=0.001, max=1e9)]
Seed = Annotated[int, option("Seed of the random numbers.", min=0, max=LARGEST_SEED)]
Fast = Annotated[bool, option("Run as fast as possible, not in real time.", "--fast")]
Force = Annotated[bool, option("Replace the output if it exists.", "--force")]
Quick = Annotated[bool, option("Measure less, for a first look.", "--quick")]
Accelerator = Annotated[str, option("Processor to train on: auto, cpu, cuda, ...")]
