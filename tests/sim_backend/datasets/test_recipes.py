import sys
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.sets.manifest import WITHHELD
from tactile_rt.sets.sensor_faults import SensorFaults
from tactile_rt.sim_backend.datasets.dataset import describe_set
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe, recipe_of_set, shipped_recipes
from tactile_rt.sim_backend.datasets.recipe_objects import choose_objects
from tactile_rt.sim_backend.datasets.recipes import (
    COUNTS,
    ObjectChoice,
    Range,
    SweepChoice,
    SweepRecipe,
)
from tactile_rt.sim_backend.objects import catalogue as objects
from tactile_rt.sim_backend.sweep import Sweep
from tests.helpers.refusals import refusal


def write(path: Path, text: str) -> str:
    path.write_text(text)
    return str(path)


# The ones that ship


def test_the_default_set_has_the_size_that_training_needs() -> None:
    recipe = read_recipe("default24")
    manifest = describe_set(recipe)
    assert len(manifest.categories) == 24
    assert set(manifest.categories) == set(objects.CATEGORIES)
    assert set(manifest.withheld) == set(objects.WITHHELD)
    assert not set(manifest.categories) & set(manifest.withheld)
    counts = {split: len(names) for split, names in manifest.split.items()}
    assert counts == {"train": 24 * 44, "validation": 24 * 4, "test": 24 * 13, WITHHELD: 4 * 12}
    assert len(recipe.sweeps) == 12
    assert (recipe.period_ns, recipe.lead, recipe.samples) == (9_000_000, 24, 164)
    assert recipe.profile == "realtime"


def test_default24_draws_from_the_stated_ranges() -> None:
    recipe = read_recipe("default24")
    drawn = [drawn_of(recipe, k, f"mug-{i}") for i in range(40) for k in range(12)]
    ranges = {
        "speed_mm_s": (28, 40),
        "yaw_deg": (0, 360),
        "height_mm": (-8, 4),
        "distance_mm": (5.5, 8),
        "gap_mm": (0.5, 4),
    }
    for name, (low, high) in ranges.items():
        values = np.array([getattr(s, name) for s in drawn])
        assert low <= values.min() < low + 0.05 * (high - low), name
        assert high >= values.max() > high - 0.05 * (high - low), name
        assert np.histogram(values, bins=8, range=(low, high))[0].min() > 30, name
    assert {s.size_mm for s in drawn} == {40.0}


def test_the_papers_sets_have_its_combinations() -> None:
    """Chung et al. (2025), appendix A1."""
    low = read_recipe("paper-lowvar-highfi")
    assert (low.profile, len(low.sweeps)) == ("dataset", 16)
    drawn = [drawn_of(low, i) for i in range(16)]
    grid = {(s.height_mm, s.yaw_deg, s.distance_mm) for s in drawn}
    assert grid == {(h, y, d) for h in (-5, 0) for y in (0, 30, 90, 120) for d in (5, 8)}
    assert {(s.speed_mm_s, s.size_mm) for s in drawn} == {(30, 40)}

    high = read_recipe("paper-highvar-lowfi")
    assert (high.profile, len(high.sweeps)) == ("realtime", (24 + 2) * 12)
    drawn = [drawn_of(high, i) for i in range(312)]
    groups: dict[int, list[Sweep]] = {}
    for i, sweep in enumerate(drawn):
        groups.setdefault(high.sweeps.draw_index(i), []).append(sweep)
    assert len(groups) == 26 and high.sweeps.draws == 24
    for group in groups.values():
        assert len({(s.speed_mm_s, s.size_mm) for s in group}) == 1, "once per group"
        first = min(s.yaw_deg for s in group)
        assert 0 <= first <= 89
        wanted = {(h, first + turn) for h in (-3, 0, 3) for turn in (0, 90, 180, 270)}
        assert {(s.height_mm, s.yaw_deg) for s in group} == wanted
    assert {s.distance_mm for s in drawn} == {5}
    for low_end, high_end, values in (
        (30, 60, {s.speed_mm_s for s in drawn}),
        (20, 60, {s.size_mm for s in drawn}),
    ):
        assert len(values) == 26 and low_end <= min(values) and max(values) <= high_end
        assert max(values) - min(values) > 0.7 * (high_end - low_end)


def drawn_of(recipe: SweepRecipe, index: int, name: str = "mug-0") -> Sweep:
    """As `make_sweep` draws it."""
    shared = recipe.rng(name, recipe.sweeps.draw_index(index), 3)
    return recipe.sweeps.draw(recipe.rng(name, index), index, shared)


@pytest.mark.parametrize("name", shipped_recipes())
def test_a_shipped_recipe_is_called_what_its_file_is_called(name: str) -> None:
    recipe = read_recipe(name)
    assert recipe.name == name
    assert recipe_of_set(recipe.to_dict()) == recipe
    assert all(side for side in describe_set(recipe).split.values())


# Draws


def test_every_parameter_of_a_sweep_can_be_chosen() -> None:
    chosen = {f.name for f in fields(SweepChoice)} - set(COUNTS)
    assert chosen == {f.name for f in fields(Sweep)}
    assert all(getattr(SweepChoice, name) == getattr(Sweep, name) for name in chosen)


def test_a_sweep_is_drawn_from_seed_object_and_index_alone() -> None:
    recipe = read_recipe("default24")

    def draw(recipe: SweepRecipe, name: str, index: int) -> Sweep:
        return drawn_of(recipe, index, name)

    first = draw(recipe, "mug-3", 7)
    assert draw(replace(recipe, profile="accurate"), "mug-3", 7) == first, "paired sets"
    fewer = replace(recipe, sweeps=replace(recipe.sweeps, draws=8))
    assert draw(fewer, "mug-3", 7) == first, "a larger set begins with the smaller one's sweeps"
    others = [
        draw(recipe, "mug-3", 6),
        draw(recipe, "mug-4", 7),
        draw(recipe, "bowl-3", 7),
        draw(replace(recipe, seed=1), "mug-3", 7),
    ]
    assert len({s.yaw_deg for s in [first, *others]}) == 5


def test_the_draw_of_a_known_sweep_never_changes() -> None:
    """What a stored set says of itself must stay true in every later release."""
    recipe = read_recipe("default24")
    assert recipe.key("mug-3", 7) == [0, 688124435, 7]
    sweep = drawn_of(recipe, 7, "mug-3")
    assert round(sweep.yaw_deg, 6) == 300.180777


@given(
    st.lists(st.floats(-100, 100), min_size=1, max_size=4, unique=True),
    st.lists(st.floats(1, 100), min_size=1, max_size=3, unique=True),
    st.integers(1, 5),
    st.integers(0, 3),
)
def test_a_grid_has_every_combination_as_often_as_draws(heights, sizes, draws, held_out) -> None:
    choice = SweepChoice(
        height_mm=Range(each=tuple(heights)),
        size_mm=Range(each=tuple(sizes)),
        yaw_deg=Range((0, 360)),
        draws=draws,
        held_out_draws=held_out,
    )
    each = draws + held_out
    assert len(choice) == len(heights) * len(sizes) * each
    rng = np.random.default_rng(0)
    found = [choice.draw(rng, i, rng) for i in range(len(choice))]
    pairs = [(s.height_mm, s.size_mm) for s in found]
    assert all(pairs.count((h, s)) == each for h in heights for s in sizes)
    marked = [choice.draw_index(i) for i in range(len(choice))]
    assert sorted(marked) == sorted(list(range(each)) * (len(choice) // each))


# A user's own


def test_what_is_drawn_once_is_shared_by_a_draw_s_combinations(tmp_path: Path) -> None:
    path = write(
        tmp_path / "mine.toml",
        """
        [sweeps]
        draws = 3
        size_mm = { between = [20, 60], once = true }
        speed_mm_s = { between = [20, 60] }
        yaw_deg = { between = [0, 1], plus = [0, 100] }
        """,
    )
    recipe = read_recipe(path)
    assert recipe.sweeps.size_mm == Range((20.0, 60.0), once=True)
    assert recipe_of_set(recipe.to_dict()) == recipe
    drawn = [drawn_of(recipe, i) for i in range(len(recipe.sweeps))]
    assert len(drawn) == 6
    assert len({s.size_mm for s in drawn}) == 3 and len({s.speed_mm_s for s in drawn}) == 6
    assert len({s.yaw_deg for s in drawn}) == 6
    assert sum(100 <= s.yaw_deg <= 101 for s in drawn) == 3
    assert [drawn_of(recipe, i) for i in range(6)] == drawn, "any of them can be made again"
    for text in ("each = [1, 2], once = true", "each = [1, 2], peak = 2"):
        refused = write(tmp_path / "no.toml", f"[sweeps]\nsize_mm = {{ {text} }}\n")
        with pytest.raises(ConfigError, match=r"no\.toml:2: .*once = true"):
            read_recipe(refused)


def test_a_middle_may_be_drawn_oftener_than_the_ends(tmp_path: Path) -> None:
    text = "[sweeps]\ndraws = 4000\nroll_deg = { between = [-100, 300], peak = 3 }\n"
    recipe = read_recipe(write(tmp_path / "peak.toml", text))
    assert recipe_of_set(recipe.to_dict()) == recipe
    rng = np.random.default_rng(0)
    away = np.abs([recipe.sweeps.draw(rng, i, rng).roll_deg - 100 for i in range(4000)]) / 200
    # the third root of what is drawn is even
    assert away.max() <= 1
    for share in (0.1, 0.5, 0.9):
        assert np.quantile(away, share) == pytest.approx(share**3, abs=0.04)
    for peak in ("0.5", "11"):
        refused = write(
            tmp_path / "no.toml", f"[sweeps]\nroll_deg = {{ between = [0, 1], peak = {peak} }}\n"
        )
        assert "peak must be from 1 to 10" in refusal(read_recipe, refused)


def test_a_recipe_of_ones_own(tmp_path: Path) -> None:
    path = write(
        tmp_path / "mine.toml",
        """
        name = "mine"
        array = "rat"
        period_ms = 1
        lead_ms = 30
        length_ms = 500
        [objects]
        from = "varied-shapes"
        categories = ["mug", "bowl"]
        withheld = ["goblet"]
        outliers = ["jack"]
        per_category = 4
        validation = 1
        test = 1
        per_withheld = 2
        [sweeps]
        draws = 2
        speed_mm_s = { each = [30, 35.5] }
        yaw_deg = { between = [-10, 10] }
        [sensor]
        noise_force = 1e-5
        [randomisation]
        friction = 0.2
        [faults]
        dead_row = 0.25
        drift = 2
        """,
    )
    recipe = read_recipe(path)
    assert recipe.sweeps.speed_mm_s == Range(each=(30.0, 35.5))
    assert recipe.sweeps.yaw_deg == Range((-10.0, 10.0))
    assert (recipe.sensor.noise_force, recipe.randomisation.friction) == (1e-5, 0.2)
    assert (recipe.lead, recipe.samples) == (30, 500)
    manifest = describe_set(recipe)
    assert manifest.spec.name == "rat-right"
    assert manifest.categories == ("mug", "bowl")
    assert manifest.split == {
        "train": ("varied-mug-0", "varied-bowl-0", "varied-mug-1", "varied-bowl-1"),
        "validation": ("varied-mug-2", "varied-bowl-2"),
        "test": ("varied-mug-3", "varied-bowl-3"),
        "withheld": ("varied-goblet-0", "varied-goblet-1"),
        "outliers": ("varied-jack-0", "varied-jack-1"),
    }
    kinds = {n: (manifest.category(n), manifest.label(n)) for n in manifest.names()}
    assert kinds["varied-bowl-1"] == ("bowl", 1)
    assert kinds["varied-goblet-0"] == ("goblet", -1)
    assert kinds["varied-jack-0"] == ("jack", -1)
    assert manifest.faults == recipe.faults == SensorFaults(dead_row=0.25, drift=2)
    assert recipe_of_set(manifest.recipe) == recipe


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("sead = 1", r":1: the file has no key 'sead'; did you mean seed\?"),
        ("[sensor]\nnoise_force = -1", r"sensor: noise_force must be 0 or more, not -1"),
        ("[randomisation]\nfriction = 2", r"randomisation: friction is relative"),
        ("seed = -1", "seed must be 0 or more, not -1"),
        ("period_ms = 0.5", "period_ms must be 1 or more, the simulator's own, not 0.5"),
        ("lead_ms = 2000", r"length_ms \(1476\) must exceed lead_ms \(2000\)"),
        ("profile = 'realtim'", r"no profile 'realtim'; did you mean realtime\?"),
        (
            "[sweeps]\nyaw_deg = [0, 90]",
            r":2: sweeps.yaw_deg: expected a number or a table, got \[0, 90\]",
        ),
        ("[sweeps]\nyaw_deg = { between = [0] }", r"sweeps.yaw_deg: expected a number, \{ between"),
        (
            "[sweeps]\nyaw_deg = { each = [nan] }",
            r"sweeps.yaw_deg.each\[0\]: nan is not a finite number",
        ),
        (
            "[sweeps]\nyaw_deg = { between = [9, 1] }",
            "between must begin with its lower end, not 9, 1",
        ),
        ("[sweeps]\nsize_mm = 1e300", "sweeps: size_mm must be 0.001 to 10000, not 1e[+]300"),
        ("length_ms = 1e12", "length_ms must be at most 600000, not 1e[+]12"),
        ("[objects]\nper_category = 1000000000", "per_category must be at most 100000, not 1e"),
        (
            "[sweeps]\nspeed_mm_s = { each = [30, -3] }",
            "sweeps: speed_mm_s must be 0.001 to 3000, not -3",
        ),
        ("[sweeps]\ndraws = 0", "sweeps: draws must be at least 1, not 0"),
        ("[objects]\ncategories = ['a', 'a']", "objects: categories: 'a' appears twice"),
        ("[objects]\ncategories = ['mug']\nwithheld = ['mug']", "'mug' is also one of the cat"),
        ("[objects]\nfrom = 'varied-shape'", r"no such folder 'varied-shape'; did you mean varied"),
        ("[faults]\ndead_row = 2", "dead_row must be between 0 and 1, not 2"),
        ("[objects]\ntest = 0.5", "objects: test must be a whole number, at least 1, not 0.5"),
    ],
)
def test_a_mistake_is_one_line_with_file_key_and_remedy(tmp_path, text, complaint) -> None:
    path = write(tmp_path / "mine.toml", text)
    with pytest.raises(ConfigError, match=complaint) as refused:
        read_recipe(path)
    assert str(refused.value).startswith(path)
    assert str(refused.value).count(path) == 1
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[objects]\ncategories = ['mugs']", r"no category 'mugs'; did you mean mug\?"),
        ("[objects]\nper_category = 16", "16 objects cannot be split with 4 .* and 12 for test"),
        ("array = 'moose'", "no simulated array 'moose': did you mean mouse"),
    ],
)
def test_what_does_not_exist_is_found_when_the_set_is_described(tmp_path, text, complaint) -> None:
    recipe = read_recipe(write(tmp_path / "mine.toml", text))
    with pytest.raises(ConfigError, match=complaint):
        describe_set(recipe)


# A folder of meshes


class FakeFolder:
    """What `object_sets.open_objects` gives for a folder of two categories, one object broken."""

    origins: ClassVar[dict[str, Any]] = {}

    def __init__(self, sizes: dict[str, int]) -> None:
        self.categories = {f"{c}/{i:x}": c for c, n in sizes.items() for i in range(n)}
        self.names = tuple(self.categories)
        self.skipped = {"cup/broken": "no volume"}

    def load(self, name: str) -> str:
        return f"the mesh of {name}"


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch):
    def use(sizes: dict[str, int]) -> None:
        module = SimpleNamespace(open_objects=lambda path, mesh, labels: FakeFolder(sizes))
        monkeypatch.setitem(sys.modules, "tactile_rt.sim_backend.objects.object_sets", module)

    return use


def test_meshes_are_split_eight_to_one_to_one_by_object(folder) -> None:
    folder({"cup": 40, "chair": 21, "train": 5})
    recipe = recipe_of_set({"objects": {"from": "meshes", "withheld": ["train"]}})
    objects = choose_objects(recipe.objects)
    assert objects.categories == ("chair", "cup")
    counts = {split: len(names) for split, names in objects.split.items()}
    assert counts == {"train": 32 + 17, "validation": 4 + 2, "test": 4 + 2, "withheld": 5}
    names = [name for side in objects.split.values() for name in side]
    assert len(names) == len(set(names)) == 66
    assert not any("/" in name for name in names), "a name is a file's name"
    assert all(objects.category_of[name] == name.split("-")[0] for name in names)
    assert objects.load("cup-1f") == "the mesh of cup/1f"
    assert objects.skipped == {"cup/broken": "no volume"}
    held_out = set(objects.split["test"])
    folder({"cup": 40, "chair": 21, "train": 5, "lamp": 30})
    assert held_out < set(choose_objects(recipe.objects).split["test"])


def test_fewer_of_a_folder_and_too_few(folder) -> None:
    folder({"cup": 40, "chair": 2})
    some = {"from": "meshes", "categories": ["cup"], "per_category": 10, "validation": 2, "test": 3}
    split = choose_objects(recipe_of_set({"objects": some}).objects).split
    assert [len(names) for names in split.values()] == [5, 2, 3]
    with pytest.raises(ConfigError, match=r"meshes: chair has 2 objects, too few to hold out 1"):
        _ = choose_objects(recipe_of_set({"objects": {"from": "meshes"}}).objects).split
    wrong = recipe_of_set({"objects": {"from": "meshes", "categories": ["cups"]}})
    with pytest.raises(ConfigError, match=r"no category 'cups'; did you mean cup\?"):
        _ = choose_objects(wrong.objects).split


def test_a_folder_names_each_object_once(folder, monkeypatch: pytest.MonkeyPatch) -> None:
    folder({"a": 3, "a-b": 3})
    monkeypatch.setattr(FakeFolder, "names", ("a/b", "a-b"), raising=False)
    monkeypatch.setattr(FakeFolder, "__init__", lambda self, sizes: None)
    with pytest.raises(
        ConfigError, match="names of two objects differ only by / and -: rename one"
    ):
        _ = choose_objects(ObjectChoice(source="meshes")).split


def test_no_such_recipe(tmp_path: Path) -> None:
    assert "no recipe 'default42'; did you mean default24?" in refusal(read_recipe, "default42")
    assert "none.toml: no such file" in refusal(read_recipe, str(tmp_path / "none.toml"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    assert "bytes.toml:1: not UTF-8 text" in refusal(read_recipe, str(tmp_path / "bytes.toml"))


def test_without_a_distance_it_is_that_of_the_array(tmp_path: Path) -> None:
    """Recipes that name one keep it: millimetres are millimetres."""

    def distance(text: str) -> object:
        return read_recipe(write(tmp_path / "mine.toml", text)).sweeps.distance_mm

    assert distance("") == 6.5
    assert distance("array = 'rat'") == 8.75
    assert distance("array = 'rat'\n[sweeps]\ndistance_mm = 6.5") == 6.5
    assert distance("array = 'rat'\n[sweeps]\nyaw_deg = 3") == 8.75
