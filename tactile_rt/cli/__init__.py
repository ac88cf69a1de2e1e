"""The `tactile-rt` command: one thin module per group of commands.

A user's mistake is one clear line on stderr and exit code 2; Ctrl-C leaves quietly.
"""

import io
import os
import pkgutil
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    import typer
    from _typeshed import ReadableBuffer

__all__ = ["load_app", "main"]

AGAIN_S = 0.01  # after which a signal whose exception Python dropped comes again


def main() -> None:
    """Run the command line."""
    _open_streams()
    if sys.argv[1:2] == ["run"] and not any(a.startswith("--source") for a in sys.argv):
        # It is to be the daemon: a signal that comes before all else is imported counts, too.
        from tactile_rt.daemon.process import note_signals

        note_signals()
    if sys.argv[1:2] == ["teach"]:  # two threads of numpy's libraries take 30 times as long as one
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    with _signals() as told:
        _run(told)


@contextmanager
def _signals() -> Iterator[list[int]]:
    """Let Ctrl-C, SIGTERM and SIGHUP end the block alike; gives the signals that have come."""
    told: list[int] = []
    alike = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    untouched = signal.SIG_DFL, signal.default_int_handler

    def leave(number: int, frame: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        if number in alike:
            told.append(number)
        elif told:
            number = told[-1]
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        _leave(number)

    def report_or_repeat(unraisable: "sys.UnraisableHookArgs") -> None:
        # While an object is taken away Python drops what is raised: it comes again a little later.
        if told and isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        else:
            report(unraisable)

    found = {s: signal.getsignal(s) for s in (*alike, signal.SIGALRM)}
    before = {s: handler for s, handler in found.items() if handler in untouched}
    for number in before:
        signal.signal(number, leave)
    report, sys.unraisablehook = sys.unraisablehook, report_or_repeat
    try:
        yield told
    except KeyboardInterrupt:
        _leave(signal.SIGINT)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        sys.unraisablehook = report
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(number: int) -> NoReturn:
    sys.exit(128 + number)


def load_app() -> "typer.Typer":
    """Return the application with all commands.

    A command imports what it needs when it runs, so help is instant and a robot needs no torch.
    """
    for module in pkgutil.iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    from tactile_rt.cli.app import app

    return app


def _run(told: list[int]) -> None:
    import typer

    app = load_app()
    from tactile_rt.core.errors import TactileError

    # Typer brings a copy of click since 0.29: whose these are depends on its release.
    usage_error: Any = typer.BadParameter.__base__

    try:
        try:
            sys.exit(app(prog_name="tactile-rt", standalone_mode=False))
        except Exception:
            if told:  # what a library makes of a signal is no mistake
                _leave(told[-1])
            raise
        finally:
            sys.stdout.flush()  # while what goes wrong can still be told
    except usage_error as error:
        _misused(error)
    except TactileError as error:
        _give_up(str(error))
    except BrokenPipeError:  # whoever read it has gone
        _empty_stdout()
        sys.exit(1)
    except OSError as error:  # a folder that is a file, a full disk, ...: the user's to mend
        # Folders are made where there is none, so what exists all the same is a file.
        _empty_stdout()
        why = "is not a folder" if isinstance(error, FileExistsError) else error.strerror
        _give_up(f"cannot use {error.filename}: {why}" if error.filename else why or str(error))


class _Told(io.FileIO):
    """The error output: where it can take no more, as the disk of a log is full, work goes on."""

    def write(self, data: "ReadableBuffer") -> int:
        with suppress(OSError):
            super().write(data)
        return memoryview(data).nbytes


def _open_streams() -> None:
    """Have a standard input, output and error output, whatever we were started with."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file that is opened would be taken for it
            os.open(os.devnull, os.O_RDWR)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)
    if sys.stderr is not sys.__stderr__:  # somebody listens in
        return
    told = io.BufferedWriter(_Told(2, "w", closefd=False))
    coding = getattr(sys.stderr, "encoding", None)
    sys.stderr = io.TextIOWrapper(told, coding, "backslashreplace", line_buffering=True)


def _misused(error: Any) -> NoReturn:
    """Say in a line what was wrong with the words of a command, and where to read about it."""
    if type(error).__name__ == "NoArgsIsHelpError":  # nothing was said at all
        error.show()
        sys.exit(error.exit_code)
    command = error.ctx.command_path if error.ctx else "tactile-rt"
    said = " ".join(error.format_message().split()).rstrip(".")
    _give_up(f"{said}; see {command} --help", error.exit_code)


def _empty_stdout() -> None:
    """Print what is still buffered, or forget it: at exit Python would try, fail and say so."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _give_up(why: str, code: int = 0) -> NoReturn:
    import typer

    from tactile_rt.cli.app import USER_ERROR
    from tactile_rt.core.errors import shorten

    line = shorten(" ".join(why.splitlines()))  # what a user wrote may have several
    typer.secho(f"tactile-rt: {line}", err=True, fg="red")
    sys.exit(code or USER_ERROR)
