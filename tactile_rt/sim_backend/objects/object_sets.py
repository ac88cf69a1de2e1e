"""Folders of mesh files: which objects they hold, of which categories, and each by its name.

Two layouts, told apart by what is there:

    ShapeNetCore    <synset>/<object id>/models/model_normalized.obj, and taxonomy.json beside them,
                    whose names the categories get (else they are called by their synset)
    plain           <category>/<object>.obj (or another of `mesh_files.MESH_SUFFIXES`), and
                    perhaps objects.csv, which says which are alike and where they are from

ShapeNet's meshes (Chang et al. 2015) are y-up and mostly sheets that enclose nothing. The published
sweeps took such ones through a convex decomposition of their voxels (Chung et al. 2025); here the
sheets become thin plates.
"""

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import check_columns, convert, read_csv
from tactile_rt.sim_backend.objects.mesh_detail import STANDARD, MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import MESH_SUFFIXES, UNREAD_SUFFIXES
from tactile_rt.sim_backend.objects.meshes import load_mesh
from tactile_rt.sim_backend.objects.solids import TactileObject

SHAPENET_FILE = Path("models") / "model_normalized.obj"
TAXONOMY = "taxonomy.json"
FOLDER_TABLE = "objects.csv"


class Origin(msgspec.Struct, frozen=True):
    """What a folder's `objects.csv` says of an object, in the columns of these names.

    Attributes:
        shape: The same for objects of a category that are variants, mirror images or copies of one
            thing; empty: no other is like it.
        licence: The SPDX name of the licence that it comes under.
        kind: What it is called, where categories are shapes.
        attribution: Whom to name where the licence asks for it.
    """

    shape: str = ""
    source: str = ""
    licence: str = ""
    kind: str = ""
    maker: str = ""
    attribution: str = ""


class ObjectRow(Origin, frozen=True, kw_only=True):
    """A row of a folder's `objects.csv`."""

    category: str
    name: str


@dataclass(frozen=True)
class ObjectSet:
    """The objects of a folder.

    Attributes:
        paths: The file of every object, by its name ``category/object``, in alphabetical order.
    """

    folder: Path
    paths: dict[str, Path]
    detail: MeshDetail = STANDARD
    origins: dict[str, Origin] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of all objects."""
        return tuple(self.paths)

    @cached_property
    def categories(self) -> dict[str, str]:
        """Category of every object, by its name."""
        return {name: name.rpartition("/")[0] for name in self.paths}

    def path(self, name: str) -> Path:
        """An object's file."""
        if name not in self.paths:
            raise ConfigError(f"{self.folder}: holds no object {name!r}")
        return self.paths[name]

    def load(self, name: str) -> TactileObject:
        """An object as convex pieces, called ``category-object``.

        Raises:
            ConfigError: no such object, or its mesh cannot be used; `skipped` has it then.
        """
        path = self.path(name)
        try:
            found = load_mesh(path, self.detail)
        except ConfigError as error:
            self.skipped[name] = str(error)
            raise
        return replace(found, name=name.replace("/", "-"), category=self.categories[name])

    def check(
        self, progress: Callable[[str], None] = lambda name: None
    ) -> dict[str, TactileObject]:
        """Load every object once: the usable ones, without pieces; see `skipped`."""
        found = {}
        for name in self.names:
            progress(name)
            with suppress(ConfigError):  # noted by `load`
                found[name] = replace(self.load(name), pieces=())
        return found


def open_objects(where: str | Path, detail: MeshDetail = STANDARD) -> ObjectSet:
    """The objects in a folder.

    Args:
        detail: how meshes become pieces; in a ShapeNet folder y is up, unless it says otherwise.
    """
    folder = Path(where)
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder of objects")
    shapenet = sorted(folder.glob(f"*/*/{SHAPENET_FILE.as_posix()}"))
    if shapenet:
        called = _taxonomy(folder)
        named = [(called.get(p.parents[2].name, p.parents[2].name), p.parents[1].name, p)
                 for p in shapenet]  # fmt: skip
        return ObjectSet(folder, _named(folder, named), replace(detail, up=detail.up or "y"))
    files = sorted(folder.glob("[!.]*/[!.]*"))
    plain = [p for p in files if p.suffix.lower() in MESH_SUFFIXES]
    read = {p.with_suffix("") for p in plain}
    unread = [p for p in files if p.suffix.lower() in UNREAD_SUFFIXES]
    plain += [p for p in unread if p.with_suffix("") not in read]  # which are named, and why
    if not plain:
        raise ConfigError(
            f"{folder}: holds no objects: expected category/object.obj (or "
            f"{', '.join(MESH_SUFFIXES[1:])}), or ShapeNet's synset/id/{SHAPENET_FILE.as_posix()}"
        )
    named = [(p.parent.name, p.stem, p) for p in plain]
    return ObjectSet(folder, _named(folder, named), detail, dict(read_table(folder)))


def _named(folder: Path, found: list[tuple[str, str, Path]]) -> dict[str, Path]:
    """Files by names that files can have."""
    paths: dict[str, Path] = {}
    for category, stem, path in found:
        name = f"{_safe(category)}/{_safe(stem)}"
        if name in paths:
            raise ConfigError(
                f"{folder}: {paths[name].relative_to(folder)} and {path.relative_to(folder)} would "
                "have the same name: rename one"
            )
        paths[name] = path
    return dict(sorted(paths.items()))


def read_table(folder: Path) -> dict[str, ObjectRow]:
    """Read the rows of a folder's table by their objects' names; none without a table."""
    path = folder / FOLDER_TABLE
    if not path.exists():
        return {}
    table = read_csv(path)
    known = ("category", "name", *Origin.__struct_fields__)
    check_columns(table, known, known[:2])
    rows: list[ObjectRow] = [convert(row, ObjectRow) for row in table.rows]
    return {f"{_safe(row.category)}/{_safe(row.name)}": row for row in rows}


def _safe(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name.strip())


def _taxonomy(folder: Path) -> dict[str, str]:
    """Name of every synset: the first of its synonyms."""
    path = folder / TAXONOMY
    if not path.exists():
        return {}
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {str(e["synsetId"]): str(e["name"]).split(",")[0] for e in entries}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is not ShapeNet's taxonomy: {error!r}") from None
