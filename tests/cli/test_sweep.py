"""`tactile-rt sweep`: what its options come to."""

import pytest

from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sim_backend.datasets import dataset
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set

RECIPE = """
name = "tiny"
lead_ms = 45
length_ms = 180
[objects]
categories = ["mug"]
per_category = 3
validation = 1
test = 1
[sweeps]
draws = 2
yaw_deg = { between = [0, 360] }
gap_mm = 0.5
"""


@pytest.fixture
def recipe(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(RECIPE)
    return path


@pytest.fixture
def here(monkeypatch):
    """The work is done in this process: starting another takes longer than these sweeps."""
    monkeypatch.setattr(
        dataset, "run_processes", lambda work, names, processes: ((n, work(n)) for n in names)
    )


def test_a_set_is_made_gone_on_with_described_and_checked(call, refused, recipe, tmp_path):
    folder = tmp_path / "set"
    options = ("--seed", 3, "--set", "sweeps.draws=1", "--processes", 1)
    code, out, err = call("sweep", folder, "--recipe", recipe, *options, "--split", "test")
    assert (code, out) == (0, "")
    assert "1 sweeps at profile realtime" in err
    assert sorted(p.stem for p in folder.glob("*.npz")) == ["mug-2"]
    made = recipe_of_set(SweepManifest.read(folder).recipe)
    assert (made.name, made.seed, len(made.sweeps)) == ("tiny", 3, 1)

    code, _, err = call("sweep", folder, "--processes", 1)  # goes on as it was begun
    assert code == 0
    assert "3 sweeps" in err
    assert sorted(p.stem for p in folder.glob("*.npz")) == ["mug-0", "mug-1", "mug-2"]
    code, _, err = call("sweep", folder, "--verify")
    assert (code, "4 files are as they were written" in err) == (0, True)

    pytest.importorskip("matplotlib")
    pytest.importorskip("sklearn")
    assert call("sweep", folder, "--card")[0] == 0
    assert "3 simulated sweeps of 3 objects" in (folder / "README.md").read_text()
    (folder / "mug-1.npz").write_bytes(b"")
    assert "missing or damaged: mug-1.npz" in refused("sweep", folder, "--verify")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--recipe", "tiny"), "no recipe 'tiny'; there are default24,"),
        (
            ("--set", "objects.per_category=2"),
            "2 objects cannot be split with 4 for validation and 12 for test",
        ),
        (("--set", "sweeps.draws=0"), "sweeps: draws must be at least 1, not 0"),
        (("--set", "contacs=true"), "--set contacs=true: no key 'contacs'; did you mean contacts?"),
        (("--verify",), "has no SHA256SUMS"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(refused, cwd, options, said):
    assert said in refused("sweep", cwd / "set", *options)
    assert not (cwd / "set").exists()


@pytest.mark.usefixtures("here")
def test_another_profile_of_a_set_goes_elsewhere(call, refused, recipe, tmp_path):
    folder = tmp_path / "set"
    assert call("sweep", folder, "--recipe", recipe, "--split", "test", "--processes", 1)[0] == 0
    said = refused("sweep", folder, "--profile", "accurate")
    assert "holds another sweep set (other recipe.profile, " in said


@pytest.mark.usefixtures("here")
def test_sweeps_that_miss_are_told(done, recipe, tmp_path):
    recipe.write_text(RECIPE + "height_mm = 200\n")
    _, err = done("sweep", tmp_path / "set", "--recipe", recipe, "--processes", 1)
    assert "6 sweeps at profile realtime; 6 miss the array" in err.replace("\n", " ")


def test_a_ray_cluster_is_named_by_host_and_port(refused, recipe, tmp_path):
    pytest.importorskip("ray")
    said = refused("sweep", tmp_path / "set", "--recipe", recipe, "--ray", "head")
    assert "no Ray cluster at head: give its HOST:PORT" in said
