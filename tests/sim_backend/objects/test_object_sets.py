"""Mesh objects: how near their pieces are, where they are kept, and folders of them."""

import json
import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.datasets.recipe_objects import choose_objects
from tactile_rt.sim_backend.objects import meshes
from tactile_rt.sim_backend.objects.mesh_detail import MeshDetail
from tactile_rt.sim_backend.objects.meshes import load_mesh
from tactile_rt.sim_backend.objects.object_sets import open_objects
from tests.helpers import mesh_truth
from tests.helpers.refusals import refusal

MM = 40.0  # largest extent that errors are given at


def saved(mesh: trimesh.Trimesh, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    mesh.export(path)
    return path


SHAPES = {
    "bracket": mesh_truth.bracket,
    "channel": mesh_truth.channel,
    "gear": mesh_truth.gear,
    "bowl": mesh_truth.bowl,
    "torus": lambda: mesh_truth.torus(14, 6),
}


@pytest.mark.parametrize("name", SHAPES)
def test_pieces_are_within_a_tenth_of_a_millimetre(name: str, tmp_path: Path) -> None:
    mesh = SHAPES[name]()
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    mesh.apply_scale(1 / mesh.extents.max())
    thing = load_mesh(saved(mesh, tmp_path / f"{name}.ply"))
    assert MM * thing.surface_error <= 0.1
    far = max(mesh_truth.sampled(mesh, thing.pieces))
    assert far <= thing.surface_error + 1e-5  # no farther than what is reported
    if name in ("bowl", "torus"):  # and not much nearer
        assert far >= 0.5 * thing.surface_error
    assert all(p.is_convex and p.is_watertight and p.volume > 0 for p in thing.pieces)
    assert thing.made_by == "pieces"


def test_a_limit_on_pieces_widens_the_error_and_says_so(tmp_path: Path) -> None:
    path = saved(mesh_truth.torus(14, 6, around=16, across=8), tmp_path / "torus.ply")
    few = load_mesh(path, MeshDetail(max_pieces=6))
    assert len(few.pieces) <= 6
    assert MM * few.surface_error > 0.1
    hull = load_mesh(path, MeshDetail(hull=True))
    assert len(hull.pieces) == 1 and hull.made_by == "hull"
    assert hull.surface_error > few.surface_error


def test_pieces_are_cut_once(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(mesh_truth.bracket(), tmp_path / "bracket.stl")
    first = load_mesh(path)
    (kept,) = cache.glob("*.npz")

    def never(*_: object) -> None:
        raise AssertionError("cut again")

    with monkeypatch.context() as patched:
        patched.setattr(meshes, "SolidPieces", never)
        again = load_mesh(path)
        moved = load_mesh(shutil.copy(path, tmp_path / "other.stl"))  # its content counts
    for one in (again, moved):
        assert one.surface_error == first.surface_error and one.made_by == first.made_by
        for a, b in zip(one.pieces, first.pieces, strict=True):
            assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)
    kept.write_bytes(kept.read_bytes()[:200])  # damaged: as if it were not there
    assert len(load_mesh(path).pieces) == len(first.pieces)
    assert not list(cache.glob("*.part"))


def test_without_a_place_to_keep_pieces_they_are_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("TACTILE_RT_CACHE", str(tmp_path / "file"))
    path = saved(mesh_truth.bracket(), tmp_path / "bracket.stl")
    assert len(load_mesh(path).pieces) == 2


def test_sheets_become_plates_that_stand(tmp_path: Path) -> None:
    path = saved(mesh_truth.sheet_chair(), tmp_path / "chair.obj")
    chair = load_mesh(path, MeshDetail(up="y"))
    assert chair.made_by == "plates"
    assert MM * chair.surface_error < 0.25
    extents = np.ptp([c for p in chair.pieces for c in p.bounds], axis=0)
    assert extents[2] == pytest.approx(1.0, abs=0.01)  # y is up in the file
    assert load_mesh(path, MeshDetail(hull=True)).made_by == "hull"


# folders


@pytest.fixture
def shapenet(tmp_path: Path) -> Path:
    """Two synsets of ShapeNetCore, three objects, one of them empty."""
    root = tmp_path / "ShapeNetCore"
    file = "models/model_normalized.obj"
    saved(mesh_truth.bracket(), root / "03001627" / "a1" / file)
    saved(mesh_truth.channel(), root / "03001627" / "b2" / file)
    broken = root / "02876657" / "c3" / file
    broken.parent.mkdir(parents=True)
    broken.write_text("# nothing here\n")
    taxonomy = [{"synsetId": "03001627", "name": "chair"},
                {"synsetId": "02876657", "name": "bottle,flask"}]  # fmt: skip
    (root / "taxonomy.json").write_text(json.dumps(taxonomy))
    return root


def test_a_shapenet_folder(shapenet: Path) -> None:
    objects = open_objects(shapenet)
    assert objects.names == ("bottle/c3", "chair/a1", "chair/b2")
    assert objects.categories["bottle/c3"] == "bottle"
    thing = objects.load("chair/a1")
    assert (thing.name, thing.category) == ("chair-a1", "chair")
    tall = np.ptp([c for p in thing.pieces for c in p.bounds], axis=0)
    assert tall[2] == pytest.approx(20 / 40, abs=1e-3)  # its y, 20 mm of 40, is up
    usable = objects.check()
    assert [thing.made_by for thing in usable.values()] == ["pieces"] * 2
    assert set(usable) == {"chair/a1", "chair/b2"}
    assert list(objects.skipped) == ["bottle/c3"] and "no triangles" in objects.skipped["bottle/c3"]


def test_a_shapenet_folder_without_its_taxonomy(shapenet: Path) -> None:
    (shapenet / "taxonomy.json").unlink()
    assert open_objects(shapenet).names[0] == "02876657/c3"
    (shapenet / "taxonomy.json").write_text('{"not": "a list"}')
    assert "taxonomy.json is not ShapeNet's taxonomy" in refusal(open_objects, shapenet)


def test_labels_replace_the_synsets_of_a_shapenet_folder(shapenet: Path, tmp_path: Path) -> None:
    file = tmp_path / "categories.json"
    file.write_text('{"03001627/b2": 17, "02876657/c3": "flask", "02958343/other": 3}')
    assert open_objects(shapenet, labels=file).names == ("flask/c3", "label-017/b2")
    sets = [f"objects.from={shapenet}", f"objects.labels={file}"]
    choice = read_recipe("paper-lowvar-highfi", sets=sets).objects
    assert choose_objects(choice).categories == ("flask", "label-017")
    file.write_text('{"02958343/other": 3}')
    assert "has no label of any object, such as 02876657/c3" in refusal(
        open_objects, shapenet, labels=file
    )
    file.write_text("[3]")
    assert "is not {SYNSET/OBJECT: LABEL}" in refusal(open_objects, shapenet, labels=file)
    assert "not ShapeNetCore" in refusal(open_objects, shapenet / "03001627", labels=file)


def test_a_folder_of_folders(tmp_path: Path) -> None:
    root = tmp_path / "things"
    saved(mesh_truth.bracket(), root / "bracket" / "one.stl")
    saved(mesh_truth.gear(), root / "gear" / "my gear.ply")
    (root / "gear" / "notes.txt").write_text("not a mesh")
    objects = open_objects(root)
    assert objects.names == ("bracket/one", "gear/my_gear")
    assert objects.load("gear/my_gear").name == "gear-my_gear"
    assert "holds no object 'gear/other'" in refusal(objects.load, "gear/other")


def test_wrong_folders_are_named(tmp_path: Path) -> None:
    assert "no such folder of objects" in refusal(open_objects, tmp_path / "nowhere")
    assert "holds no objects: expected category/object.obj" in refusal(open_objects, tmp_path)
    for suffix in (".obj", ".stl"):
        saved(mesh_truth.bracket(), tmp_path / "bracket" / f"one{suffix}")
    assert "would have the same name: rename one" in refusal(open_objects, tmp_path)


RECIPE = """
name = "mine"
array = "mouse"
profile = "realtime"
[objects]
from = "{folder}"
validation = 1
test = 1
[sweeps]
draws = 1
height_mm = 0
speed_mm_s = 40
yaw_deg = 0
distance_mm = 6.5
gap_mm = 1
"""


def test_a_recipe_sweeps_a_folder_and_lists_what_is_broken(tmp_path: Path) -> None:
    root = tmp_path / "things"
    for k in range(3):
        saved(mesh_truth.bracket(), root / "bracket" / f"b{k}.stl")
        saved(mesh_truth.channel(), root / "channel" / f"c{k}.stl")
    (root / "channel" / "c1.stl").write_bytes(b"")
    recipe = tmp_path / "mine.toml"
    recipe.write_text(RECIPE.format(folder=root))
    out = tmp_path / "set"
    made = list(make_sweeps(read_recipe(str(recipe)), out, processes=1))
    assert len(made) == 6  # with the one that could not be
    skipped = json.loads((out / "skipped.json").read_text())
    assert "channel-c1" in json.dumps(skipped) and "empty" in json.dumps(skipped)
    assert len(list(out.glob("*.npz"))) == 5
    assert SweepManifest.read(out).versions["manifold3d"] == version("manifold3d")
