"""What a command makes of the place it is run in: closed streams, full disks, who ends it."""

import errno
import os
import signal
import subprocess
import sys
import time
import weakref

import pytest

from tactile_rt.cli import app as cli_app
from tactile_rt.recording import Recording, StreamWriter
from tests.helpers.processes import PROGRAM

SOURCE = "synthetic:2x1?pace=fast&seconds=1"


def shell(words: str, streams: str) -> subprocess.CompletedProcess[str]:
    command = ["sh", "-c", f'"$0" -c "$1" {words} {streams}', sys.executable, PROGRAM]
    return subprocess.run(command, capture_output=True, text=True)


def test_without_any_stream_it_does_its_work(tmp_path):
    path = tmp_path / "a.mcap"
    # Nothing that is opened meanwhile is taken for the output.
    assert shell(f"record '{SOURCE}' {path}", "<&- >&- 2>&-").returncode == 0
    assert sum(map(len, Recording(path))) == 1000
    assert shell("no-such-command", "<&- >&- 2>&-").returncode == 2


def test_the_disk_of_its_log_may_be_full():
    full = shell("run --source 'synthetic:mouse?pace=fast&seconds=1'", "2>/dev/full")
    assert (full.returncode, full.stderr) == (0, "")
    assert shell("replay none.mcap", "2>/dev/full").returncode == 2


@pytest.mark.parametrize("words", [f"describe '{SOURCE}'", "run --source 'replay:demo?speed=0'"])
def test_a_full_disk_under_its_output_is_one_line(words):
    full = shell(words, ">/dev/full")
    assert (full.returncode, full.stderr) == (2, "tactile-rt: No space left on device\n")


@pytest.mark.parametrize(
    ("words", "made", "needs"),
    [
        ("convert a.mcap a.h5", "a.h5", "h5py"),
        ("convert a.mcap a.npz", "a.npz", "mcap"),
        ("convert a.mcap bag --to ros2", "bag", "mcap"),
        ("align example brain", "brain", "h5py"),
    ],
)
def test_what_finds_no_room_is_named_and_not_left(call, cwd, words, made, needs):
    pytest.importorskip(needs)
    call("record", SOURCE, "a.mcap")
    # No file may be larger than 4 KiB: to who writes it is as a disk that is full.
    command = ["bash", "-c", f'ulimit -f 4; exec "$0" -c "$1" {words}', sys.executable, PROGRAM]
    whole = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}  # or halves of it would be kept
    full = subprocess.run(command, capture_output=True, text=True, env=whole)
    said = f"tactile-rt: cannot use {made}: File too large\n"
    assert (full.returncode, full.stdout, full.stderr) == (2, "", said)
    assert [path.name for path in cwd.iterdir()] == ["a.mcap"]


@pytest.fixture
def heard():
    """Signals do what they do by themselves: nohup has hangups ignored, ``&`` Ctrl-C."""
    own = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {s: signal.signal(s, handler) for s, handler in own.items()}
    yield
    for s, handler in before.items():
        signal.signal(s, handler)


@pytest.mark.parametrize("made_of_it", [None, RuntimeError("unexpected pos 5760 vs 5672")])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_who_is_told_to_leave_leaves_nothing_half_written(
    call, heard, tmp_path, monkeypatch, number, made_of_it
):
    from tactile_rt.recording import conversion

    call("record", SOURCE, tmp_path / "a.mcap")

    def write(*arguments):
        arguments[1].write(b"half")
        try:
            os.kill(os.getpid(), number)
        finally:
            if made_of_it:  # as torch does where it writes a checkpoint
                raise made_of_it

    monkeypatch.setitem(conversion.WRITERS, ".csv", write)
    before = signal.getsignal(number)
    assert call("convert", tmp_path / "a.mcap", tmp_path / "a.csv") == (128 + number, "", "")
    assert os.listdir(tmp_path) == ["a.mcap"]
    assert signal.getsignal(number) == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_who_is_told_to_leave_where_python_drops_what_is_raised_leaves(
    call, heard, tmp_path, monkeypatch, number
):
    """As while h5py takes an object away, in a callback of a weak reference."""
    from tactile_rt.recording import conversion

    call("record", SOURCE, tmp_path / "a.mcap")
    taken = []

    class Thing:
        """What a weak reference may be of."""

    def write(*arguments):
        thing = Thing()
        kept = weakref.ref(thing, lambda _: taken.append(os.kill(os.getpid(), number)))
        del thing
        assert kept() is None
        for _ in range(3000):  # it comes again soon
            time.sleep(0.01)

    monkeypatch.setitem(conversion.WRITERS, ".csv", write)
    before = sys.unraisablehook
    assert call("convert", tmp_path / "a.mcap", tmp_path / "a.csv") == (128 + number, "", "")
    assert os.listdir(tmp_path) == ["a.mcap"] and taken == []
    assert sys.unraisablehook is before


def test_a_recording_is_whole_when_the_terminal_closes(call, heard, tmp_path, monkeypatch):
    push = StreamWriter.push

    def push_and_close(writer, chunk):
        push(writer, chunk)
        os.kill(os.getpid(), signal.SIGHUP)

    monkeypatch.setattr(StreamWriter, "push", push_and_close)
    code, _, err = call("record", "synthetic:2x1?pace=fast&seconds=60", tmp_path / "a.mcap")
    assert (code, err) == (0, "")
    assert sum(map(len, Recording(tmp_path / "a.mcap"))) > 0


def test_what_ignores_hangups_goes_on_ignoring_them():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with cli_app.leaving(None):
            os.kill(os.getpid(), signal.SIGHUP)
            went_on = True
    finally:
        signal.signal(signal.SIGHUP, before)
    assert went_on


def test_a_configuration_is_written_whole_or_not(refused, tmp_path, monkeypatch):
    from tactile_rt.core import files

    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, "replace", full)
    path = tmp_path / "robot.toml"
    said = refused("config", "example", path)
    assert said == f"tactile-rt: cannot use {path}: No space left on device\n"
    assert os.listdir(tmp_path) == []
