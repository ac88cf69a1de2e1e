"""The page of the physics has the figures of its data."""

import json

from bench.pictures.physics import DATA, PAGE, tables
from tactile_rt.sim_backend.arrays.files import load_array


def test_the_tables_of_the_page_are_of_what_was_measured() -> None:
    data, page = json.loads(DATA.read_text("utf-8")), PAGE.read_text("utf-8")
    for name, lines in tables(data).items():
        start = f"<!-- {name}: written by bench/pictures/physics.py -->"
        assert "\n".join([start, *lines, f"<!-- end {name} -->"]) in page
    assert sum("**MISSED**" in line for line in tables(data)["bars"]) == sum(
        one["met"] is False for one in data["bars"]
    )
    whiskers = data["whiskers"]
    assert [row[0] for row in whiskers["rows"]] == [w.name for w in load_array("mouse").whiskers]
    assert {len(row) for row in whiskers["rows"]} == {len(whiskers["columns"])}
