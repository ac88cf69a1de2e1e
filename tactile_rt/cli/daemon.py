"""`tactile-rt run robot.toml` and `config`: the onboard daemon."""

from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import app, check_output
from tactile_rt.stream import ConfigError

__all__ = ["Settings", "serve"]

Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", help="Override a key: page.port=9000, source.whiskers.url=...; may be repeated."
    ),
]
File = Annotated[Path, typer.Argument(help="The configuration, e.g. robot.toml.")]

config = typer.Typer(help="The configuration of `tactile-rt run robot.toml`.", no_args_is_help=True)
app.add_typer(config, name="config")


def serve(file: Path, sets: list[str], seconds: float | None) -> None:
    """Run the daemon; leaves the process with its exit code."""
    from tactile_rt.daemon.lock import AlreadyRunning
    from tactile_rt.daemon.process import ExitCode, leave, run_daemon

    try:
        leave(run_daemon(file, sets, seconds))
    except AlreadyRunning as error:
        typer.secho(f"tactile-rt: {error}", err=True, fg="red")
        leave(ExitCode.RUNNING)


@config.command()
def check(file: File, sets: Settings = None) -> None:
    """Say whether a configuration can work; nothing is opened."""
    from tactile_rt.daemon.checks import check_config
    from tactile_rt.daemon.loading import load_config

    loaded = load_config(file, sets or [])
    check_config(loaded)
    found = loaded.config
    tables = [t for t in ("recorder", "page", "metrics") if getattr(found, t) is not None]
    counts = [
        f"{len(items)} {what}{'' if len(items) == 1 else 's'}"
        for what, items in (
            ("source", found.source),
            ("model", found.model),
            ("publisher", found.publisher),
        )
    ]
    typer.echo(f"{file}: {', '.join([*counts, *tables])}: all right")


@config.command()
def show(file: File, sets: Settings = None) -> None:
    """Print the configuration in force: with what it extends, overrides and defaults."""
    from tactile_rt.daemon.config import config_text
    from tactile_rt.daemon.loading import load_config

    typer.echo(config_text(load_config(file, sets or []).config), nl=False)


@config.command()
def example(
    output: Annotated[Path | None, typer.Argument(help="Where to; default: print it.")] = None,
) -> None:
    """Give a configuration to begin with, in which every key is explained."""
    from tactile_rt.daemon.config import EXAMPLE

    check_output(output)
    if output is None:
        typer.echo(EXAMPLE, nl=False)
        return
    if output.exists():
        raise ConfigError(f"{output} is there already: name another file")
    output.write_text(EXAMPLE)
    typer.echo(f"{output} is written; run it with: tactile-rt run {output}")
