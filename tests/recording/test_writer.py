"""A file of a recording: its name, and what a kill leaves of it at every step."""

import os

import pytest

from tactile_rt.recording import Recording
from tactile_rt.recording import writer as module
from tactile_rt.recording.description import describe
from tactile_rt.recording.writer import RecordingWriter
from tactile_rt.testing import ArraySource
from tests.helpers.processes import run_program
from tests.helpers.recordings import SPEC

# Begins a file, killed at each line of the writer in turn.
PROGRAM = """
import itertools, os, sys
from pathlib import Path
import mcap.stream_reader, mcap.writer  # once, not in each child
from tactile_rt.recording import Recording, recover, writer
from tactile_rt.recording.description import describe
from tactile_rt.recording.writer import RecordingWriter
from tactile_rt.testing import ArraySource, small_spec

folder, force = Path(sys.argv[1]), sys.argv[2] == "force"
path, mended = folder / "run.mcap", folder / "mended.mcap"
source = ArraySource(small_spec(), [])
about = describe(source, "array:x", {"who": "Ada"})


def begin(killed_at):
    lines = itertools.count(1)

    def trace(frame, event, argument):
        if frame.f_code.co_filename != writer.__file__:
            return None
        if event == "line" and next(lines) == killed_at:
            os._exit(9)
        return trace

    sys.settrace(trace)
    RecordingWriter(path, source, about, force=force)
    os._exit(0)


for step in itertools.count(1):
    for left in folder.iterdir():
        left.unlink()
    if force:
        path.write_bytes(b"precious")
    child = os.fork()
    if not child:
        begin(step)
    ended = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if not path.exists():
        found = "nothing"
    elif path.read_bytes() == b"precious":
        found = "the old one"
    else:
        found = Recording(recover(path, mended)).description.session["who"]
    strange = [p.name for p in folder.glob("*") if p.name not in (path.name, mended.name)]
    strange = [n for n in strange if not (n.startswith(".run.") and n.endswith(".mcap.part"))]
    print(step, ended, found, *strange, sep=",")
    if ended == 0:
        break
"""


@pytest.mark.parametrize(("how", "before"), [("new", "nothing"), ("force", "the old one")])
def test_killed_at_any_step_it_leaves_no_file_that_cannot_be_recovered(how, before, tmp_path):
    done = run_program(tmp_path, how, program=PROGRAM, timeout=None)
    assert done.returncode == 0, done.stderr
    found = [line.split(",")[1:] for line in done.stdout.splitlines()]
    assert found[-1] == ["0", "Ada"]
    killed = found[:-1]
    assert len(killed) > 100
    # Nothing, then at once a file that says what it is of.
    named = killed.index(["9", "Ada"])
    assert killed == [["9", before]] * named + [["9", "Ada"]] * (len(killed) - named)
    assert named > 100


def begun(path, **further):
    source = ArraySource(SPEC, [])
    return RecordingWriter(path, source, describe(source), **further)


def test_a_file_that_is_there_is_never_written_over_whoever_comes_first(path, monkeypatch):
    path.write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        begun(path)
    path.unlink()
    create = module._create

    def beaten(*arguments):
        path.write_bytes(b"precious")  # by another process, meanwhile
        return create(*arguments)

    monkeypatch.setattr(module, "_create", beaten)
    with pytest.raises(FileExistsError):
        begun(path)
    assert path.read_bytes() == b"precious"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("there", [False, True])
def test_without_links_a_file_is_renamed_and_none_written_over(there, path, monkeypatch):
    create = module._create

    def created(*arguments):
        made = create(*arguments)
        if there:
            path.write_bytes(b"precious")
        return made

    def no_links(*arguments, **further):
        raise PermissionError(1, "Operation not permitted")  # as exFAT says it

    monkeypatch.setattr(module, "_create", created)
    monkeypatch.setattr(os, "link", no_links)
    if there:
        with pytest.raises(FileExistsError):
            begun(path)
        assert path.read_bytes() == b"precious"
    else:
        begun(path).close()
        assert list(Recording(path)) == []
    assert list(path.parent.iterdir()) == [path]


def test_forced_it_follows_a_link_and_writes_into_what_is_no_file(path, tmp_path):
    path.symlink_to(tmp_path / "target.mcap")
    begun(path, force=True).close()
    assert path.is_symlink()
    assert list(Recording(tmp_path / "target.mcap")) == []
    null = tmp_path / "null"
    null.symlink_to(os.devnull)
    begun(null, force=True).close()
    assert not os.path.isfile(os.devnull)
