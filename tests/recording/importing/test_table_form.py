"""Tables that others wrote: delimiters, commas, headers, times; what is no table."""

import gzip

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import concatenate
from tactile_rt.recording import Recording
from tactile_rt.recording.importing.table import import_table
from tactile_rt.recording.importing.table_form import csv_form, read_table

N = 50


def imported(path, columns, rate_hz=0.0, **form):
    output = path.with_suffix(".mcap")
    made = import_table(read_table(path, csv_form(path, **form)), output, columns, rate_hz)
    return made, concatenate(list(Recording(output))), Recording(output).description


@pytest.fixture
def table(tmp_path):
    """Import a table that is written so, in one piece or line by line."""

    def written(text, *columns, **form):
        (tmp_path / "t.csv").write_text("".join(text))
        return imported(tmp_path / "t.csv", *columns, **form)

    return written


def rows(form: str) -> str:
    return "".join(form.format(k=k, s=5 + 0.01 * k, a=k - 7, b=0.25 * k) for k in range(N))


WRITTEN = {
    "numpy": ("# t x y\n", "{s:.18e} {a:.18e} {b:.18e}\n", "t=time:s,x=S.fx:mN,y=S.fy:mN"),
    "yarpdatadumper": ("", "{k} {s:.6f} {a} {b} \n", "count,time:s,S.fx:mN,S.fy:mN"),
    "units without brackets": (
        "t;x;y\ns;mN;mN\n", "{s:.2f};{a};{b}\n", "t=time:s,x=S.fx:mN,y=S.fy:mN",
    ),
    "above it": (
        "Sensor: ATI mini40\nRate, 100\n\nt,x,y\n", "{s:.2f},{a},{b}\n",
        "t=time:s,x=S.fx:mN,y=S.fy:mN",
    ),
    "rostopic -p": (
        "%time,field.wrench.force.x,field.wrench.force.y\n", "{s:.2f},{a},{b}\n",
        "%time=time:s,field.wrench.force.x=S.fx:mN,field.wrench.force.y=S.fy:mN",
    ),
    "another mark": ("t,x,y\n", "{s:.2f};{a};{b}\n", "t=time:s,x=S.fx:mN,y=S.fy:mN"),
    "words between": ("", "{s:.2f} N: ({a}, {b})\n", "time:s,S.fx:mN,S.fy:mN"),
    "case": ("Time , FX,fY\n", "{s:.2f}, {a}, {b}\n", "time=time:s,fx=S.fx:mN,fy=S.fy:mN"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITTEN)
def test_a_table_is_read_as_it_is_written(table, name):
    header, form, columns = WRITTEN[name]
    made, chunk, about = table(header + rows(form), columns)
    assert (made.samples, made.intact, made.corrupt, made.missing) == (N, N, 0, 0)
    expected = [[1e-3 * (k - 7), 0.25e-3 * k] for k in range(N)]
    assert chunk.values[:, 0] == pytest.approx(np.array(expected))
    assert np.diff(chunk.t_ns).tolist() == [10_000_000] * (N - 1)
    assert about.spec.rate_hz == 100 and about.spec.units == ("N", "N")


def test_a_thousand_with_a_point_is_no_one(table):
    lines = ["t;F\n", *(f"0,{k:02d};{v}\n" for k, v in enumerate(["999", *["1.000"] * (N - 1)]))]
    made, chunk, _ = table(lines, "t=time:s,F=S.v:1")
    assert chunk.values.ravel().tolist() == [999.0] and made.corrupt == N - 1
    assert "line 3: '1.000 (a thousand?)' is no number" in made.notes[0]


@pytest.mark.parametrize("form", ["{},1'234\u2019{}.5\n", '{},"1,234,{}.5"\n', "{};1.234.{},5\n"])
def test_a_thousand_that_can_be_nothing_else_is_one(table, form):
    _, chunk, _ = table((form.format(k, 100 + k) for k in range(N)), "time:s,S.x:1")
    assert chunk.values.ravel().tolist() == [1_234_100.5 + k for k in range(N)]


def test_columns_that_change_places_are_read_by_their_names(table):
    second = "".join(f"{-k},{N + k},{k}\n" for k in range(N))
    first = "".join(f"{k},{k},{-k}\n" for k in range(N))
    made, chunk, _ = table(f"t,x,y\n{first}y,t,x\n{second}", "t=time:s,x=S.fx,y=S.fy")
    assert made.notes == [f"columns stand in another order from line {N + 2} on"]
    assert chunk.values[:, 0].tolist() == [[k, -k] for k in (*range(N), *range(N))]


def test_a_last_line_that_is_cut_in_a_number_is_told(table):
    text = "t,x\n" + "".join(f"{k / 100:.2f},{1000 + k}\n" for k in range(N))
    assert table(text, "t=time:s,x=S.fx")[0].notes == []
    assert table(text[:-1], "t=time:s,x=S.fx")[0].notes == [], "it is whole"
    (note,) = table(text[:-3], "t=time:s,x=S.fx")[0].notes
    assert note == "its last line, '0.49,10', has no end: it may be cut"
    (note,) = table(f"{text}0.5,1\n0.51,1.25\n0.52,1.2", "t=time:s,x=S.fx")[0].notes
    assert "'0.52,1.2', has no end" in note, "though it is not the shortest"


def test_a_column_that_is_seldom_there_is_a_column(table):
    lines = (f"{k / 100},nan,{20 + k if k % 10 == 0 else ''}\n" for k in range(N))
    columns = "t=time:s,fx=A0.value:1,temp=T0.value:1"
    made, chunk, _ = table(["t,fx,temp\n", *lines], columns)
    assert (made.samples, made.corrupt) == (N, 0)
    assert chunk.valid[:, 1].tolist() == [k % 10 == 0 for k in range(N)]


@pytest.mark.parametrize("late", [1, 30, 300])
def test_a_column_that_comes_late_takes_no_row_with_it(table, late):
    lines = (f"{k / 100},{k},{k if k >= late else ''}\n" for k in range(310))
    made, chunk, _ = table(["t,a,b\n", *lines], "t=time:s,a=A0.fx,b=B0.fx")
    assert (made.samples, made.corrupt) == (310, 0)
    assert chunk.valid[:, 1].tolist() == [k >= late for k in range(310)]


@pytest.mark.parametrize("head", ["t,x,y\n", ""])
def test_a_word_in_the_first_rows_is_counted_as_in_all_others(table, head):
    lines = (f"{k / 100},{'OVERLOAD' if k % 10 < 2 else k},{k}\n" for k in range(N))
    columns = "t=time:s,x=S.fx,y=S.fy" if head else "time:s,S.fx,S.fy"
    made, _, _ = table([head, *lines], columns)
    assert (made.samples, made.corrupt) == (N - 10, 10)


def test_a_time_of_seconds_and_the_rest(table):
    lines = (f"{1_700_000_000 + k // 2},{k % 2 * 500_000_001},ft,{k}\n" for k in range(9))
    _, chunk, about = table(lines, "time:s,time:ns,-,S.fx")
    assert about.utc_offset_ns == 1_700_000_000 * 10**9 and about.spec.rate_hz == 2
    assert chunk.t_ns[:4].tolist() == [0, 500_000_001, 10**9, 1_500_000_001]


def test_days_of_a_spreadsheet_are_told_from_seconds(table):
    lines = [f"{45356.5 + k / 86400:.9f},{k}\n" for k in range(9)]
    made, chunk, _ = table(lines, "time:days,S.fx")
    assert made.first == "2024-03-05 12:00:00.000000" and not made.notes
    assert np.diff(chunk.t_ns) == pytest.approx(1e9, abs=1e5)
    made, _, _ = table(lines, "time:s,S.fx")
    assert "8.64e+04 Hz by its times is too fast" in made.notes[0]


def test_a_long_pause_is_told_with_its_place(table):
    late = [0.01 * k + 50 * (k >= 30) + 2 * (k >= 40) for k in range(N)]
    made, _, about = table([f"{t:.2f},{k}\n" for k, t in enumerate(late)], "time:s,S.fx")
    assert made.notes == ["no rows for 50.01 s after row 30, the longest of 2 gaps"]
    assert about.spec.rate_hz == 100


def test_names_from_windows(tmp_path):
    (tmp_path / "t.csv").write_bytes(("t;T (\u00b0C)\n" + rows("{k};{b}\n")).encode("cp1252"))
    assert csv_form(tmp_path / "t.csv").names == ("t", "T (\u00b0C)")


@pytest.mark.parametrize(
    "first, line", [("", '"{k},5","{k},25"\n'), ("Serial 12345\n", "{k}  {k},25\n")]
)
def test_a_decimal_comma_is_told_from_a_delimiter(table, first, line):
    _, chunk, _ = table([first, *(line.format(k=k) for k in range(9))], "time:s,S.fx")
    assert chunk.values[3, 0, 0] == 3.25


@pytest.mark.parametrize("delimiter", [",", ", ", ";", "; ", "\t", "|"])
@pytest.mark.parametrize("quote", ["", '"'])
def test_cells_that_are_empty_move_none(table, delimiter, quote):
    rows = [[k, "" if k % 4 == 3 else 10 + k, "" if k % 5 == 3 else 20 + k] for k in range(N)]
    lines = [delimiter.join(f"{quote}{cell}{quote}" for cell in row) + "\n" for row in rows]
    made, chunk, _ = table(["Serial 12345\nDevice: Foo 3\n", *lines], "time:s,A0.fx,B0.fx")
    assert (made.samples, made.corrupt) == (N, 0)
    for j in (0, 1):
        read = chunk.values[chunk.valid[:, j], j, 0].tolist()
        assert read == [row[j + 1] for row in rows if row[j + 1]]


def test_names_between_commas_above_spaces(tmp_path):
    (tmp_path / "t.txt").write_text("# t, x, y\n" + rows("{s:.2f} {a} {b}\n"))
    assert csv_form(tmp_path / "t.txt").names == ("t", "x", "y")


def test_commas_alone_are_no_decimal_commas(table):
    lines = (f"{k},{'!x' if k == 9 else f'2,{-k}'}\n" for k in range(N))
    made, chunk, _ = table(lines, "time:s,S.fx")
    assert (made.samples, made.corrupt) == (N - 1, 1)
    assert set(chunk.values[:, 0, 0].tolist()) == {2}


def test_a_comma_of_thousands_is_no_decimal_comma(table):
    with pytest.raises(RecordingError, match="'1,250' is no number"):
        table(["t,x\n", *(f'0.{k},"{k},250"\n' for k in range(1, 9))], "t=time:s,x=S.fx")


@pytest.mark.parametrize(
    "packed", [lambda text: gzip.compress(text.encode()), lambda text: text.encode("utf-16")]
)
def test_gzip_and_utf16(tmp_path, packed):
    (tmp_path / "t.csv").write_bytes(packed("t,x\n" + rows("{s:.2f},{a}\n")))
    assert imported(tmp_path / "t.csv", "t=time:s,x=S.fx")[0].samples == N


@pytest.mark.parametrize(
    ("cell", "column", "t_ns"),
    [
        ("1700000000.123456789", "time:s", 1_700_000_000_123_456_789),
        ("1700000000123456789", "time:ns", 1_700_000_000_123_456_789),
        ("1700000000123.25", "time:ms", 1_700_000_000_123_250_000),
        ("2023-11-14T22:13:20.5Z", "time:iso", 1_700_000_000_500_000_000),
        ("2023-11-14 22:13:20.5", "time:iso", 1_700_000_000_500_000_000),
        ("14.11.2023 22:13:20.5", "time:iso", 1_700_000_000_500_000_000),
        ("2023-11-14,22:13:20.5", "time:iso,time:iso", 1_700_000_000_500_000_000),
    ],
)
def test_times_are_exact_and_those_since_1970_are_utc(table, cell, column, t_ns):
    later = {"time:s": "1700000001", "time:ns": "1700000001000000000", "time:ms": "1700000001000"}
    second = later.get(column, f"2023-11-14{cell[10]}22:13:21")
    made, chunk, about = table(f"{cell},1\n{second},2\n{second[:-1]}9,3\n", f"{column},S.fx")
    assert ("local time" in made.last) == ("iso" in column and "Z" not in cell)
    assert made.first.endswith(" UTC") != ("local time" in made.last)
    assert int(chunk.t_ns[0]) + about.utc_offset_ns == t_ns


def test_what_is_missing_is_not_valid_and_what_is_no_row_is_corrupt(table):
    text = "t,x,y\n0.0,1,2\n0.1,,3\n0.2,nan,null\n0.3,abc,1\n0.4,1\n"
    text += "0.5,1,1\n0.6,1,1\n0.7,1,1\n0.8,1,1\n0.9,1,1"
    made, chunk, _ = table(text, "t=time:s,x=A0.fx,y=B0.fx")
    assert (made.samples, made.corrupt) == (8, 2)
    assert chunk.valid[:3].tolist() == [[True, True], [False, True], [False, False]]
    assert any("'abc' is no number" in note for note in made.notes)


def test_a_count_tells_what_is_missing(table):
    counts = [250, 251, 252, 255, 0, 1, 1, 2]
    lines = (f"{c} {k} 5\n" for k, c in enumerate(counts))
    made, chunk, _ = table(lines, "count:8,time:s,S.fx")
    assert (made.samples, made.missing) == (7, 2)
    assert chunk.seq.tolist() == [0, 1, 2, 5, 6, 7, 8]


def test_rows_of_one_time_are_spread_and_times_that_go_back_go_on(table):
    coarse = [0.0, 0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.2]
    made, chunk, about = table((f"{t},1,2\n" for t in coarse), "time:s,S.fx,S.fy")
    assert np.diff(chunk.t_ns).min() > 15e6 and any("spread" in note for note in made.notes)
    assert about.spec.rate_hz == 40
    assert np.diff(chunk.t_ns).tolist() == [25_000_000] * 11
    back = [*range(9), *range(9)]
    made, chunk, _ = table((f"{t / 10},1,2\n" for t in back), "time:s,S.fx,S.fy")
    assert np.diff(chunk.t_ns).tolist() == [100_000_000] * 17
    assert any("times go back 1 times" in note for note in made.notes)


def test_rows_of_several_lines_after_some_to_skip(table):
    text = ["-10000\n", *(f"{k} 1 2\n{k + 1} 3\n7\n" for k in range(9))]
    made, chunk, _ = table(text, "-{1..3},T{0..2}.p:1", 20, skip=1, lines=3)
    assert made.samples == 9 and chunk.values[4].ravel().tolist() == [5, 3, 7]
    assert np.diff(chunk.t_ns).tolist() == [50_000_000] * 8


def test_columns_of_a_file_are_with_their_places(tmp_path, table):
    (tmp_path / "c.toml").write_text(
        'name = "pad"\ncolumns = ["t=time:s", "x=A0.fx:mN"]\n[elements.A0]\nposition = [1, 2, 3]\n'
    )
    _, _, about = table("t,x\n" + rows("{s:.2f},{a}\n"), str(tmp_path / "c.toml"))
    assert about.spec.name == "pad" and about.spec.positions == ((1, 2, 3),)


@pytest.mark.parametrize(
    ("text", "columns", "why"),
    [
        ("t,Fx\n1,2\n2,3\n", "t=time:s,Fz=S.fz", "no column 'Fz'; there are t, Fx"),
        ("t,Fx\n1,2\n2,3\n", "t=time:s,S.fz", "give all columns a name"),
        ("1,2\n2,3\n", "t=time:s,x=S.fz", "does not name its columns"),
        ("t,Fx\n1,2\n2,3\n", "Fx=S.fx", "no column is a time: give --rate"),
        ("t,Fx\n1,2\n2,3\n", "Fx=S", "'S' is no column"),
        ("t,Fx\n1,2\n1,3\n", "t=time:s,Fx=S.fx", "the same time: leave its column out, and give"),
        ("t,x\n05/10/2024 09:48:16 AM,2\n", "t=time:iso,x=S.x:1", "'05/10/2024 09:.* is no time"),
        ("1,2\n2,3\n", "time:s,S.fx,S.fy,S.fz", "no line has the 4 columns"),
        ("hello, world\nhow, are you\n", "time:s,S.fx", "is no table of numbers"),
        ("", "time:s,S.fx", "is no table of numbers"),
        ("t,sensor,x\n" + "1,1,2\n1,2,3\n" * 9, "t=time:s,x=S.x", "'sensor' says .*1, 2.*pivot"),
        ("t,name,x\n" + "1,a,2\n1,b,3\n" * 9, "t=time:s,x=S.x", "'name' says .*a, b.*: pivot"),
        ("sensor,t0,t1\nfx,1,2\nfy,1,2\nfz,1,3\n", "t0=S.x", "fx, fy, fz .*transpose"),
        ("t,F\n" + "0,01,1,5\n0,02,1,6\n" * 9, "t=time:s", "names 2 columns, its rows have 4"),
        ("t,F\n" + "0.01s,1.5N\n0.02s,5mN\n" * 9, "t=time:s", "cells hold units .5mN."),
        ("".join(f"{c},{'1.5,' * 40}2\n" for c in "tab"), "-,T{0..40}.x", "t, a, b .*transpose"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told_and_nothing_is_written(tmp_path, table, text, columns, why):
    with pytest.raises((ConfigError, RecordingError), match=why):
        table(text, columns)
    assert [p.name for p in tmp_path.iterdir()] == ["t.csv"]


def test_cut_anywhere_nothing_raises(tmp_path):
    whole = ("t,x\n" + rows("{s:.2f},{a}\n")).encode()
    for at in range(0, len(whole), 7):
        (tmp_path / "t.csv").write_bytes(whole[at:])
        try:
            imported(tmp_path / "t.csv", "time:s,S.fx")
        except (ConfigError, RecordingError):
            assert len(whole) - at < 60
