"""The application that every command adds itself to, and what commands share."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import typer

from tactile_rt.stream import ConfigError, TactileError
from tactile_rt.version import VERSION

__all__ = ["INTERRUPTED", "USER_ERROR", "app", "check_output", "needs", "starting"]

USER_ERROR, INTERRUPTED = 2, 130  # exit codes

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
        typer.echo(f"tactile-rt {VERSION}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    pass


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
