"""Files as other programs write them, and what is right for each: by `tactile-rt import` alone.

Each is made after files that people have: their dialects, headers, times and units. What is held is
what a user gets: how many samples, when, and the numbers.
"""

import struct
from base64 import b64encode

import numpy as np
import pytest

from tactile_rt.core.stream import concatenate
from tactile_rt.recording import Recording
from tests.recording.importing.test_bag import FORMS, bag

N = 20
TIMES = [k / 100 for k in range(N)]  # s
FX = [0.5 * k - 3 for k in range(N)]  # N
FY = [-0.25 * k for k in range(N)]
COLUMNS = "time:s,A.fx:N,A.fy:N"


def rows(line, *, header="", digits="{:.4f}"):
    """A table of time, fx and fy; `line` joins three texts."""
    told = [[digits.format(x) for x in row] for row in zip(TIMES, FX, FY, strict=True)]
    return header + "".join(line(*row) + "\n" for row in told)


def joined(by):
    return lambda *cells: by.join(cells)


def comma(text):
    return text.replace(".", ",")


# name: (file's name, what is in it, arguments)
TABLES = {
    "spaces, aligned": (
        "a.txt", rows(lambda *c: "".join(f"{x:>14}" for x in c)), ["--columns", COLUMNS]
    ),
    "decimal comma": ("a.csv", comma(rows(joined(";"))), ["--columns", COLUMNS]),
    "quoted header": (
        "a.csv", rows(joined(","), header='"time (s)","F x","F y"\n'), ["--columns", COLUMNS]
    ),
    "remarks above": (
        "a.csv", rows(joined(","), header="# made by logger 3\n# 2024-05-10\n"),
        ["--columns", COLUMNS],
    ),
    "exponents": ("a.csv", rows(joined(","), digits="{:.6E}"), ["--columns", COLUMNS]),
    "no time": (
        "a.csv", "".join(f"{x},{y}\n" for x, y in zip(FX, FY, strict=True)),
        ["--columns", "A.fx:N,A.fy:N", "--rate", "100"],
    ),
    "a column of no interest": (
        "a.csv", rows(lambda t, x, y: f"{t},run 7,{x},{y}"), ["--columns", "time:s,-,A.fx:N,A.fy:N"]
    ),
    "scaled": (
        "a.csv",
        "".join(f"{t},{1e3 * x},{1e3 * y}\n" for t, x, y in zip(TIMES, FX, FY, strict=True)),
        ["--columns", "time:s,A.fx*0.001:N,A.fy*0.001:N"],
    ),
}  # fmt: skip


def imported(done, folder, name, content, arguments):
    path = folder / name
    path.write_text(content)
    out = folder / "out.mcap"
    said, _ = done("import", path, out, *arguments)
    return concatenate(list(Recording(out))), Recording(out).description.spec, said


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read(done, tmp_path, name):
    whole, spec, said = imported(done, tmp_path, *TABLES[name])
    assert spec.channels == ("fx", "fy") and spec.units == ("N", "N")
    np.testing.assert_allclose(whole.values[:, 0, 0], FX, atol=1e-5)
    np.testing.assert_allclose(whole.values[:, 0, 1], FY, atol=1e-5)
    np.testing.assert_allclose((whole.t_ns - whole.t_ns[0]) / 1e9, TIMES, atol=1e-4)
    assert whole.valid.all() and f"{N} intact, 0 corrupt, 0 missing" in said
    assert spec.rate_hz == pytest.approx(100, rel=0.01)


def frames(form):
    """Ten samples of an AFT200, two frames each; `form` of (time in s, identifier, bytes)."""
    lines = []
    for k in range(10):
        for i, words in ((1, (30_000 + k, 30_000, 29_000)), (2, (30_100, 30_000 - k, 30_000))):
            lines.append(form(k / 100 + 1e-3 * (i - 1), i, struct.pack(">HHH", *words)))
    return "".join(lines)


def spaced(data, by=" "):
    return by.join(f"{byte:02X}" for byte in data)


UTC = 1_700_000_000
SAVVYCAN = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
VECTOR = "date Fri May 10 09:48:16 am 2024\nbase hex  timestamps absolute\ninternal events logged\n"
LOGS = {
    "candump -l": frames(lambda t, i, d: f"({UTC + t:.6f}) can0 {i:03X}#{spaced(d, '')}\n"),
    "candump": frames(lambda t, i, d: f"  can0  {i:03X}   [{len(d)}]  {spaced(d)}\n"),
    "candump -ta": frames(
        lambda t, i, d: f" ({UTC + t:.6f})  can0  {i:03X}   [{len(d)}]  {spaced(d)}\n"
    ),
    "candump -tz": frames(
        lambda t, i, d: f" ({t:010.6f})  can0  {i:03X}   [{len(d)}]  {spaced(d)}\n"
    ),
    "asc": VECTOR
    + frames(lambda t, i, d: f"{t:11.6f} 1  {i:X}             Rx   d {len(d)} {spaced(d)}\n"),
    "csv of python-can": "timestamp,arbitration_id,extended,remote,error,dlc,data\n"
    + frames(lambda t, i, d: f"{UTC + t:.6f},0x{i:x},0,0,0,{len(d)},{b64encode(d).decode()}\n"),
    "SavvyCAN": SAVVYCAN
    + frames(lambda t, i, d: f"{round(1e6 * t)},{i:08X},false,Rx,0,{len(d)},{spaced(d, ',')},\n"),
    "slcan": frames(lambda t, i, d: f"t{i:03X}{len(d)}{spaced(d, '')}\r"),
}


@pytest.mark.parametrize("name", LOGS)
def test_a_log_of_a_bus_is_read(done, tmp_path, name):
    suffix = {"asc": "asc", "csv of python-can": "csv", "SavvyCAN": "csv"}.get(name, "log")
    words = ["--as", "codec=aft200"]
    whole, spec, said = imported(done, tmp_path, f"can.{suffix}", LOGS[name], words)
    assert len(whole) == 10 and "10 samples in, 20 intact, 0 corrupt" in said
    assert spec.channels == ("fx", "fy", "fz", "mx", "my", "mz")
    steps = np.diff(whole.values[:, 0], axis=0)
    assert (steps[:, 0] > 0).all() and (steps[:, 4] < 0).all() and not steps[:, [1, 2, 3, 5]].any()
    if name not in ("candump", "slcan"):  # which have no times
        assert np.diff(whole.t_ns) == pytest.approx(1e7, abs=2e4)


@pytest.mark.parametrize("form", FORMS)
def test_a_bag_is_read(done, tmp_path, form):
    out = tmp_path / "out.mcap"
    said, _ = done("import", bag(tmp_path, form), out, "--topic", "/ft/wrench")
    whole = concatenate(list(Recording(out)))
    assert whole.values[:, 0].tolist() == [[0.5 * k, 1, 2, 3, 4, -k] for k in range(60)]
    assert np.diff(whole.t_ns).tolist() == [10_000_000] * 59
    assert "60 intact, 0 corrupt, 0 missing" in said
