"""`tactile-rt import`: one line of what came of it, or one of why not."""

import pytest

from bench.drivers.fuzzing import wire_of
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording import Recording


@pytest.fixture
def raw(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    packets = wire_of(make_codec("serial", "bota", {}))
    (tmp_path / "raw.bin").write_bytes(
        b"".join(packets[:20]) + b"\xaa" * 9 + b"".join(packets[20:])
    )
    return tmp_path / "raw.bin"


def test_bytes_become_a_recording_of_their_name(call, raw):
    code, said, _ = call("import", "raw.bin", "--as", "codec=bota")
    assert code == 0
    assert said == "raw.mcap: 40 samples in, 40 intact, 0 corrupt, 0 missing; 0.39 s at 100 Hz\n"
    assert sum(map(len, Recording("raw.mcap"))) == 40
    assert call("run", "--source", "replay:raw.mcap?speed=0", "--model", "none.onnx")[0] == 2


def test_what_is_there_is_replaced_only_if_forced(call, refused, raw):
    call("import", "raw.bin", "--as", "codec=bota")
    assert "is there already" in refused("import", "raw.bin", "--as", "codec=bota")
    assert call("import", "raw.bin", "--as", "codec=bota", "--force")[0] == 0


def test_half_a_log_has_a_note(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frames = [f for p in wire_of(make_codec("can", "aft200", {})) for f in p]
    text = "".join(
        f"({k / 2000:.6f}) can0 {f.id:03X}#{f.data.hex()}\n" for k, f in enumerate(frames)
    )
    (tmp_path / "can.log").write_text(text[:-4])
    code, said, told = call("import", "can.log", "out.mcap", "--as", "codec=aft200")
    assert code == 0 and "39 samples in, 79 intact" in said
    assert told == "can.log: passed over, no line of a candump log: 1\n"


def test_a_table_and_a_rate(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.csv").write_text("Fx;Fy\n" + "1,5;2\n" * 9)
    code, said, _ = call("import", "t.csv", "--columns", "Fx=S.fx,Fy=S.fy", "--rate", "50")
    assert code == 0 and "9 samples in" in said and "at 50 Hz" in said


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("raw.bin",), "say what it is: --as codec=NAME or --columns"),
        (("raw.bin", "--as", "bota"), "--as is codec=NAME&OPTION=VALUE"),
        (("raw.bin", "--as", "codec=bota", "--columns", "S.fx"), "give --as"),
        (("raw.bin", "--as", "codec=ft300"), "no whole ft300 sample .*`tactile-rt sniff raw.bin`"),
        (("raw.bin", "--columns", "S.fx"), "is no table of numbers"),
        (("raw.bin", "--as", "codec=bota", "--form", "pcap"), "no form 'pcap'"),
        (("raw.bin", "--columns", "S.fx", "--decimal", ";"), "--decimal is , or ."),
        (("raw.bin", "--columns", "S.fx", "--delimiter", ",,"), "--delimiter is one character"),
    ],
)
def test_what_cannot_be_is_one_line(refused, raw, options, why):
    import re

    assert re.search(why, refused("import", *options))
    assert [p.name for p in raw.parent.iterdir()] == ["raw.bin"]


def test_a_log_with_nothing_in_it_is_no_matter_of_its_codec(refused, tmp_path):
    (tmp_path / "can.log").touch()
    assert "can.log is empty" in refused("import", tmp_path / "can.log", "--as", "codec=xela")
