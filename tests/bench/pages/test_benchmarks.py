"""The page of all measured figures holds what commands printed, and nothing else."""

import re

import pytest

pytest.importorskip("mujoco")

from bench.pages.benchmarks import (
    HEADLINES,
    PAGE,
    Measurement,
    bar_table,
    read,
    row,
    section,
    written,
)
from tactile_rt.cli.bench import AREAS
from tactile_rt.models.evaluation.records import Record


def test_the_page_is_made_of_what_is_kept() -> None:
    assert PAGE.read_text("utf-8") == written(), "python -m bench.pages.benchmarks writes it anew"


def test_every_area_is_told() -> None:
    page = PAGE.read_text("utf-8")
    assert re.findall(r"^## (\w+)$", page, re.M) == list(AREAS)
    for area in AREAS:
        assert (f"`tactile-rt bench {area}" in page) or read(area) is not None


def test_what_is_kept_has_its_command_machine_and_day() -> None:
    kept = [found for area in AREAS if (found := read(area)) is not None]
    assert kept
    for found in kept:
        assert found.command.startswith("tactile-rt bench ")
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", found.day)
        assert "cores" in found.machine and found.records


def test_headlines_are_measured_and_every_missed_bar_is_shown() -> None:
    page = PAGE.read_text("utf-8")
    assert set(HEADLINES) == {*AREAS, "missed"}
    shown = 0
    for area in AREAS:
        found = read(area)
        assert found is not None
        assert HEADLINES[area].keys() <= {one.name for one in found.records}
        shown += sum(one.met is False for one in found.records)
    assert page.count(" **MISSED** |") == shown
    assert len(page.split()) < 1500


def test_a_figure_is_shown_beside_its_bar() -> None:
    assert row(Record("a.b", 3.0, "ms", "<= 2", "a rival; x"), "{anchor}") == (
        "| a rival | 3 ms | <= 2 **MISSED** |"
    )
    assert row(Record("a.c", 0.0, "", "== 0"), "none") == "| none | 0 | == 0 met |"
    assert row(Record("a.d", 1.00006, "x", "<= 1"), "d") == "| d | 1.00006 x | <= 1 **MISSED** |"
    assert row(Record("a.e", 515_623.4, "", ""), "e") == "| e | 515,623 |  |"
    made = [Record("a.met", 1, "", "<= 2"), Record("a.no", 3, "", "<= 2"), Record("a.it", 0, "")]
    assert bar_table(made, {"a.it": "it"})[2:] == [
        "| it | 0 |  |",
        "| `a.no` | 3 | <= 2 **MISSED** |",
    ]


def test_a_quick_look_is_marked_and_what_is_not_measured_says_so() -> None:
    looked = Measurement("tactile-rt bench sim --quick", "1", "2026-01-01", "m", ())
    assert "not a figure to quote" in section("sim", looked)
    assert "Not measured yet" in section("sim", None)
