"""Options that several commands share: one name has one meaning, one help and one check."""

from pathlib import Path
from typing import Annotated, Any

import typer

from tactile_rt.cli.app import check_named_once, check_output
from tactile_rt.core.errors import ConfigError

STDOUT = Path("-")
LARGEST_SEED = 2**32 - 1  # that every generator takes


def _check_json(file: Path | None) -> Path | None:
    """Refuse a file that cannot be written, or that the command names twice."""
    if file is not None and file != STDOUT:
        try:
            check_named_once(file)
            check_output(file)
        except (ConfigError, OSError) as error:  # such as a name that is too long
            raise typer.BadParameter(getattr(error, "strerror", None) or str(error)) from None
    return file


def set_option(help: str) -> Any:
    """Return the option ``--set KEY=VALUE`` of a command, which may be given again."""
    return typer.Option("--set", metavar="KEY=VALUE", help=f"{help}; may be repeated.")


Url = Annotated[str, typer.Argument(help="URL of a source, e.g. serial:///dev/ttyUSB0?codec=bota.")]
Models = Annotated[
    list[Path], typer.Argument(help="Checkpoints (best.pt), .onnx files, and responses (.npz).")
]
Json = Annotated[
    Path | None,
    typer.Option(help="Also write results as JSON; `-` prints JSON only.", callback=_check_json),
]
Model = Annotated[Path | None, typer.Option(help="Model file, .onnx. Default: the shipped model.")]
Seconds = Annotated[
    float | None, typer.Option(min=0.001, max=1e9, help="Stop after this many seconds.")
]
Seed = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the random numbers.")]
Fast = Annotated[bool, typer.Option("--fast", help="Run as fast as possible, not in real time.")]
Force = Annotated[bool, typer.Option("--force", help="Replace the output if it exists.")]
Quick = Annotated[bool, typer.Option("--quick", help="Measure less, for a first look.")]
Faults = Annotated[Path | None, typer.Option(help="TOML file of the faults to inject.")]
ProjectFolder = Annotated[
    Path | None, typer.Option(help="Folder of `tactile-rt new`: its array, device and model.")
]
Array = Annotated[str, typer.Option(help="Array: mouse, rat, rat-left, ..., or a file.")]
Accelerator = Annotated[str, typer.Option(help="Processor to train on: auto, cpu, cuda, ...")]
Page = Annotated[Path | None, typer.Option("--out", help="Also write an HTML page here.")]
Stimuli = Annotated[
    Path | None,
    typer.Option(help="File of `tactile-rt whisk`. Default: the shipped file of the mouse array."),
]
Sessions = Annotated[
    list[str] | None,
    typer.Option("--session", help="Only sessions with this in their name; wildcards * and ?."),
]
