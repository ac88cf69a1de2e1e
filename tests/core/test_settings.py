"""What users write becomes structs, and every mistake is one line in the same words."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import (
    check_columns,
    convert,
    make_node,
    nearest,
    no_such,
    parse_toml,
    read_csv,
    read_toml,
    set_key,
    split_url,
    take_options,
)
from tests.helpers.refusals import refusal


@dataclass(frozen=True)
class Line:
    baud: int = 9600
    dtr: bool = True


@dataclass(frozen=True)
class Device:
    base: int = 0x100
    scale: float = 1.0
    name: str = ""


def test_each_takes_what_it_knows():
    fields = {"base": "0x2A0", "baud": "115200", "dtr": "false", "scale": "2.5e-3", "name": "7"}
    line, device = take_options("sensor", fields, Line, Device)
    assert line == Line(115200, False)
    assert device == Device(0x2A0, 2.5e-3, "7")
    assert take_options("sensor", {}, Line, Device) == (Line(), Device())


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"bade": "1"}, "sensor has no option 'bade'; did you mean baud?"),
        ({"baud": "fast"}, "sensor: baud: expected a whole number, got 'fast'"),
        ({"baud": "0x" + 5000 * "f"}, "sensor: baud: expected a whole number, got '0xffff"),
        ({"dtr": "maybe"}, "sensor: dtr: expected true or false, got 'maybe'"),
    ],
)
def test_a_mistake_is_named(fields, said):
    assert refusal(take_options, "sensor", fields, Line).startswith(said)


@pytest.mark.parametrize("text", ["nan", "-inf", "1e999"])
def test_what_is_no_quantity_is_refused_in_text_and_in_toml(text):
    said = f"{float(text)} is not a finite number"
    assert refusal(take_options, "sensor", {"scale": text}, Device) == f"sensor: scale: {said}"
    if text != "1e999":
        assert refusal(parse_toml, f"a = [1.0, {text}]", "x.toml") == f"x.toml:1: a[1]: {said}"


def test_a_url_is_taken_apart():
    assert split_url("can:slcan:/dev/ttyACM0?a=b=c&d=%26+&e=") == (
        "can", "slcan:/dev/ttyACM0", {"a": "b=c", "d": "&+", "e": ""},
    )  # fmt: skip
    assert split_url("") == ("", "", {})
    assert refusal(split_url, "x:?a=1&b=2&a=3") == "option 'a' is given twice"


class Place(msgspec.Struct, forbid_unknown_fields=True):
    grid: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class Limit:
    stop_s: float = 1.0

    def __post_init__(self):
        if self.stop_s < 0:
            raise ConfigError("stop_s must be 0 or more")


class Table(msgspec.Struct, forbid_unknown_fields=True):
    kind: Literal["slow", "fast"] = "slow"
    name: Annotated[str, msgspec.Meta(pattern="^[a-z]*$", description="word: a to z")] = ""
    elements: dict[str, Place] = {}
    limit: list[Limit] = []
    reads: tuple[str | Place, ...] = ()
    matrix: dict[str, tuple[tuple[float, ...], ...]] = {}
    level: Annotated[int, msgspec.Meta(ge=0, le=9)] | None = None
    texts: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)] = ("a",)
    table: Place = msgspec.field(default_factory=Place)


RIGHT = """
kind = "fast"
reads = ["a", { grid = [1, 2] }]
level = 3
[elements.A0]
grid = [3, 4]
[[limit]]
stop_s = 2
[matrix]
A0 = [[1, 2.5]]
"""


def test_a_document_becomes_a_struct():
    made = convert(parse_toml(RIGHT, "x.toml"), Table)
    assert made.kind == "fast" and made.reads == ("a", Place((1, 2))) and made.level == 3
    assert made.elements == {"A0": Place((3, 4))} and made.limit == [Limit(2.0)]
    assert made.matrix == {"A0": ((1.0, 2.5),)}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("kind = 'fats'", "x.toml:1: kind: 'fats' is not one of slow, fast; did you mean fast?"),
        ("name = 'A'", "x.toml:1: name: 'A' is no word: a to z"),
        ("knid = 1", "x.toml:1: the file has no key 'knid'; did you mean kind?"),
        ("\n[elements.A]\ngird = 1", "x.toml:3: elements.A has no key 'gird'; did you mean grid?"),
        ("[elements]\nA0 = 3", "x.toml:2: elements.A0 is a table of keys, not 3"),
        ("[elements.A0]\ngrid = [1]",
         "x.toml:2: elements.A0.grid: expected a list of 2 whole numbers, got [1]"),
        ("[elements.A0]\ngrid = [1, 'b']",
         "x.toml:2: elements.A0.grid[1]: expected a whole number, got 'b'"),
        ("[[limit]]\n[[limit]]\nstop_s = 'x'",
         "x.toml:3: limit[1].stop_s: expected a number, got 'x' (in seconds)"),
        ("[[limit]]\n[[limit]]\nstop_ms = 1",
         "x.toml:3: limit[1] has no key 'stop_ms'; did you mean stop_s, in seconds?"),
        ("[[limit]]\nstop_s = -1", "x.toml:1: limit[0]: stop_s must be 0 or more"),
        ("[limit]", "x.toml:1: there may be several of limit: write [[limit]]"),
        ("[[table]]", "x.toml:1: only one is allowed: write [table]"),
        ("[table]\nlimit = 1", "x.toml:2: table has no key 'limit'; it is a table of the file: "
         "write [[limit]]"),
        ("reads = [1]", "x.toml:1: reads[0]: expected text or a table, got 1"),
        ("reads = [{ gird = 1 }]", "x.toml:1: reads[0] has no key 'gird'; did you mean grid?"),
        ("[matrix]\nB0 = [[1, 2], [3, 'x']]",
         "x.toml:2: matrix.B0[1][1]: expected a number, got 'x'"),
        ("level = 10", "x.toml:1: level: expected a whole number <= 9, got 10"),
        ("texts = []", "x.toml:1: texts: must not be empty"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_file_has_place_key_found_and_allowed(text, said):
    found = refusal(lambda: convert(parse_toml(text, "x.toml"), Table))
    assert found == said or (said.endswith(",") and found.startswith(said))


def test_a_setting_is_told_in_the_same_words():
    nodes = parse_toml(RIGHT, "x.toml")
    assert convert(set_key(nodes, "limit.0.stop_s=5", Table), Table).limit == [Limit(5.0)]
    said = refusal(lambda: convert(set_key(nodes, "level=many", Table), Table))
    assert said == "--set level=many: level: expected a whole number, got 'many'"
    said = refusal(set_key, nodes, "limit.1.stop_s=5", Table)
    assert said == "--set limit.1.stop_s=5: no limit '1'; there are none"


def test_of_a_part_of_a_tree_the_whole_path_is_told():
    nodes = parse_toml("[a]\n[[a.b]]\ngrid = 1", "x.toml")
    said = refusal(convert, nodes, Place, ["a", "b", 0])
    assert said == "x.toml:3: a.b[0].grid: expected a list of 2 whole numbers, got 1"


def test_what_is_not_from_a_file_has_no_line():
    class Whole(msgspec.Struct):
        needed: int

    assert refusal(convert, make_node({}, "here", 0, Path()), Whole) == "here: needs a key 'needed'"


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "x.toml"
    assert refusal(read_toml, path) == f"{path}: no such file"
    assert refusal(read_toml, tmp_path) == f"{tmp_path}: cannot be read: Is a directory"
    path.write_bytes(b"a = 1\n\xff")
    assert refusal(read_toml, path) == f"{path}:2: not UTF-8 text"
    path.write_text("\ufeffa = 1\n")
    assert read_toml(path).plain() == {"a": 1}
    assert refusal(read_toml, path, 3) == f"{path}: larger than 0 MB: too large for such a file"


def test_rows_of_a_table(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("# a remark\nx, y\n1,2\n,\n 3 ,4.5\n")
    table = read_csv(path)
    assert table.columns == ("x", "y")
    assert [convert(row, dict[str, float], lax=True) for row in table.rows] == [
        {"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.5},
    ]  # fmt: skip
    check_columns(table, ("x", "y", "z"), ("x",))
    said = refusal(check_columns, table, ("x", "yy"))
    assert said.endswith(":2: no column 'y'; did you mean yy?")
    said = refusal(check_columns, table, ("x", "y", "z"), ("z",))
    assert said.endswith(":2: no column z; add it")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", ": is empty; its first line names the columns"),
        ("x;y\n", ":1: columns are separated by semicolons; use commas"),
        ("x,x\n", ":1: column 'x' appears twice; remove one"),
        ("x,y\n1\n", ":2: 1 values for 2 columns"),
        ("x,y\n1,2\n1,a\n", ":3: y: expected a number, got 'a'"),
        ("x,y\n1,nan\n", ":2: y: nan is not a finite number"),
        ("x,y\n1,\n", ":2: y: expected a number, got ''"),
    ],
)
def test_a_mistake_in_a_table_names_the_line(tmp_path, text, said):
    path = tmp_path / "a.csv"
    path.write_text(text)

    def read():
        for row in read_csv(path).rows:
            convert(row, dict[str, float], lax=True)

    assert refusal(read) == f"{path}{said}"


def test_the_nearest_name():
    assert nearest("Pge", ["page", "log"]) == "did you mean page?"
    assert nearest("x", ["page", "log"]) == "there are page, log"
    assert nearest("x", ["page"]) == "there is page" and nearest("x", []) == "there are none"
    assert nearest("zz", [str(n) for n in range(100)]).endswith("17, 18 and 81 more")
    assert no_such("page", "x", ["a"]) == "no page 'x'; there is a"


def readers():
    """(name, function of a path, text that is wrong, where and how that is told)."""
    from tactile_rt.calibration import load_calibration, read_loads
    from tactile_rt.daemon.loading import load_config
    from tactile_rt.drivers.codecs.ascii_mapping import LineMapping, read_mapping
    from tactile_rt.drivers.emulation.faults import read_faults
    from tactile_rt.sources.opening import check_source

    page = 'version = 1\n[page]\nport = "x"'
    yield "daemon", load_config, page, ":3: page.port: expected a whole"
    yield "calibration", load_calibration, "version = 1\ndevice = 7", ":2: device: expected text"
    yield "loads", read_loads, "fy,raw_a\n1,x", ":2: raw_a: expected a number, got 'x'"
    yield (
        "mapping",
        lambda p: read_mapping(str(p), LineMapping),
        "columns = 3",
        ":1: columns: expected a list",
    )
    yield "faults", read_faults, "seed = 'x'", ":1: seed: expected a whole number, got 'x'"
    yield (
        "combined", lambda p: check_source(f"combined:{p}"), "name = 3", ":1: name: expected text",
    )  # fmt: skip


@pytest.mark.parametrize("reader", list(readers()), ids=lambda reader: reader[0])
def test_every_reader_words_its_mistakes_alike(tmp_path, reader):
    name, read, text, said = reader
    path = tmp_path / f"{name}.{'csv' if name == 'loads' else 'toml'}"
    path.write_text(text)
    gone = tmp_path / f"gone{path.suffix}"
    assert refusal(read, path).startswith(f"{path}{said}")
    assert refusal(read, gone) == f"{gone}: no such file"
    path.write_bytes(b"\xff")
    assert refusal(read, path) == f"{path}:1: not UTF-8 text"
    if path.suffix == ".toml":
        path.write_text("a = [\n")
        assert refusal(read, path).startswith(f"{path}:2: not TOML: ")


def test_nobody_else_reads_toml_or_words_msgspecs_mistakes():
    package = Path(__file__).parents[2] / "tactile_rt"
    assert package.is_dir()
    for path in package.rglob("*.py"):
        if path.parent.name != "settings":
            text = path.read_text(encoding="utf-8")
            assert "tomllib" not in text and "msgspec.toml" not in text, path
