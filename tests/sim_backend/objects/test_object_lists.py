"""Lists of objects from elsewhere: read, got from clones and over HTTP, split by their shapes."""

import csv
import hashlib
import shutil
import subprocess
import threading
import zipfile
from collections import Counter
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set
from tactile_rt.sim_backend.datasets.recipe_objects import choose_objects
from tactile_rt.sim_backend.datasets.recipes import ObjectChoice
from tactile_rt.sim_backend.objects import object_lists
from tactile_rt.sim_backend.objects.object_lists import (
    ListedFile,
    get_objects,
    read_list,
    shipped_lists,
)
from tactile_rt.sim_backend.objects.object_sets import open_objects
from tactile_rt.sim_backend.objects.solids import box

COLUMNS = ListedFile.__struct_fields__
COMMIT = "0123456789abcdef0123456789abcdef01234567"


def listed(path: Path, rows: list[dict[str, str]]) -> Path:
    """A list of these rows; what they leave out is as in most."""
    usual = {
        "category": "box", "repository": "some/shapes", "commit": COMMIT, "licence": "CC0-1.0",
        "up": "y", "scale": "0.01", "shape": "",
    }  # fmt: skip
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        table.writerows(usual | row for row in rows)
    return path


def part(repository: Path, path: str, mesh: trimesh.Trimesh) -> dict[str, str]:
    """The mesh in the repository, and what a list says of it."""
    file = repository / path
    file.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(file)
    return {"path": path, "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}


@pytest.fixture
def shapes(tmp_path: Path) -> tuple[Path, Path]:
    """A list of two objects, one of two parts, and the folder of clones that has them."""
    repository = tmp_path / "clones" / "shapes"
    seat = part(repository, "meshes/seat.obj", box((0, 0, 0), (2, 0.2, 2)))
    back = part(repository, "meshes/the back.stl", box((0, 1, 1), (2, 2, 0.2)))
    brick = part(repository, "meshes/brick.ply", box((0, 0, 0), (1, 2, 3)))
    rows = [
        {"category": "chair", "name": "one", **seat},
        {"category": "chair", "name": "one", **back},
        {"name": "brick", "scale": "", **brick},
    ]
    return listed(tmp_path / "things.csv", rows), repository.parent


def upright(folder: Path) -> None:
    """Both objects are there: parts in their places, y of the files up, in metres."""
    chair = trimesh.load_mesh(folder / "chair" / "one.ply")
    np.testing.assert_allclose(chair.extents, (0.02, 0.021, 0.021), atol=1e-6)
    brick = trimesh.load_mesh(folder / "box" / "brick.ply")
    np.testing.assert_allclose(brick.extents, (0.04 / 3, 0.04, 0.08 / 3), atol=1e-6)
    assert open_objects(folder).names == ("box/brick", "chair/one")
    assert not list(folder.rglob(".*"))


def test_objects_come_out_of_a_folder_of_clones(shapes, tmp_path: Path, call) -> None:
    wanted, clones = shapes
    code, out, err = call("objects", "get", wanted, tmp_path / "got", "--clones", clones)
    assert (code, err) == (0, "")
    assert out.startswith("2 of 2 objects of 2 kinds are in ")
    upright(tmp_path / "got")
    assert (tmp_path / "got" / "objects.csv").read_text().splitlines() == [
        "category,name,shape,source,licence",
        "box,brick,brick,some/shapes,CC0-1.0",
        "chair,one,one,some/shapes,CC0-1.0",
    ]
    code, out, _ = call("objects", "check", tmp_path / "got")
    assert code == 0 and "chair" in out
    for name in ("bolt.step", "one.step"):  # of the other there is a mesh
        (tmp_path / "got" / "chair" / name).write_text("ISO-10303-21;")
    code, _, said = call("objects", "check", tmp_path / "got")
    assert code == 1 and "bolt.step: unknown mesh format" in said and "one.step" not in said


def test_a_second_list_takes_nothing_away_of_the_first(shapes, tmp_path: Path, call) -> None:
    wanted, clones = shapes
    get_objects(read_list(str(wanted)), tmp_path / "got", clones)
    first = open_objects(tmp_path / "got").origins
    brick = part(clones / "shapes", "meshes/other.ply", box((0, 0, 0), (3, 2, 3)))
    rows = [{"name": "other", **brick}, {"name": "brick", "repository": "an/other", **brick}]
    second = listed(tmp_path / "second.csv", rows)
    code, out, err = call("objects", "get", second, tmp_path / "got", "--clones", clones)
    assert code == 1
    assert "box/brick.ply comes from some/shapes: choose another folder" in out + err
    both = open_objects(tmp_path / "got").origins
    assert first.items() <= both.items() and both.keys() - first.keys() == {"box/other"}


def test_a_commit_counts_and_not_what_lies_about(shapes, tmp_path: Path) -> None:
    wanted, clones = shapes

    def git(*words: str) -> str:
        who = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        command = ["git", *who, "-C", str(clones / "shapes"), *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "shapes")
    wanted.write_text(wanted.read_text().replace(COMMIT, git("rev-parse", "HEAD")))
    for file in (clones / "shapes" / "meshes").iterdir():
        file.write_bytes(b"changed since")
    assert get_objects(read_list(str(wanted)), tmp_path / "got", clones) == {}
    upright(tmp_path / "got")


def test_objects_are_fetched(shapes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wanted, clones = shapes
    root = tmp_path / "served" / "some" / "shapes"
    root.mkdir(parents=True)
    (clones / "shapes").rename(root / COMMIT)

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path / "served"))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setattr(object_lists, "RAW", f"http://127.0.0.1:{server.server_port}")
    assert get_objects(read_list(str(wanted)), tmp_path / "got") == {}
    upright(tmp_path / "got")
    (root / COMMIT / "meshes" / "seat.obj").unlink()
    why = get_objects(read_list(str(wanted)), tmp_path / "again")
    server.shutdown()
    server.server_close()
    assert (
        list(why) == ["chair/one"]
        and "seat.obj: cannot be downloaded (HTTP Error 404" in why["chair/one"]
    )
    assert (tmp_path / "again" / "box" / "brick.ply").exists()


def test_a_file_that_is_not_what_the_list_means_is_not_used(shapes, tmp_path, call) -> None:
    wanted, clones = shapes
    back = clones / "shapes" / "meshes" / "the back.stl"
    kept = back.read_bytes()
    back.write_bytes(kept + b" ")
    code, out, err = call("objects", "get", wanted, tmp_path / "got", "--clones", clones)
    assert code == 1 and out.startswith("1 of 2 objects")
    assert "some/shapes/meshes/the back.stl: is not the listed file (sha256 " in err
    assert not (tmp_path / "got" / "chair").exists()
    back.write_bytes(kept)  # and it goes on with what is missing
    (tmp_path / "got" / "box" / "brick.ply").write_bytes(b"kept")
    assert get_objects(read_list(str(wanted)), tmp_path / "got", clones) == {}
    assert (tmp_path / "got" / "box" / "brick.ply").read_bytes() == b"kept"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"path": "../../etc/passwd.obj"}, "leads out of its repository"),
        ({"name": "../up"}, "category and name may hold no /"),
        ({"sha256": "abc"}, "sha256"),
        ({"up": "x"}, "up"),
        ({"scale": "big"}, "scale must be a number of metres, not 'big'"),
        ({"scale": "inf"}, "scale must be a number of metres, not 'inf'"),
        ({"commit": "1.8-1"}, "commit must be a version for a package of debian or pypi"),
        ({"repository": "pypi/shapes"}, "commit must be a version for a package of debian or pypi"),
    ],
)
def test_a_wrong_row_is_named(tmp_path: Path, change: dict[str, str], said: str) -> None:
    row = {"name": "one", "path": "one.obj", "sha256": 64 * "0"}
    path = listed(tmp_path / "list.csv", [row, row | change])
    with pytest.raises(ConfigError, match=r"list\.csv:3: ") as caught:
        read_list(str(path))
    assert said in str(caught.value)


def test_what_is_not_there_is_said(shapes, tmp_path: Path) -> None:
    wanted, _clones = shapes
    with pytest.raises(ConfigError, match=r"no list 'reel'; did you mean real\?"):
        read_list("reel")
    with pytest.raises(ConfigError, match="no such folder of clones"):
        get_objects(read_list(str(wanted)), tmp_path / "got", tmp_path / "nowhere")
    why = get_objects(read_list(str(wanted)), tmp_path / "got", tmp_path)
    assert set(why) == {"box/brick", "chair/one"}
    assert all("no clone of some/shapes with meshes/" in line for line in why.values())


def test_objects_come_out_of_an_archive_of_an_unpacked_package(shapes, tmp_path: Path) -> None:
    wanted, clones = shapes
    folder = clones / "shapes"
    with zipfile.ZipFile(folder / "all.sh3f", "w") as archive:
        for file in (folder / "meshes").iterdir():
            archive.write(file, f"meshes/{file.name}")
    shutil.rmtree(folder / "meshes")
    more = {"repository": "debian/shapes", "commit": "1.8-1", "kind": "thing", "maker": "me"}
    rows = [row | more for row in csv.DictReader(wanted.read_text().splitlines())]
    listed(wanted, [row | {"path": f"all.sh3f/{row['path']}"} for row in rows])
    things = read_list(str(wanted))
    assert get_objects(things, tmp_path / "got", clones) == {}
    upright(tmp_path / "got")
    origin = open_objects(tmp_path / "got").origins["box/brick"]
    assert (origin.kind, origin.maker, origin.attribution) == ("thing", "me", "")
    for archive in (b"no archive", None):  # nor a folder of that name
        (folder / "all.sh3f").unlink()
        if archive:
            (folder / "all.sh3f").write_bytes(archive)
        why = get_objects(things, tmp_path / "again", clones)["box/brick"]
        assert f"{clones}: no brick.ply of shapes; `apt-get download shapes=1.8-1`" in why
    why = get_objects(things, tmp_path / "again")["box/brick"]
    assert why.startswith("shapes is a package; `apt-get download shapes=1.8-1`")
    assert why.endswith("and say --clones FOLDER")


def test_the_list_of_shapes_has_enough_of_every_shape() -> None:
    things = read_list("real2")
    first = [thing.files[0] for thing in things]
    number = Counter(file.category for file in first)
    assert len(number) == 13 and number.pop("other") == 600
    assert min(number.values()) >= 60 and max(number.values()) == 150
    assert 600 < 0.3 * len(things)
    assert len({file.maker for file in first}) == 8 and all(file.kind for file in first)
    assert all(file.attribution for file in first if file.licence.startswith("CC-BY"))


def test_the_list_that_ships_has_enough_of_enough_kinds() -> None:
    assert shipped_lists() == ("real", "real2")
    shapes: dict[str, set[str]] = {}
    for thing in read_list("real"):
        first = thing.files[0]
        shapes.setdefault(first.category, set()).add(first.shape)
        assert first.licence in ("CC0-1.0", "MIT")
    assert len(shapes) >= 30
    assert sum(len(some) >= 8 for some in shapes.values()) >= 20


def test_kinds_within_a_category_come_from_the_folder_s_table(tmp_path: Path) -> None:
    (tmp_path / "block").mkdir()
    rows = ["category,name,kind"]
    for k in range(6):
        (tmp_path / "block" / f"{k}.ply").touch()
        rows.append(f"block,{k},{'box' if k % 2 else ''}")
    (tmp_path / "objects.csv").write_text("\n".join(rows))
    choice = ObjectChoice(str(tmp_path), validation=1, test=1)
    assert choose_objects(choice).kind_of == {f"block-{k}": "box" for k in (1, 3, 5)}


def test_variants_stay_on_one_side_and_a_source_can_be_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "things"
    (folder / "box").mkdir(parents=True)
    rows = ["category,name,shape,source,licence"]
    for k in range(12):
        for variant in "ab":
            (folder / "box" / f"{k}{variant}.ply").touch()
            source = "some/shapes" if k < 9 or variant == "a" else "other/shapes"
            rows.append(f"box,{k}{variant},{k},{source},CC0-1.0")
    for k in range(3):
        (folder / "box" / f"new{k}.ply").touch()
        rows.append(f"box,new{k},,other/shapes,CC0-1.0")
    (folder / "objects.csv").write_text("\n".join(rows))

    def split(**more: str) -> dict[str, set[str]]:
        recipe = recipe_of_set({"objects": {"from": str(folder), **more}})
        assert recipe_of_set(recipe.to_dict()).objects == recipe.objects
        return {k: set(names) for k, names in choose_objects(recipe.objects).split.items()}

    for side in split().values():
        for name in side:
            if name[-1] in "ab":
                assert {name[:-1] + "a", name[:-1] + "b"} <= side
    left = set.union(*split(without_source="other/shapes").values())
    assert len(left) == 21 and not any("new" in name for name in left)
    only = split(only_source="other/shapes")
    assert only["test"] == {"box-new0", "box-new1", "box-new2"} and not only["train"]
    with pytest.raises(ConfigError, match=r"no source 'others/shapes'; did you mean other/shapes"):
        split(only_source="others/shapes")
