"""`tactile-rt install-service`: make the daemon start at boot."""

import re
import sys
from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import app
from tactile_rt.stream import ConfigError

__all__: list[str] = []

UNIT = "tactile-rt.service"
HOMES = ("/home/", "/root/")
USER = re.compile(r"[a-z_][a-z0-9_-]{0,30}")


@app.command("install-service")
def install_service(
    file: Annotated[Path, typer.Argument(help="The configuration, e.g. /etc/tactile/robot.toml.")],
    to: Annotated[Path, typer.Option(help="Folder to write into; it must be new or empty.")] = Path(
        "tactile-service"
    ),
    user: Annotated[str, typer.Option(help="Name that the service runs under.")] = "tactile",
) -> None:
    """Write a systemd unit, udev rules for what is plugged in, and a script that installs them.

    Nothing is changed outside the folder: read the script, then run it as root.
    """
    from tactile_rt.daemon.checks import check_config
    from tactile_rt.daemon.loading import load_config
    from tactile_rt.daemon.systemd import install_script, unit_text
    from tactile_rt.drivers.discovery import serial_ports, udev_rules

    loaded = load_config(file.absolute())
    check_config(loaded)
    if not USER.fullmatch(user):
        raise ConfigError(f"--user {user!r} is not a name that a user can have")
    if to.exists() and (not to.is_dir() or any(to.iterdir())):
        raise ConfigError(f"{to} is there already: name a new folder with --to")
    program, path = _program(), str(file.absolute())
    unit = unit_text([*program, "run", path], loaded.config, user)
    script = install_script(UNIT, [*program, "config", "check", path], loaded.config, user)
    to.mkdir(parents=True, exist_ok=True)
    (to / UNIT).write_text(unit)
    (to / "99-tactile.rules").write_text(udev_rules(serial_ports()))
    (to / "install.sh").write_text(script)
    typer.echo(f"{to}: {UNIT}, 99-tactile.rules, install.sh are written")
    for name in (program[0], path):
        if name.startswith(HOMES):
            typer.echo(f"{name}: the user {user} must be able to read it; better /opt or /etc")
    typer.echo(f"read them, then: sudo sh {to / 'install.sh'}")


def _program() -> list[str]:
    """How this program is started, whatever the folder and the environment."""
    script = Path(sys.executable).with_name("tactile-rt")
    if script.exists():
        return [str(script)]
    return [sys.executable, "-c", "from tactile_rt.cli import main; main()"]
