"""`tactile-rt label`: make a sweep set from recordings."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import app, check_folder, check_text
from tactile_rt.cli.options import Force, Json, Seed, argument, option
from tactile_rt.cli.tables import progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError, RecordingError


@app.command(epilog="tactile-rt label mug-1.mcap box-1.mcap touches --by-name")
def label(
    files: Annotated[
        list[Path],
        argument(
            "Recordings (.mcap), then the folder of the sweep set.", metavar="RECORDING... OUT"
        ),
    ],
    labels: Annotated[
        Path | None, option("CSV file of labels. Default: labels.csv beside them.")
    ] = None,
    by_name: Annotated[
        bool, option("Take labels from file names: mug-3.mcap is of a mug.", "--by-name")
    ] = False,
    unlabelled: Annotated[
        bool, option("All touches, to pretrain with --recipe simclr.", "--unlabelled")
    ] = False,
    like: Annotated[
        Path | None, option("Sweep set or model whose sensor and sample period to use.")
    ] = None,
    shares: Annotated[
        str, option("Shares of the objects in train,validation,test.")
    ] = "0.7,0.15,0.15",
    seed: Seed = 0,
    force: Force = False,
    json: Json = None,
) -> None:
    """Make a sweep set from labelled recordings, to train on.

    The columns of labels.csv: recording,start_s,end_s,label and, optionally, object; times are
    seconds since the recording's first sample. Touches that cannot be used are counted on stderr.
    """
    from tactile_rt.recording import labelling
    from tactile_rt.recording.labelled_set import write_set
    from tactile_rt.recording.labels import LABELS
    from tactile_rt.sets.manifest import SPLITS
    from tactile_rt.sim_backend.datasets.inventory import write_sums

    *recordings, folder = files
    if not recordings:
        raise ConfigError(f"no OUT: name the folder of the sweep set after {folder}")
    if (labels is not None) + by_name + unlabelled > 1:
        raise ConfigError("--labels, --by-name and --unlabelled exclude one another: give one")
    check_text(*recordings, folder, labels, like)  # the manifest names them
    parts = _parse_shares(shares)
    _check_out(folder, force)
    check_folder(folder)
    beside = (one.parent / LABELS for one in recordings)
    if json is not None and json.resolve() in {one.resolve() for one in beside}:
        raise ConfigError(f"--json {json} holds the labels that are read: name another")
    if by_name:
        intervals = labelling.intervals_by_name(recordings)
    elif unlabelled:
        intervals = labelling.intervals_of_all(recordings)
    else:
        intervals = labelling.intervals_beside(recordings, labels)
    with progress_bar("finding touches") as update:
        touches = labelling.find_labelled(
            recordings, intervals, like,
            lambda one, seconds: update(description=f"{one.name} {seconds:.0f} s"),
        )  # fmt: skip
    given = {"--labels": labels, "--like": like, "--shares": shares, "--seed": seed}
    words = [w for k, v in given.items() if v is not None for w in (k, str(v))]
    words += [k for k, v in {"--by-name": by_name, "--unlabelled": unlabelled}.items() if v]
    manifest = write_set(folder, touches, parts, seed, shlex.join(words), write_sums)
    for line in touches.left_out:
        typer.echo(line, err=True)
    for name, some in (("validation", "to train"), ("test", "for `tactile-rt eval`")):
        if not manifest.split[name]:
            none = f"no object is left for {name}, which is needed {some}: label more"
            typer.echo(none, err=True)
    sides = ", ".join(f"{name} {len(manifest.split[name])}" for name in SPLITS)
    counts = {
        c: sum(used.interval.label == c for used in touches.used) for c in manifest.categories
    }
    told_as_json(
        {
            "set": folder, "touches": touches.found.total(), "used": len(touches.used),
            "classes": counts, "objects": {name: len(manifest.split[name]) for name in SPLITS},
            "left_out": list(touches.left_out),
        },
        json,
    )  # fmt: skip
    classes = ", ".join(f"{name} {n}" for name, n in counts.items())
    used = f"{len(touches.used)} of {touches.found.total()} touches ({classes})"
    typer.echo(f"{folder}: {used}; objects: {sides}", err=True)


def _parse_shares(text: str) -> tuple[float, ...]:
    from tactile_rt.recording.labelled_set import check_shares

    try:
        shares = tuple(map(float, text.split(",")))
    except ValueError:
        raise ConfigError(
            f"--shares must be TRAIN,VALIDATION,TEST, as 0.7,0.15,0.15, not {text!r}"
        ) from None
    check_shares(shares)
    return shares


def _check_out(folder: Path, force: bool) -> None:
    """Refuse a folder with files, unless ``force`` replaces a recorded set in it."""
    from tactile_rt.sets.manifest import MANIFEST, SweepManifest, object_path
    from tactile_rt.sim_backend.datasets.inventory import SUMS

    if not folder.absolute().parent.is_dir():
        raise ConfigError(f"no folder {folder.parent} to make {folder.name} in")
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not force:
        raise ConfigError(f"{folder} already exists: name another folder, or give --force")
    try:
        manifest = SweepManifest.read(folder)
    except RecordingError:
        manifest = None
    if manifest is None or not manifest.recorded:
        raise ConfigError(
            f"{folder} is not a set of recordings, and is not replaced: name another folder"
        )
    own = {MANIFEST, SUMS, *(object_path(folder, name).name for name in manifest.names())}
    if others := sorted({path.name for path in folder.iterdir()} - own):
        raise ConfigError(
            f"{folder} holds {others[0]!r}, too, and is not replaced: name another folder"
        )
