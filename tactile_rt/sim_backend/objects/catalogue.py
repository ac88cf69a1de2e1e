"""Objects by name, as convex pieces: parametric objects by category, and mesh files.

`make_object` generates the n-th mug, bottle, ...; `load_object` also reads a mesh file. "mug-17" is
built by its kind's one plan; "varied-mug-17" by any plan, see `shapes.varied`. Other packages may
add categories (`core.packages`), which have one plan each and are used only where they are named.
"""

import difflib
import logging
import re
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import trimesh

from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.sim_backend.objects.mesh_detail import STANDARD, MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import MESH_SUFFIXES
from tactile_rt.sim_backend.objects.meshes import load_mesh
from tactile_rt.sim_backend.objects.shapes import (
    furniture,
    mixtures,
    outdoors,
    tools,
    vehicles,
    vessels,
)
from tactile_rt.sim_backend.objects.shapes import varied as varied_shapes
from tactile_rt.sim_backend.objects.solids import TactileObject, fit_unit_box, stretch_pieces

__all__ = [
    "CATEGORIES",
    "OUTLIERS",
    "VARIED",
    "WITHHELD",
    "TactileObject",
    "added_categories",
    "load_object",
    "make_object",
    "promised_object",
]

log = logging.getLogger("tactile_rt.sim_backend.objects")
_Builder = Callable[[np.random.Generator], list[trimesh.Trimesh]]

_KNOWN: dict[str, _Builder] = {
    "beehive": outdoors.beehive,
    "birdcage": tools.birdcage,
    "bottle": vessels.bottle,
    "bowl": vessels.bowl,
    "cactus": outdoors.cactus,
    "car": vehicles.car,
    "castle": outdoors.castle,
    "chair": furniture.chair,
    "dumbbell": tools.dumbbell,
    "gear": tools.gear,
    "grapes": outdoors.grapes,
    "hourglass": tools.hourglass,
    "house": outdoors.house,
    "jack": tools.jack,
    "ladder": furniture.ladder,
    "lamp": furniture.lamp,
    "mug": vessels.mug,
    "mushroom": outdoors.mushroom,
    "pagoda": outdoors.pagoda,
    "plane": vehicles.plane,
    "pumpkin": outdoors.pumpkin,
    "snowman": outdoors.snowman,
    "spring": tools.spring,
    "table": furniture.table,
}

# each resembles a category to train on: lamp, chair, mug, car
_UNKNOWN: dict[str, _Builder] = {
    "goblet": vessels.goblet,
    "stool": furniture.stool,
    "teapot": vessels.teapot,
    "truck": vehicles.truck,
}

# objects of no kind, which a model may learn to refuse
_OUTLIERS: dict[str, _Builder] = {
    "assembly": mixtures.assembly,
    "medley": partial(mixtures.medley, builders=tuple(_KNOWN.values())),
}

_BUILDERS = _KNOWN | _UNKNOWN | _OUTLIERS

VARIED = "varied-"  # prefix of a kind's name
PLAIN_SHARE = 0.25  # share of varied objects with the kind's only plan, stretched
STRETCH = 1.25  # largest factor along each axis

CATEGORIES: tuple[str, ...] = tuple(sorted(_KNOWN))  # for training
WITHHELD: tuple[str, ...] = tuple(sorted(_UNKNOWN))  # never trained on: new to a classifier
OUTLIERS: tuple[str, ...] = tuple(_OUTLIERS)  # of no kind: a model may learn to refuse them


def added_categories() -> tuple[str, ...]:
    """Return the names of the categories that other packages add."""
    return packages.added_names(packages.OBJECTS)


def make_object(category: str, index: int) -> TactileObject:
    """Generate object `index` (0 or more) of a category, the same on every machine."""
    kind = _find_kind(category, index)
    # crc32 because hash() of a string differs from one process to the next
    rng = np.random.default_rng([zlib.crc32(category.encode()), index])
    build: _Builder = _BUILDERS.get(kind) or packages.import_addition(packages.OBJECTS, kind)
    if kind == category:
        pieces = build(rng)
    else:
        plain = rng.random() < PLAIN_SHARE
        pieces = build(rng) if plain else varied_shapes.BUILDERS.get(kind, build)(rng)
        pieces = stretch_pieces(pieces, STRETCH ** rng.uniform(-1, 1, 3))
    return TactileObject(f"{category}-{index}", kind, fit_unit_box(pieces))


def load_object(target: str, detail: MeshDetail = STANDARD) -> TactileObject:
    """Load an object by name ("mug-17"; "mug" is "mug-0") or from a mesh file."""
    return promised_object(target, detail)()


def promised_object(target: str, detail: MeshDetail = STANDARD) -> Callable[[], TactileObject]:
    """Return a factory that makes the object of a name or mesh file when called.

    A mesh is read at once, so an unknown name or an unusable mesh raises its error here.
    """
    if Path(target).suffix or "/" in target or "\\" in target:
        mesh = load_mesh(Path(target), detail)
        if mesh.made_by == "plates":
            log.warning("%s: not closed, taken as plates", target)
        return lambda: mesh
    match = re.fullmatch(r"(.+)-(\d+)", target)
    category, index = (match[1], int(match[2])) if match else (target, 0)
    _find_kind(category, index)
    return cache(partial(make_object, category, index))


def _find_kind(category: str, index: int) -> str:
    """Return a category's kind; raise a `ConfigError` for an unknown category or negative index."""
    kind = category.removeprefix(VARIED)
    if kind not in _BUILDERS and kind not in (added := added_categories()):
        near = difflib.get_close_matches(kind, (*_BUILDERS, *added), n=1, cutoff=0.3)
        prefix = VARIED if category.startswith(VARIED) else ""
        known = name_some([*CATEGORIES, *WITHHELD, *OUTLIERS, *added], 8)
        hint = f"did you mean {prefix + near[0]!r}?" if near else f"there are {known}"
        raise ConfigError(
            f"no object called {category!r}; {hint} (or a mesh file: {', '.join(MESH_SUFFIXES)})"
        )
    if index < 0:
        raise ConfigError(f"object {category}-{index}: the index must be 0 or more")
    return kind
