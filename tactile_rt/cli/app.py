"""The Typer application that every command joins, and helpers that commands share."""

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
SLOW_WORK = "tactile_rt.sim_backend.objects"  # logger of work that takes seconds

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


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"tactile-rt {VERSION}")
        raise typer.Exit


def add_group(name: str, help: str) -> typer.Typer:
    """Add a group of commands to the application; return the group."""
    made = typer.Typer(cls=PanelGroup, help=help, no_args_is_help=True)
    app.add_typer(made, name=name)
    return made


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Print the version."
    ),
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(WELCOME)
    if sys.stderr.isatty():  # a terminal shows slow work; a log file stays clean
        logger = logging.getLogger(SLOW_WORK)
        logger.addHandler(logging.StreamHandler())
        logger.setLevel(logging.INFO)
        logger.propagate = False


@contextmanager
def starting() -> Iterator[None]:
    """Raise KeyboardInterrupt in the block on Ctrl-C, even if a library swallows the signal."""
    interrupted = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        if callable(before):
            before(number, frame)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield
    except Exception:  # raised by a library in place of Ctrl-C, if `interrupted`
        if interrupted:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupted:  # swallowed, as by trimesh while it is imported
        raise KeyboardInterrupt


def open_url(url: str) -> "Source":
    """Open the source that a URL names. Stop on Ctrl-C even if a library swallows it."""
    from tactile_rt.sources.opening import open_source

    with starting():
        return open_source(url)


@contextmanager
def needing(extra: str) -> Iterator[None]:
    """Turn a failed import in the block into an error that names the extra."""
    with require_extra("this needs", extra), starting():
        yield


@contextmanager
def leaving(seconds: float | None) -> Iterator[None]:
    """Leave the block without an error on Ctrl-C, SIGTERM, hangup, broken pipe or timeout."""
    handled = [signal.SIGINT, signal.SIGTERM, signal.SIGALRM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup sets it
        handled.append(signal.SIGHUP)
    before = [signal.signal(s, signal.default_int_handler) for s in handled]
    # A timer, not the stream's clock: a silent device must not keep us waiting.
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
        for s, handler in zip(handled, before, strict=True):
            signal.signal(s, handler)


def check_output(file: Path | None) -> None:
    """Refuse a file that cannot be written, now rather than after minutes of work.

    Raises:
        ConfigError: the path is a folder, or its parent folder is missing or not writable.
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
    """Refuse a folder that is not writable, now rather than after seconds of work.

    Raises:
        ConfigError: the path is a file, or the folder (or its nearest parent) is not writable.
    """
    above = next(one for one in (folder.absolute(), *folder.absolute().parents) if one.exists())
    if not above.is_dir():
        raise ConfigError(f"{above}: is not a folder")
    if not os.access(above, os.W_OK | os.X_OK):
        raise ConfigError(f"{folder} cannot be written: {above} may not be written into")


def check_text(*names: Path | None) -> None:
    """Refuse file names that are not UTF-8, which cannot be written into another file."""
    for name in filter(None, names):
        try:
            str(name).encode()
        except UnicodeEncodeError:
            raise ConfigError(f"{str(name)!r} is not UTF-8: rename it") from None


def check_named_once(file: Path) -> None:
    """Refuse an output file that two arguments of the command line name."""
    where = file.resolve()
    if sum(where in _list_files(word) for word in sys.argv[1:]) > 1:
        raise ConfigError(f"{file} is another file of this command: name a new one")


def _list_files(word: str) -> set[Path]:
    """Return the paths that an argument may name, alone or within an option or URL."""
    parts = (word, *map(unquote, re.split("[:?&=@,]", word)))
    return {Path(part).resolve() for part in parts if part and "\0" not in part}


def check_is_mcap(file: Path) -> None:
    """Refuse a recording's name that does not end in ``.mcap``."""
    if file.suffix != ".mcap":
        raise ConfigError(
            f"{file}: a recording must end in .mcap; `tactile-rt convert` makes other formats"
        )


def check_new(file: Path, force: bool) -> None:
    """Refuse to overwrite a file that exists, is an input or is being recorded.

    Raises:
        ConfigError: the file cannot be written, exists without ``force``, is named twice in the
            command line, or is being recorded by a process.
    """
    check_output(file)
    if not file.exists():
        return
    if not force:
        raise ConfigError(f"{file} already exists: name another file, or give --force")
    check_named_once(file)
    from tactile_rt.recording.writer import check_not_recorded

    check_not_recorded(file)
