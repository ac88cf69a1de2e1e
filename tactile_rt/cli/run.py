"""`tactile-rt run` and `demo`: a classifier on a live stream."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import app, needs, starting
from tactile_rt.cli.daemon import Settings, serve
from tactile_rt.stream import ConfigError

Model = Annotated[
    Path | None, typer.Option(help="An .onnx model; default: the one that comes with the package.")
]
Seconds = Annotated[
    float | None, typer.Option(min=0.001, max=1e9, help="Leave after so many seconds.")
]


@contextmanager
def leaving(seconds: float | None) -> Iterator[None]:
    """Let Ctrl-C, SIGTERM, a closed output pipe or the clock end the block, and go on after it."""
    alike = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
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


@app.command()
def run(
    file: Annotated[
        Path | None, typer.Argument(help="A configuration: run the daemon, e.g. robot.toml.")
    ] = None,
    source: Annotated[
        str | None, typer.Option(help="URL of a source, e.g. sim:mouse?objects=mug.")
    ] = None,
    model: Model = None,
    every_step: Annotated[
        bool, typer.Option("--every-step/--final-only", help="Decisions to print.")
    ] = True,
    seconds: Seconds = None,
    sets: Settings = None,
) -> None:
    """Run the daemon on a configuration, or classify what one source's array touches.

    With a FILE everything is said there (`tactile-rt config example`);
    SIGHUP reads it again, SIGTERM closes it. Exit codes: 0 stopped, 2 wrong
    configuration, 3 already running, 4 stopped but something hung.

    With --source, print one line of JSON per decision.

    Fields: type ("classification"); t_ns and onset_ns, times of the last
    sample used and of first contact on the stream's clock; step since onset,
    from 1; final, whether it is the episode's last; label, the most probable
    class; probabilities of all classes; latency_ms of the model step.

    A summary goes to stderr. Ctrl-C leaves.
    """
    if file is not None:
        if source is not None or model is not None or not every_step:
            raise ConfigError(
                f"{file} says what to run: give --set source.NAME.url=... or the like beside it"
            )
        serve(file, sets or [], seconds)
        return
    if source is None or sets:
        raise ConfigError("run needs a configuration (robot.toml, --set with it) or --source URL")

    import msgspec

    from tactile_rt.classifier.classifier import Classifier
    from tactile_rt.classifier.model_file import shipped_model
    from tactile_rt.classifier.session import Session
    from tactile_rt.sources.opening import open_source

    samples = printed = 0
    with starting():
        opened = open_source(source)
    with opened:
        session = Session(opened, Classifier(model or shipped_model(), opened.spec))
        with leaving(seconds), session:
            for chunk, decisions in session:
                samples += len(chunk)
                for d in decisions:
                    if not (every_step or d.final):
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
                        "latency_ms": round(1e3 * d.latency_s, 3),
                    }
                    typer.echo(msgspec.json.encode(fields))  # which flushes
                    printed += 1
    dropped = session.dropped + opened.stats.dropped
    typer.echo(f"{samples} samples, {printed} decisions, {dropped} dropped", err=True)


@app.command()
def demo(
    sweeps: Annotated[
        int, typer.Option(min=0, help="Leave after so many objects; 0: go on until Ctrl-C.")
    ] = 0,
    seconds: Seconds = None,
    model: Model = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the drawn objects and sweeps.")] = 0,
    fast: Annotated[
        bool, typer.Option("--fast", help="As fast as it simulates, not in real time.")
    ] = False,
    plain: Annotated[
        bool, typer.Option("--plain", help="One line per object instead of the view.")
    ] = False,
) -> None:
    """Sweep objects that the model never saw past simulated whiskers, and keep the score."""
    from rich.console import Console

    from tactile_rt.classifier.model_file import shipped_model

    console = Console()
    try:
        with starting(), console.status("building the array and the objects"):
            from tactile_rt.cli.demo import Demonstration
            from tactile_rt.cli.demo_view import watch

            demonstration = Demonstration(model or shipped_model(), sweeps, seed, fast)
    except ModuleNotFoundError as error:
        raise needs("sim", error) from None
    with leaving(seconds), demonstration:
        if plain or not console.is_terminal or console.is_dumb_terminal:
            for settled in demonstration.run():
                for outcome in settled:
                    typer.echo(outcome.line())
        else:
            watch(demonstration, console)
    typer.echo(demonstration.summary())
