"""`tactile-rt replay`: run a model on a recording, and compare with its live decisions."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO
from urllib.parse import parse_qsl

import typer

from tactile_rt.cli.app import app, check_new, leaving
from tactile_rt.cli.options import Force, argument, option
from tactile_rt.core.errors import ConfigError, RecordingError, name_some

if TYPE_CHECKING:
    from tactile_rt.classifier.classifier import Classification, Classifier
    from tactile_rt.core.stream import Chunk
    from tactile_rt.recording import Recording

DIFFERENT = 1  # exit code
RECORDED = "recorded"  # the codec and options by which packets were decoded live
TIMING = ("model_ms", "latency_ms", "age_ms", "late")  # keys of a decision that differ between runs


@app.command(epilog="tactile-rt replay touches.mcap --model model.onnx")
def replay(
    files: Annotated[list[Path], argument("A recording, or the rotated files of one source.")],
    model: Annotated[
        Path | None, option("Model file, .onnx, or shipped. Default: the one that decided live.")
    ] = None,
    name: Annotated[str, option("Name of the model, if several decided live.")] = "",
    speed: Annotated[str, option("Speed relative to the recorded one, or max.")] = "max",
    codec: Annotated[
        str, option("Decode the raw packets: recorded (as live), NAME or NAME?OPTION=VALUE.")
    ] = "",
    check: Annotated[bool, option("Compare with the recorded decisions.", "--check")] = False,
    out: Annotated[Path | None, option("File of decisions. Default: stdout.")] = None,
    force: Force = False,
) -> None:
    """Run a model on a recording, as it ran or would have run live.

    One line of JSON per decision, as the daemon's `decision` messages, without the times that they
    took: the same bytes at every speed and in every run. With --check they are compared with the
    recorded ones instead of printed; exit code 1, and the first difference, if there is one. With
    --codec the samples are decoded anew, and their differences from the recorded ones go to stderr.
    """
    fields = {"speed": _parse_speed(speed)} | _parse_codec(codec)
    if out is not None:
        check_new(out, force)
    run = _Replay(_open_in_order(files), model, name, check, fields)
    if "from" in fields:
        _show_decoding(run.files, {k: v for k, v in fields.items() if k not in ("from", "speed")})
    if out is not None:
        from tactile_rt.core.files import write_whole

        write_whole(out, run.write)
    elif check:
        run.write(None)
    else:
        finished = False
        with leaving(None):
            for line in run.lines():
                typer.echo(line)  # echo flushes
            finished = True
        if not finished:
            typer.echo("stopped before the end", err=True)
    typer.echo(f"{run.samples} samples, {len(run.decided)} decisions", err=True)
    if check:
        run.compare()


class _Replay:
    """Replay of the recordings of one source through a classifier."""

    def __init__(
        self,
        files: "list[Recording]",
        model: Path | None,
        name: str,
        check: bool,
        fields: dict[str, str],
    ) -> None:
        from tactile_rt.classifier.model_file import hash_of, shipped_model
        from tactile_rt.recording.checking import choose_model_file, live_model

        model = shipped_model() if model == Path("shipped") else model
        self.files, self._fields = files, fields
        self.samples = 0
        self.decided: list[dict[str, Any]] = []
        self._first = self._last = 0  # stream time, ns
        self._begins_at = 0
        self._live = live_model(str(files[0].path), files[0].description, name, model, check)
        self._model = choose_model_file(model, self._live)
        name = self._live.name if self._live and check else ""
        self._skips = [s for f in files for s in f.skips(name)] if name else []
        sha256 = hash_of(self._model)
        known = self._live.sha256 if self._live else ""
        if check and known and known != sha256:
            raise ConfigError(
                f"--check needs the model that decided, sha256 {known[:16]}...; "
                f"{self._model} is {sha256[:16]}..."
            )

    def write(self, file: BinaryIO | None) -> None:
        """Write a line of JSON per decision into a file. With None, only run the model."""
        for line in self.lines():
            if file is not None:
                file.write(line + b"\n")

    def lines(self) -> Iterator[bytes]:
        """Yield a line of JSON for each decision, at the speed of the replay."""
        import msgspec

        from tactile_rt.recording.replay import prepare_replay

        classifier: Classifier | None = None
        after = 0
        for recording in self.files:
            with prepare_replay(str(recording.path), dict(self._fields)).open() as source:
                for chunk in source:
                    # Sequence numbers that restart are another stream: it needs a new classifier.
                    if classifier is None or chunk.seq[0] < after:
                        classifier = self._make_classifier(source.spec)
                    if not self.samples:
                        self._first, self._begins_at = int(chunk.t_ns[0]), int(chunk.seq[0])
                    after, self._last = int(chunk.seq[-1]) + 1, int(chunk.t_ns[-1])
                    self.samples += len(chunk)
                    for decision in self._decide(classifier, chunk):
                        message = self._make_message(decision, recording)
                        self.decided.append(message)
                        yield msgspec.json.encode(message)

    def _decide(self, classifier: "Classifier", chunk: "Chunk") -> "list[Classification]":
        """Classify the samples of a chunk that the model also received live."""
        from tactile_rt.recording.checking import samples_given

        given = samples_given(chunk, self._skips)
        return classifier.push(given) if given is not None else []

    def compare(self) -> None:
        """Compare the decisions with the recorded ones; exit with `DIFFERENT` if they differ."""
        from tactile_rt.recording.checking import check_decisions

        assert self._live is not None
        recorded = [
            decision
            for recording in self.files
            for decision in recording.decisions()
            if decision["model"] == self._live.name
        ]
        table = self._live.table
        checked = check_decisions(
            recorded, self.decided, (self._first, self._last),
            final_only=table.get("decisions") == "final",
            may_withhold=table.get("late") == "skip",
        )  # fmt: skip
        parts = [f"{checked.same} decisions of {self._live.name} are as recorded"]
        if checked.before:
            parts.append(f"{checked.before} recorded ones are about samples before the first")
        if self._skips:
            parts.append(f"{len(self._skips)} stretches were skipped live, the model being behind")
        if checked.withheld:
            parts.append(f"{checked.withheld} were withheld live as late")
        if checked.late:
            parts.append(f"{checked.late} at the end came too late for the recording")
        if not self._live.sha256:
            parts.append("the recording does not hold the model's hash")
        typer.echo("; ".join(parts))
        if checked.difference:
            typer.secho(checked.difference, err=True, fg="red")
            if self._begins_at:
                typer.echo(
                    f"the recording begins in the middle of its stream (sample {self._begins_at}); "
                    "what came before decides, too: give the files before it as well",
                    err=True,
                )
            raise typer.Exit(DIFFERENT)

    def _make_classifier(self, spec: Any) -> "Classifier":
        from tactile_rt.classifier.classifier import Classifier
        from tactile_rt.classifier.skips import Skip

        table = self._live.table if self._live else {}
        return Classifier(
            self._model, spec, mode=table.get("mode", "episode"), every=table.get("every") or None,
            sure=table.get("sure") or None, in_a_row=table.get("in_a_row", 2),
            providers=tuple(table.get("providers", ("cpu",))),
            fuse_s=table.get("fuse_s", 0.0),
            skips=[Skip(s["from_ns"], s["until_ns"]) for s in self._skips],
        )  # fmt: skip

    def _make_message(self, decision: "Classification", recording: "Recording") -> dict[str, Any]:
        import msgspec

        from tactile_rt.daemon.items import Decision
        from tactile_rt.daemon.messages import message_of

        about = recording.description
        item = Decision(
            about.session.get("daemon_source", about.spec.name),
            self._live.name if self._live else self._model.stem,
            about.spec.frame, decision, 0, 0, about.utc_offset_ns,
        )  # fmt: skip
        fields: dict[str, Any] = msgspec.to_builtins(message_of(item))
        return {key: value for key, value in fields.items() if key not in TIMING}


def _open_in_order(files: list[Path]) -> "list[Recording]":
    from tactile_rt.recording import Recording
    from tactile_rt.recording.layout import DECISIONS, EVENTS, SAMPLES

    folders = [path for path in files if path.is_dir()]
    if folders:
        raise ConfigError(f"{folders[0]} is a folder: {_list_sources(folders[0])}")
    found = [Recording(path) for path in files]
    names = dict.fromkeys(map(_find_source, found))
    if len(names) > 1:
        raise ConfigError(
            f"recordings of several sources: {name_some(names)}; replay one at a time"
        )
    if len(found) == 1:
        return found
    begins = []
    for recording in found:
        if differing := found[0].spec.differences(recording.spec):
            raise ConfigError(f"{recording.path} has another array than {files[0]}: {differing[0]}")
        # A file may have no samples, only late decisions about those of the file before.
        first = next(recording.raw(SAMPLES, DECISIONS, EVENTS), None)
        offset = recording.description.utc_offset_ns
        begins.append(0 if first is None else first.t_ns + offset)
    return [found[k] for k in sorted(range(len(found)), key=begins.__getitem__)]


def _list_sources(folder: Path) -> str:
    from tactile_rt.recording import Recording

    names: dict[str, str] = {}
    for path in sorted(folder.glob("*.mcap")):
        try:
            names.setdefault(_find_source(Recording(path)), path.name)
        except RecordingError:
            continue
    if not names:
        return "name a recording"
    sources = ", ".join(f"{name} ({file} ...)" for name, file in names.items())
    return f"name the files of one source; it has recordings of {sources}"


def _find_source(recording: "Recording") -> str:
    about = recording.description
    return about.session.get("daemon_source", about.source)


def _show_decoding(files: "list[Recording]", options: dict[str, str]) -> None:
    from tactile_rt.recording.checking import compare_decoding

    if len(files) > 1:
        raise ConfigError("packets are decoded again from one file at a time")
    for line in compare_decoding(files[0].path, options).lines():
        typer.echo(line, err=True)


def _parse_speed(text: str) -> str:
    try:
        speed = 0.0 if text == "max" else float(text)
    except ValueError:
        speed = -1.0
    if not (0 < speed < float("inf") or text == "max"):
        raise ConfigError(f"--speed must be max or a multiple of the recorded pace, not {text!r}")
    return repr(speed)


def _parse_codec(codec: str) -> dict[str, str]:
    """Return the `replay:` options that decode raw packets, or {} to replay samples."""
    if codec in ("", RECORDED):
        return {"from": "wire"} if codec else {}
    chosen, _, query = codec.partition("?")
    own = dict(parse_qsl(query.replace("+", "%2B"), keep_blank_values=True))
    if set(own) & {"from", "speed", "codec"}:
        raise ConfigError(f"--codec {codec}: from, speed and codec are not options of a codec")
    return {"from": "wire", "codec": chosen, **own}
