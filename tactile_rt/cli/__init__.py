"""The `tactile-rt` command: one thin module per group of commands.

A user's mistake is one clear line on stderr and exit code 2; Ctrl-C leaves quietly.
"""

import sys

import typer

from tactile_rt import __version__
from tactile_rt.stream import TactileError

__all__ = ["main"]

USER_ERROR, INTERRUPTED = 2, 130

app = typer.Typer(
    name="tactile-rt",
    help="Tactile perception in real time: whisker arrays in, what they touch out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"tactile-rt {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    pass


def main() -> None:
    """Run the command line."""
    # Each module adds its commands; what a command needs is imported when it runs, so that
    # `--help` is instant and a robot never imports torch.
    from tactile_rt.cli import bench, live, modelling, simulation  # noqa: F401

    try:
        app()
    except TactileError as error:
        typer.secho(f"tactile-rt: {error}", err=True, fg="red")
        sys.exit(USER_ERROR)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def needs(extra: str, error: ModuleNotFoundError) -> TactileError:
    """The error to raise when a command's import fails: which extra brings it."""
    from tactile_rt.stream import ConfigError

    if (error.name or "").startswith("tactile_rt"):
        raise error
    return ConfigError(
        f"this needs {error.name}, which is not installed: pip install 'tactile-rt[{extra}]'"
    )
