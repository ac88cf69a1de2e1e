"""`tactile-rt record`, `recover` and `convert`: what they write, say and refuse."""

import signal

import numpy as np
import pytest

from tactile_rt.recording import Recording
from tactile_rt.testing import FakeSerial
from tests.helpers.processes import start_program

SOURCE = "synthetic:2x3?pace=fast&seconds=0.3"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


def samples(path):
    return sum(map(len, Recording(path)))


def test_a_source_is_recorded_to_its_end(call, path):
    code, out, err = call("record", SOURCE, path, "--note", "who=Ada", "--note", "why=a=b")
    assert (code, err) == (0, "")
    assert out.startswith(f"{path}: 300 samples, ")
    assert samples(path) == 300
    about = Recording(path).description
    assert about.source == SOURCE
    assert about.session == {"who": "Ada", "why": "a=b"}


def test_a_device_s_packets_are_recorded_and_it_tells_how_it_goes(done, path):
    with FakeSerial(np.zeros((5000, 2, 3))) as fake:
        out, err = done("record", fake.url, path, "--seconds", "1.3")
    assert err.count("\n") == 1
    assert err.startswith("streaming, ")
    assert " packets, " in err
    assert " packets, " in out
    assert samples(path) > 500
    assert sum(1 for _ in Recording(path).packets()) > 100


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_a_whole_file(end, path):
    with start_program("record", "synthetic:2x3", path) as process:
        assert process.stderr.readline().split()[1] == "samples,"
        process.send_signal(end)
        out, _ = process.communicate(timeout=10)
    assert process.returncode == 0
    assert out.startswith(f"{path}: ")
    assert samples(path) == int(out.split()[1]) > 500


def test_what_is_left_of_a_killed_one_is_recovered(call, refused, path):
    with start_program("record", "synthetic:2x3", path) as process:
        told = int(process.stderr.readline().split()[0])
        process.kill()
        process.communicate(timeout=10)
    assert "`tactile-rt recover" in refused("convert", path, path.with_name("out.npz"))
    assert not path.with_name("out.npz").exists()
    code, out, err = call("recover", path)
    made = path.with_name("run.recovered.mcap")
    assert (code, err) == (0, "")
    assert out.startswith(f"{made}: {samples(made)} samples, ")
    assert samples(made) >= told - 1000  # at 1 kHz
    assert call("recover", path)[0] == 2  # which would write over it
    assert call("recover", path, "--force")[:2] == (0, out)
    assert call("recover", made)[1] == f"{made} is whole: nothing to do\n"


@pytest.mark.parametrize("name", ["out.npz", "out.csv", "out.h5"])
def test_a_recording_is_converted(name, call, path):
    if name == "out.h5":
        pytest.importorskip("h5py")
    call("record", SOURCE, path)
    output = path.with_name(name)
    code, out, err = call("convert", path, output)
    assert (code, out, err) == (0, f"{output}: 300 samples\n", "")
    before = output.read_bytes()
    assert call("convert", path, output)[0] == 2
    assert call("convert", path, output, "--force")[0] == 0
    assert len(output.read_bytes()) == len(before)


def test_a_bag_is_made_of_one_recording_or_more(call, path):
    call("record", SOURCE, path)
    bag = path.with_name("run-ros2")
    assert call("convert", path, "--to", "ros2") == (0, f"{bag}: 300 samples\n", "")
    assert samples(bag / "run-ros2_0.mcap") == 300 and (bag / "metadata.yaml").is_file()
    assert call("convert", path, path, bag, "--to", "ros2")[0] == 2
    assert call("convert", path, path, bag, "--to", "ros2", "--force")[1] == f"{bag}: 600 samples\n"


def test_a_lerobot_dataset_is_made(call, refused, path):
    pytest.importorskip("pyarrow")
    call("record", SOURCE, path)
    made = path.with_name("run-lerobot")
    code, out, err = call("convert", path, "--to", "lerobot", "--fps", "50", "--task", "touch it")
    assert (code, out, err) == (0, f"{made}: 300 samples, 1 episodes\n", "")
    precious = path.with_name("precious")
    precious.mkdir()
    said = refused("convert", path, precious, "--to", "lerobot", "--force")
    assert "was not made by --to lerobot" in said


def test_a_file_that_is_there_is_not_written_over(call, refused, path):
    path.write_bytes(b"precious")
    said = refused("record", SOURCE, path)
    assert said == f"tactile-rt: {path} already exists: name another file, or give --force\n"
    assert path.read_bytes() == b"precious"
    assert call("record", SOURCE, path, "--force")[0] == 0
    assert samples(path) == 300


@pytest.mark.parametrize(
    "again",
    [
        ("record", SOURCE, "run.mcap"),
        ("recover", "cut.mcap", "--out", "run.mcap"),
        ("import", "table.csv", "run.mcap", "--columns", "S.fx:N", "--rate", "10"),
    ],
    ids=lambda words: words[0],
)
def test_what_another_process_is_recording_is_not_replaced(again, call, refused, path, cwd):
    (cwd / "table.csv").write_text("1\n2\n3\n")
    assert call("record", SOURCE, "whole.mcap")[0] == 0
    (cwd / "cut.mcap").write_bytes((cwd / "whole.mcap").read_bytes()[:-200])
    there = sorted(cwd.iterdir())
    other = start_program("record", "synthetic:2x3", path)
    try:
        assert "samples" in other.stderr.readline()  # it is at it
        said = f"tactile-rt: {path.name} is being recorded right now: "
        assert refused(*again, "--force").startswith(said)
    finally:
        other.send_signal(signal.SIGINT)
        out, _ = other.communicate()
    assert other.returncode == 0
    assert f"{samples(path)} samples" in out  # and nothing of it is lost
    assert sorted(cwd.iterdir()) == sorted([*there, path])
    assert call(*again, "--force")[0] == 0  # now that it has ended


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("record", SOURCE, "none/x.mcap"), "no folder none to write x.mcap in"),
        (
            ("record", SOURCE, "run.csv"),
            "run.csv: a recording must end in .mcap; `tactile-rt convert`",
        ),
        (("record", SOURCE, "x.mcap", "--note", "who"), "--note must be NAME=VALUE, not 'who'"),
        (("recover", "none.mcap"), "no recording none.mcap"),
        (("convert", "none.mcap", "x.txt"), "none of .npz, .csv, .h5"),
        (("convert", "text.mcap", "x.csv"), "text.mcap is not an MCAP file"),
        (("convert", "text.mcap"), "name a recording and the file to write, or give --to"),
        (("convert", "text.mcap", "--to", "ros"), "did you mean ros2?"),
    ],
)
def test_a_mistake_is_one_line(arguments, said, refused, cwd):
    (cwd / "text.mcap").write_text("no recording at all\n")
    assert said in refused(*arguments)
    assert [p.name for p in cwd.iterdir()] == ["text.mcap"]  # nothing half-written
