"""The `tactile-rt` command: one thin module per group of commands.

A user's mistake is one clear line on stderr and exit code 2; Ctrl-C leaves quietly.
"""

import sys
from typing import NoReturn

import typer

from tactile_rt.cli.app import INTERRUPTED, USER_ERROR, app
from tactile_rt.stream import TactileError

__all__ = ["main"]


def main() -> None:
    """Run the command line."""
    # Each module adds its commands; what a command needs is imported when it runs, so that
    # `--help` is instant and a robot never imports torch.
    from tactile_rt.cli import (  # noqa: F401
        align,
        bench,
        calibrate,
        daemon,
        devices,
        emulate,
        evaluate,
        grid,
        hil,
        locate,
        model,
        record,
        replay,
        run,
        sweep,
        top,
        train,
        view,
        whisk,
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
