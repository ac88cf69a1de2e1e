"""`tactile-rt sniff`: what fits a file or a port, and the command to go on with, which works."""

import shlex

import pytest

from bench.drivers.fuzzing import wire_of
from tactile_rt.drivers import device_source, sniffing
from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedSerial
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sources.opening import open_source


def next_command(said: str) -> list[str]:
    """The arguments of the last line, which is a command."""
    words = shlex.split(said.splitlines()[-1])
    assert words[0] == "tactile-rt"
    return words[1:]


def spoken(wire: str, name: str, options: dict | None = None):
    packets = wire_of(make_codec(wire, name, options or {}))
    return b"".join(packets) if wire == "serial" else [f for packet in packets for f in packet]


FILES = {
    "bytes": (lambda: spoken("serial", "ft300")[9:], "--as codec=ft300"),
    "hex": (
        lambda: spoken("serial", "kwr75").hex(" ", 1).replace(" ", "\n").encode(),
        "--as codec=kwr75",
    ),
    "candump": (
        lambda: "".join(
            f"({k / 9:.6f}) can0 {f.id:03X}#{f.data.hex()}\n"
            for k, f in enumerate(spoken("can", "xela"))
        ).encode(),
        "--as codec=xela",
    ),
    "table, with a minus of typographers": (
        lambda: b"t;Fx [N];Fy [N]\n" + b"".join(b"%d,5;7;\xe2\x88\x923,5\n" % k for k in range(20)),
        "--columns t=time:s,Fx [N]=S.fx:N,Fy [N]=S.fy:N",
    ),
    "table without a time": (
        lambda: b"Fx,Fy\n" + b"".join(b"%d,%d.5\n" % (k * k, k) for k in range(20)),
        "--columns Fx=S.fx:N,Fy=S.fy:N --rate 100",
    ),
    "LabVIEW without times": (
        lambda: b"Separator\tTab\nX_Columns\tNo\n***End_of_Header***\nChannels\t2\n"
        b"X_Dimension\tTime\tTime\nDelta_X\t0,002000\t0,002000\n***End_of_Header***\n"
        b"X_Value\tFx\tFy\tComment\n" + b"".join(b"\t%d,5\t0,5\n" % k for k in range(20)),
        "--columns Fx=S.fx:N,Fy=S.fy:N --rate 500",
    ),
    "lines": (
        lambda: b"".join(b"%d %d %d.5\r\n" % (10 * k, k * k % 7, k % 5) for k in range(40)),
        "--columns time:ms,T{0..1}.value",
    ),
    "names in a plotter's lines": (
        lambda: b"".join(b"Fx:%d,Fy:%d\n" % (k * k % 7, k % 5) for k in range(40)),
        "--as codec=ascii_line&columns=Fx%3DS.fx:N,Fy%3DS.fy:N",
    ),
    "lines and when a terminal had them": (
        lambda: b"".join(
            b"12:00:%02d.%03d -> X: %d Y: %d\n" % (k // 50, k % 50 * 20, k * k % 7, k % 5)
            for k in range(90)
        ),
        "--as codec=ascii_line&columns=X%3DS.x:1,Y%3DS.y:1",
    ),
    "units below": (
        lambda: b"Zeit,Fx\n[s],[mN]\n" + b"".join(b"%d,%d\n" % (k, k * k % 7) for k in range(40)),
        "--columns Zeit=time:s,Fx=S.fx:mN",
    ),
    "units below, one of them odd": (
        lambda: b"Zeit;Kraft;Weg;Temp\ns;kip;cm;\xb0C\n" + b"".join(
            b"%d,5;%d;0,5;21\n" % (k, k * k % 7) for k in range(40)
        ),
        "--columns Zeit=time:s,Kraft=S.kraft:1,Weg=S.weg:cm,Temp=S.temperature:degC",
    ),
    "units below, of one column": (
        lambda: b"Zeit;Kraft;Weg\n;kN;\n" + b"".join(b"%d,5;%d;9\n" % (k, k) for k in range(40)),
        "--columns Zeit=time:s,Kraft=S.kraft:kN,Weg=S.weg:1",
    ),
    "labels with units, one a line": (
        lambda: b"".join(
            b"Force [N]:\t%d\r\nTemp (C):\t%d.5\r\n" % (k % 7, k * k % 5) for k in range(40)
        ),
        "--as codec=ascii_line&columns=Force [N]%3DS.force:N,Temp (C)%3DS.temperature:degC",
    ),
    "lists in cells": (
        lambda: b"t,f\n" + b"".join(
            b'0.%02d,"[%d, %d.5, nan, 2]"\n' % (k, k % 7, k) for k in range(40)
        ),
        "--columns t=time:s,f.{0..1}=f_{0..1}.value:1,f.3=f_3.value:1",
    ),
    "half days": (
        lambda: b"Time,Fx\n" + b"".join(
            b"9/16/2023 12:59:%02d PM,%d\n" % (k, k) for k in range(40)
        ),
        "--columns Time=time:iso,Fx=S.fx:N",
    ),
    "days before months": (
        lambda: b"Time,Fx\n" + b"".join(b"5/10/2023 23:59:%02d,%d\n" % (k, k) for k in range(40)),
        "--columns Time=time:dmy,Fx=S.fx:N",
    ),
    "a date and a time of day": (
        lambda: b"Day;At;Fx\n" + b"".join(b"16.9.2023;0:00:%02d;0,5\n" % k for k in range(40)),
        "--columns Day=time:iso,At=time:iso,Fx=S.fx:N",
    ),
    "a reading that goes round": (
        lambda: b"".join(b"%d %d\n" % (k % 5, k * k % 17) for k in range(60)),
        "--columns T{0..1}.value --rate 100",
    ),
    "days of a spreadsheet": (
        lambda: b"Time,Fz\n" + b"".join(b"%.9f,%d\n" % (45356.5 + k / 864e4, k) for k in range(20)),
        "--columns Time=time:days,Fz=S.fz:N",
    ),
    "one bad cell": (
        lambda: b"time_s,Fx_N\n" + b"".join(
            b"0.%02d,%s\n" % (k, b"?!" if k == 7 else b"%d" % k) for k in range(20)
        ),
        "--columns time_s=time:s,Fx_N=S.fx:N",
    ),
    "columns that are there in turn, or never": (
        lambda: b"t,a,b,c\n" + b"".join(
            b"0.%02d,%s,\n" % (k, b"%d," % k if k % 2 else b",%d" % k) for k in range(40)
        ),
        "--columns t=time:s,a=a.value:1,b=b.value:1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_the_command_for_a_file_imports_it(call, done, cwd, name):
    made, options = FILES[name]
    (cwd / "file.log").write_bytes(made())
    said, _ = done("sniff", "file.log")
    command = next_command(said)
    assert " ".join(command) == f"import file.log {options}"
    code, told, _ = call(*command)
    assert code == 0 and int(told.split()[1]) >= 15


def test_what_cannot_be_read_is_told_and_not_proposed(call, cwd):
    (cwd / "a.csv").write_text(
        "t,Fx\n" + "".join(f"16/9/23 12:00:{k},{k}\n" for k in range(10, 40))
    )
    code, said, _ = call("sniff", "a.csv")
    assert code == 0 and "'16/9/23 12:00:10' in column 1 is no time that is read" in said
    assert "t=time" not in said and "--rate" in said
    (cwd / "a.csv").write_text("t,Fz\n" + "".join(f"0.{k},ca.{k * k}x\n" for k in range(10, 40)))
    code, said, _ = call("sniff", "a.csv")
    assert code == 1 and said.endswith("no columns were found that fit: no measured number in Fz\n")
    (cwd / "a.csv").write_text("Zeit;Kraft;Weg\n" + "".join(f"{k};2;1.200,5\n" for k in range(9)))
    _, said, _ = call("sniff", "a.csv")
    assert said.endswith("=time:ms,Kraft=Kraft.value:1,Weg=Weg.value:1\n")
    (cwd / "b.csv").write_text("a,b,a\n" + "".join(f"{k},[{k},x],{k * k}\n" for k in range(40)))
    code, said, _ = call("sniff", "b.csv")
    assert code == 1 or call(*next_command(said))[0] == 0


@pytest.mark.parametrize(
    "data",
    [
        b"", b"time,fx [\xc2\xb5N]\n", bytes(3000), bytes(range(256)) * 3,
        b"".join(b"12:00:%02d INFO worker %d has started\n" % (k % 60, k) for k in range(60)),
    ],
)  # fmt: skip
def test_nothing_fits_and_it_says_so(call, cwd, data):
    (cwd / "file.log").write_bytes(data)
    code, said, _ = call("sniff", "file.log")
    assert code == 1 and said.startswith("nothing fits file.log")
    assert ("it holds no rows" in said) == (len(data) < 99), said


def test_frames_that_no_codec_knows_are_shown(call, cwd):
    text = "".join(f"({k / 9:.3f}) can0 3A{k % 2}#{k:08X}\n" for k in range(60))
    (cwd / "can.log").write_text(text)
    code, said, _ = call("sniff", "can.log")
    assert code == 1 and "3A0  30 frames of 4 bytes" in said and "codec=can-dbc" in said


def test_a_further_codec_is_tried(call, done, cwd):
    (cwd / "mine.toml").write_text(
        'name = "m"\nrate_hz = 100\nlength = 5\nsync = "A5 5A"\n'
        '[[values]]\nat = 2\ntype = "uint8"\nchannels = ["a", "b", "c"]\nunit = "1"\n'
    )
    (cwd / "raw.bin").write_bytes(b"".join(b"\xa5\x5a%03d" % (k * 7 % 501) for k in range(99)))
    said, _ = done("sniff", "raw.bin", "--try", "codec=binary_frame&mapping=mine.toml")
    assert next_command(said) == "import raw.bin --as codec=binary_frame&mapping=mine.toml".split()
    assert "--try is codec=NAME" in call("sniff", "raw.bin", "--try", "binary_frame")[2]


@pytest.mark.parametrize(
    ("codec", "options", "further"),
    [("mlx_hex", {}, ""), ("ascii_line", {"columns": "time:ms,A0.fx,A0.fy"}, "&baud=9600")],
)
def test_a_port_is_heard_at_every_speed(call, monkeypatch, codec, options, further):
    monkeypatch.setattr(sniffing, "line_speeds", lambda: [(115_200, "N"), (9600, "N")])
    line = {"baud": "9600"} if further else {}
    with open_source("synthetic:") as signal, EmulatedSerial(
        signal, codec, options=options | line, log=False
    ) as device:  # fmt: skip
        code, said, told = call("sniff", device.port)
    assert code == 0 and "9600 bit/s: " in told
    (url,) = next_command(said)[2:]
    assert url.startswith(f"serial://{device.port}?codec={codec}") and url.endswith(further)


def test_a_device_that_must_be_asked_is_asked_only_if_it_is_allowed(call, monkeypatch):
    monkeypatch.setattr(sniffing, "FIRST_S", 0.2)
    monkeypatch.setattr(device_source, "ATTEMPTS", 1)
    with open_source("synthetic:") as signal, EmulatedCan(signal, "xela", log=False) as device:
        url = f"can:{device.port}"
        code, said, _ = call("sniff", url, "--seconds", "0.2")
        assert code == 1 and "try --ask" in said
        assert not device.codec.streaming
        code, said, _ = call("sniff", url, "--seconds", "0.2", "--ask")
    assert code == 0 and next_command(said) == ["run", "--source", f"{url}?codec=xela"]


def test_it_is_asked_at_the_speed_that_is_named(call, monkeypatch):
    monkeypatch.setattr(sniffing, "FIRST_S", 0.2)
    monkeypatch.setattr(device_source, "ATTEMPTS", 1)
    with open_source("synthetic:5x6") as signal, EmulatedSerial(
        signal, "ft300", options={"baud": "57600"}, log=False
    ) as device:  # fmt: skip
        code, said, _ = call("sniff", device.port, "--baud", "57600", "--ask", "--seconds", "0.2")
    url = f"serial://{device.port}?codec=ft300&baud=57600"
    assert code == 0 and next_command(said) == ["run", "--source", url]


def test_what_is_nothing_at_all_is_one_line(refused, cwd):
    assert "is no port, bus or file" in refused("sniff", "nix")
    assert "is a folder" in refused("sniff", ".")


def test_a_time_is_one_also_from_its_end_and_above_a_foot(call, cwd):
    rows = [f"{k / 100},{k}\n" for k in range(60)]
    for text in ("".join([*rows, "mean,29.5\n"]), "".join(rows[::-1])):
        (cwd / "t.csv").write_text(f"t,F [furlong]\n{text}")
        code, said, _ = call("sniff", "t.csv")
        assert code == 0 and "units that are not read: furlong" in said
        assert next_command(said)[-1] == "t=time:s,F [furlong]=F.value:1"


def test_text_with_rows_is_no_protocol_of_which_much_is_damaged(call, cwd):
    (cwd / "t.csv").write_text(
        "t,F,note\n" + "".join(f'{k / 100:.2f},{k},"a\nb"\n' for k in range(99))
    )
    code, said, _ = call("sniff", "t.csv")
    assert code == 1 and "most lines are no rows" in said and "ati" not in said


def test_a_recording_is_known(call, cwd):
    (cwd / "raw.bin").write_bytes(spoken("serial", "bota"))
    call("import", "raw.bin", "--as", "codec=bota")
    code, said, _ = call("sniff", "raw.mcap")
    teach = ["teach", "replay:raw.mcap?speed=0", "lesson", "--classes", "A,B"]
    assert code == 0 and next_command(said) == teach, "the model that ships is of another array"
    assert "--source takes it as replay:raw.mcap" in call("run", "raw.mcap")[2]
    assert "mouse13.onnx was made for" in call("replay", "raw.mcap", "--model", "shipped")[2]
