"""CAN logs as tools write them: every line that is a frame is read rightly, or told."""

import re

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tactile_rt.drivers.logs import read_log

DATE = "date Tue Mar 5 10:11:12.250 am 2024\n"
BLOCK = "Begin Triggerblock Tue Mar 5 10:11:12.250 am 2024\n   0.000000 Start of measurement\n"
END = "End TriggerBlock\n"
ABSOLUTE, RELATIVE = "base hex  timestamps absolute\n", "base hex  timestamps relative\n"
TRC = ";$FILEVERSION={}\n;$STARTTIME=37704.5364870833\n{}"
STEADY = [0.0, 0.01, 0.02, 0.03]
NAMES = {"Force": (0x1A0, False), "ABC": (0x1A0, False), "Long": (0x18FF0102, True)}


def frames(line, step=0.01, n=4, first=0.0):
    return "".join(line.format(t=first + step * k, k=k, n=k + 1) for k in range(n))


CLASSIC = "{t:11.6f} 1  1A0             Rx   d 3 0{k} FF 07\n"
NAMED = CLASSIC.replace("1A0", "Force")
BUSY = "   0.005000 1  Statistic: D 1 R 0 XD 0 XR 0 E 0 O 0 B 1.00%\n"
FD = "{t:11.6f} CANFD   1 Rx        1A0  {name:>32} 1 0 3  3 0{{k}} FF 07   10 133 303000\n"
GOOD = {
    "a header that ends without a word of events": DATE + "base hex  no internal events logged\n"
    + frames(CLASSIC),
    "comments and blank lines in the header": DATE + "\n// version 7\n" + ABSOLUTE
    + frames(CLASSIC),
    "base first": ABSOLUTE + DATE + frames(CLASSIC),
    "decimal behind a blank line": DATE + "\nbase dec  timestamps absolute\n"
    + frames("{t:.6f} 1 416 Rx d 3 {k} 255 7\n"),
    "no header": frames(CLASSIC),
    "a byte order mark, CRLF": "\ufeff" + (DATE + ABSOLUTE + BLOCK + frames(CLASSIC) + END)
    .replace("\n", "\r\n"),
    "blank lines after the end": DATE + ABSOLUTE + BLOCK + frames(CLASSIC) + END + "\n\n",
    "differences": DATE + RELATIVE + BLOCK + frames(CLASSIC.replace("{t:11.6f}", "   0.010000"))
    + END,
    "differences to other events, too": DATE + RELATIVE + BLOCK
    + frames(BUSY + CLASSIC.replace("{t:11.6f}", "   0.005000")) + END,
    "differences with a decimal comma": DATE + RELATIVE
    + frames(CLASSIC.replace("{t:11.6f}", "0,010000")),
    "requests to transmit": DATE + ABSOLUTE
    + frames(CLASSIC.replace("Rx  ", "TxRq") + CLASSIC.replace("Rx", "Tx")),
    "names": DATE + ABSOLUTE + BLOCK + frames(NAMED) + END,
    "names that are hexadecimal": DATE + ABSOLUTE + frames(NAMED).replace("Force", "ABC", 2),
    "names beside decimals": DATE + "base dec  timestamps absolute\n"
    + frames("{t:.6f} 1 ABC Rx d 3 {k} 255 7\n"),
    "FD": DATE + ABSOLUTE + frames(FD.format(t=0, name="").replace("   0.000000", "{t:11.6f}")),
    "FD with names": DATE + ABSOLUTE
    + frames(FD.format(t=0, name="Force").replace("   0.000000", "{t:11.6f}")),
    "trc 1.0": ";   C:\\a.trc\n;    Start time: 11.09.2002 14:11:05.234\n;----+- ---+---\n"
    + frames("{n:>7}) {t:>6.0f}    01A0 3 0{k} FF 07\n", 10, first=1841),
    "trc 1.1": TRC.format("1.1", frames("{n:>6}) {t:>11.1f}  Rx  01A0  3  0{k} FF 07\n", 10))
    + "     5)      1298.9  Warng  FFFFFFFF  4    00 00 00 08  BUSHEAVY \n",
    "trc 1.2": TRC.format("1.2", frames("{n:>6}) {t:>11.3f} 1  Rx  01A0  3  0{k} FF 07\n", 10)),
    "trc 1.3": TRC.format("1.3", frames("{n:>6}) {t:>11.3f} 1  Rx  01A0 -  3  0{k} FF 07\n", 10)),
    "trc 2.0": TRC.format("2.0", ";$COLUMNS=N,O,T,I,d,l,D\n"
    + frames("{n:>6} {t:>11.3f} DT     01A0 Rx 3  0{k} FF 07 \n", 10))
    + "      9      1298.945 ST          Rx    00 00 00 08 \n",
    "trc 2.1": TRC.format("2.1", ";$COLUMNS=N,O,T,B,I,d,R,L,D\n"
    + frames("{n:>6} {t:>11.3f} DT 1     01A0 Rx - 3  0{k} FF 07 \n", 10)),
    "csv twice": "timestamp,arbitration_id,extended,remote,error,dlc,data\n0.0,0x1a0,0,0,0,3,AP8H\n"
    "0.01,0x1a0,0,0,0,3,Af8H\ntimestamp,arbitration_id,extended,remote,error,dlc,data\n"
    "0.02,0x1a0,0,0,0,3,Av8H\n\n0.03,0x1a0,0,0,0,3,A/8H\n",
}  # fmt: skip


def read(path, text):
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    log = read_log(path)
    log.names = NAMES
    return log, [(frame, t) for packet, t in log.packets() for frame in packet]


@pytest.mark.parametrize("what", GOOD)
def test_a_good_log_is_read_whole_without_a_note(tmp_path, what):
    log, found = read(tmp_path / "log", GOOD[what])
    assert [(f.id, f.data) for f, _ in found] == [(0x1A0, bytes([k, 255, 7])) for k in range(4)]
    assert [(t - found[0][1]) / 1e9 for _, t in found] == pytest.approx(STEADY, abs=1e-6)
    assert log.notes == [] and log.frames == 4


HALF = DATE + ABSOLUTE + BLOCK + frames(CLASSIC)
ODD = [
    (HALF[:-9], 3, "it ends before its end: 3 frames were read"),
    (HALF[:-2], 3, "it ends before its end: 3 frames were read"),
    (HALF, 4, "it ends before its end: 4 frames were read"),
    (HALF.replace("02 FF", "ZZ FF") + END, 3, "no frame of an asc log: 1 (line 7: its"),
    (HALF.replace("1A0             Rx   d 3 02", "1A0             R#   d 3 02") + END, 3,
     "passed over, no frame of an asc log: 1 (line 7)"),
    (HALF.replace("02 FF 07", "02 FF") + END, 3, "an asc log: 1 (line 7: 2 of 3 bytes)"),
    (HALF.replace("1A0", "Gear") + END, 0, "(Gear), not read in 4 frames: not in the DBC"),
    (HALF.replace("1A0", "FA0") + END, 0, "no frame of an asc log: 4 (line 5: no such"),
    ("date mar. mars 5 2024\n" + ABSOLUTE + frames(CLASSIC), 4, "date, mar. mars 5 2024, is not"),
    (GOOD["trc 1.1"].replace("02 FF 07\n", "02 FF\n"), 3, "no frame of a trc log: 1 (l"),
    (GOOD["trc 1.3"][:-2], 3, "passed over, no frame of a trc log: 1 (line 6: its b"),
    (GOOD["trc 2.0"].replace("=2.0", "=9.0"), 0, "version '9.0' of a .trc is not read"),
    (GOOD["csv twice"].replace("Av8H", "Av8"), 3, "passed over, no frame of a csv log: 1 (line 5"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "n", "note"), ODD)
def test_what_is_odd_is_told_with_its_line(tmp_path, text, n, note):
    log, found = read(tmp_path / "log", text)
    assert len(found) == n
    assert len(log.notes) == 1 and note in log.notes[0]


def test_names_need_a_dbc_file(tmp_path):
    (tmp_path / "log.asc").write_text(GOOD["names"])
    log = read_log(tmp_path / "log.asc")
    assert list(log.packets()) == []
    names = "identifiers are names here (Force), not read in 4 frames"
    assert log.notes == [f"{names}: codec=can-dbc knows those of its DBC file"]


EDITS = st.lists(
    st.tuples(st.sampled_from(["cut", "change", "twice", "out"]), st.integers(0, 29)),
    max_size=4, unique_by=lambda edit: edit[1],
)  # fmt: skip
IS_FRAME = {
    "asc": r"\s*[\d.]+ 1\s+\S+\s+Rx|.* d 4 ", "trc": r"\s*\d+\s+[\d.]+ DT", "csv": r"[^t]",
    "log": r"\(",
}  # fmt: skip


@pytest.mark.parametrize("suffix", IS_FRAME)
@settings(max_examples=5, deadline=None, suppress_health_check=list(HealthCheck))
@given(edits=EDITS)
def test_frames_of_a_damaged_log_add_up(tmp_path, suffix, edits):
    path = tmp_path / f"run.{suffix}"
    with can.Logger(path) as log:
        for k in range(30):
            data = bytes([k, 200, 1, 2])
            log(can.Message(1e9 + k / 100, 0x120 + k, is_extended_id=False, data=data, channel=0))
    lines = path.read_text().splitlines()
    at = [k for k, line in enumerate(lines) if re.match(IS_FRAME[suffix], line)]
    whole = dict(zip(range(30), (lines[k] for k in at), strict=True))
    kept = set(whole)
    for what, k in edits:
        kept.discard(k)
        line = whole[k]
        whole[k] = {"cut": line[: len(line) * 2 // 3], "change": line[:-4] + "?" + line[-3:],
                    "twice": f"{line}\n{line}", "out": ""}[what]  # fmt: skip
    new = "\n".join([*lines[: at[0]], *whole.values(), *lines[at[-1] + 1 :]]) + "\n"
    log, found = read(path, new)
    assert log.total == sum(bool(line.strip()) for line in new.splitlines())
    told = sum(int(n) for note in log.notes for n in re.findall(r"log: (\d+) \(line", note))
    there = sum(bool(line.strip()) for text in whole.values() for line in text.split("\n"))
    assert len(found) == log.frames and log.frames + told == there
    assert {f.data[0] for f, _ in found} >= kept


def test_a_blf_that_is_cut_tells_it_and_a_whole_one_does_not(tmp_path):
    path = tmp_path / "run.blf"
    with can.Logger(path) as log:
        for k in range(30):
            log(can.Message(1e9 + k, 0x120, is_extended_id=False, data=bytes([k]), channel=0))
    whole = path.read_bytes()
    assert len(read(path, whole)[1]) == 30 and read(path, whole)[0].notes == []
    counted = bytearray(whole)
    counted[32:36] = (99).to_bytes(4, "little")  # objects that are no frames count, too
    assert read(path, bytes(counted))[0].notes == []
    for n in (len(whole) - 1, len(whole) // 2, 150, 20):
        log, found = read(path, whole[:n])
        assert len(log.notes) == 1 and len(found) <= 30 and log.total >= len(found)
