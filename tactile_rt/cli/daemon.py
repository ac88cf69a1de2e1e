"""`tactile-rt run`, `config` and `install-service`: the onboard daemon, or a classifier alone."""

import re
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import add_group, app, check_output, leaving, open_url
from tactile_rt.cli.options import Model, Seconds, argument, option, set_option
from tactile_rt.core.errors import ConfigError, SpecMismatch

Settings = Annotated[
    list[str] | None,
    set_option("A key of the configuration: page.port=9000, source.whiskers.url=..."),
]
UNIT = "tactile-rt.service"
HOMES = ("/home/", "/root/")
USER = re.compile(r"[a-z_][a-z0-9_-]{0,30}")

File = Annotated[Path, argument("The configuration, e.g. robot.toml.")]

config = add_group("config", "Write, check and print configurations of the daemon.")


@app.command(epilog="tactile-rt run --source replay:demo --final-only")
def run(
    file: Annotated[Path | None, argument("Configuration of the daemon, e.g. robot.toml.")] = None,
    source: Annotated[str | None, option("URL of a source, e.g. sim:mouse?objects=mug.")] = None,
    model: Model = None,
    final_only: Annotated[
        bool, option("Print only the last decision of each touch.", "--final-only")
    ] = False,
    fuse: Annotated[
        float,
        option("Touches that follow within so many seconds are of one object.", min=0, max=3600),
    ] = 0.0,
    seconds: Seconds = None,
    sets: Settings = None,
) -> None:
    """Run the daemon, or print a model's decisions on one source.

    With FILE, run the daemon of that configuration (`tactile-rt config example` writes one);
    SIGHUP reads it again, SIGTERM stops the daemon. Exit codes: 0 stopped, 2 wrong
    configuration, 3 already running, 4 stopped but something hung.

    With --source, print one line of JSON per decision.

    Fields: type ("classification"); t_ns and onset_ns, times of the last sample used and of first
    contact on the stream's clock; step since onset, from 1; final, true for the episode's last;
    label, the most probable class, or a refusal to name one ("unknown"); probabilities of all of
    them; prediction_set, the classes that are still possible, and coverage, how often the true
    one is among them; names, the kinds of the label's class that are still possible, and
    names_coverage, how often the true one is among these; object, the enrolled object that it is,
    or "none of these", at a touch's last step, its object_margin above what is needed, and
    object_touches that it rests on; latency_ms of the model step.

    A summary goes to stderr. Ctrl-C ends it.
    """
    if file is not None:
        if source is not None or model is not None or final_only or fuse:
            raise ConfigError(
                f"{file} says source, model and decisions: change them there or by --set, as "
                "--set source.NAME.url=..."
            )
        _serve(file, sets or [], seconds)
        return
    if source is None or sets:
        raise ConfigError("run needs a configuration (robot.toml, --set with it) or --source URL")

    import msgspec

    from tactile_rt.classifier.classifier import Classifier
    from tactile_rt.classifier.model_card import sensor_of
    from tactile_rt.classifier.model_file import shipped_model
    from tactile_rt.classifier.session import Session
    from tactile_rt.core.errors import name_some
    from tactile_rt.daemon.stuck_at import StuckAtDetector
    from tactile_rt.drivers.device_source import device_of, share_of_changes
    from tactile_rt.sources.opening import check_model, is_made_up

    file = model or shipped_model()
    samples = printed = 0
    check_model(file, source)
    with open_url(source) as opened:
        try:
            classifier = Classifier(file, opened.spec, fuse_s=fuse)
        except SpecMismatch as error:
            raise SpecMismatch(f"{source}: {error}") from None
        if is_made_up(source):
            typer.echo(f"{source} is made up: decisions on it mean nothing", err=True)
        session, card = Session(opened, classifier), classifier.card
        stuck_at, stuck = StuckAtDetector(opened.spec.rate_hz), tuple[int, ...]()
        if device_of(opened) is not None:
            changes = max(card.changes, share_of_changes(opened))
            stuck_at.expect(opened.spec, sensor_of(card), changes)
        with leaving(seconds), session:
            for chunk, decisions in session:
                samples += len(chunk)
                stuck_at.add(chunk)
                all_of_them = tuple(range(len(opened.spec.elements)))
                found = all_of_them if stuck_at.seconds else stuck_at.elements
                if set(found) - set(stuck):
                    names = name_some([opened.spec.elements[k] for k in found])
                    typer.echo(f"no value of {names} changes: stuck, or out of range", err=True)
                stuck = found
                for d in decisions:
                    if final_only and not d.final:
                        continue
                    fields = {
                        "type": "classification",
                        "t_ns": d.t_ns,
                        "onset_ns": d.onset_ns,
                        "step": d.step,
                        "final": d.final,
                        "label": d.label,
                        "probabilities": {
                            label: round(float(p), 4)
                            for label, p in zip(d.labels, d.probabilities, strict=True)
                        },
                        "prediction_set": d.prediction_set,
                        "coverage": d.coverage,
                        "names": d.names,
                        "names_coverage": d.names_coverage,
                        "object": d.object,
                        "object_margin": d.object_margin and round(d.object_margin, 4),
                        "object_touches": d.object_touches,
                        "latency_ms": round(1e3 * d.latency_s, 3),
                    }
                    typer.echo(msgspec.json.encode(fields))  # echo flushes
                    printed += 1
    dropped = session.dropped + opened.stats.dropped
    typer.echo(f"{samples} samples, {printed} decisions, {dropped} dropped", err=True)


def _serve(file: Path, sets: list[str], seconds: float | None) -> None:
    """Run the daemon, then end the process with its exit code."""
    from tactile_rt.core.locks import AlreadyRunning
    from tactile_rt.daemon.process import ExitCode, leave, run_daemon

    try:
        leave(run_daemon(file, sets, seconds))
    except AlreadyRunning as error:
        typer.secho(f"tactile-rt: {error}", err=True, fg="red")
        leave(ExitCode.RUNNING)


@config.command(epilog="tactile-rt config check robot.toml")
def check(file: File, sets: Settings = None) -> None:
    """Check that a configuration can work, without opening a device.

    Its models are loaded and tried.
    """
    from tactile_rt.classifier.trial import TrialLimits, try_model
    from tactile_rt.daemon.admission import model_path
    from tactile_rt.daemon.checks import check_config
    from tactile_rt.daemon.loading import load_config
    from tactile_rt.sources.opening import is_made_up

    loaded = load_config(file, sets or [])
    check_config(loaded)
    found = loaded.config
    for model in dict.fromkeys(model_path(m) for m in found.model):
        try_model(model, TrialLimits(found.limits.model_mb, found.limits.model_s))
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
    for source in found.source:
        if found.model and is_made_up(source.url):
            typer.echo(f"source {source.name} is made up: decisions on it mean nothing")


@config.command(epilog="tactile-rt config show robot.toml --set page.port=9000")
def show(file: File, sets: Settings = None) -> None:
    """Print a configuration with its defaults and --set values."""
    from tactile_rt.daemon.config import config_text
    from tactile_rt.daemon.loading import load_config

    typer.echo(config_text(load_config(file, sets or []).config), nl=False)


@config.command(epilog="tactile-rt config example robot.toml")
def example(
    output: Annotated[Path | None, argument("File to write. Default: print it.")] = None,
) -> None:
    """Write an example configuration that explains every key."""
    from tactile_rt.daemon.config import EXAMPLE

    _print_or_write(EXAMPLE, output, f"run it with: tactile-rt run {shlex.quote(str(output))}")


@config.command(epilog="tactile-rt config alerts alerts.yml")
def alerts(
    output: Annotated[Path | None, argument("File to write. Default: print it.")] = None,
) -> None:
    """Write Prometheus alert rules for a daemon that serves metrics."""
    from tactile_rt.daemon.metrics import ALERTS

    _print_or_write(ALERTS.read_text("utf-8"), output, "name it under rule_files of prometheus.yml")


@config.command("ros2-messages", epilog="tactile-rt config ros2-messages ws/src")
def ros2_messages(
    folder: Annotated[Path, argument("The src folder of a ROS 2 workspace.")],
) -> None:
    """Write tactile_rt_msgs, the ROS 2 package of our message types."""
    import shutil

    from tactile_rt.core.files import replace_folder
    from tactile_rt.recording.ros2.cdr import PACKAGE

    made = folder / PACKAGE.name
    if not folder.is_dir():
        raise ConfigError(f"no folder {folder}")
    if made.exists():
        raise ConfigError(f"{made} already exists")
    with replace_folder(made) as unfinished:
        shutil.copytree(PACKAGE, unfinished, dirs_exist_ok=True)
    typer.echo(f"{made} is written; build it with: colcon build --packages-select {PACKAGE.name}")


def _print_or_write(text: str, output: Path | None, then: str) -> None:
    """Print a text, or write it into a new file and print the hint `then`."""
    check_output(output)
    if output is None:
        typer.echo(text, nl=False)
        return
    if output.exists():
        raise ConfigError(f"{output} already exists: name another file")
    _write(output, text)
    typer.echo(f"{output} is written; {then}")


def _write(path: Path, text: str) -> None:
    from tactile_rt.core.files import write_whole

    write_whole(path, lambda file: file.write(text.encode()))


@app.command("install-service", epilog="tactile-rt install-service /etc/tactile/robot.toml")
def install_service(
    file: Annotated[Path, argument("The configuration, e.g. /etc/tactile/robot.toml.")],
    out: Annotated[Path, option("New or empty folder to write into.")] = Path("tactile-service"),
    user: Annotated[str, option("User that the service runs as.")] = "tactile",
) -> None:
    """Write a systemd service that starts the daemon at boot.

    Also writes udev rules for the connected devices, and a script that installs both. Nothing is
    changed outside the folder: read the script, then run it as root.
    """
    from tactile_rt.daemon.checks import check_config
    from tactile_rt.daemon.loading import load_config
    from tactile_rt.daemon.service import check_folders, install_script, unit_text
    from tactile_rt.drivers.discovery import serial_ports, udev_rules

    loaded = load_config(file.absolute())
    check_config(loaded)
    if not USER.fullmatch(user):
        raise ConfigError(f"--user {user!r} is not a name that a user can have")
    check_folders(loaded, user)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out} already exists: name a new folder with --out")
    program, path = _find_program(), str(file.absolute())
    unit = unit_text([*program, "run", path], loaded.config, user)
    again = [*program, "install-service", path, "--user", user]
    script = install_script(UNIT, again, user)
    out.mkdir(parents=True, exist_ok=True)
    _write(out / UNIT, unit)
    _write(out / "99-tactile.rules", udev_rules(serial_ports()))
    _write(out / "install.sh", script)
    typer.echo(f"{out}: {UNIT}, 99-tactile.rules, install.sh are written")
    for name in (program[0], path):
        if name.startswith(HOMES):
            typer.echo(f"{name}: the user {user} must be able to read it; better /opt or /etc")
    typer.echo(f"read them, then: sudo sh {shlex.quote(str(out / 'install.sh'))}")


def _find_program() -> list[str]:
    """Return the argument list that starts this program in any folder and environment."""
    script = Path(sys.executable).with_name("tactile-rt")
    if script.exists():
        return [str(script)]
    return [sys.executable, "-c", "from tactile_rt.cli import main; main()"]
