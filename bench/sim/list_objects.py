"""Make the list `real` of objects, from clones of the repositories that it names.

What is of which kind is said here, by hand, as patterns of file names. What is of the same shape is
measured: two objects of a kind are variants, mirror images or copies of each other if the distances
between random pairs of points of their surfaces, and the heights of these points, are spread alike.
Scans and parts of the same YCB object are told by their names.

Run: python -m bench.sim.list_objects CLONES [--out FILE]
"""

import argparse
import csv
import hashlib
import re
import subprocess
import tempfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.sim_backend.objects.mesh_files import read_parts

OUT = Path("tactile_rt/sim_backend/objects/lists/real.csv")
PAIRS, BINS = 40_000, 48
ALIKE = 0.12  # of all pairs and heights that may lie in other bins
YCB = re.compile(r"^\d+_|^plastic_|_base$")


@dataclass(frozen=True)
class Repository:
    """Where objects come from: files, by a pattern that names them, and what holds of all."""

    name: str
    pattern: str
    licence: str
    up: str
    scale: str = ""


REPOSITORIES = (
    *(
        Repository(
            f"KayKit-Game-Assets/KayKit-{pack}",
            r".*/obj/(.*/)?(?P<name>[^/]+)\.obj",
            "CC0-1.0",
            "y",
        )
        for pack in (
            "City-Builder-Bits-1.0", "Dungeon-Remastered-1.0", "Furniture-Bits-1.0",
            "Halloween-Bits-1.0", "Medieval-Hexagon-Pack-1.0", "Prototype-Bits-1.0",
            "Restaurant-Bits-1.0", "Space-Base-Bits-1.0",
        )
    ),
    Repository(
        "openai/robogym", r"robogym/assets/stls/ycb/(?P<name>[^/]+)/[^/]+\.stl", "MIT", "z", "1"
    ),
    Repository(
        "openai/robogym", r"robogym/assets/stls/holdouts/chess/visual/scad_(?P<name>[^/]+)\.stl",
        "MIT", "z",
    ),
    Repository("openai/robogym", r"robogym/assets/stls/geom/(?P<name>[^/]+)\.stl", "MIT", "z"),
    Repository(
        "ChenEating716/pybullet-URDF-models",
        r"urdf_models/models/(?P<name>[^/]+)/textured\.obj", "MIT", "z", "1",
    ),
)  # fmt: skip

# Of each kind: the names that belong to it, whole. Of colours one is enough.
KINDS = {
    "ball": r"053_mini_soccer_ball|05[4-8]_\w+|017_orange|plastic_orange|013_apple|plastic_apple"
    r"|018_plum|plastic_plum|015_peach|plastic_peach|sphere1280",
    "barrel": r"barrel\w*|Barrel\w+|keg\w*|bucket_\w+",
    "bed": r"bed_\w+",
    "bench": r"bench\w*|pallet|Pallet\w+",
    "book": r"book_\d|book_s\w+|menu",
    "bottle": r"bottle_\w+|ketchup|mustard|\w*mustard_bottle|\w*bleach_cleanser|\w*windex_bottle"
    r"|shampoo|conditioner|cleanser|repellent|magic_clean|glue_\d|correction_fluid",
    "bowl": r"bowl|bowl_small|\w*_bowl|stew_bowl|024_bowl",
    "box": r"\d+_\w+_box|\w+_box|Box_\w|box_(large|small|A|B)|box_stacked|suger_\d|orion_pie"
    r"|\w+_tea|cargo_[AB]|containers_\w|036_wood_block|061_foam_brick|clear_box_\d|cube"
    r"|Primitive_Cube",
    "cabinet": r"cabinet_\w+|kitchencabinet\w*|kitchencounter_\w+|fridge_[AB]|oven|stove_\w+"
    r"|dumpster",
    "can": r"\d+_\w+_can|Can_\w|potato_chip_\d",
    "candle": r"candle\w*|torch\w*",
    "car": r"car_(hatchback|police|sedan|stationwagon|taxi)|spacetruck|spacetruck_large"
    r"|spacetruck_trailer",
    "chair": r"chair_[ABC]|chair_[AB]_wood|chair|armchair\w*|couch\w*",
    "chess piece": r"chess_\w+",
    "chest": r"chest|chest_gold|trunk_\w+|coffin|coffin_decorated",
    "clamp": r"\w*_clamp",
    "crate": r"crate\w*|crates_stacked|cargo_[AB]_packed",
    "cup": r"065-\w_cups|\w+_cup|pen_container_1",
    "door": r"door_\w|Door_\w\w*|oven_door|fridge_\w+_door\w*|wall_doorway_door",
    "fence": r"fence\w*|barrier\w*|dishrack|towelrail",
    "food": r"food_\w+",
    "grave": r"grave_\w+|gravemarker_\w|gravestone|plaque\w*|shrine\w*|crypt",
    "hammer": r"048_hammer|\w+_hammer\w*|035_power_drill|power_drill",
    "hill": r"hill_\w+|hills_[ABC]|mountain_[ABC]|mountain_[ABC]_grass(_trees)?|hills_[ABC]_trees",
    "house": r"building_[A-H]_withoutBase|building_(home_[AB]|church|tavern|barracks|market"
    r"|blacksmith"
    r"|lumbermill|mine|castle|archeryrange|watermill)_blue|basemodule_\w|tent",
    "jar": r"jar_\w+",
    "lamp": r"lamp_\w+|lantern_\w+|post_lantern|streetlight|trafficlight_\w|post_skull",
    "lego": r"073-\w_lego_duplo",
    "marker": r"\w+_marker",
    "pan": r"pan_\w+|027_skillet|pot_\w+|stew_pot|028_skillet_lid|lid_\w+",
    "picture": r"pictureframe_\w+",
    "pillar": r"pillar\w*|column\w*|Pillar_\w|Primitive_Pillar|fence_pillar\w*",
    "skull": r"\w*skull\w*|bone_\w|ribcage",
    "slope": r"Primitive_Slope\w*|terrain_\w+|hex_grass_sloped\w*",
    "tile": r"hex_\w+|floor_\w+|Floor\w*|Primitive_Floor\w*",
    "toy plane": r"072-\w_toy_airplane",
    "tool": r"042_adjustable_wrench|scissors|037_scissors|038_padlock|key\w*|\w*stapler_\d",
    "plate": r"plate|plate_\w+|\w+_plate|\w+_plate_\d|029_plate|cuttingboard|coin\w*|Coin_\w",
    "pumpkin": r"pumpkin_\w+",
    "rock": r"rock_\w+|rocks_\w|resource_stone|rubble_\w+",
    "screwdriver": r"\w+_screwdriver",
    "shelf": r"shelf_\w+|shelves|bookcase\w*",
    "spoon": r"\w*spoon|\w*fork|\w*knife|\w*spatula",
    "stairs": r"stairs\w*|Primitive_Stairs\w*",
    "stool": r"chair_stool\w*|stool",
    "table": r"table_\w+|kitchentable_\w+",
    "tower": r"building_tower_(A|B|base|catapult|cannon)_blue|watertower|building_windmill_blue"
    r"|windturbine_\w+|structure_\w+|lander_\w|drill_structure",
    "tree": r"tree\w+|cactus_\w+|bush",
    "wall": r"wall\w*|Wall\w*|Primitive_Wall\w*|Primitive_Window|Primitive_Doorway|arch\w*",
}
ENOUGH = 8  # shapes in a kind that can be learnt


def main() -> None:
    """Write the list, and say how many of each kind there are."""
    parser = argparse.ArgumentParser(prog="python -m bench.sim.list_objects")
    parser.add_argument("clones", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    asked = parser.parse_args()
    rows: list[dict[str, str]] = []
    spread: dict[str, list[tuple[str, NDArray[np.float64]]]] = defaultdict(list)
    shape: dict[tuple[str, str], str] = {}
    for repository in REPOSITORIES:
        for name, files in _objects(asked.clones, repository):
            kind = next((k for k, known in KINDS.items() if re.fullmatch(known, name)), None)
            if kind is None:
                continue
            kind, name = kind.replace(" ", "_"), f"{_short(repository)}-{name}"
            try:
                seen = _spread(files, repository.up)
            except Exception as error:
                print(f"{name}: {error}")  # noqa: T201
                continue
            known_shape = _known(name, seen, spread[kind])
            spread[kind].append((known_shape, seen))
            shape[kind, name] = known_shape
            rows += [
                {
                    "category": kind,
                    "name": name,
                    "repository": repository.name,
                    "commit": _git(asked.clones, repository, "rev-parse", "HEAD").decode().strip(),
                    "path": path,
                    "sha256": hashlib.sha256(content).hexdigest(),
                    "licence": repository.licence,
                    "up": repository.up,
                    "scale": repository.scale,
                    "shape": known_shape,
                }
                for path, content in files.items()
            ]
    shapes = Counter(kind for kind, _ in {(k, s) for (k, _), s in shape.items()})
    rows.sort(key=lambda row: (row["category"], row["name"], row["path"]))
    with asked.out.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    for kind, number in sorted(shapes.items()):
        total = sum(k == kind for k, _ in shape)
        print(f"{kind:12s} {total:3d} objects, {number:3d} shapes")  # noqa: T201
    enough = sum(number >= ENOUGH for number in shapes.values())
    print(f"{enough} kinds of {ENOUGH} shapes or more, {len(shapes)} in all")  # noqa: T201


def _short(repository: Repository) -> str:
    return (
        repository.name.split("/")[1]
        .split("-Bits")[0]
        .removeprefix("KayKit-")
        .split("-")[0]
        .lower()
    )


def _git(clones: Path, repository: Repository, *command: str) -> bytes:
    place = str(clones / repository.name.split("/")[1])
    return subprocess.run(["git", "-C", place, *command], capture_output=True, check=True).stdout


def _objects(clones: Path, repository: Repository) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Name and files of every object of a repository that is there."""
    paths = _git(
        clones, repository, "-c", "core.quotePath=off", "ls-tree", "-r", "--name-only", "HEAD"
    )
    found: dict[str, dict[str, bytes]] = defaultdict(dict)
    for path in paths.decode().splitlines():
        match = re.fullmatch(repository.pattern, path)
        if match:
            try:
                content = _git(clones, repository, "cat-file", "blob", f"HEAD:{path}")
            except subprocess.CalledProcessError:
                continue  # a clone may lack large files
            found[match["name"]][path] = content
    yield from sorted(found.items())


def _spread(files: dict[str, bytes], up: str) -> NDArray[np.float64]:
    """How distances of pairs of points, and heights, are spread: shares of bins."""
    with tempfile.TemporaryDirectory() as place:
        parts = []
        for k, (path, content) in enumerate(files.items()):
            parts.append(Path(place) / f"{k}{Path(path).suffix}")
            parts[-1].write_bytes(content)
        mesh = read_parts(parts, up)
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    points, _ = trimesh.sample.sample_surface(mesh, 2 * PAIRS, seed=zlib.crc32(b"pairs"))
    away = np.linalg.norm(points[:PAIRS] - points[PAIRS:], axis=1)
    return np.concatenate(
        [
            np.histogram(values, BINS, bounds)[0] / len(values)
            for values, bounds in ((away, (0, 1.75)), (points[:, 2], (-0.5, 0.5)))
        ]
    )


def _known(
    name: str, seen: NDArray[np.float64], before: list[tuple[str, NDArray[np.float64]]]
) -> str:
    """The shape that an object has, by the name of the first that has it."""
    for shape, other in before:
        if _thing(shape) == _thing(name) or np.abs(seen - other).sum() / 2 < ALIKE:
            return shape
    return name


def _thing(name: str) -> str:
    """The same of the parts and of the scan of a YCB object."""
    repository, own = name.split("-", 1)
    return YCB.sub("", own) if repository in ("robogym", "pybullet") else name


if __name__ == "__main__":
    main()
