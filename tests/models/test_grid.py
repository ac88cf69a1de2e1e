"""A grid of tiny networks: planned, done over again never, counted and told."""

import csv
import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning")
pytest.importorskip("matplotlib")

from tactile_rt.models.grid import pool, results
from tactile_rt.models.grid.picture import draw_grid
from tactile_rt.models.grid.plan import Task, read_grid, shipped_grids
from tactile_rt.models.grid.pool import run_grid
from tactile_rt.models.grid.results import gather, put_into, table, write_results
from tactile_rt.models.grid.work import Outcome, Workbench, outcome_path, read_outcome, settings_of
from tactile_rt.stream import ArraySpec, ConfigError, ModelError, RecordingError
from tactile_rt.sweep_set import SweepManifest, write_object

SPEC = ArraySpec(
    name="row",
    elements=tuple(f"{'ABCDE'[i // 7]}{i % 7}" for i in range(35)),
    grid=tuple((i // 7, i % 7) for i in range(35)),
    positions=tuple((0.0, 0.002 * (i % 7), 0.002 * (i // 7)) for i in range(35)),
    orientations=((1.0, 0.0, 0.0, 0.0),) * 35,
    channels=("fx", "fy", "fz", "mx", "my", "mz"),
    units=("N", "N", "N", "N m", "N m", "N m"),
    rate_hz=1000.0,
    frame="head",
)
SPLIT = {
    side: tuple(f"{kind}-{i}" for kind in ("mug", "car") for i in range(begin, end))
    for side, begin, end in (("train", 0, 4), ("validation", 4, 6), ("test", 6, 10))
}
TOML = """
data = "{data}"
width = 0.03125
updates = 2
batch = 4
seeds = 2
sweeps = {{ train = 2, validation = 1, test = 2 }}
probe = {{ epochs = 2, drop_epochs = 1 }}
[supervised]
learning_rate = 1e-3
[[cell]]
encoder = "gru"
[[cell]]
encoder = "gru"
objective = "simclr"
augmentation = "image"
[[question]]
text = "Do labels help?"
pairs = [{{ better = "gru", than = "gru simclr image" }}, {{ better = "gru", than = "svm" }}]
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three sweeps of 20 objects of two kinds, told apart by which whiskers they touch."""
    folder = tmp_path_factory.mktemp("set")
    SweepManifest(SPEC, 9_000_000, 20, ("mug", "car"), SPLIT).write(folder)
    rng = np.random.default_rng(0)
    for names in SPLIT.values():
        for name in names:
            values = np.zeros((3, 150, 35, 6), dtype=np.float32)
            touched = slice(0, 17) if name.startswith("mug") else slice(17, 35)
            size = 1e-4 * rng.lognormal(0, 0.3, (3, 1, 1, 6)) * ([1.0] * 3 + [1e-2] * 3)
            values[:, 40:, touched] = size
            write_object(folder, name, values, {"yaw": np.zeros(3)})
    return folder


@pytest.fixture
def plan(data: Path, tmp_path: Path) -> Path:
    path = tmp_path / "grid.toml"
    path.write_text(TOML.format(data=data))
    return path


def test_the_shipped_grid_is_the_papers_figure_and_its_controls() -> None:
    assert shipped_grids() == ("mouse24",)
    grid = read_grid("mouse24")
    learning = [cell.learning for cell in grid.cells]
    assert learning.count("supervised") >= 12
    assert sum(one.startswith("simclr") for one in learning) >= 6
    for control in ("tactile", "tactile-paper", "image", "tactile+masking"):
        assert f"simclr {control}" in learning
    assert grid.seeds == 3
    assert any(cell.name == "gru" for cell in grid.cells)
    assert grid.svm
    tasks = grid.tasks()
    seeds = [task.seed for task in tasks]
    assert seeds == sorted(seeds), "all with the first seed before any with the second"
    assert len({task.slug for task in tasks}) == len(tasks)
    assert all(grid.config(t, Path("x")).updates == grid.updates for t in tasks if t.cell)
    assert len({grid.config(t, Path("x")).batch for t in tasks if t.cell}) <= 2


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('encoder = "gru"', 'encoder = "lstm"', "cell 'lstm': encoder is 'lstm', not one of"),
        ("image", "picture", "augmentation is 'picture', not one of"),
        ("updates = 2", 'updates = "2"', "updates: expected a whole number, got '2'"),
        ("updates = 2", "updates = 0", "needs a cell, a seed and an update"),
        ("batch = 4", "bach = 4", "the file has no key 'bach'; did you mean batch?"),
        ("learning_rate", "rate", "has no key 'rate'; "),
        ('than = "svm"', 'than = "svn"', "compares 'svn', which no cell is"),
        ("[supervised]", "[supervised", "Expected ']'"),
        ('objective = "simclr"\naugmentation = "image"', "", "two cells are 'gru'"),
    ],
)
def test_a_slip_in_a_grid_is_named(plan: Path, old: str, new: str, said: str) -> None:
    plan.write_text(plan.read_text().replace(old, new))
    with pytest.raises(ConfigError) as error:
        read_grid(plan)
    assert str(plan) in str(error.value)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_grid_that_is_not_there_is_told_with_those_that_are(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"no grid none\.toml: name a TOML file, or one of mouse24"
    ):
        read_grid("none.toml")


def test_a_grid_is_done_once_and_told(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, folder = read_grid(plan), tmp_path / "out"
    names = [task.name for task in grid.tasks()]
    assert names == ["svm", *(["gru", "random gru", "gru simclr image"] * 2)]

    class KilledError(Exception):
        pass

    told: list[tuple[str, int, int]] = []

    def tell(found: Outcome, done: int, total: int) -> None:
        told.append((found.name, done, total))
        if done == 3:
            raise KilledError

    with pytest.raises(KilledError):
        run_grid(grid, folder, report=tell)
    kept = {p: p.stat().st_mtime_ns for p in (folder / "outcomes").iterdir()}
    assert len(kept) == 3
    run_grid(grid, folder, report=tell)
    assert [name for name, *_ in told] == names, "nothing twice, nothing left out"
    assert [(done, total) for _, done, total in told] == [(k, 7) for k in range(1, 8)]
    assert (
        kept.items() <= {p: p.stat().st_mtime_ns for p in (folder / "outcomes").iterdir()}.items()
    )
    monkeypatch.setattr(pool, "Workbench", None)
    run_grid(grid, folder)  # nothing is left to do

    # Touches of other whiskers: a machine tells them apart at once.
    svm = read_outcome(grid, folder, grid.tasks()[0])
    assert svm is not None
    assert svm.right().tolist() == [True] * 16  # 8 objects, 2 sweeps of each
    found = gather(grid, folder)
    assert (found.objects, found.sweeps, found.classes) == (8, 16, 2)
    assert [row.name for row in found.rows] == ["svm", "gru", "gru simclr image"]
    assert [row.seeds for row in found.rows] == [1, 2, 2]
    gru = found.rows[1]
    assert gru.top5 is not None
    assert gru.top5.value == 1.0  # of two classes
    assert gru.random is not None
    assert gru.random == found.rows[2].random, "of one network"
    assert gru.parameters > 1000

    write_results(found, folder)
    rows = list(csv.DictReader((folder / "results.csv").read_text().splitlines()))
    assert gru.top1 is not None
    assert float(rows[1]["top1"]) == gru.top1.value
    assert json.loads((folder / "results.json").read_text())["objects"] == 8
    draw_grid(found, folder / "task_performance.png")
    assert (folder / "task_performance.png").read_bytes().startswith(b"\x89PNG")
    text = table(found)
    assert "| gru | supervised |" in text
    assert "| Do labels help? | gru - gru simclr image |" in text

    changed = msgspec.structs.replace(grid, updates=3)
    with pytest.raises(ConfigError, match="'gru' trained with other settings"):
        run_grid(changed, folder)


def test_a_network_that_diverges_is_an_outcome(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid, folder = read_grid(plan), tmp_path / "out"
    pool.write_subset(Path(grid.data), folder / "sweeps", grid.sweeps)

    def diverge(*_: object, **__: object) -> Path:
        raise ModelError("training diverged in epoch 1")

    monkeypatch.setattr("tactile_rt.models.grid.work.train", diverge)
    bench = Workbench(grid, folder)
    for task in grid.tasks()[:2]:
        bench.do(task)
    rows = gather(grid, folder).rows
    assert rows[1].top1 is None
    assert rows[1].failed == "training diverged in epoch 1"
    assert "`gru`: training diverged in epoch 1" in table(gather(grid, folder))
    draw_grid(gather(grid, folder), folder / "picture.png")


def test_a_grid_without_its_sweeps_says_so(plan: Path, tmp_path: Path) -> None:
    grid = msgspec.structs.replace(read_grid(plan), data=str(tmp_path / "none"))
    with pytest.raises(RecordingError, match="is not a sweep set"):
        run_grid(grid, tmp_path / "out")
    with pytest.raises(ConfigError, match="has no outcome yet"):
        gather(grid, tmp_path / "out")


def made_up(folder: Path, grid: results.Grid, task: Task, right: str) -> None:
    """An outcome as if the task had been done."""
    path = outcome_path(folder, task)
    path.parent.mkdir(parents=True, exist_ok=True)
    outcome = Outcome(task.name, task.seed, settings_of(grid, folder, task), right, right, right)
    path.write_bytes(msgspec.json.encode(outcome))


def test_comparisons_are_of_the_same_sweeps_and_seeds(plan: Path, tmp_path: Path) -> None:
    grid, folder = read_grid(plan), tmp_path / "out"
    pool.write_subset(Path(grid.data), folder / "sweeps", grid.sweeps)
    right = {
        ("gru", 0): "1111111111111100",
        ("gru", 1): "1111111111110000",
        ("gru simclr image", 0): "1111110000000000",  # the second seed is not done yet
        ("svm", 0): "1111111111111111",
    }
    for task in grid.tasks():
        if (task.name, task.seed) in right:
            made_up(folder, grid, task, right[task.name, task.seed])
    found = gather(grid, folder)
    labels, svm = found.answers
    assert labels.difference.value == pytest.approx(8 / 16), "seed 0 alone"
    assert labels.verdict == "yes"
    assert svm.difference.value == pytest.approx(-3 / 16), "the machine beside both seeds"
    assert svm.difference.low < -3 / 16 < svm.difference.high <= 0
    assert found.rows[1].top1 is not None
    assert found.rows[1].top1.value == pytest.approx(13 / 16)


def test_a_table_goes_between_the_marks_of_a_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- grid: begin -->\nold\n<!-- grid: end -->\nafter\n")
    put_into(page, "new\n")
    put_into(page, "newer\n")
    marks = "<!-- grid: begin -->\nnewer\n<!-- grid: end -->"
    assert page.read_text() == f"before\n{marks}\nafter\n"
    page.write_text("no marks\n")
    with pytest.raises(ConfigError, match="to put the table between"):
        put_into(page, "new\n")
    assert page.read_text() == "no marks\n"


@pytest.mark.slow
def test_processes_share_the_work(plan: Path, tmp_path: Path) -> None:
    grid = read_grid(plan)
    told: list[str] = []
    run_grid(grid, tmp_path / "two", 2, lambda found, done, total: told.append(found.name))
    assert sorted(told) == sorted(task.name for task in grid.tasks())
    run_grid(grid, tmp_path / "one")
    for task in grid.tasks():  # who does it does not change what comes of it
        one, two = (read_outcome(grid, tmp_path / k, task) for k in ("one", "two"))
        assert one is not None
        assert two is not None
        assert one.top1 == two.top1
