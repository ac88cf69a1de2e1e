"""The application that every command adds itself to, and what commands share."""

import logging
import os
import re
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING
from urllib.parse import unquote

import typer

from tactile_rt.cli.panels import WELCOME, PanelGroup
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import VERSION, require_extra

if TYPE_CHECKING:
    from tactile_rt.core.stream import Source

USER_ERROR, INTERRUPTED = 2, 130  # exit codes
SLOW_WORK = "tactile_rt.sim_backend.objects"  # a logger

COLUMNS, BOXED = shutil.get_terminal_size().columns, 100

app = typer.Typer(
    name="tactile-rt",
    cls=PanelGroup,
    help="Recognise what whisker arrays, tactile skins and force sensors touch, in real time.",
    pretty_exceptions_enable=False,
    # Boxes cut long words where they have no room; plain text is as wide as the terminal.
    rich_markup_mode="rich" if COLUMNS >= BOXED else None,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "terminal_width": min(COLUMNS, BOXED),
    },
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"tactile-rt {VERSION}")
        raise typer.Exit


def add_group(name: str, help: str) -> typer.Typer:
    """Return a new group of commands of the application."""
    made = typer.Typer(cls=PanelGroup, help=help, no_args_is_help=True)
    app.add_typer(made, name=name)
    return made


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(WELCOME)
    if sys.stderr.isatty():  # what takes seconds says so; a log file keeps clean
        said = logging.getLogger(SLOW_WORK)
        said.addHandler(logging.StreamHandler())
        said.setLevel(logging.INFO)
        said.propagate = False


@contextmanager
def starting() -> Iterator[None]:
    """Let Ctrl-C end the block even where a library swallows it, as trimesh does while it is
    imported, or makes another error of it."""
    asked = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        if callable(before):
            before(number, frame)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    except Exception:
        if asked:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        raise KeyboardInterrupt


def open_url(url: str) -> "Source":
    """Open a source of samples; Ctrl-C ends it even where a library swallows it."""
    from tactile_rt.sources.opening import open_source

    with starting():
        return open_source(url)


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Let the block import what an extra brings; say which where it is missing."""
    with require_extra("this needs", extra), starting():
        yield


@contextmanager
def leaving(seconds: float | None) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM, a closed terminal or output pipe, or the clock end the block, and go on
    after it."""
    alike = [signal.SIGINT, signal.SIGTERM, signal.SIGALRM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup has it
        alike.append(signal.SIGHUP)
    before = [signal.signal(s, signal.default_int_handler) for s in alike]
    # A timer, not a look at the stream's clock: a silent device must not keep us waiting.
    signal.setitimer(signal.ITIMER_REAL, seconds or 0)
    try:
        yield
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:
        # What is still buffered would fail again when Python flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        for s, handler in zip(alike, before, strict=True):
            signal.signal(s, handler)


def check_output(file: Path | None) -> None:
    """Refuse a file that cannot be written, now rather than after minutes of work.

    Raises:
        ConfigError: it is a folder, or the folder that it goes into is not there or not one's own.
    """
    if file is None:
        return
    if not file.parent.is_dir():
        raise ConfigError(f"no folder {file.parent} to write {file.name} in")
    if file.is_dir():
        raise ConfigError(f"{file} is a folder: name a file to write")
    if not os.access(file.parent, os.W_OK | os.X_OK):
        raise ConfigError(f"{file} cannot be written: {file.parent} may not be written into")


def check_folder(folder: Path) -> None:
    """Refuse a folder that nothing can be written into, now rather than after seconds of work.

    Raises:
        ConfigError: it is a file, or it, or the one that it would be made in, is not one's own.
    """
    above = next(one for one in (folder.absolute(), *folder.absolute().parents) if one.exists())
    if not above.is_dir():
        raise ConfigError(f"{above}: is not a folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ConfigError(f"{folder} cannot be written: {above} may not be written into")


def check_text(*names: Path | None) -> None:
    """Refuse names of files that are no UTF-8, which cannot stand in another file."""
    for name in filter(None, names):
        try:
            str(name).encode()
        except UnicodeEncodeError:
            raise ConfigError(f"{str(name)!r} is no UTF-8: rename it") from None


def check_named_once(file: Path) -> None:
    """Refuse to write a file that two words of the command line name, see `_files`."""
    where = file.resolve()
    if sum(where in _files(word) for word in sys.argv[1:]) > 1:
        raise ConfigError(f"{file} is another file of this command: name a new one")


def _files(word: str) -> set[Path]:
    """What files a word may name: alone, as an option, or in a URL."""
    parts = (word, *map(unquote, re.split("[:?&=@,]", word)))
    return {Path(part).resolve() for part in parts if part and "\0" not in part}


def check_is_mcap(file: Path) -> None:
    """Refuse a recording's name that does not end in ``.mcap``."""
    if file.suffix != ".mcap":
        raise ConfigError(f"{file}: a recording is a .mcap; `tactile-rt convert` makes others")


def check_new(file: Path, force: bool) -> None:
    """Refuse to write over a file that is there, that is read, or that is just being recorded.

    Raises:
        ConfigError: as `check_output`; it is there, and not to be replaced; the command line names
            it twice; or some process is recording into it.
    """
    check_output(file)
    if not file.exists():
        return
    if not force:
        raise ConfigError(f"{file} is there already: name another file, or give --force")
    check_named_once(file)
    from tactile_rt.recording.writer import check_not_recorded

    check_not_recorded(file)
