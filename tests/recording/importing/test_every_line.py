"""Every line of a file of text is a header, a remark, a sample, or counted as none."""

from random import Random

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactile_rt.core.stream import concatenate
from tactile_rt.drivers.logs import read_log
from tactile_rt.recording import Recording
from tactile_rt.recording.checking import compare_decoding
from tactile_rt.recording.importing.table import import_table
from tactile_rt.recording.importing.table_form import csv_form, read_table
from tactile_rt.recording.importing.wire import import_wire

N = 40
HEADS = {  # lines above the rows, of three columns
    "": [], "names": ["t,Fx,Fy"], "units": ["t,Fx,Fy", "s,N,N"], "remark": ["# t,Fx,Fy"],
    "preamble": ["Sensor: ATI mini40", "Rate,100", "", "t,Fx,Fy"],
}  # fmt: skip
FEW = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=8
)
COUNTS = {k: st.integers(0, 3) for k in ("cut", "more", "words", "twice", "blank", "remark")}


@FEW
@given(
    st.sampled_from(sorted(HEADS)), st.fixed_dictionaries(COUNTS), st.randoms(),
    st.sampled_from([",", ";", "\t", "|"]), st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]), st.booleans(), st.booleans(),
)  # fmt: skip
def test_the_lines_of_a_table_add_up(
    tmp_path, head, counts, draw: Random, by, end, encoding, swapped, last
):
    body = [f"{k / 100:.2f},{k + 0.5},{-k}.25" for k in range(N)]
    if swapped:
        at = draw.randrange(N - 1)
        body[at], body[at + 1] = body[at + 1], body[at]
    for line in draw.sample(body[2:], counts["twice"]):
        body.insert(body.index(line), line)
    others = [f"{0.5 + k},7" for k in range(counts["cut"])]
    others += ["0.5,7,7,7"] * counts["more"] + ["sensor lost"] * counts["words"]
    others += [""] * counts["blank"] + ["# a remark, of two"] * counts["remark"]
    for line in others + HEADS[head][: counts["blank"]] * (head == "names"):
        body.insert(draw.randrange(2, len(body)), line)
    text = end.join(HEADS[head] + body) + end * last
    path = tmp_path / "t.csv"
    path.write_bytes(text.replace(",", by).encode(encoding))
    columns = "t=time:s,Fx=S.fx:N,Fy=S.fy:N" if HEADS[head] else "time:s,S.fx:N,S.fy:N"
    made = import_table(read_table(path, csv_form(path)), tmp_path / "o.mcap", columns)
    assert made.samples == made.intact == N + counts["twice"]
    assert made.corrupt == counts["cut"] + counts["more"] + counts["words"]
    chunk = concatenate(list(Recording(tmp_path / "o.mcap")))
    assert (np.diff(chunk.t_ns) > 0).all() and (np.diff(chunk.values[:, 0, 0]) >= 0).all()
    assert made.seconds == pytest.approx(0.39, abs=0.011)


@FEW
@given(
    st.integers(0, 3), st.integers(0, 3), st.integers(0, 3), st.booleans(), st.randoms(),
    st.sampled_from(["\n", "\r\n", "\r"]), st.sampled_from(["", "12:00:{:06.3f} -> "]),
)  # fmt: skip
def test_the_lines_that_a_board_printed_add_up(
    tmp_path, cut, words, banner, rest, draw: Random, end, stamp
):
    if stamp:
        end = "\n"
    body = [f"{k},{k + 0.5},-{k}" for k in range(N)]
    for line in ["3,4"] * cut + ["sensor was lost"] * words + [""] * cut:
        body.insert(draw.randrange(1, len(body)), line)
    body = [f"made by board {k}" for k in range(banner)] + body
    text = "".join(f"{stamp.format(k / 10)}{line}{end}" for k, line in enumerate(body))
    (tmp_path / "b.txt").write_bytes((text + "7,8" * (rest and not stamp)).encode())
    fields = {"codec": "ascii_line", "columns": "-,A0.v,A1.v"}
    made = import_wire(read_log(tmp_path / "b.txt"), tmp_path / "o.mcap", fields)
    assert (made.samples, made.intact, made.corrupt) == (N, N, cut)
    passed = [note for note in made.notes if "lines skipped, of text" in note]
    assert len(passed) == bool(words) and all(note.endswith(f": {words}") for note in passed)
    assert any("3 bytes of no whole sample" in n for n in made.notes) == (rest and not stamp)
    again = compare_decoding(tmp_path / "o.mcap")
    assert (again.equal, again.differing) == (N, 0)


@pytest.mark.parametrize(
    ("first", "samples", "corrupt", "told"),
    [
        ("(N): 4.25 Temp: 23.75", N, 0, "lines skipped, of text or of a sample whose beginning"),
        ("Force: 4,25 Temp: 23.75", N, 1, ": 4,25 is a decimal comma or two numbers: line"),
        ("Force: 1,4.25 Temp: 23.75", N, 1, ": 1,4.25 is a decimal comma or two numbers"),
        ("Force: 4.25 Temp: (23,75)", N + 1, 0, ""),
    ],
)
def test_a_labelled_line_that_is_cut_or_has_a_comma_is_told(
    tmp_path, first, samples, corrupt, told
):
    lines = [first, *(f"Force: {k}.5 Temp: {k}" for k in range(N))]
    (tmp_path / "b.txt").write_text("\n".join(lines) + "\n")
    fields = {"codec": "ascii_line", "columns": "Force=A0.force,Temp=A0.temp", "rate_hz": "100"}
    made = import_wire(read_log(tmp_path / "b.txt"), tmp_path / "o.mcap", fields)
    assert (made.samples, made.corrupt) == (samples, corrupt)
    assert any(told in note for note in made.notes) == bool(told), made.notes


TABLES = {  # lines, columns, samples, corrupt, elements that are not valid
    "short rows": (
        ["t,Fx,Fy,ok", *(f"{k / 100},{k},{k}.81"[: 6 if k in (12, 39) else None]
                         + ",1" * (k not in (12, 39)) for k in range(N))],
        "t=time:s,Fx=S.fx,Fy=S.fy", N - 2, 2, 0,
    ),
    "settings above": (["t,Fx", "150", *(f"{k / 100},{k}" for k in range(N))], "", N, 1, 0),
    "settings below the names": (
        ["t,Fx,Fy", "150,2", *(f"{k / 100},{k},1" for k in range(N))], "", N, 1, 0
    ),
    "a mark now and then": (
        ["t,Fx,mark", *(f"{k / 100},{k}" + ",hit" * (k == 7) for k in range(N))], "", N, 0, 0
    ),
    "a cell that most rows lack": (
        ["t,Fx,Fy", *(f"{k / 100},{k}" + ",5" * (k % 3 == 0) for k in range(N))],
        "t=time:s,Fx=A0.fx,Fy=B0.fx", N, 0, 26,
    ),
    "placeholders first": (
        ["t,Fx,Fy", *(f"{k / 100},{'NULL' if k < 3 else k},{'n.a.' if k < 5 else k}"
                      for k in range(N))],
        "t=time:s,Fx=A0.fx,Fy=B0.fx", N, 0, 8,
    ),
    "an error of a spreadsheet begins no remark": (
        ["Fx,t", *(f"{'#N/A' if k < 3 else k},{k / 100}" for k in range(N))], "", N, 0, 3
    ),
    "LabVIEW, no times": (
        ["LabVIEW Measurement\t", "Date\t2024/03/05\t", "***End_of_Header***\t", "\t",
         "Channels\t2\t\t", "Samples\t40\t40\t", "Delta_X\t0,001\t0,001\t",
         "***End_of_Header***\t\t\t", "X_Value\tForce X\tForce Y\tComment",
         *(f"\t{k},500000\t1,000000" + "\tgo" * (k == 0) for k in range(N))],
        "Force X=S.fx,Force Y=S.fy", N, 0, 0,
    ),
    "lists": (["t,f", *(f'{k / 100},"[{k}, 2.5, -1e-3]"' for k in range(N))],
              "t=time:s,f.{0..2}=T{0..2}.p", N, 0, 0),
    "lists without quotes": (["t,f,g", *(f"{k / 100},[{k} nan],(1, 2)" for k in range(N))],
                             "t=time:s,f.{0..1}=T{0..1}.p,g.{0..1}=T{2..3}.p", N, 0, N),
}  # fmt: skip


@pytest.mark.parametrize("name", TABLES)
def test_rows_have_the_width_of_their_table(tmp_path, name):
    lines, columns, samples, corrupt, lacking = TABLES[name]
    path, rate = tmp_path / "t.csv", 1000 if "LabVIEW" in name else 0
    path.write_text("\n".join(lines) + "\n")
    table = read_table(path, csv_form(path))
    made = import_table(table, tmp_path / "o.mcap", columns or "t=time:s,Fx=S.fx", rate)
    assert (made.samples, made.corrupt) == (samples, corrupt)
    assert made.rate_hz == (rate or 100)
    chunk = concatenate(list(Recording(tmp_path / "o.mcap")))
    assert (~chunk.valid).sum() == lacking


@pytest.mark.parametrize(
    ("cell", "column", "seconds"),
    [
        ("9/16/2023 12:59:40 PM", "iso", 46_780), ("9/16/2023 12:59:40 AM", "iso", 3580),
        ("16/09/2023 1:02:03 pm", "iso", 46_923), ("16-09-2023 13:02:03.5", "iso", 46_923.5),
        ("9/16/2023 13:02", "iso", 46_920), ("2023-9-16 9:5:3.25", "iso", 32_703.25),
        ("2023/09/16 09:05:03 a.m.", "iso", 32_703), ("9/5/2023 9:05:03", "mdy", 32_703),
        ("5/9/2023 9:05:03", "dmy", 32_703), ("16/09/2023, 09:05:03", "iso", 32_703),
    ],
)  # fmt: skip
def test_dates_are_read_as_people_write_them(tmp_path, cell, column, seconds):
    later = cell.replace("2023", "2024", 1)
    (tmp_path / "t.csv").write_text(f't;Fx\n"{cell}";1\n"{later}";1\n')
    table = read_table(tmp_path / "t.csv", csv_form(tmp_path / "t.csv"))
    import_table(table, tmp_path / "o.mcap", f"t=time:{column},Fx=S.fx")
    day = 1_693_872_000 if "/5/" in cell or cell[0] == "5" else 1_694_822_400
    begin_ns = day * 10**9 + round(1e9 * seconds)
    assert Recording(tmp_path / "o.mcap").description.utc_offset_ns == begin_ns
