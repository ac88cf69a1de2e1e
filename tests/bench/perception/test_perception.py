"""The benchmark: its data keep what they promise, its figures are right, its page says them."""

import csv
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.perception.area import OBJECTS, BenchmarkResults
from bench.perception.data import FILE, SHAPES_FILE, SOURCE, Data, Portion, load, pack
from bench.perception.folds import KINDS, TEST_KINDS
from bench.perception.generator import _without, measured
from bench.perception.methods import Method, of_kinds
from bench.perception.page import PAGE, figures, made
from bench.perception.scores import Figures, score
from tactile_rt.models.datasets import SweepSet, join_sets
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation.measured_coverage import Coverage
from tactile_rt.models.evaluation.measures import Interval
from tactile_rt.sets.manifest import OUTLIERS, WITHHELD
from tactile_rt.sets.objects import write_object
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe, recipe_of_set
from tactile_rt.sim_backend.objects.object_sets import ObjectRow
from tests.helpers.source_tree import ROOT

SPLITS = ("train", "validation", "test", SOURCE, OUTLIERS, WITHHELD)
LISTS = ROOT / "tactile_rt/sim_backend/objects/lists"


@pytest.fixture(scope="module")
def data() -> Data:
    return load()


@pytest.fixture(scope="module")
def shapes() -> Data:
    return load(SHAPES_FILE)


def groups(name: str) -> dict[str, tuple[str, str]]:
    """What things of a list are copies of, by their names in a set."""
    with (LISTS / f"{name}.csv").open() as file:
        return {
            f"{row['category']}-{row['name']}": (row["category"], row["shape"] or row["name"])
            for row in csv.DictReader(file)
        }


def test_shapes_are_small_and_known_to_all_and_kinds_for_testing_apart(shapes: Data) -> None:
    assert SHAPES_FILE.stat().st_size <= 12e6
    assert len(shapes.kinds) == 13
    of_split = defaultdict(set)
    for origin in shapes.origins.values():
        of_split[origin.split].add(origin.category)
    assert all(of_split[side] == set(shapes.kinds) for side in ("train", "validation", "test"))
    assert of_split[KINDS] == {"other"}
    kind_of = shapes.sets["train"].manifest.kind_of
    for name, origin in shapes.origins.items():
        kept = origin.category == "other" and kind_of[name] in TEST_KINDS
        assert (origin.split == KINDS) == kept, name
    tested = set(shapes.wide["test"].sweeps.objects.tolist())
    assert tested == set(shapes.sets["test"].sweeps.objects.tolist())


def test_no_thing_of_shapes_is_on_two_sides(shapes: Data) -> None:
    group, sides = groups("real2"), defaultdict(set)
    for name, origin in shapes.origins.items():
        if origin.split != KINDS:  # which are held out by kind
            sides[group[name]].add(origin.split)
    assert {k: v for k, v in sides.items() if len(v) > 1} == {}


def test_it_is_small_and_has_kinds_and_objects_enough(data: Data) -> None:
    assert FILE.stat().st_size <= 5e6
    assert len(data.kinds) >= 25
    of_split = defaultdict(set)
    for origin in data.origins.values():
        of_split[origin.split].add(origin.category)
    unknown = of_split[OUTLIERS] | of_split[WITHHELD]
    assert len(unknown) >= 20 and not unknown & set(data.kinds)
    assert not of_split[OUTLIERS] & of_split[WITHHELD]
    assert len(of_split[SOURCE]) >= 8 and of_split[SOURCE] <= set(data.kinds)
    for split in ("train", "validation", "test"):
        assert of_split[split] == set(data.kinds)
    assert all(o.licence in ("MIT", "CC0-1.0") for o in data.origins.values())
    assert all(len(data.sets[split].sweeps) for split in SPLITS)


def test_no_shape_is_on_two_sides_and_the_held_out_source_only_on_one(data: Data) -> None:
    shape, sides = groups("real"), defaultdict(set)
    for name, origin in data.origins.items():
        sides[shape[name]].add(origin.split)
    assert {k: v for k, v in sides.items() if len(v) > 1} == {}
    held_out = {o.source for o in data.origins.values() if o.split == SOURCE}
    assert len(held_out) == 1
    elsewhere = {o.source for o in data.origins.values() if o.split not in (SOURCE, WITHHELD)}
    assert not held_out & elsewhere


def test_its_recipes_are_those_that_made_it(data: Data) -> None:
    folder = ROOT / "bench/perception/recipes"
    recipe = read_recipe(str(folder / "real27.toml"))
    assert recipe.objects.categories == data.kinds
    told = {o.category for o in data.origins.values() if o.split == OUTLIERS}
    assert set(recipe.objects.outliers) == told
    stored = data.sets["train"].manifest.recipe
    assert recipe_of_set(stored).sweeps == recipe.sweeps


def test_what_is_packed_is_what_was_felt_to_a_fifth_of_the_noise(
    data: Data, tmp_path: Path
) -> None:
    origins = data.origins
    few = {split: [n for n, o in origins.items() if o.split == split][:2] for split in SPLITS}
    manifest = data.sets["train"].manifest
    names = [n for split in SPLITS for n in few[split]]
    small = replace(
        manifest,
        split={split: tuple(few[split]) for split in SPLITS},
        category_of={n: origins[n].category for n in names},
        withheld=tuple({origins[n].category for n in few[OUTLIERS] + few[WITHHELD]}),
    )
    small.write(tmp_path)
    rng = np.random.default_rng(0)
    felt = {}
    for name in names:
        split = data.sets[origins[name].split].sweeps
        felt[name] = split.values[split.objects == name] * np.float32(1.1)
        felt[name] += (1e-7 * rng.normal(size=felt[name].shape)).astype(np.float32)
        write_object(tmp_path, name, felt[name], {})
    path = tmp_path / "packed.xz"
    parts = [Portion(split, tmp_path, split) for split in SPLITS]
    parts.append(Portion("test", tmp_path, "test", wide=True))
    rows = {n: ObjectRow(category="any", name=n, maker="me", source=n) for n in names}
    path.write_bytes(pack(parts, rows))
    back = load(path)
    assert {n: o.split for n, o in back.origins.items()} == {n: origins[n].split for n in names}
    assert all((o.maker, o.source) == ("me", n) for n, o in back.origins.items())
    assert np.array_equal(back.wide["test"].sweeps.values, back.sets["test"].sweeps.values)
    assert not len(back.wide[SOURCE].sweeps)
    for name in names:
        there = back.sets[origins[name].split].sweeps
        step = 0.2 * manifest.limits.noise
        error = np.abs(there.values[there.objects == name] - felt[name]) / step
        assert error.max() <= 0.51
        kind = origins[name].category
        expected = data.kinds.index(kind) if kind in data.kinds else -1
        assert set(there.labels[there.objects == name]) == {expected}


def oracle(data: Data, wrong: set[str] = frozenset()) -> Method:  # type: ignore[assignment]
    """Knows all that is known, but takes the objects of some sources for the next kind."""

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> np.ndarray:
        n, k = len(sweeps.sweeps), len(data.kinds)
        labels = sweeps.sweeps.labels.copy()
        source = [data.origins[name].source for name in sweeps.sweeps.objects.tolist()]
        labels[np.isin(source, list(wrong))] += 1
        out = np.full((n, k), 0.1 / (k - 1), dtype=np.float32)
        out[np.arange(n), labels % k] = 0.9
        out[labels < 0] = 1 / k
        return out

    return Method("oracle", "the answers", data.kinds, posteriors)


def test_an_oracle_is_right_and_one_that_errs_on_a_source_is_found_out(data: Data) -> None:
    test = data.sets["test"]
    best = score(oracle(data), test)
    figures = (best.top1, best.macro, best.two, best.four, *best.at.values())
    assert all((f.value, f.low, f.high) == (1, 1, 1) for f in figures)
    assert best.calibration.value == pytest.approx(0.1, abs=1e-6)
    source = next(iter(data.origins.values())).source
    share = np.mean([data.origins[n].source == source for n in test.sweeps.objects.tolist()])
    assert score(oracle(data, {source}), test).top1.value == pytest.approx(1 - share)


def test_sets_are_joined_by_the_names_of_their_kinds(data: Data) -> None:
    test = data.sets["test"]
    reverse = data.kinds[::-1]
    turned = of_kinds(test, reverse)
    assert [reverse[k] for k in turned.sweeps.labels] == [data.kinds[k] for k in test.sweeps.labels]
    some = of_kinds(test, ("zebra", data.kinds[3]))
    assert set(some.sweeps.labels) == {1}
    assert len(some.sweeps) == (test.sweeps.labels == 3).sum()
    both = join_sets([of_kinds(one, data.kinds) for one in (test, turned)])
    assert np.array_equal(both.sweeps.labels, np.tile(test.sweeps.labels, 2))


def test_of_several_conditions_the_worst_counts_and_strangers_are_left_out(data: Data) -> None:
    test = data.sets["test"]
    of_row = np.array(test.manifest.spec.grid)[:, 0]
    without = {row: _without(test, of_row == row) for row in np.unique(of_row)}
    for row, there in without.items():
        assert not there.sweeps.values[:, :, of_row == row].any()
        assert np.array_equal(there.sweeps.values[:, :, of_row != row],
                              test.sweeps.values[:, :, of_row != row])  # fmt: skip
    lost = np.unique(of_row)[1]

    def posteriors(sweeps: SweepSet, disturbance: Disturbance) -> np.ndarray:
        blind = not sweeps.sweeps.values[:, :, of_row == lost].any()
        return oracle(data).posteriors(sweeps, disturbance) if not blind else np.tile(
            np.eye(len(data.kinds), dtype=np.float32)[0], (len(sweeps.sweeps), 1)
        )  # fmt: skip

    method = Method("needs a row", "", data.kinds, posteriors)
    wanted = {"sound": [(test, CLEAN)], "worst": [(one, CLEAN) for one in without.values()]}
    found = measured(method, wanted)
    assert found["sound"].value == 1
    assert found["worst"].value == pytest.approx(np.mean(test.sweeps.labels == 0))
    assert measured(replace(method, kinds=data.kinds[1:]), wanted) == {}


def test_the_page_is_made_of_the_figures_beside_it(shapes: Data) -> None:
    page = ROOT / PAGE
    found = json.loads(page.with_suffix(".json").read_text("utf-8"))
    assert page.read_text("utf-8") == made(found, shapes)


def test_figures_are_in_percent_and_what_is_none_is_null(shapes: Data) -> None:
    none, one = Interval(*[float("nan")] * 3), Interval(0.1234, 0.1, 0.2)
    method = Method("m", "real", shapes.kinds, lambda *_: np.zeros(0))
    score = Figures(one, one, one, none, one, {50: one})
    coverage = Coverage(float("nan"), none, none, one, one)
    results = BenchmarkResults(
        shapes, {OBJECTS: {method: score}}, {"f": {"m, real": (score, score)}}, {},
        {}, {"m": {"t": coverage}}, {"m": {"n": one}}, {"m": {"f": one}},
    )  # fmt: skip
    found = json.loads(json.dumps(figures(results)))
    row = found["scores"][OBJECTS]["m, real"]
    assert row["surest 50 %"] == [12.3, 10, 20] and row["four"] is None
    assert found["coverage"]["m"]["t"]["set"] is None
    text = made(found, shapes)
    many = " | ".join(["12.3 (10-20)"] * 2)
    assert f"| m, real | {many} | - | {many} | 12.3 (10-20) |" in text
    assert "| m, real: one sweep | 12.3 (10-20) | 12.3 |" in text
    assert "| m, t | - | - | - | 12.3 (10-20) | 12.3 (10-20) |" in text
