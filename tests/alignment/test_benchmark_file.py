"""Frozen benchmarks at rest."""

import json
import math

import numpy as np
import pytest
from msgspec.structs import replace

from tactile_rt.alignment import benchmark_sha256, load_benchmark, save_benchmark, score
from tactile_rt.alignment.benchmark import Consistency, Frozen
from tactile_rt.alignment.strict import freeze_strict
from tactile_rt.core.errors import ConfigError
from tests.helpers.brains import animals

SHORT = Frozen(np.ones(3), 1.0, 1.0, 9)


@pytest.fixture(scope="module")
def benchmark():
    made = freeze_strict(animals(np.random.default_rng(0), number=3), 20)
    first = made.targets[0]
    poor = replace(
        first, name="mouse-9", chosen=Frozen(np.zeros(15), math.nan, math.nan, 3), reliable=False
    )
    a2a = Consistency(
        (*made.a2a.animals, "mouse-9"),
        np.append(made.a2a.pooled, np.nan),
        np.pad(made.a2a.pairwise, (0, 1), constant_values=np.nan),
    )
    said = {"sources": ("a.nwb", "b.nwb"), "notes": ("session x left out",)}
    return replace(made, targets=(*made.targets, poor), a2a=a2a, **said)


@pytest.fixture
def path(benchmark, tmp_path):
    save_benchmark(benchmark, tmp_path / "benchmark.json")
    return tmp_path / "benchmark.json"


def test_a_benchmark_comes_back_as_it_was(benchmark, path):
    again = load_benchmark(path)
    assert benchmark_sha256(again) == benchmark_sha256(benchmark)
    assert again.protocol == "strict"
    assert (again.notes, again.sources) == (benchmark.notes, benchmark.sources)
    np.testing.assert_array_equal(again.a2a.pairwise, benchmark.a2a.pairwise)
    assert math.isnan(again.targets[3].chosen.factor)
    layers = {"a": np.random.default_rng(1).normal(size=(6, 9))}
    one, other = score(benchmark, layers), score(again, layers)
    assert (one.score, one.p, one.sem) == (other.score, other.p, other.sem)
    np.testing.assert_array_equal(one.corrected, other.corrected)
    assert math.isnan(one.corrected[0, 3])


def test_it_is_small_and_holds_no_rates(path):
    assert path.stat().st_size < 12_000
    whole = json.loads(path.read_text())
    assert set(whole) == {"kind", "benchmark", "sha256"}
    assert set(whole["benchmark"]) == {
        "protocol", "stimuli", "bootstraps", "seed", "targets", "pooled", "a2a", "sources", "notes",
    }  # fmt: skip


def test_a_changed_file_is_refused(path):
    path.write_text(path.read_text().replace('"bootstraps": 20', '"bootstraps": 1000'))
    with pytest.raises(ConfigError, match="changed since it was built"):
        load_benchmark(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "tactile_rt benchmark 2"}, r"of this release.*benchmark 2.*\$\.kind"),
        ({"benchmark": {"protocol": "strict", "targets": 3}}, r"Expected `array`.*\$.*targets"),
        ({"colour": "red"}, "unknown field `colour`"),
    ],
)
def test_a_file_of_another_kind_says_where(path, change, message):
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(ConfigError, match=message) as error:
        load_benchmark(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: replace(b, protocol="loose"), "no protocol 'loose'"),
        (lambda b: replace(b, stimuli=b.stimuli[::-1]), "stimuli"),
        (lambda b: replace(b, targets=b.targets[1:]), "must have the same animals"),
        (
            lambda b: replace(b, targets=(replace(b.targets[0], chosen=SHORT), *b.targets[1:])),
            "an RDM has 15 entries",
        ),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(benchmark, path, change, message):
    save_benchmark(change(benchmark), path)
    with pytest.raises(ConfigError, match=message):
        load_benchmark(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.json: cannot be read"):
        load_benchmark(tmp_path / "none.json")
