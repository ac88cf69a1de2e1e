"""Folders of mesh files: their objects by category and name.

The files that exist decide between two layouts:

    ShapeNetCore    <synset>/<object id>/models/model_normalized.obj, and taxonomy.json beside them,
                    which names the categories (else their synsets do); or a JSON file of labels
                    does, as the published ones divide 53 synsets into 117
    plain           <category>/<object>.obj (or another of `mesh_files.MESH_SUFFIXES`), and
                    optionally objects.csv, with sources and the objects that are alike

ShapeNet's meshes (Chang et al. 2015) are y-up and mostly sheets that enclose nothing. The published
sweeps use convex decompositions of their voxels (Chung et al. 2025); here the sheets become thin
plates.
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
from tactile_rt.core.settings import check_columns, convert, read_csv, read_text
from tactile_rt.sim_backend.objects.mesh_detail import STANDARD, MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import MESH_SUFFIXES, UNREAD_SUFFIXES
from tactile_rt.sim_backend.objects.meshes import load_mesh
from tactile_rt.sim_backend.objects.solids import TactileObject

SHAPENET_FILE = Path("models") / "model_normalized.obj"
TAXONOMY = "taxonomy.json"
FOLDER_TABLE = "objects.csv"


class Origin(msgspec.Struct, frozen=True):
    """The origin of an object, from the columns of these names in a folder's `objects.csv`.

    Attributes:
        shape: The same for objects of a category that are variants, mirror images or copies of one
            thing; empty if no other is like it.
        licence: The SPDX name of the object's licence.
        kind: The object's kind within its category, where categories are shapes.
        attribution: The credit that the licence demands.
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
    """The objects of a folder of mesh files.

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
        """Names of all objects."""
        return tuple(self.paths)

    @cached_property
    def categories(self) -> dict[str, str]:
        """Category of every object, by its name."""
        return {name: name.rpartition("/")[0] for name in self.paths}

    def path(self, name: str) -> Path:
        """Return the path of an object's mesh file."""
        if name not in self.paths:
            raise ConfigError(f"{self.folder}: holds no object {name!r}")
        return self.paths[name]

    def load(self, name: str) -> TactileObject:
        """Load an object as convex pieces, named ``category-object``.

        Raises:
            ConfigError: no such object, or its mesh cannot be used: then `skipped` has the reason.
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
        """Load every object; return usable ones without pieces, and note others in `skipped`."""
        found = {}
        for name in self.names:
            progress(name)
            with suppress(ConfigError):  # noted by `load`
                found[name] = replace(self.load(name), pieces=())
        return found


def open_objects(
    where: str | Path, detail: MeshDetail = STANDARD, labels: str | Path = ""
) -> ObjectSet:
    """Find the mesh objects in a folder of either layout.

    Args:
        detail: how meshes become pieces; in a ShapeNet folder y is up, unless `detail.up` is set.
        labels: JSON file with the label of each ShapeNet object to use, a name or number:
            ``{"02958343/1a0b": 17}``; its category is then ``label-017``. "" for none.
    """
    folder = Path(where)
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder of objects")
    shapenet = sorted(folder.glob(f"*/*/{SHAPENET_FILE.as_posix()}"))
    if shapenet:
        named = [(p.parents[2].name, p.parents[1].name, p) for p in shapenet]
        if labels:
            named = _relabel(named, Path(labels))
        else:
            titles = _read_taxonomy(folder)
            named = [(titles.get(synset, synset), name, p) for synset, name, p in named]
        return ObjectSet(folder, _name_files(folder, named), replace(detail, up=detail.up or "y"))
    if labels:
        raise ConfigError(f"{folder} is not ShapeNetCore; `labels` are for its objects alone")
    files = sorted(folder.glob("[!.]*/[!.]*"))
    plain = [p for p in files if p.suffix.lower() in MESH_SUFFIXES]
    read = {p.with_suffix("") for p in plain}
    unread = [p for p in files if p.suffix.lower() in UNREAD_SUFFIXES]
    plain += [p for p in unread if p.with_suffix("") not in read]  # `load` refuses these
    if not plain:
        raise ConfigError(
            f"{folder}: holds no objects: expected category/object.obj (or "
            f"{', '.join(MESH_SUFFIXES[1:])}), or ShapeNet's synset/id/{SHAPENET_FILE.as_posix()}"
        )
    named = [(p.parent.name, p.stem, p) for p in plain]
    return ObjectSet(folder, _name_files(folder, named), detail, dict(read_table(folder)))


def _relabel(named: list[tuple[str, str, Path]], path: Path) -> list[tuple[str, str, Path]]:
    """Replace the synsets of objects by labels in a JSON file; omit unlabelled objects."""
    try:
        labels = msgspec.json.decode(read_text(path), type=dict[str, int | str])
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{path} is not {{SYNSET/OBJECT: LABEL}} in JSON: {error}") from None
    found = []
    for synset, name, file in named:
        label = labels.get(f"{synset}/{name}")
        if label is not None:
            category = label if isinstance(label, str) else f"label-{label:03d}"
            found.append((category, name, file))
    if not found:
        raise ConfigError(f"{path} has no label of any object, such as {named[0][0]}/{named[0][1]}")
    return found


def _name_files(folder: Path, found: list[tuple[str, str, Path]]) -> dict[str, Path]:
    """Return the files by object name, in which special characters are replaced."""
    paths: dict[str, Path] = {}
    for category, stem, path in found:
        name = f"{_clean_name(category)}/{_clean_name(stem)}"
        if name in paths:
            raise ConfigError(
                f"{folder}: {paths[name].relative_to(folder)} and {path.relative_to(folder)} would "
                "have the same name: rename one"
            )
        paths[name] = path
    return dict(sorted(paths.items()))


def read_table(folder: Path) -> dict[str, ObjectRow]:
    """Read the rows of a folder's `objects.csv` by object name; empty without one."""
    path = folder / FOLDER_TABLE
    if not path.exists():
        return {}
    table = read_csv(path)
    known = ("category", "name", *Origin.__struct_fields__)
    check_columns(table, known, known[:2])
    rows: list[ObjectRow] = [convert(row, ObjectRow) for row in table.rows]
    return {f"{_clean_name(row.category)}/{_clean_name(row.name)}": row for row in rows}


def _clean_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name.strip())


def _read_taxonomy(folder: Path) -> dict[str, str]:
    """Read the category name of every ShapeNet synset: the first of its synonyms."""
    path = folder / TAXONOMY
    if not path.exists():
        return {}
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        return {str(e["synsetId"]): str(e["name"]).split(",")[0] for e in entries}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path} is not ShapeNet's taxonomy: {error!r}") from None
