"""The drawn house is this one."""

import pytest

pytest.importorskip("grimp")

from bench.pictures.house import FILE, draw, floors, imports, reduced


def test_the_picture_is_of_this_tree() -> None:
    assert FILE.read_text("utf-8") == draw(), "python -m bench.pictures.house redraws it"


def test_every_arrow_leads_down() -> None:
    level = {room: i for i, floor in enumerate(floors()) for room in floor}
    assert all(level[a] < level[b] for a, there in imports().items() for b in there)


def test_what_other_ways_lead_to_is_left_out() -> None:
    arrows = {"a": {"b", "c", "d"}, "b": {"c"}, "c": {"d"}, "d": set()}
    assert reduced(arrows) == {"a": {"b"}, "b": {"c"}, "c": {"d"}, "d": set()}
