"""What the command line says to words that it does not know, and how its tables print."""

import os
import pty
import re
import subprocess
import sys
from contextlib import suppress

import pytest

from tactile_rt.drivers.catalogue import CODECS
from tests.helpers.processes import PROGRAM


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("runn", "No such command 'runn'"),
        ("align nosuch", "No such command 'nosuch'; see tactile-rt align --help"),
        ("run --secods 3", "No such option: --secods"),
        ("hz", "Missing argument"),
        ("echo a b", "unexpected extra argument"),
        ("run --seconds", "requires an argument"),
    ],
)
def test_misuse_is_one_line_that_says_where_to_read(refused, words, said):
    line = refused(*words.split())
    assert said in line
    assert "; see tactile-rt" in line and line.endswith("--help\n")


@pytest.mark.parametrize(
    "words",
    [
        ("eval", "m.onnx", "set", "--json", "m.onnx"),
        ("align", "score", "--json=./a.onnx", "a.onnx", "--benchmark", "b"),
        ("align", "gate", "m.onnx", "--reference=best.pt", "--json", "best.pt"),
        ("import", "m.onnx", "--as", "codec=can-dbc&mapping=best.pt", "--json", "best.pt"),
        ("hil", "--source=sim:mouse?objects=mug,sub/../%61.onnx&sweeps=1", "--json=a.onnx"),
        ("hz", "replay:%00a.onnx?speed=0", "x.json", "--json", "x.json"),
    ],
)
def test_json_never_goes_over_another_file_of_the_command(call, cwd, words):
    for name in ("m.onnx", "a.onnx", "best.pt"):
        (cwd / name).write_text("kept")
    (cwd / "sub").mkdir()
    code, out, err = call(*words)
    assert (code, out, err.count("\n")) == (3 if "gate" in words else 2, "", 1)
    assert "is another file of this command: name a new one" in err
    assert {path.read_text() for path in cwd.glob("*.*")} == {"kept"}


@pytest.mark.parametrize(
    "words",
    [
        ("record", "replay:run.mcap?speed=0", "./run.mcap"),
        ("replay", "run.mcap", "--out=sub/../run.mcap"),
    ],
)
def test_what_a_command_reads_is_not_replaced_by_force(refused, cwd, words):
    (cwd / "sub").mkdir()
    (cwd / "run.mcap").write_text("kept")
    said = refused(*words, "--force")
    assert "run.mcap is another file of this command: name a new one" in said
    assert (cwd / "run.mcap").read_text() == "kept"


def test_codecs_are_a_line_each_in_a_pipe(done):
    out, _ = done("codecs")
    heading, *lines = out.splitlines()
    assert heading.split() == ["codec", "wire", "device"]
    assert sorted(tuple(line.split()[1::-1]) for line in lines) == sorted(CODECS)
    assert "…" not in out


def test_of_one_codec_all_is_told(done):
    out, _ = done("codecs", "xela")
    assert re.search(r"^options over can: .*rate_hz", out, re.MULTILINE)
    assert "cannot detect: " in out


def test_a_terminal_too_narrow_for_a_table_shows_a_fact_a_line():
    master, slave = pty.openpty()
    environment = {**os.environ, "COLUMNS": "24", "TERM": "xterm"}
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "codecs"],
        stdout=slave, stderr=slave, stdin=slave, env=environment,
    ) as child:  # fmt: skip
        os.close(slave)
        said = b""
        with suppress(OSError):  # what Linux says when the other end has closed
            while part := os.read(master, 4096):
                said += part
    os.close(master)
    assert child.returncode == 0
    plain = re.sub(r"\x1b\[[0-9;]*m", "", said.decode()).replace("\r", "")
    assert "codec: ft300\nwire: serial\ndevice: " in plain


def test_the_folder_is_what_a_lone_recording_lacks(refused):
    assert "no OUT: name the folder of the sweep set after a.mcap" in refused("label", "a.mcap")
