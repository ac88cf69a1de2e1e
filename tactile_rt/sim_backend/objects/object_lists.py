"""Lists of objects that others made: where each is, what it is, who may use it; and getting them.

A list is a CSV file with a row for every mesh file:

    category, name        which object; several rows of one name are its parts
    repository, commit    OWNER/NAME on GitHub, and the state of it
    path, sha256          the file, and what it must hold
    licence               by its SPDX name
    up                    the axis that points up in it, y or z
    scale                 metres in a unit of the file; empty: not known
    shape                 the same for variants, mirror images and copies of one thing, which stay
                          on one side of a split; empty: its own
    kind                  what it is called within its category, such as box; empty: not known

`get_objects` puts them into a folder as `object_sets` reads it, z up, with an `objects.csv` that
says where each is from. No mesh comes with this package.
"""

import csv
import hashlib
import io
import math
import subprocess
import tempfile
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.settings import check_columns, convert, no_such, read_csv
from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM

__all__ = ["get_objects", "read_list"]

RAW = "https://raw.githubusercontent.com"
AT_ONCE = 8  # files that are got at one time
PATIENCE_S = 30.0
Text = Annotated[str, msgspec.Meta(min_length=1)]


class ListedFile(msgspec.Struct, frozen=True):
    """A row of a list: a mesh file, see the module."""

    category: Text
    name: Text
    repository: Annotated[str, msgspec.Meta(pattern=r"^[\w.-]+/[\w.-]+$")]
    commit: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{40}$")]
    path: Text
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    licence: Text
    up: Annotated[str, msgspec.Meta(pattern="^[yz]$")] = "z"
    scale: str = ""
    shape: str = ""
    kind: str = ""


@dataclass(frozen=True)
class ListedObject:
    """An object of a list."""

    files: tuple[ListedFile, ...]

    @property
    def name(self) -> str:
        """Its name, ``category/name``."""
        return f"{self.files[0].category}/{self.files[0].name}"


def shipped_lists() -> tuple[str, ...]:
    """Names of the lists that ship with the package."""
    folder = resources.files(__package__) / "lists"
    return tuple(sorted(p.name[:-4] for p in folder.iterdir() if p.name.endswith(".csv")))


def read_list(name: str) -> tuple[ListedObject, ...]:
    """The objects of the list of this name that ships with the package, or of a .csv file."""
    if Path(name).suffix == ".csv":
        path = Path(name)
    elif name in shipped_lists():
        path = Path(str(resources.files(__package__) / "lists" / f"{name}.csv"))
    else:
        raise ConfigError(f"{no_such('list', name, shipped_lists())} (or give a .csv file)")
    table = read_csv(path)
    known = ListedFile.__struct_fields__
    check_columns(table, known, known[:7])
    files: list[ListedFile] = [convert(row, ListedFile) for row in table.rows]
    for row, file in zip(table.rows, files, strict=True):
        parts = Path(file.path).parts
        if ".." in parts or file.path.startswith("/"):
            raise ConfigError(f"{row.where}: {file.path!r} leads out of its repository")
        if "/" in file.category + file.name or ".." in (file.category, file.name):
            raise ConfigError(f"{row.where}: category and name may hold no / and not be ..")
        try:
            scale = float(file.scale or 1)
        except ValueError:
            scale = math.nan
        if not 0 < scale < math.inf:
            raise ConfigError(f"{row.where}: scale is a number of metres, not {file.scale!r}")
    ordered = sorted(files, key=lambda f: (f.category, f.name))
    grouped = groupby(ordered, key=lambda f: (f.category, f.name))
    return tuple(ListedObject(tuple(group)) for _, group in grouped)


def get_objects(
    objects: Sequence[ListedObject],
    folder: Path,
    clones: Path | None = None,
    progress: Callable[[str], None] = lambda name: None,
) -> dict[str, str]:
    """Get objects into a folder; those that it has already stay.

    Args:
        clones: a folder of clones of the repositories, each by its name, or one clone; None: they
            are fetched from GitHub.

    Returns:
        Why objects could not be got, by their names; nothing of them is in the folder.

    Raises:
        ConfigError: the folder of clones is not there.
    """
    from tactile_rt.sim_backend.objects import mesh_files  # noqa: F401

    if clones is not None and not clones.is_dir():
        raise ConfigError(f"{clones}: no such folder of clones")
    folder.mkdir(parents=True, exist_ok=True)
    missing: dict[str, str] = {}

    def get(thing: ListedObject) -> None:
        path = folder / f"{thing.name}.ply"
        if not path.exists():
            try:
                _get(thing, path, clones)
            except ConfigError as error:
                missing[thing.name] = str(error)
        progress(thing.name)

    with ThreadPoolExecutor(AT_ONCE if clones is None else 1) as pool:
        list(pool.map(get, objects))
    _write_table([thing for thing in objects if thing.name not in missing], folder)
    return dict(sorted(missing.items()))


def _get(thing: ListedObject, path: Path, clones: Path | None) -> None:
    from trimesh.exchange.ply import export_ply

    from tactile_rt.sim_backend.objects.mesh_files import read_parts

    first = thing.files[0]
    with tempfile.TemporaryDirectory() as place:
        parts = []
        for number, file in enumerate(thing.files):
            content = _fetched(file) if clones is None else _cloned(file, clones)
            found = hashlib.sha256(content).hexdigest()
            if found != file.sha256:
                raise ConfigError(
                    f"{file.repository}/{file.path}: is not what the list means (sha256 "
                    f"{found[:12]}... instead of {file.sha256[:12]}...)"
                )
            parts.append(Path(place) / f"{number}{Path(file.path).suffix}")
            parts[-1].write_bytes(content)
        mesh = read_parts(parts, first.up)
    mesh.apply_scale(float(first.scale) if first.scale else SIZE_MM * 1e-3 / mesh.extents.max())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda out: out.write(export_ply(mesh)))


def _fetched(file: ListedFile) -> bytes:
    url = f"{RAW}/{file.repository}/{file.commit}/{quote(file.path)}"
    try:
        with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
            content: bytes = answer.read()
    except (OSError, urllib.error.URLError) as error:
        raise ConfigError(
            f"{url}: cannot be got ({error}); clone {file.repository} and say --clones"
        ) from None
    return content


def _cloned(file: ListedFile, clones: Path) -> bytes:
    """What a clone has at the commit; or its working tree, if it is none or has it not."""
    owner, name = file.repository.split("/")
    places = [clones / name, clones / owner / name, clones / f"{owner}+{name}", clones]
    for place in places:
        if place.is_dir():
            shown = subprocess.run(
                ["git", "-C", str(place), "cat-file", "blob", f"{file.commit}:{file.path}"],
                capture_output=True, check=False,
            )  # fmt: skip
            if shown.returncode == 0:
                return shown.stdout
            if (place / file.path).is_file():
                return (place / file.path).read_bytes()
    raise ConfigError(f"{clones}: no clone of {file.repository} with {file.path}")


def _write_table(objects: Sequence[ListedObject], folder: Path) -> None:
    from tactile_rt.sim_backend.objects.object_sets import FOLDER_TABLE, Origin

    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("category", "name", *Origin.__struct_fields__))
    for thing in objects:
        file = thing.files[0]
        shape = file.shape or file.name
        origin = shape, file.repository, file.licence, file.kind
        table.writerow((file.category, file.name, *origin))
    write_whole(folder / FOLDER_TABLE, lambda out: out.write(text.getvalue().encode()))
