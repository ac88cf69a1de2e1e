"""`tactile-rt import`: one line of what came of it, or one of why not."""

import pytest

from bench.drivers.fuzzing import wire_of
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording import Recording
from tests.helpers.dbc_mappings import map_signal


@pytest.fixture
def raw(cwd):
    packets = wire_of(make_codec("serial", "bota", {}))
    (cwd / "raw.bin").write_bytes(b"".join(packets[:20]) + b"\xaa" * 9 + b"".join(packets[20:]))
    return cwd / "raw.bin"


def test_bytes_become_a_recording_of_their_name(call, done, raw):
    said, _ = done("import", "raw.bin", "--as", "codec=bota")
    assert said.splitlines()[:3] == [
        "raw.mcap: 40 samples in, 40 intact, 0 corrupt, 0 missing; 0.39 s at 100 Hz",
        "  1489 bytes: 1480 read, 9 passed over, 0 out of order; 0 samples have an invalid element",
        "  from 0 s to 0.39 s; 100 Hz by its times; 100 Hz said",
    ]
    assert said.splitlines()[3].startswith("  fx ") and said.endswith(" N m\n")
    assert sum(map(len, Recording("raw.mcap"))) == 40
    assert call("run", "--source", "replay:raw.mcap?speed=0", "--model", "none.onnx")[0] == 2


def test_what_is_there_is_replaced_only_if_forced(call, refused, raw):
    call("import", "raw.bin", "--as", "codec=bota")
    assert "already exists" in refused("import", "raw.bin", "--as", "codec=bota")
    assert call("import", "raw.bin", "--as", "codec=bota", "--force")[0] == 0


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("raw.bin",), "say what it is: --as codec=NAME or --columns"),
        (("raw.bin", "--as", "bota"), "--as is codec=NAME&OPTION=VALUE"),
        (("raw.bin", "--as", "codec=bota", "--columns", "S.fx"), "give --as"),
        (("raw.bin", "--as", "codec=ft300"), "no whole ft300 sample .*`tactile-rt sniff raw.bin`"),
        (("raw.bin", "--columns", "S.fx"), "is no table of numbers"),
        (("raw.bin", "--as", "codec=bota", "--form", "pcap"), "no form 'pcap'"),
        (("raw.bin", "--columns", "S.fx", "--decimal", ";"), "--decimal must be , or ."),
        (
            ("raw.bin", "--columns", "S.fx", "--delimiter", ",,"),
            "--delimiter must be one character",
        ),
    ],
)
def test_what_cannot_be_is_one_line(refused, raw, options, why):
    import re

    assert re.search(why, refused("import", *options))
    assert [p.name for p in raw.parent.iterdir()] == ["raw.bin"]


def test_a_log_with_nothing_in_it_is_no_matter_of_its_codec(refused, tmp_path):
    (tmp_path / "can.log").touch()
    assert "can.log is empty" in refused("import", tmp_path / "can.log", "--as", "codec=xela")


GOOD, ODD = "(0.{k:02}) can0 1A0#00{k:02X}FFCE\n", "(0.{k:02}) can0 1A0#0\n"
DBC = """VERSION ""
NS_ :
BS_:
BU_: FT
BO_ 416 Force: 4 FT
 SG_ Fx : 7|16@0- (0.01,0) [-327|327] "N" FT
"""


@pytest.fixture
def bus(cwd):
    """A folder with a good and an odd log of a bus, and what describes its frames."""
    pytest.importorskip("cantools")
    good = [GOOD.format(k=k) for k in range(90)]
    (cwd / "good.log").write_text("".join(good))
    good[40:50] = [ODD.format(k=40)]
    (cwd / "odd.log").write_text("".join(good))
    (cwd / "f.dbc").write_text(DBC)
    (cwd / "f.toml").write_text(map_signal("f.dbc", "fx", "Force.Fx"))
    return cwd


AS = ("--as", "codec=can-dbc&mapping=f.toml")


def test_strict_writes_what_is_good_and_nothing_else(call, refused, bus):
    code, said, told = call("import", "good.log", *AS, "--strict")
    assert code == 0 and told == "" and "90 lines: 90 read, 0 passed over, 0 out of order" in said
    assert "from 0 s to 0.89 s; 100 Hz by its times; 100 Hz said\n  fx 0..0.89 N\n" in said
    before = sorted(p.name for p in bus.iterdir())
    assert call("import", "odd.log", *AS, "--strict")[0] == 2
    assert sorted(p.name for p in bus.iterdir()) == before


def test_names_of_an_asc_log_are_those_of_the_dbc_file(call, bus):
    head = "date Tue Mar 5 10:11:12.250 am 2024\nbase hex  timestamps relative\n"
    line = "   0.010000 1  Force           Rx   d 4 00 64 FF CE\n"
    (bus / "named.asc").write_text(head + line * 50 + line.replace("Force", "Gear"))
    code, said, told = call("import", "named.asc", *AS)
    assert code == 0 and "50 samples in, 50 intact" in said and "0.49 s at 100 Hz" in said
    names = "identifiers are names here (Gear), not read in 1 frames: not in the DBC file"
    assert told == f"named.asc: {names}\n"


def test_a_rate_that_nobody_said_is_not_said(call, cwd):
    (cwd / "a.txt").write_text("".join(f"{k} {k / 4}\n" for k in range(90)))
    code, said, told = call("import", "a.txt", "--as", "codec=ascii_line&columns=S.fx,S.fy")
    assert code == 0 and "the rate is not known: 100 Hz" in told and " said" not in said
    (cwd / "b.txt").write_text("".join(f"{10 * (k % 80)} {k / 4}\n" for k in range(120)))
    code, said, told = call("import", "b.txt", "--as", "codec=ascii_line&columns=time:ms,S.fx")
    assert code == 0 and "the device's clock goes back 1 times" in told and " said" not in said


def test_the_report_as_json_has_all_of_it(call, bus):
    import json

    code, said, told = call("import", "odd.log", *AS, "--json", "-")
    report = json.loads(said)
    assert code == 0 and "1 (line 41)" in told
    note = "passed over, no line of a candump log: 1 (line 41)"
    assert report["odd"] == report["notes"] == [note]
    assert [report[k] for k in ("unit", "total", "read", "passed_over")] == ["lines", 81, 80, 1]
    assert report["ranges"]["S.fx"] == pytest.approx([0, 0.89]) and report["units"] == {"fx": "N"}
    assert (report["first"], report["last"], report["said_hz"]) == ("0 s", "0.89 s", 100)


def test_a_picture_shows_what_came_in(call, refused, bus):
    pytest.importorskip("matplotlib")
    code, _, _ = call("import", "odd.log", *AS, "--plot", "in.svg")
    drawn = (bus / "in.svg").read_text()
    assert code == 0 and drawn.startswith("<?xml")
    for word in ("odd.log: 80 samples in", "fx [N]", "time [s]", "missing", "1 (line 41)"):
        assert f"<!-- {word}" in drawn or word in drawn
    assert "is no picture" in refused("import", "good.log", *AS, "--plot", "in.txt")
    assert not (bus / "good.mcap").exists()


@pytest.mark.parametrize(
    "name", ["a.csv", "a.mcap", "a.log", "a.blf", "a.bag", "a.npz", "bag/b.db3"]
)
def test_a_git_lfs_pointer_is_refused_by_that_name(refused, tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    (tmp_path / "bag" if "/" in name else tmp_path).joinpath("metadata.yaml").write_text("")
    said = f"{path} is a Git LFS pointer, not the file itself: `git lfs pull`"
    target = path.parent if "/" in name else path
    for line in (("import", target, tmp_path / "o.mcap", "--columns", "a=S.x"), ("sniff", target)):
        assert said in refused(*line)
    if name == "a.mcap":  # also where it would be written over
        assert said in refused("import", path, path)
    if "/" not in name:
        for command in (("replay", path), ("recover", path), ("convert", path, tmp_path / "x.csv")):
            assert said in refused(*command)


def test_a_git_lfs_pointer_is_refused_behind_every_other_door(tmp_path):
    from tactile_rt.alignment.json_file import read_json
    from tactile_rt.alignment.loading import read_responses
    from tactile_rt.alignment.neural import read_published
    from tactile_rt.alignment.stimuli_input import read_stimuli
    from tactile_rt.core.errors import TactileError
    from tactile_rt.recording.labels import check_appendable, read_labels

    path = tmp_path / "a.npz"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n")
    doors = [
        read_responses, read_published, read_stimuli, check_appendable,
        lambda path: read_json(path, dict, ""), lambda path: read_labels(path, []),
    ]  # fmt: skip
    for door in doors:
        with pytest.raises(TactileError, match=r"a\.npz is a Git LFS pointer, not the file itself"):
            door(path)
