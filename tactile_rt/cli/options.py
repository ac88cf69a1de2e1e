"""Options that several commands share: one name has one meaning, one help and one check."""

from pathlib import Path
from typing import Annotated, Any

import typer

from tactile_rt.cli.app import check_named_once, check_output
from tactile_rt.core.errors import ConfigError

__all__ = [
    "STDOUT",
    "Accelerator",
    "Array",
    "Fast",
    "Faults",
    "Force",
    "Json",
    "Model",
    "Models",
    "Page",
    "ProjectFolder",
    "Quick",
    "Seconds",
    "Seed",
    "Sessions",
    "Stimuli",
    "Url",
    "set_option",
]

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
    """Return the option ``--set KEY=VALUE`` of a command, which may be given again.

    Args:
        help: of what, with an example.
    """
    return typer.Option("--set", metavar="KEY=VALUE", help=f"{help}; may be repeated.")


Url = Annotated[str, typer.Argument(help="URL of a source, e.g. serial:///dev/ttyUSB0?codec=bota.")]
Models = Annotated[
    list[Path], typer.Argument(help="Checkpoints (best.pt), .onnx files, and responses (.npz).")
]
Json = Annotated[
    Path | None,
    typer.Option(help="Also write results as JSON; `-` prints JSON only.", callback=_check_json),
]
Model = Annotated[
    Path | None, typer.Option(help="An .onnx model; default: the one that comes with the package.")
]
Seconds = Annotated[
    float | None, typer.Option(min=0.001, max=1e9, help="Leave after so many seconds.")
]
Seed = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Of what is drawn at random.")]
Fast = Annotated[bool, typer.Option("--fast", help="As fast as it goes, not in real time.")]
Force = Annotated[bool, typer.Option("--force", help="Replace a file that is there.")]
Quick = Annotated[bool, typer.Option("--quick", help="Measure less: a look, not a figure.")]
Faults = Annotated[Path | None, typer.Option(help="A .toml of what goes wrong.")]
ProjectFolder = Annotated[
    Path | None, typer.Option(help="A folder of `tactile-rt new`: its array, device and model.")
]
Array = Annotated[str, typer.Option(help="mouse, rat, rat-left, ..., or a file.")]
Accelerator = Annotated[str, typer.Option(help="auto, cpu, cuda ...")]
Page = Annotated[Path | None, typer.Option("--out", help="Write it as a page here, .html.")]
Stimuli = Annotated[
    Path | None,
    typer.Option(help="Of `tactile-rt whisk`. Default: the mouse array's, which ships."),
]
Sessions = Annotated[
    list[str] | None,
    typer.Option("--session", help="Only sessions whose name has this; * and ? fit any."),
]
