"""One file after another, named by time; what is in them is the matter of the daemon's recorder."""

import re

import pytest

from tactile_rt.recording import Recording
from tactile_rt.recording.description import describe
from tactile_rt.recording.rotation import Rotation
from tactile_rt.testing import ArraySource
from tests.helpers.recordings import SPEC


def test_files_of_one_second_are_numbered_and_none_is_written_over(tmp_path):
    source, rotation = ArraySource(SPEC, []), Rotation(tmp_path, "left")
    about = describe(source)
    made = [rotation.begin(source, about) for _ in range(12)]
    assert len({writer.path for writer in made}) == 12
    for writer in made:
        assert re.fullmatch(r"left-\d{8}T\d{6}Z(-\d+)?\.mcap", writer.path.name)
        writer.close()
        assert Recording(writer.path).spec == SPEC


@pytest.mark.parametrize(
    ("limits", "size", "due"),
    [({}, 10**12, False), ({"mb": 1}, 10**6, False), ({"mb": 1}, 10**6 + 1, True),
     ({"seconds": 1e-9}, 0, True), ({"seconds": 1e6}, 10**12, False)],
)  # fmt: skip
def test_a_file_is_due_by_size_or_time(limits, size, due, tmp_path):
    source = ArraySource(SPEC, [])
    rotation = Rotation(tmp_path, "left", **limits)
    writer = rotation.begin(source, describe(source))
    writer.stats.bytes = size
    assert rotation.is_due(writer) is due
    writer.close()
