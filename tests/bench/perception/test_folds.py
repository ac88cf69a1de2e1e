"""Folds by maker: nothing of the makers held out, nor what is like it, is learnt from."""

from dataclasses import replace

import numpy as np
import pytest

from bench.perception.area import restrict
from bench.perception.data import Portion
from bench.perception.folds import (
    EVERYONE,
    FOLDS,
    KINDS,
    MAKER,
    hold_out_kinds,
    hold_out_makers,
    write_views,
)
from bench.perception.methods import Method
from tactile_rt.models.datasets import SweepSet, check_sets
from tactile_rt.sets.manifest import SPLITS, SweepManifest
from tactile_rt.sim_backend.objects.object_sets import Origin
from tests.helpers.tiny_sweeps import write_tiny_set

MAKERS = ("sweethome3d", "m3", "kaykit")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swept")
    write_tiny_set(folder, objects=12, sweeps=4, kinds=("rock", "globe"), held_out=3)
    return folder


def origins_of(manifest):
    """Makers in turn; the first object of each category is like the second, by another maker."""
    return {
        name: Origin(maker=MAKERS[number % 3], shape="twin" if name.endswith(("-0", "-1")) else "")
        for number, name in enumerate(sorted(manifest.names()))
    }


@pytest.mark.parametrize("maker", MAKERS)
def test_nothing_of_a_maker_held_out_nor_like_it_is_elsewhere(source, maker):
    manifest = SweepManifest.read(source)
    origins = origins_of(manifest)
    found = hold_out_makers(manifest, origins, [maker])
    assert set(found.split[MAKER]) == {n for n, o in origins.items() if o.maker == maker}
    kept = [n for side in SPLITS for n in found.split[side]]
    assert not {n for n in kept if origins[n].maker == maker}
    for name in set(manifest.names(SPLITS)) - set(kept) - set(found.split[MAKER]):
        assert origins[name].shape == "twin"
    both = {n.partition("-")[0] for n in found.split[MAKER] if origins[n].shape}
    assert not {n for n in kept if origins[n].shape and n.partition("-")[0] in both}


def test_kinds_for_testing_only_are_learnt_by_nobody(source):
    manifest = SweepManifest.read(source)
    one, two = manifest.categories[:2]
    named = {n: "other" if manifest.category(n) == one else two for n in manifest.names()}
    manifest = replace(manifest, categories=("other", two), category_of=named)
    found = hold_out_kinds(manifest)
    rocks = {n for n in named if named[n] == "other" and manifest.kind_of.get(n) == "rock"}
    assert rocks and set(found.split[KINDS]) == rocks
    assert not rocks & set(found.names(SPLITS))
    assert set(found.names()) == set(manifest.names(SPLITS))


def test_a_view_reads_as_any_set_and_a_portion_takes_the_first_sweeps(source, tmp_path):
    origins = origins_of(SweepManifest.read(source))
    write_views(source, origins, tmp_path)
    write_views(source, origins, tmp_path)  # again, once more of it is swept
    assert {p.name for p in tmp_path.iterdir()} == {EVERYONE, *FOLDS}
    splits = [SweepSet.read(tmp_path / "m3", s) for s in ("train", "validation")]
    check_sets(tmp_path / "m3", splits)
    whole = SweepSet.read(tmp_path / EVERYONE, "test")
    part = Portion("test", tmp_path / EVERYONE, "test", most=2).read()
    for name in set(whole.sweeps.objects.tolist()):
        mine = whole.sweeps.values[whole.sweeps.objects == name][:2]
        assert np.array_equal(part.sweeps.values[part.sweeps.objects == name], mine)


def test_a_method_asked_for_some_kinds_shares_its_posterior_among_them():
    found = np.array([[0.5, 0.3, 0.2], [0.0, 0.0, 1.0]], np.float32)
    method = Method("any", "nothing", ("a", "b", "c"), lambda sweeps, disturbance: found)
    asked = restrict(method, ("b", "a")).posteriors(None, None)
    np.testing.assert_allclose(asked, [[0.375, 0.625], [0, 0]], rtol=1e-6)
