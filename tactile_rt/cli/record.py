"""`tactile-rt record`, `recover` and `convert`: make, repair and convert recordings."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tactile_rt.cli.app import app, check_is_mcap, check_new, check_output, leaving, open_url
from tactile_rt.cli.options import Force, Json, Seconds, Url, argument, option
from tactile_rt.cli.tables import progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import no_such

if TYPE_CHECKING:
    from tactile_rt.core.stream import Source
    from tactile_rt.recording import StreamWriter

POLL_S = 0.1
TELL_S = 1.0


@app.command(epilog="tactile-rt record replay:demo touches.mcap --seconds 5")
def record(
    source: Url,
    output: Annotated[Path, argument("The recording to write, .mcap.")],
    seconds: Seconds = None,
    note: Annotated[list[str] | None, option("Note to store: NAME=VALUE; may be repeated.")] = None,
    force: Force = False,
    json: Json = None,
) -> None:
    """Record a source's samples, raw packets and device health.

    A line a second goes to stderr. Ctrl-C ends it and leaves a whole file; `tactile-rt recover`
    repairs the file of a recorder that was killed.
    """
    from tactile_rt.recording import StreamWriter

    check_output(output)
    check_is_mcap(output)
    check_new(output, force)  # before a device is opened and started
    session = _parse_notes(note or [])
    with (
        open_url(source) as opened,
        StreamWriter(output, opened, url=source, session=session, force=force) as writer,
        leaving(seconds),
    ):
        _copy(opened, writer)
    results = {
        "file": output, "samples": writer.stats.samples,
        "packets": writer.stats.packets, "bytes": writer.stats.bytes,
        "corrupt": opened.stats.corrupt, "missing": opened.stats.missing,
        "dropped_samples": writer.stats.dropped_samples,
        "dropped_packets": writer.stats.dropped_packets,
    }  # fmt: skip
    if not told_as_json(results, json):
        typer.echo(f"{output}: {_describe_progress(opened, writer)}")


def _copy(source: "Source", writer: "StreamWriter") -> None:
    """Record until the stream ends; print a line of progress every second."""
    from tactile_rt.core.stream import EndOfStream

    tell_at = time.monotonic() + TELL_S
    while True:
        try:
            chunk = source.read(POLL_S)
        except EndOfStream:
            return
        if chunk is not None:
            writer.push(chunk)
        if time.monotonic() >= tell_at:
            tell_at += TELL_S
            typer.echo(_describe_progress(source, writer), err=True)


def _describe_progress(source: "Source", writer: "StreamWriter") -> str:
    done, stats = writer.stats, source.stats
    health = getattr(source, "health", None)
    parts = [f"{health.state}"] if health is not None else []
    parts.append(f"{done.samples} samples")
    if writer.about.wire:
        parts.append(f"{done.packets} packets")
    parts.append(f"{done.bytes / 1e6:.1f} MB")
    if stats.corrupt or stats.missing:
        parts.append(f"lost on the wire: {stats.corrupt} damaged, {stats.missing} missing")
    if done.dropped_samples or done.dropped_packets:
        parts.append(
            f"disk too slow: {done.dropped_samples} samples, {done.dropped_packets} packets dropped"
        )
    return ", ".join(parts)


def _parse_notes(given: list[str]) -> dict[str, str]:
    notes = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name or name == "crc32":
            raise ConfigError(f"--note must be NAME=VALUE, not {pair!r}")
        notes[name] = value
    return notes


@app.command(epilog="tactile-rt recover touches.mcap")
def recover(
    recording: Annotated[Path, argument("Recording that was cut short or is damaged.")],
    out: Annotated[
        Path | None, option("File to write. Default: NAME.recovered.mcap beside it.")
    ] = None,
    force: Force = False,
    json: Json = None,
) -> None:
    """Repair a damaged recording in a new file."""
    from tactile_rt.recording import Recording
    from tactile_rt.recording import recover as repair

    check_output(out)
    with progress_bar(f"reading {recording}"):
        made = repair(recording, out, force)
        n, first, last = 0, 0, 0
        for chunk in Recording(made):
            first = first if n else int(chunk.t_ns[0])
            n, last = n + len(chunk), int(chunk.t_ns[-1])
    whole = made == recording
    results = {"file": made, "whole": whole, "samples": n, "seconds": (last - first) / 1e9}
    if told_as_json(results, json):
        return
    if whole:
        typer.echo(f"{recording} is whole: nothing to do")
    else:
        typer.echo(f"{made}: {n} samples, {(last - first) / 1e9:.1f} s")


@app.command(epilog="tactile-rt convert touches.mcap touches.npz")
def convert(
    files: Annotated[
        list[Path],
        argument(
            "Recordings (.mcap), then a .npz, .csv or .h5 file or a folder.",
            metavar="RECORDING... OUTPUT",
        ),
    ],
    to: Annotated[str, option("Write a folder of this kind: ros2 or lerobot.")] = "",
    fps: Annotated[int, option("With lerobot: rows per second.", min=1, max=1000)] = 30,
    task: Annotated[str, option("With lerobot: the task. Default: the note `task`.")] = "",
    video: Annotated[
        list[str] | None,
        option(
            "With lerobot: a camera's film, NAME=FILE or NAME=FILE@SECONDS (its start after "
            "the first sample); may be repeated."
        ),
    ] = None,
    force: Force = False,
    json: Json = None,
) -> None:
    """Convert a recording to npz, CSV, HDF5, ROS 2 or LeRobot.

    A .npz or .h5 holds samples, description, decisions, events and health; a .csv and a LeRobot
    dataset hold the samples; a ROS 2 bag also holds the raw packets. With --to, OUTPUT may be left
    out: RECORDING-ros2, RECORDING-lerobot.
    """
    from tactile_rt.recording.conversion import convert as convert_file

    if to:
        with progress_bar(f"writing for {to}"):
            results = _write_folder(to, files, fps, task, video or [], force)
        _print_results(results, json)
        return
    if len(files) != 2:
        raise ConfigError("name a recording and the file to write, or give --to")
    recording, output = files
    check_new(output, force)
    with progress_bar(f"converting {recording}"):
        samples = convert_file(recording, output)
    _print_results({"output": output, "samples": samples}, json)


def _print_results(results: dict[str, Any], json: Path | None) -> None:
    """Print the output's path and the numbers written, or write them as JSON."""
    if not told_as_json(results, json):
        counts = ", ".join(f"{n} {what}" for what, n in results.items() if what != "output")
        typer.echo(f"{results['output']}: {counts}")


# A file by which --force recognises an earlier output of each form, which it may replace.
MARKS = {"ros2": "metadata.yaml", "lerobot": "meta/info.json"}


def _write_folder(
    to: str, files: list[Path], fps: int, task: str, video: list[str], force: bool
) -> dict[str, Any]:
    """Write a ROS 2 bag or a LeRobot dataset. Return its path and the numbers written."""
    from tactile_rt.recording import Recording
    from tactile_rt.recording.as_lerobot import write_dataset
    from tactile_rt.recording.conversion import write_bag
    from tactile_rt.recording.lerobot_meta import film_of

    if to not in MARKS:
        raise ConfigError(no_such("form", to, sorted(MARKS)))
    *recordings, output = files if len(files) > 1 else [*files, files[0].with_suffix("")]
    if len(files) == 1:
        output = output.with_name(f"{output.name}-{to}")
    if not output.parent.is_dir():
        raise ConfigError(f"no folder {output.parent} to write {output.name} in")
    if output.exists():
        if not force:
            raise ConfigError(f"{output} already exists: name another folder, or give --force")
        if not (output / MARKS[to]).is_file():
            raise ConfigError(f"{output} already exists, and was not made by --to {to}")
    read = [Recording(path) for path in recordings]
    if to == "ros2":
        if task or video:
            raise ConfigError("--task and --video go with --to lerobot")
        return {"output": output, "samples": write_bag(read, output)}
    films = [film_of(one) for one in video]
    n = write_dataset(read, output, fps, task, films)
    return {"output": output, "samples": n, "episodes": len(read)}
