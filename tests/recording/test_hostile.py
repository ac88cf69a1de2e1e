"""Recordings that are made to exhaust who reads them are refused at once, in one line."""

import pytest

from tactile_rt.core.errors import RecordingError
from tactile_rt.recording import Recording
from tests.helpers.hostile_files import MCAPS
from tests.helpers.measured import measured


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
