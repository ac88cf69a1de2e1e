"""The `tactile-rt` command: one thin module per group of commands.

A user's mistake is one clear line on stderr and exit code 2; Ctrl-C leaves quietly.
"""

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import NoReturn

import typer

from tactile_rt import __version__
from tactile_rt.stream import ConfigError, TactileError

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
    from tactile_rt.cli import (  # noqa: F401
        align,
        bench,
        calibrating,
        daemon,
        devices,
        emulating,
        evaluating,
        grids,
        hil,
        install,
        live,
        locating,
        model,
        modelling,
        recording,
        replaying,
        simulation,
        top,
        view,
        whisking,
    )

    try:
        app()
    except TactileError as error:
        _give_up(str(error))
    except OSError as error:  # a folder that is a file, a full disk, ...: the user's to mend
        # Folders are made where there is none, so what exists all the same is a file.
        why = "is not a folder" if isinstance(error, FileExistsError) else error.strerror
        _give_up(f"cannot use {error.filename}: {why}" if error.filename else str(error))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _give_up(why: str) -> NoReturn:
    typer.secho(f"tactile-rt: {why}", err=True, fg="red")
    sys.exit(USER_ERROR)


@contextmanager
def starting() -> Iterator[None]:
    """Let Ctrl-C end the block even where it is swallowed, as trimesh does while it is imported."""
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        raise KeyboardInterrupt


def check_output(file: Path | None) -> None:
    """Refuse a file that cannot be written, now rather than after minutes of work.

    Raises:
        ConfigError: it is a folder, or the folder that it goes into is not there.
    """
    if file is None:
        return
    if not file.parent.is_dir():
        raise ConfigError(f"no folder {file.parent} to write {file.name} in")
    if file.is_dir():
        raise ConfigError(f"{file} is a folder: name a file to write")


def needs(extra: str, error: ModuleNotFoundError) -> TactileError:
    """The error to raise when a command's import fails: which extra brings it."""
    if (error.name or "").startswith("tactile_rt"):
        raise error
    return ConfigError(
        f"this needs {error.name}, which is not installed: pip install 'tactile-rt[{extra}]'"
    )
