"""What is swept past the whiskers: a named thing made of convex pieces.

`make_object` draws the n-th mug, bottle, ...; `load_object` also takes a mesh file.
"""

import difflib
import re
import zlib
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
import trimesh

from tactile_rt.sim_backend.objects.mesh_detail import STANDARD, MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import MESH_SUFFIXES
from tactile_rt.sim_backend.objects.meshes import load_mesh
from tactile_rt.sim_backend.objects.shapes import furniture, outdoors, tools, vehicles, vessels
from tactile_rt.sim_backend.objects.solids import TactileObject, normalised
from tactile_rt.stream import ConfigError

__all__ = [
    "CATEGORIES",
    "WITHHELD",
    "TactileObject",
    "load_object",
    "make_object",
    "promised_object",
]

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

# each a neighbour of a category that is trained: of lamp, chair, mug, car
_UNKNOWN: dict[str, _Builder] = {
    "goblet": vessels.goblet,
    "stool": furniture.stool,
    "teapot": vessels.teapot,
    "truck": vehicles.truck,
}

_BUILDERS = _KNOWN | _UNKNOWN

CATEGORIES: tuple[str, ...] = tuple(sorted(_KNOWN))  # for training
WITHHELD: tuple[str, ...] = tuple(sorted(_UNKNOWN))  # never trained: what is new to a classifier


def make_object(category: str, index: int) -> TactileObject:
    """Instance `index` (0 or more) of a category: the same one every time, everywhere."""
    _check(category, index)
    rng = np.random.default_rng([zlib.crc32(category.encode()), index])
    return TactileObject(f"{category}-{index}", category, normalised(_BUILDERS[category](rng)))


def load_object(target: str, detail: MeshDetail = STANDARD) -> TactileObject:
    """The object named "mug-17" or "mug" (the same as "mug-0"), or the one in a mesh file."""
    return promised_object(target, detail)()


def promised_object(target: str, detail: MeshDetail = STANDARD) -> Callable[[], TactileObject]:
    """What gives the object that `load_object` would, made when it is first asked for.

    That a name means nothing, or that a mesh cannot be used, is told at once: a mesh is read here.
    """
    if Path(target).suffix or "/" in target or "\\" in target:
        mesh = load_mesh(Path(target), detail)
        return lambda: mesh
    match = re.fullmatch(r"(.+)-(\d+)", target)
    category, index = (match[1], int(match[2])) if match else (target, 0)
    _check(category, index)
    return cache(partial(make_object, category, index))


def _check(category: str, index: int) -> None:
    if category not in _BUILDERS:
        near = difflib.get_close_matches(category, _BUILDERS, n=1, cutoff=0.3)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        raise ConfigError(
            f"no object called {category!r}{hint}; there are {', '.join(CATEGORIES)}; "
            f"{', '.join(WITHHELD)} (withheld from training); "
            f"and mesh files ending in {', '.join(MESH_SUFFIXES)}"
        )
    if index < 0:
        raise ConfigError(f"object {category}-{index}: the index must be 0 or more")
    # crc32 because hash() of a string differs from one process to the next
