"""What is read is what was written, or named."""

import time

import numpy as np
import pytest
from mcap.writer import Writer

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.recording import Recording, recover
from tactile_rt.testing import cut_chunks
from tests.helpers.hostile_files import MCAPS
from tests.helpers.measured import measured
from tests.helpers.recordings import SPEC, all_parts, noise, odd_chunks, write


def test_chunks_come_back_bit_for_bit(path, no_thread_left):
    chunks = odd_chunks()
    write(path, chunks)
    back = list(Recording(path))
    assert all_parts(back) == all_parts(chunks)
    assert [c.values.dtype for c in back] == [np.float32] * len(chunks)
    assert back[0].values.flags.writeable  # its reader's own


def test_a_description_comes_back(path):
    before = time.time_ns() - time.monotonic_ns()
    write(path, odd_chunks(), session={"who": "Ada", "why": "a test"}, url="array:x")
    about = Recording(path).description
    assert about.spec == SPEC
    assert about.session == {"who": "Ada", "why": "a test"}
    assert (about.source, about.wire, about.codec) == ("array:x", "", "")
    assert abs(about.utc_offset_ns - before) < 1e9


def foreign(path, **metadata):
    with path.open("wb") as file:
        other = Writer(file)
        other.start()
        for name, fields in metadata.items():
            other.add_metadata(name, fields)
        channel = other.register_channel("x", "json", 0)
        other.add_message(channel, 1, b"{}", 1)
        other.finish()


@pytest.mark.parametrize(
    ("make", "kind", "said"),
    [
        (lambda p: None, ConfigError, "no recording .*run.mcap|No such file"),
        (lambda p: p.mkdir(), ConfigError, "cannot be read: Is a directory"),
        (lambda p: p.write_bytes(b""), RecordingError, "not an MCAP file"),
        (lambda p: p.write_text("seq,t_ns\n"), RecordingError, "not an MCAP file"),
        (foreign, RecordingError, "no recording of tactile-rt"),
        (
            lambda path: foreign(path, tactile_rt={"version": "2"}),
            RecordingError,
            "of version '2'; this release reads 3",
        ),
    ],
    ids=["missing", "folder", "empty", "text", "another's mcap", "older"],
)
def test_what_is_no_recording_is_named(make, kind, said, path):
    make(path)
    for read in (Recording, lambda p: list(Recording(p)), recover):
        with pytest.raises(kind, match=said) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def test_a_recording_is_read_as_often_as_one_likes(path):
    chunks = cut_chunks(noise(40), 1000.0)
    write(path, chunks)
    recording = Recording(str(path))
    for again in (recording, recording, recording.chunks()):
        assert all_parts(again) == all_parts(chunks)
    assert list(recording.packets()) == list(recording.events()) == list(recording.raw()) == []
    with path.open("r+b") as file:  # damaged by now
        file.seek(path.stat().st_size // 3)
        file.write(bytes(50))
    with pytest.raises(RecordingError, match=r"run\.mcap is damaged"):
        list(recording)


@pytest.mark.parametrize("name", MCAPS)
def test_a_hostile_recording_is_refused(name, tmp_path):
    path = tmp_path / "hostile.mcap"
    path.write_bytes(MCAPS[name]())
    for command in (("recover", path), ("replay", path, "--speed", "max")):
        measured(*command).assert_refused("hostile.mcap")
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(RecordingError) as caught:  # as a robot's own program reads it
        list(Recording(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "command",
    [("convert", "hostile.mcap", "out.npz"), ("label", "hostile.mcap", "set", "--by-name")],
)
def test_every_command_that_reads_recordings_refuses_it(command, cwd):
    (cwd / "hostile.mcap").write_bytes(MCAPS["zstd of 1 GiB"]())
    measured(*command).assert_refused("hostile.mcap")
    assert [p.name for p in cwd.iterdir()] == ["hostile.mcap"]
