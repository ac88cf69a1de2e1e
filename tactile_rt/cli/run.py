"""`tactile-rt run`: the daemon, or a classifier on one live stream."""

from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import app, leaving, open_url
from tactile_rt.cli.daemon import Settings, serve
from tactile_rt.cli.options import Model, Seconds
from tactile_rt.core.errors import ConfigError, SpecMismatch


@app.command(epilog="tactile-rt run --source replay:demo --final-only")
def run(
    file: Annotated[
        Path | None, typer.Argument(help="Configuration of the daemon, e.g. robot.toml.")
    ] = None,
    source: Annotated[
        str | None, typer.Option(help="URL of a source, e.g. sim:mouse?objects=mug.")
    ] = None,
    model: Model = None,
    final_only: Annotated[
        bool, typer.Option("--final-only", help="Print only the last decision of each touch.")
    ] = False,
    fuse: Annotated[
        float,
        typer.Option(
            min=0, max=3600, help="Touches that follow within so many seconds are of one object."
        ),
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
        serve(file, sets or [], seconds)
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
            typer.echo(f"{source} is made up: what is decided on it means nothing", err=True)
        session, card = Session(opened, classifier), classifier.card
        stuck_at, stuck = StuckAtDetector(opened.spec.rate_hz), tuple[int, ...]()
        if device_of(opened) is not None:
            changes = max(card.changes, share_of_changes(opened))
            stuck_at.expect(opened.spec, sensor_of(card), changes)
        with leaving(seconds), session:
            for chunk, decisions in session:
                samples += len(chunk)
                stuck_at.add(chunk)
                if set(stuck_at.elements) - set(stuck):
                    names = name_some([opened.spec.elements[k] for k in stuck_at.elements])
                    typer.echo(
                        f"no value of {names} changes: it hangs, or is out of range", err=True
                    )
                stuck = stuck_at.elements
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
                    typer.echo(msgspec.json.encode(fields))  # which flushes
                    printed += 1
    dropped = session.dropped + opened.stats.dropped
    typer.echo(f"{samples} samples, {printed} decisions, {dropped} dropped", err=True)
