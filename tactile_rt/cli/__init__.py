"""The `tactile-rt` command: one thin module per group of commands.

A user's mistake gives one clear line on stderr and exit code 2; Ctrl-C ends a command quietly.
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

AGAIN_S = 0.01  # delay before a signal is raised again, if Python dropped its exception


def main() -> None:
    """Run `tactile-rt` with the arguments of this process."""
    _open_streams()
    if sys.argv[1:2] == ["run"] and not any(a.startswith("--source") for a in sys.argv):
        # The daemon also obeys signals that come before everything is imported.
        from tactile_rt.daemon.process import queue_signals

        queue_signals()
    if sys.argv[1:2] == ["teach"]:  # two threads of numpy's libraries take 30 times as long as one
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    with _catch_signals() as received:
        _run(received)


@contextmanager
def _catch_signals() -> Iterator[list[int]]:
    """End the block on Ctrl-C, SIGTERM or SIGHUP; yield the list of received signals."""
    received: list[int] = []
    handled = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    defaults = signal.SIG_DFL, signal.default_int_handler

    def leave(number: int, frame: FrameType | None) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        if number in handled:
            received.append(number)
        elif received:
            number = received[-1]
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        _leave(number)

    def report_or_repeat(unraisable: "sys.UnraisableHookArgs") -> None:
        # Python drops exceptions while it deletes an object: raise the signal again a little later.
        if received and isinstance(unraisable.exc_value, KeyboardInterrupt | SystemExit):
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        else:
            report(unraisable)

    found = {s: signal.getsignal(s) for s in (*handled, signal.SIGALRM)}
    before = {s: handler for s, handler in found.items() if handler in defaults}
    for number in before:
        signal.signal(number, leave)
    report, sys.unraisablehook = sys.unraisablehook, report_or_repeat
    try:
        yield received
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


def _run(received: list[int]) -> None:
    import typer

    app = load_app()
    from tactile_rt.core.errors import TactileError

    # Since 0.29 Typer has a copy of click of its own: the class depends on Typer's release.
    usage_error: Any = typer.BadParameter.__base__

    try:
        try:
            sys.exit(app(prog_name="tactile-rt", standalone_mode=False))
        except Exception:
            if received:  # a library has turned the signal into another error
                _leave(received[-1])
            raise
        finally:
            sys.stdout.flush()  # while an error can still be reported
    except usage_error as error:
        _report_misuse(error)
    except TactileError as error:
        _give_up(str(error))
    except BrokenPipeError:  # the reader of stdout has gone
        _empty_stdout()
        sys.exit(1)
    except OSError as error:  # a folder that is a file, a full disk, ...: for the user to mend
        # Missing folders are created, so a path that exists all the same is a file.
        _empty_stdout()
        why = "is not a folder" if isinstance(error, FileExistsError) else error.strerror
        _give_up(f"cannot use {error.filename}: {why}" if error.filename else why or str(error))


class _ErrorStream(io.FileIO):
    """Stream to stderr that ignores write errors, such as the full disk of a log."""

    def write(self, data: "ReadableBuffer") -> int:
        with suppress(OSError):
            super().write(data)
        return memoryview(data).nbytes


def _open_streams() -> None:
    """Open standard streams that are closed, and let stderr ignore write errors."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:  # closed: the next file to be opened would take its place
            os.open(os.devnull, os.O_RDWR)
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)
    if sys.stderr is not sys.__stderr__:  # replaced by the calling program
        return
    stream = io.BufferedWriter(_ErrorStream(2, "w", closefd=False))
    coding = getattr(sys.stderr, "encoding", None)
    sys.stderr = io.TextIOWrapper(stream, coding, "backslashreplace", line_buffering=True)


def _report_misuse(error: Any) -> NoReturn:
    """Report a usage error in one line that names the help, and exit."""
    if type(error).__name__ == "NoArgsIsHelpError":  # no argument was given at all
        error.show()
        sys.exit(error.exit_code)
    command = error.ctx.command_path if error.ctx else "tactile-rt"
    message = " ".join(error.format_message().split()).rstrip(".")
    _give_up(f"{message}; see {command} --help", error.exit_code)


def _empty_stdout() -> None:
    """Flush stdout, or discard its buffer, which Python would fail to print at exit."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _give_up(why: str, code: int = 0) -> NoReturn:
    import typer

    from tactile_rt.cli.app import USER_ERROR
    from tactile_rt.core.errors import shorten

    line = shorten(" ".join(why.splitlines()))  # a user's text may have several lines
    typer.secho(f"tactile-rt: {line}", err=True, fg="red")
    sys.exit(code or USER_ERROR)
