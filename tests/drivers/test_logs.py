"""Logs that others wrote, as packets: whole, cut anywhere, packed, of several buses."""

import gzip
import itertools
import random
import sqlite3

import can
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.logs import read_log

T0 = 1_700_000_000.5
N = 60
WRITERS = {".log": "candump", ".asc": "asc", ".blf": "blf", ".trc": "trc", ".csv": "csv"}


def messages():
    for k in range(N):
        yield can.Message(
            timestamp=T0 + 0.01 * k, arbitration_id=0x710 + k % 16, is_extended_id=False,
            data=bytes([k, 255 - k, 3]), channel=0,
        )  # fmt: skip
    yield can.Message(
        timestamp=T0 + 1, arbitration_id=0x1ABCDE, is_extended_id=True, data=b"", channel=0
    )


def frames_sent():
    return [CanFrame(m.arbitration_id, bytes(m.data), m.is_extended_id) for m in messages()]


@pytest.fixture
def log_of(tmp_path):
    """The log that a file of this text is."""

    def read(text, name="can.log", **options):
        (tmp_path / name).write_text(text)
        return read_log(tmp_path / name, **options)

    return read


def written(path):
    with can.Logger(path) as log:
        for message in messages():
            log(message)
    return path


@pytest.mark.parametrize("suffix", WRITERS)
def test_what_python_can_wrote_is_read(tmp_path, suffix):
    log = read_log(written(tmp_path / f"run{suffix}"))
    assert (log.wire, log.form) == ("can", WRITERS[suffix])
    packets = list(log.packets())
    assert [frame for packet, _ in packets for frame in packet] == frames_sent()
    gaps = [b - a for (_, a), (_, b) in itertools.pairwise(packets)]
    assert all(abs(gap - 10_000_000) < 300_000 for gap in gaps[: N - 1])
    assert abs(packets[0][1] - T0 * 1e9) < 1e6 and log.notes == []


@pytest.mark.parametrize("suffix", WRITERS)
def test_its_gzip_is_unpacked_also_where_it_is_cut(tmp_path, suffix):
    path = written(tmp_path / f"run{suffix}")
    packed = tmp_path / f"run{suffix}.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert len(list(read_log(packed).packets())) == N + 1
    packed.write_bytes(packed.read_bytes()[:-200])
    log = read_log(packed)
    assert 0 < len(list(log.packets())) < N + 1
    assert any("cut short" in note for note in log.notes)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf"])
def test_half_a_log_is_read_with_a_note(tmp_path, suffix):
    path = written(tmp_path / f"run{suffix}")
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2 + 5])
    log = read_log(path)
    assert 10 < len(list(log.packets())) < N
    assert len(log.notes) == 1


@pytest.mark.parametrize("suffix", WRITERS)
def test_damage_never_raises(tmp_path, suffix):
    path = written(tmp_path / f"run{suffix}")
    whole, draw = path.read_bytes(), random.Random(1)
    for k in range(60):
        data = bytearray(whole[: draw.randrange(len(whole))] if k % 2 else whole)
        for _ in range(draw.randrange(1, 8)):
            if data:
                data[draw.randrange(len(data))] = draw.randrange(256)
        path.write_bytes(data)
        for form in ("", WRITERS[suffix]):
            for _ in read_log(path, form).packets():
                pass


def test_a_log_of_several_buses_is_of_the_one_that_is_named(log_of):
    text = "(1.0) can0 123#AA\n(1.1) can1 123#BB\n(1.2) can0 124#\n"
    log = log_of(text, bus="can0")
    assert [f.data for packet, _ in log.packets() for f in packet] == [b"\xaa", b""]
    assert log.notes == ["frames of several buses: can0 (2), can1 (1); those of can0 are taken"]
    assert list(log_of(text, bus="can7").packets()) == []


# One line of each, by hand: what tools print.
LINES = [
    ("  can0  201   [8]  0E 16 00 00 FF FD 21 00", 0x201, "0e160000fffd2100", None),
    (" (1788865430.176578)  can0  201   [2]  0B 0F", 0x201, "0b0f", 1788865430_176578000),
    (" (2023-11-14 22:13:20.500000)  can0  201   [1]  0B", 0x201, "0b", 1700000000_500000000),
    ("(0.100000) vcan0 00ABCDEF#1122", 0xABCDEF, "1122", 100_000_000),
    ("(0.1) can0 123##1AABB", 0x123, "aabb", 100_000_000),
    ("(0.1) can0 123#11.22.33 T", 0x123, "112233", 100_000_000),
    ("  slcan0  7FF   [2]  01 02   '..'", 0x7FF, "0102", None),
    ("t20120B0F", 0x201, "0b0f", None),
    ("T00ABCDEF10B1F2C", 0xABCDEF, "0b", None),
]


@pytest.mark.parametrize(("line", "number", "data", "t_ns"), LINES)
def test_a_line_of_a_can_log(log_of, line, number, data, t_ns):
    ((frame,), at), *_ = log_of(f"{line}\n" * 3, "can.txt").packets()
    assert (frame.id, frame.data.hex(), at) == (number, data, t_ns)
    assert frame.extended == (number > 0x7FF) and frame.fd == ("##" in line)


def test_what_savvycan_saved_is_read(log_of):
    log = log_of(
        "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8\n"
        "166064000,0000021A,false,Rx,0,3,FE,36,12,\n"
        "166065500,00ABCDEF,true,Rx,1,1,0C,\n",
        "run.csv",
    )
    assert [(bytes(p[0].data), p[0].id, p[0].extended, t) for p, t in log.packets()] == [
        (b"\xfe\x36\x12", 0x21A, False, 166_064_000_000),
        (b"\x0c", 0xABCDEF, True, 166_065_500_000),
    ]
    assert log.notes == ["frames of several buses: 0 (1), 1 (1); --bus takes those of one"]


def test_a_table_of_python_can_s_is_read(tmp_path):
    """As its SqliteWriter makes it."""
    path = tmp_path / "run.db"
    with sqlite3.connect(path) as table:
        table.execute(
            "CREATE TABLE messages(ts REAL, arbitration_id INTEGER, extended INTEGER, "
            "remote INTEGER, error INTEGER, dlc INTEGER, data BLOB)"
        )
        for k, m in enumerate(messages()):
            row = (T0 + k, m.arbitration_id, m.is_extended_id, 0, 0, m.dlc, bytes(m.data))
            table.execute("INSERT INTO messages VALUES(?, ?, ?, ?, ?, ?, ?)", row)
    table.close()
    log = read_log(path)
    assert log.form == "db" and log.notes == []
    assert [frame for packet, _ in log.packets() for frame in packet] == frames_sent()
    path.write_bytes(path.read_bytes()[:100] + bytes(4000))
    assert list(log.packets()) == [] and len(log.notes) == 1


@pytest.mark.parametrize(
    ("apart", "times"),
    [("0 .5 .25 .75 .125 .5", "0 .5 .75 1.5 1.625 2.125"), ("0 .5 .5 .5", "0 .5 1 1.5"),
     ("0 .5 .75 1.5", "0 .5 .75 1.5"), ("7 .5 .25 .75", "7 7 7 7")],
)  # fmt: skip
def test_times_since_the_frame_before_are_added_up(log_of, apart, times):
    lines = (f" ({float(t):010.6f})  can0  123   [1]  AA\n" for t in apart.split())
    assert [t / 1e9 for _, t in log_of("".join(lines)).packets()] == [*map(float, times.split())]


HEX = [
    ("00000000: aa07 080a 0001 ff7e  ........", "aa07080a0001ff7e", None),
    ("00000000  aa 07 08 0a 00 01 ff 7e  |........|", "aa07080a0001ff7e", None),
    ("AA 07 08 0A 00 01 FF 7E", "aa07080a0001ff7e", None),
    ("aa07080a0001ff7e", "aa07080a0001ff7e", None),
    ("[1.25] 0xAA, 0x07, 0x08, 0x0A, 0x00, 0x01, 0xFF, 0x7E", "aa07080a0001ff7e", 1_250_000_000),
]


@pytest.mark.parametrize(("line", "data", "t_ns"), HEX)
def test_bytes_in_hexadecimal(log_of, line, data, t_ns):
    log = log_of(f"{line}\r\n" * 4, "dump.txt")
    assert log.wire == "serial" and log.form == "hex"
    assert [(packet.hex(), at) for packet, at in log.packets()] == [(data, t_ns)] * 4


@pytest.mark.parametrize("text", ["12 34 56\n12 33 57\n" * 9, "1,2\n3,4\n", "", "\n\n", "hello\n"])
def test_text_is_bytes_as_they_are(log_of, text):
    log = log_of(text, "board.txt")
    assert log.form == "raw" and b"".join(p for p, _ in log.packets()) == text.encode()


def test_times_never_go_back(log_of):
    log = log_of("(2.0) can0 123#AA\n(1.0) can0 123#BB\n(3.0) can0 124#\n")
    assert [t for _, t in log.packets()] == [2_000_000_000, 2_000_000_000, 3_000_000_000]
    told = "1 times go back (frame 2 is the first); these packets have the time before"
    assert log.notes == [told]


@pytest.mark.parametrize("wrong", ["03:00:00", "15:00:00", "23:00:00"])
def test_a_lone_wrong_time_of_day_is_no_midnight(log_of, wrong):
    days = ("20:59:59", wrong, "21:00:00", "23:59:59", "00:00:01")
    log = log_of("".join(f"{day}.000 -> 1,2\n" for day in days), "day.txt")
    times = [75_599, 75_599, 75_600, 86_399, 86_401]
    assert [t // 10**9 for _, t in log.packets()] == times and "1 times go back" in log.notes[0]


def test_what_is_no_file_or_form_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="no file"):
        read_log(tmp_path / "none")
    with pytest.raises(ConfigError, match="no form 'pcap' of a log"):
        read_log(written(tmp_path / "a.log"), "pcap")


@pytest.mark.parametrize(
    ("begins", "said"),
    [
        (b"\x93NUMPY\x01\x00", "is an array of NumPy: write it as a table"),
        (b"PK\x03\x04", "is a zip archive"),
        (b"\x89HDF\r\n\x1a\n", "is an HDF5 file"),
        (b"MDF     4.10", "is a measurement file"),
        (b"\n\r\r\n", "is a capture of packets"),
    ],
)
def test_what_is_known_to_be_no_log_says_what_it_is(tmp_path, begins, said):
    path = tmp_path / "x.bin"
    path.write_bytes(begins + bytes(64))
    with pytest.raises(ConfigError, match=f"x.bin {said}"):
        read_log(path)
