"""The `tactile-rt` command: one thin module per group of commands.

A user's mistake is one clear line on stderr and exit code 2; Ctrl-C leaves quietly.
"""

import os
import sys
from typing import Any, NoReturn

__all__ = ["main"]


def main() -> None:
    """Run the command line."""
    if sys.argv[1:2] == ["run"] and not any(a.startswith("--source") for a in sys.argv):
        # It is to be the daemon: a signal that comes before all else is imported counts, too.
        from tactile_rt.daemon.process import note_signals

        note_signals()
    # Each module adds its commands; what a command needs is imported when it runs, so that
    # `--help` is instant and a robot never imports torch.
    import typer

    from tactile_rt.cli import (  # noqa: F401
        align,
        align_board,
        array,
        bench,
        calibrate,
        daemon,
        demo,
        devices,
        emulate,
        evaluate,
        grid,
        hil,
        importing,
        label,
        locate,
        model,
        objects,
        project,
        record,
        replay,
        run,
        sniff,
        sweep,
        teach,
        top,
        train,
        view,
        whisk,
    )
    from tactile_rt.cli.app import INTERRUPTED, app
    from tactile_rt.stream import TactileError

    # Typer brings a copy of click since 0.29: whose these are depends on its release.
    usage_error: Any = typer.BadParameter.__base__

    try:
        try:
            sys.exit(app(prog_name="tactile-rt", standalone_mode=False))
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
        _give_up(f"cannot use {error.filename}: {why}" if error.filename else str(error))
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


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

    typer.secho(f"tactile-rt: {why}", err=True, fg="red")
    sys.exit(code or USER_ERROR)
