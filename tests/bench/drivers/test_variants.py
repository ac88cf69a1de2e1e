"""The sorter of changed files tells what is right from what is silently wrong; some are read."""

from dataclasses import replace

import numpy as np
import pytest

from bench.drivers.variant_files import EVERY, WHOLE, Variant, all_variants
from bench.drivers.variants import differ, sort_variant
from tactile_rt.core.errors import ConfigError

RIGHT = np.array([1.0, 2.0])
TABLE = Variant("table", "comma")


def sorted_as(folder, answer, notes=(), **more):
    def read(path):
        if isinstance(answer, Exception):
            raise answer
        return answer, notes

    return sort_variant(Variant("neural", "made up", right=(RIGHT,), read=read, **more), folder)


def test_a_verdict_follows_from_what_is_read_and_said(tmp_path):
    assert sorted_as(tmp_path, RIGHT).verdict == "right"
    assert sorted_as(tmp_path, RIGHT, due=True).verdict == "silent"
    assert sorted_as(tmp_path, RIGHT, ["2 left out"], due=True).verdict == "right"
    assert sorted_as(tmp_path, 2 * RIGHT).verdict == "silent"
    assert sorted_as(tmp_path, RIGHT[:1]).verdict == "silent"
    assert sorted_as(tmp_path, 2 * RIGHT, ["odd"]).verdict == "told"
    assert sorted_as(tmp_path, ConfigError("no")).verdict == "told"
    found = sorted_as(tmp_path, ValueError("of a parser"))
    assert found.verdict == "traceback" and "ValueError: of a parser" in found.said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t, v: (t + 7, v), ""),
        (lambda t, v: (t[:-1], v[:-1]), "39 samples of 2 values for 40 of 2"),
        (lambda t, v: (t * 1.1, v), "times differ: 39 is at 0.429 s, not 0.390"),
        (lambda t, v: (t, v[[1, 0, *EVERY[2:]]]), "2 samples differ: 0 is"),
        (lambda t, v: (t, np.where(v == v[3], np.nan, v)), "39 samples of 2 values for 40 of 2"),
    ],
)
def test_samples_are_compared_by_number_value_and_time(change, said):
    found = differ(change(*WHOLE), WHOLE, TABLE)
    assert found.startswith(said) and bool(found) == bool(said)


def test_a_prefix_is_right_where_a_file_was_cut():
    part = (WHOLE[0][:9], WHOLE[1][:9])
    assert differ(part, WHOLE, TABLE) and not differ(part, WHOLE, replace(TABLE, prefix=True))


@pytest.fixture(scope="module")
def variants(tmp_path_factory):
    made = all_variants(tmp_path_factory.mktemp("files"), ["table", "lines", "can", "mcap"])
    return {f"{v.base}: {v.change}": v for v in made}


def test_there_are_many_and_no_two_are_one(variants):
    assert len(variants) > 400
    contents = {(v.base, v.name, v.arguments[0], v.content()) for v in variants.values()}
    assert len(contents) > 0.97 * len(variants)


TABLES = ("comma", "decimal comma", "dates over New Year", "milliseconds")
CHANGES = ("as it is", "a row missing", "CRLF at line ends", "UTF-16", "a column less", "head lost")
GLUED = ("labels of two lines, sniffed: two rows in one", "Label: value, sniffed: two rows in one")
ONES = (
    "asc: empty",
    "labels of two lines, sniffed: UTF-16",
    "tab, no head: begins in a row",
    *GLUED,
)
OTHERS = ("candump -l: as it is", "asc: a row missing", "recording: cut at 60%", *ONES)


@pytest.mark.parametrize("name", [*(f"{b}: {c}" for b in TABLES for c in CHANGES), *OTHERS])
def test_a_variant_is_read_rightly(variants, tmp_path, name):
    found = sort_variant(variants[name], tmp_path)
    assert found.verdict == "right", found.said
