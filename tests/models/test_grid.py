"""A grid of tiny networks: planned, done over again never, counted and told."""

import json
import shutil
import signal
from dataclasses import replace
from multiprocessing.context import SpawnProcess
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, ModelError, RecordingError
from tactile_rt.models.grid import pool, results
from tactile_rt.models.grid.outcomes import (
    Outcome,
    Training,
    outcome_path,
    read_outcome,
    settings_of,
    write_tested,
)
from tactile_rt.models.grid.picture import draw_grid
from tactile_rt.models.grid.plan import Growth, Task, read_grid, shipped_grids
from tactile_rt.models.grid.pool import run_grid
from tactile_rt.models.grid.results import GridResults, gather, table, write_results
from tactile_rt.models.grid.work import Workbench
from tactile_rt.models.training.config import DivergedError, Progress
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import write_object
from tests.helpers.refusals import refusal
from tests.helpers.source_tree import ROOT
from tests.helpers.tiny_sweeps import plate

SPLIT = {
    side: tuple(f"{kind}-{i}" for kind in ("mug", "car") for i in range(begin, end))
    for side, begin, end in (("train", 0, 4), ("validation", 4, 6), ("test", 6, 10))
}
TOML = """
data = "{data}"
width = 0.03125
batch = 4
seeds = 2
search = {{ learning_rate = [1e-3, 1e-2], warmup = [0.1, 0.3], updates = 2 }}
growth = {{ first = 1, most = 2, gain = 0.01 }}
sweeps = {{ train = 2, validation = 1, test = 2 }}
probe = {{ epochs = 2, drop_epochs = 1 }}
[supervised]
clip_norm = 2
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
    SweepManifest(plate(5, 7), 9_000_000, 20, ("mug", "car"), SPLIT).write(folder)
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


def replace_in(plan: Path, old: str, new: str) -> None:
    plan.write_text(plan.read_text().replace(old, new))


def test_the_shipped_grid_is_the_papers_figure_and_its_controls() -> None:
    assert shipped_grids() == ("paper", "paper-claims", "wide24", "wide24-full")
    grid = read_grid("wide24")
    names = {cell.name for cell in grid.cells}
    for encoder in ("gru", "s4", "resnet18", "mamba", "zhuang-intersection-ln"):
        assert {encoder, f"{encoder}+gpt"} <= names
    assert grid.seeds == 3
    assert grid.svm
    tasks = grid.tasks()
    names = [task.name for task in tasks if task.cell is not None and not task.random]
    assert names == sorted(names, key=names.index), "a cell with all its seeds before the next"
    assert len({task.slug for task in tasks}) == len(tasks)


def test_the_page_of_results_is_what_was_found() -> None:
    """The data beside the page are whole; each row of the page is of a row of the tables."""
    kept, page = ROOT / "bench" / "models" / "wide24", ROOT / "docs" / "explain" / "results.md"
    found = table(gather(read_grid("wide24"), kept))
    data = page.with_suffix(".json").read_bytes()
    assert table(msgspec.json.decode(data, type=GridResults)) == found
    rows = [line.split(" | ") for line in found.replace("| ", " | ").splitlines()]
    shown = page.read_text().split("<!-- grid: begin -->\n")[1].split("<!-- grid: end -->")[0]
    shown = [line for line in shown.splitlines() if line.startswith("|") and "|---" not in line]
    for line in shown:
        cells = [cell.strip() for cell in line.strip("| ").split(" | ")]
        assert any(set(cells) <= {c.strip(" |") for c in row} for row in rows), line
    networks = [line for line in shown if "| supervised |" in line]
    assert len(networks) == sum("| supervised |" in line for line in found.splitlines())


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('encoder = "gru"', 'encoder = "lstm"', "cell 'lstm': encoder is 'lstm', not one of"),
        ("updates = 2", "updates = 0", "needs a cell, a seed and an update"),
        ("batch = 4", "bach = 4", "the file has no key 'bach'; did you mean batch?"),
        ("[1e-3, 1e-2]", "[]", "search needs a learning_rate and a warmup"),
        ('encoder = "gru"\nobj', 'encoder = "gru"\nshare = 2\nobj', "share must be above 0"),
        (
            'encoder = "gru"\nobj',
            'encoder = "gru"\nbegin = "s4"\nobj',
            "begins with 's4', but no earlier cell",
        ),
        ('than = "svm"', 'than = "svn"', "compares 'svn', but no cell has that name"),
        ('objective = "simclr"\naugmentation = "image"', "", "two cells are named 'gru'"),
        ("[1e-3, 1e-2]", "[1e-3, -1e-2]", "cell 'gru': learning_rate must be positive"),
        ("most = 2", "most = 0", "growth must not go from 1 updates to 0"),
        ("train = 2", "train = -1", "sweeps must be 0"),
        ("clip_norm = 2", "seed = 2", "supervised: seed is set by the grid itself"),
        (
            'augmentation = "image"',
            'augmentation = "image"\nbegin = "gru"\nseeds = 3',
            "begins with 'gru', which is trained with 2 of 3 seeds",
        ),
        (
            'augmentation = "image"',
            'augmentation = "image"\noptions = { preprocessing = "paper" }',
            "its network differs from that of an earlier cell that is also called 'gru'",
        ),
    ],
)
def test_a_slip_in_a_grid_is_named(plan: Path, old: str, new: str, said: str) -> None:
    replace_in(plan, old, new)
    found = refusal(read_grid, plan)
    assert str(plan) in found and said in found


def test_a_grid_that_is_not_there_is_told_with_those_that_are(tmp_path: Path) -> None:
    said = r"no grid none\.toml: name a TOML file, or one of paper,"
    with pytest.raises(ConfigError, match=said):
        read_grid("none.toml")


def test_a_grid_is_done_once_and_told(plan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, folder = read_grid(plan), plan.parent / "out"
    names = [task.name for task in grid.tasks()]
    assert names == ["svm", *["gru", "random gru"] * 2, *["gru simclr image"] * 2]

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
    after = {p: p.stat().st_mtime_ns for p in (folder / "outcomes").iterdir()}
    assert kept.items() <= after.items()
    monkeypatch.setattr(pool, "Workbench", None)
    run_grid(grid, folder)  # nothing is left to do

    # Touches of other whiskers: a machine tells them apart at once.
    svm = read_outcome(grid, folder, grid.tasks()[0])
    assert svm is not None and svm.right().tolist() == [True] * 16  # 8 objects, 2 sweeps of each
    found = gather(grid, folder)
    assert (found.objects, found.sweeps, found.classes) == (8, 16, 2)
    assert [row.name for row in found.rows] == ["svm", "gru", "gru simclr image"]
    assert [row.seeds for row in found.rows] == [1, 2, 2]
    gru = found.rows[1]
    assert gru.top5 is not None and gru.top5.value == 1.0  # of two classes
    assert gru.random is not None and gru.random == found.rows[2].random, "of one network"
    assert gru.parameters > 1000

    write_results(found, folder)
    assert json.loads((folder / "results.json").read_text())["objects"] == 8
    draw_grid(found, folder / "task_performance.png")
    assert (folder / "task_performance.png").read_bytes().startswith(b"\x89PNG")
    text = (folder / "results.md").read_text()
    assert "| gru | supervised |" in text
    assert "| Do labels help? | gru - gru simclr image |" in text

    (first,) = [t for t in grid.tasks() if (t.name, t.seed) == ("gru", 0)]
    outcome = read_outcome(grid, folder, first)
    assert outcome is not None
    # all rates with the first warm-up, the other warm-up with the best rate
    tried = [(t.learning_rate, t.warmup, t.updates) for t in outcome.trials]
    updates = tried[0][2]  # 2, or more if no trial was above chance
    best = max(outcome.trials[:-1], key=lambda t: t.score).learning_rate
    assert tried[:2] == [(1e-3, 0.1, updates), (1e-2, 0.1, updates)]
    assert tried[-1] == (best, 0.3, updates)
    assert [p.updates for p in outcome.growth] == [1, 2]
    assert outcome.chosen == max(outcome.growth, key=lambda p: p.score)
    second = read_outcome(grid, folder, msgspec.structs.replace(first, seed=1))
    assert second is not None and second.chosen is not None
    assert (second.trials, second.growth) == ((), ()), "tuned by the first seed"
    assert second.chosen.updates == outcome.chosen.updates

    changed = msgspec.structs.replace(grid, batch=3)
    assert "'gru' trained with other settings" in refusal(run_grid, changed, folder)


def test_a_network_that_diverges_is_an_outcome(plan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, folder = read_grid(plan), plan.parent / "out"
    bench = begun(plan, folder)

    def diverge(*_: object, **__: object) -> Path:
        raise DivergedError("training diverged in epoch 1")

    monkeypatch.setattr("tactile_rt.models.grid.work.train", diverge)
    for task in grid.tasks()[:2]:
        bench.do(task)
    rows = gather(grid, folder).rows
    assert rows[1].top1 is None
    assert rows[1].failed == "every training of it diverged"
    assert "`gru`: every training of it diverged" in table(gather(grid, folder))
    draw_grid(gather(grid, folder), folder / "picture.png")


def begun(plan: Path, folder: Path) -> Workbench:
    """The workbench of a plan, its sweeps in the folder."""
    grid = read_grid(plan)
    pool.prepare(grid, folder)
    return Workbench(grid, folder)


def test_a_training_of_other_settings_is_not_taken_for_one_of_these(plan: Path) -> None:
    folder = plan.parent / "out"
    bench = begun(plan, folder)
    task = bench.grid.tasks()[1]
    bench.do(task)
    replace_in(plan, "batch = 4", "batch = 3")
    outcome, runs = outcome_path(folder, task), folder / "runs" / task.slug
    said = refusal(read_outcome, read_grid(plan), folder, task)
    assert f"delete {outcome} and {runs} to train it again" in said
    outcome.unlink()
    assert "was trained with other settings" in refusal(begun(plan, folder).do, task)
    shutil.rmtree(runs)
    begun(plan, folder).do(task)
    for config in runs.glob("*/config.json"):
        assert json.loads(config.read_text())["batch"] == 3


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("batch = 4", "batch = 40", "a batch of 40 is more than the 16 sweeps"),
        ("clip_norm = 2", "jitter = 200\n[self_supervised]\njitter = 200", "jitter is 200 samples"),
        ("train = 2", "train = 1", 'pairs of "two-sweeps": no object has two sweeps'),
    ],
)
def test_what_the_sweeps_cannot_fill_is_told_before_anything_is_trained(
    plan: Path, tmp_path: Path, before: str, after: str, said: str
) -> None:
    pairs = 'objective = "simclr"\noptions = { pairs = "two-sweeps" }'
    text = plan.read_text().split("[[question]]")[0].replace('objective = "simclr"', pairs)
    plan.write_text(text.replace(before, after))
    with pytest.raises(ConfigError, match=said):
        begun(plan, tmp_path / "out")


class KilledError(Exception):
    """What a test stops a training with, after an epoch."""


def kill(progress: Progress) -> None:
    if progress.metrics:
        raise KilledError


def test_a_damaged_checkpoint_is_not_a_training_that_diverged(plan: Path, tmp_path: Path) -> None:
    bench = begun(plan, tmp_path / "out")
    task = bench.grid.tasks()[1]
    with pytest.raises(KilledError):
        bench.do(task, kill)
    (last,) = (tmp_path / "out").rglob("last.pt")
    last.write_bytes(last.read_bytes()[:2000])
    with pytest.raises(ModelError, match=r"last\.pt is damaged"):
        bench.do(task)
    assert not outcome_path(tmp_path / "out", task).exists()


def test_windows_of_the_test_begin_as_those_that_were_learnt_from(plan: Path) -> None:
    bench = begun(plan, plan.parent / "out")
    config = bench.grid.config(bench.grid.tasks()[1], bench.data)
    heard, _ = bench._cut_test(config)
    set_out, _ = bench._cut_test(replace(config, window="sweep"))
    lead = bench.test.manifest.lead
    first = bench.test.sweeps.values[0, lead : lead + 5]
    np.testing.assert_array_equal(set_out[0].samples[0, 0], first)
    assert not np.array_equal(heard[0].samples, set_out[0].samples)


def test_the_untrained_network_is_that_of_the_cell(plan: Path, tmp_path: Path) -> None:
    replace_in(plan, "clip_norm = 2", 'preprocessing = "paper"')
    options = 'options = { preprocessing = "paper", optimizer = "lars" }'
    replace_in(plan, 'augmentation = "image"', f'augmentation = "image"\n{options}')
    grid = read_grid(plan)
    random = next(task for task in grid.tasks() if task.random)
    assert grid.config(random, Path()).preprocessing == "paper"
    assert "paper" in settings_of(grid, random)
    assert "lars" not in settings_of(grid, random)


def test_outcomes_of_other_sweeps_and_damaged_ones_are_told(plan: Path, tmp_path: Path) -> None:
    grid, folder = read_grid(plan), tmp_path / "out"
    svm = grid.tasks()[0]
    made_up(folder, grid, svm, "1" * 16)
    with pytest.raises(ConfigError, match=r"no .*tested\.json: run the grid first"):
        gather(grid, folder)
    write_tested(folder, np.repeat([f"mug-{i}" for i in range(8)], 2), 2)
    assert gather(grid, folder).sweeps == 16
    draw_grid(gather(grid, folder), folder / "none.png")  # of no network yet
    made_up(folder, grid, svm, "1" * 15)
    assert "'svm', seed 0, was tested on 15 sweeps, of which there" in refusal(gather, grid, folder)
    path = outcome_path(folder, svm)
    whole = path.read_text()
    for old, new in (('"top1":"1', '"top1":"2'), ("{", "[")):
        path.write_text(whole.replace(old, new, 1))
        assert "svm_seed0.json is damaged" in refusal(gather, grid, folder)


def test_a_full_disk_is_one_line_of_a_process_too(plan: Path, tmp_path: Path) -> None:
    grid, folder = read_grid(plan), tmp_path / "out"
    pool.prepare(grid, folder)
    (folder / "runs").write_text("a file where a folder should be")
    with pytest.raises(OSError, match="runs"):
        run_grid(grid, folder, 2)


def test_a_cell_begins_with_another_and_learns_from_fewer_objects(plan: Path) -> None:
    cell = '[[cell]]\nencoder = "gru"\nbegin = "gru simclr image"\nshare = 0.5\nseeds = 1\n'
    replace_in(plan, "[[question]]", f"{cell}[[question]]")
    grid, folder = read_grid(plan), plan.parent / "out"
    name = "gru after simclr image of 0.5"
    assert [task.name for task in grid.tasks()].count(name) == 1, "one seed"
    (task,) = [task for task in grid.tasks() if task.name == name]
    assert grid.list_dependencies(task) == ("gru_simclr_image_seed0",)
    other = msgspec.structs.replace(grid, self_supervised={"masking": 0.5})
    assert settings_of(other, task) != settings_of(grid, task)
    bench = begun(plan, folder)
    few = bench.splits_with_share(0.5)[0]
    assert set(few.sweeps.objects) == {"mug-0", "mug-1", "car-0", "car-1"}
    assert bench.splits_with_share(1.0)[0] is bench.splits[0]
    said = "'gru simclr image' diverged, so there is no checkpoint to begin with"
    assert bench.do(task).failed == said
    (before,) = [t for t in grid.tasks() if t.slug in grid.list_dependencies(task)]
    assert not bench.do(before).failed
    shutil.rmtree(folder / "runs" / before.slug)  # its outcome was kept, its network was not
    done = bench.do(task)
    assert not done.failed and done.chosen is not None
    config = json.loads(next((folder / "runs" / task.slug).glob("*/config.json")).read_text())
    assert config["begin"].startswith(str(folder / "runs" / before.slug))
    assert "after simclr image of 0.5" in table(gather(grid, folder))


def test_what_only_its_scores_were_kept_of_is_trained_again(plan: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    bench = begun(plan, folder)
    task = bench.grid.tasks()[1]
    first = bench.do(task)
    outcome_path(folder, task).unlink()
    for network in (folder / "runs" / task.slug).rglob("best.pt"):
        network.unlink()
    told: list[object] = []
    again = bench.do(task, told.append)
    assert (again.top1, again.trials) == (first.top1, first.trials)
    assert again.chosen is not None
    assert [p.update for p in told if not p.metrics] == [*range(1, again.chosen.updates + 1)]  # type: ignore[attr-defined]


def test_the_longest_training_is_not_longer_than_it_helps(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    growth = msgspec.convert({"first": 10, "most": 100}, Growth)
    grid = msgspec.structs.replace(read_grid(plan), growth=growth)
    scores = {10: 0.5, 20: 0.6, 40: 0.605, 80: 0.9}
    bench = object.__new__(Workbench)
    bench.grid = grid
    monkeypatch.setattr(
        bench, "_train", lambda task, at, report: replace(at, score=scores[at.updates])
    )
    replace = msgspec.structs.replace
    points = bench._grow(grid.tasks()[1], Training(1e-3, 0.1, 2, 0.0, 0.0), print)
    assert [p.updates for p in points] == [10, 20, 40], "0.005 more is not worth going on"


def test_a_grid_without_its_sweeps_says_so(plan: Path, tmp_path: Path) -> None:
    grid = msgspec.structs.replace(read_grid(plan), data=str(tmp_path / "none"))
    with pytest.raises(RecordingError, match="is not a sweep set"):
        run_grid(grid, tmp_path / "out")
    assert "has no outcome yet" in refusal(gather, grid, tmp_path / "out")


def made_up(folder: Path, grid: results.Grid, task: Task, right: str) -> None:
    """An outcome as if the task had been done."""
    path = outcome_path(folder, task)
    path.parent.mkdir(parents=True, exist_ok=True)
    outcome = Outcome(task.name, task.seed, settings_of(grid, task), right, right, right)
    path.write_bytes(msgspec.json.encode(outcome))


def test_comparisons_are_of_the_same_sweeps_and_seeds(plan: Path, tmp_path: Path) -> None:
    grid, folder = read_grid(plan), tmp_path / "out"
    folder.mkdir()
    write_tested(folder, np.repeat([f"mug-{i}" for i in range(8)], 2), 2)
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


def test_no_process_hears_an_interrupt_even_while_it_begins(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class StartedError(Exception):
        pass

    def start(process: SpawnProcess) -> None:
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())  # as it inherits
        raise StartedError

    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    monkeypatch.setattr(SpawnProcess, "start", start)
    with pytest.raises(StartedError):
        run_grid(read_grid(plan), tmp_path / "two", 2)
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before


@pytest.mark.slow
def test_processes_share_the_work(plan: Path, tmp_path: Path) -> None:
    grid = read_grid(plan)
    told: list[str] = []
    run_grid(grid, tmp_path / "two", 2, lambda found, done, total: told.append(found.name))
    assert sorted(told) == sorted(task.name for task in grid.tasks())
    run_grid(grid, tmp_path / "one")
    for task in grid.tasks():  # who does it does not change what comes of it
        one, two = (read_outcome(grid, tmp_path / k, task) for k in ("one", "two"))
        assert one is not None and two is not None and one.top1 == two.top1
