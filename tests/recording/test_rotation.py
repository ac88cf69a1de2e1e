"""One file after another: named by time, each whole in itself, nothing lost between."""

import re

import numpy as np
import pytest

from tactile_rt.recording import Recording, StreamWriter
from tactile_rt.recording.description import describe
from tactile_rt.recording.rotation import Rotation
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, FakeSerial, cut_chunks
from tests.helpers.recordings import SPEC, all_parts, noise, record_device


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


def test_a_stream_goes_on_in_the_next_file(path, no_thread_left):
    chunks = cut_chunks(noise(3000), 1000.0, samples=10)
    limits = {"rotate_mb": 0.01, "flush_s": 0.0}
    with StreamWriter(path, ArraySource(SPEC, chunks), session={"who": "Ada"}, **limits) as writer:
        for chunk in chunks:
            writer.push(chunk)
    assert not path.exists()
    paths = list(path.parent.glob("run-*.mcap"))
    assert len(paths) == writer.files > 3
    found = sorted(map(Recording, paths), key=lambda r: next(r.chunks()).seq[0])
    assert all_parts(c for recording in found for c in recording) == all_parts(chunks)
    assert {r.description.session["who"] for r in found} == {"Ada"}
    assert writer.stats.samples == 3000
    assert writer.stats.bytes == sum(p.stat().st_size for p in paths)
    told = [list(r.health())[-1] for r in found]
    assert sum(h["recorder"]["samples"] for h in told) == 3000
    assert {h["state"] for h in told} == {"closed"}


def test_a_device_is_understood_from_every_file(path):
    fake = FakeSerial(noise(600, (4, 6)))
    chunks, _ = record_device(fake, path, 600, rotate_mb=0.01, flush_s=0.0)
    paths = list(path.parent.glob("run-*.mcap"))
    assert len(paths) > 2
    again = set()
    for each in paths:
        with open_source(f"replay:{each}?from=wire&speed=0") as source:
            assert source.spec.shape == (4, 6)
            whole = [c.values for c in source]
        for values in np.concatenate(whole) if whole else ():
            again.add(values.tobytes())
    # One frame may begin in one file, and end in the next.
    missing = sum(values.tobytes() not in again for chunk in chunks for values in chunk.values)
    assert missing < len(paths)
