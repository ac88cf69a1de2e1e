"""Of a recording that was cut or damaged, all that is whole comes back."""

import os
import re
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.recording import Description, Recording, recover
from tactile_rt.recording.description import RECOVERED
from tactile_rt.recording.layout import encode_samples
from tactile_rt.recording.recovery import MOST_NONE
from tactile_rt.recording.writer import McapFile
from tactile_rt.testing import cut_chunks
from tests.helpers.recordings import SPEC, all_parts, noise, parts, write


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording in many pieces: its bytes, its chunks, and where each piece ends in it."""
    from mcap.reader import make_reader

    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    chunks = cut_chunks(noise(120), 1000.0, samples=5)
    with path.open("wb") as file:
        made = McapFile(file, Description(SPEC, 1_700_000_000 * 10**9, session={"a": "b"}))
        for i, chunk in enumerate(chunks, 1):
            made.add("samples", encode_samples(chunk), int(chunk.t_ns[-1]))
            if i % 3 == 0:
                made.flush()
        made.finish()
    with path.open("rb") as file:
        pieces = make_reader(file).get_summary().chunk_indexes
    ends = [p.chunk_start_offset + p.chunk_length for p in pieces]
    assert len(ends) == 8
    return path.read_bytes(), chunks, ends


def cut_short(whole, tmp_path, at):
    data, chunks, ends = whole
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:at])
    with pytest.raises(RecordingError, match=re.escape(str(path))):
        list(Recording(path))
    kept = 3 * sum(end <= at for end in ends)
    try:
        back = recover(path, tmp_path / "out.mcap", force=True)
    except RecordingError as error:
        assert kept == 0
        assert str(path) in str(error)
        assert list(tmp_path.iterdir()) == [path]  # nothing half-written
        return False
    assert all_parts(Recording(back)) == all_parts(chunks[:kept])
    assert Recording(back).description.spec == SPEC
    assert Recording(back).description.session == {"a": "b"}
    back.unlink()
    return True


def test_cut_anywhere_all_that_is_whole_is_recovered(whole, tmp_path):
    data, _, ends = whole
    near = {at + d for at in ends for d in (-1, 0, 1)}
    places = near | {0, 1, 8, 9, len(data) - 1, *range(0, len(data), 97)}
    made = [cut_short(whole, tmp_path, at) for at in sorted(places)]
    assert made == sorted(made)  # more of a file never gives less
    assert sum(made) > 100


@settings(max_examples=150)
@given(at=st.floats(0, 1, exclude_max=True), damage=st.binary(min_size=1, max_size=9))
def test_damaged_anywhere_nothing_is_misread(whole, tmp_path_factory, at, damage):
    data, chunks, _ = whole
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    begin = int(at * len(data))
    path.write_bytes(data[:begin] + damage + data[begin + len(damage) :])
    back = []
    try:
        back += Recording(path)
    except RecordingError as error:
        assert str(path) in str(error)
    else:
        assert len(back) == len(chunks)
    assert all_parts(back) == all_parts(chunks[: len(back)])
    try:
        out = recover(path, path.with_name("mended.mcap"), force=True)
    except RecordingError as error:
        assert str(path) in str(error)
        return
    known = all_parts(chunks)
    order = [known.index(p) for p in all_parts(Recording(out))]
    assert order == sorted(order)


def test_a_piece_damaged_in_the_middle_is_left_out(whole, tmp_path):
    data, chunks, ends = whole
    path = tmp_path / "damaged.mcap"
    spoilt = bytearray(data)
    spoilt[ends[3] - 20] ^= 0xFF
    path.write_bytes(spoilt)
    back = []
    with pytest.raises(RecordingError, match="is damaged"):
        back += Recording(path)
    kept = all_parts(Recording(recover(path)))
    assert kept == all_parts(chunks[:9] + chunks[12:])


def test_a_whole_recording_needs_no_recovery(path):
    write(path, cut_chunks(noise(10), 1000.0))
    assert recover(path) == path
    assert list(path.parent.iterdir()) == [path]


@settings(max_examples=150)
@given(
    kept=st.lists(st.booleans(), min_size=200, max_size=200),
    synced=st.floats(0.1, 0.9),
    end=st.floats(0, 1),
    sector=st.sampled_from([512, 4096]),
)
def test_whichever_pages_a_power_cut_leaves_all_whole_pieces_come_back(
    whole, tmp_path_factory, kept, synced, end, sector
):
    data, chunks, ends = whole
    path = tmp_path_factory.getbasetemp() / "holes.mcap"
    safe = int(synced * len(data))
    left = bytearray(data[:safe]) + bytes(len(data) - safe)
    for n, at in enumerate(range(safe // sector * sector, len(data), sector)):
        if kept[n % 200]:
            left[at : at + sector] = data[at : at + sector]
    left = left[: safe + int(end * (len(data) - safe))]
    path.write_bytes(left)
    begins = [0, *ends]
    there = [
        k
        for k, (a, b) in enumerate(zip(begins, ends, strict=False))
        if b <= len(left) and left[a:b] == data[a:b]
    ]
    expected = [parts(c) for k in there for c in chunks[3 * k : 3 * k + 3]]
    if not expected:
        with suppress(RecordingError):  # nothing in it is whole
            recover(path, path.with_name("mended.mcap"), force=True)
        return
    out = recover(path, path.with_name("mended.mcap"), force=True)
    back = all_parts(Recording(out))
    assert set(expected) <= set(back)  # a hole may also lie between two pieces
    order = [all_parts(chunks).index(p) for p in back]
    assert order == sorted(order)
    assert_others_read_it(out)


def assert_others_read_it(path):
    from mcap.reader import make_reader

    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        counted = reader.get_summary().statistics.message_count
        assert sum(1 for _ in reader.iter_messages()) == counted


def test_what_only_has_the_mark_of_a_piece_is_passed_over(whole, tmp_path):
    data, chunks, ends = whole
    path = tmp_path / "marks.mcap"
    mark = b"\x06" + bytes(36) + b"\x04\0\0\0zstd"
    path.write_bytes(data[: ends[2]] + mark * 50 + data[ends[2] : ends[4]])
    assert all_parts(Recording(recover(path))) == all_parts(chunks[:15])


@pytest.mark.parametrize("use", [recover, Recording])
def test_what_is_no_file_is_refused_and_not_waited_for(use, tmp_path):
    path = tmp_path / "a.mcap"
    os.mkfifo(path)
    with pytest.raises(ConfigError, match="a pipe, socket or device, no file"):
        use(path)
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        use(tmp_path)


def test_what_is_recovered_is_on_the_medium_before_it_is_told(whole, tmp_path, monkeypatch):
    data, _, ends = whole
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: ends[3]])
    synced = []
    real = os.fsync

    def note(handle):
        real(handle)
        synced.append(os.readlink(f"/proc/self/fd/{handle}"))

    monkeypatch.setattr(os, "fsync", note)
    made = recover(path)
    assert len(synced) == 2
    assert synced[0].startswith(str(tmp_path / f".{made.name}."))  # before it has its name
    assert synced[1] == str(tmp_path)  # and then the name


def told(path):
    """(topic, log time in UTC) of each message, by MCAP's own reader, and the names of metadata."""
    from mcap.records import Metadata
    from mcap.stream_reader import StreamReader

    with path.open("rb") as file:
        messages = [(c.topic, m.log_time) for _, c, m in NonSeekingReader(file).iter_messages()]
        file.seek(0)
        named = [r.name for r in StreamReader(file).records if isinstance(r, Metadata)]
    return messages, named


def test_what_is_recovered_says_so_and_keeps_its_times(whole, tmp_path):
    data, _, ends = whole
    original, cut_off = tmp_path / "original.mcap", tmp_path / "cut.mcap"
    original.write_bytes(data)
    cut_off.write_bytes(data[: ends[4] + 9])
    back = recover(cut_off)
    assert back == tmp_path / "cut.recovered.mcap"
    messages, named = told(back)
    assert messages == told(original)[0][: len(messages)] and len(messages) == 16
    assert RECOVERED in named and RECOVERED not in told(original)[1]
    assert Recording(back).description.recovered
    assert not Recording(original).description.recovered


def test_what_is_there_already_is_only_replaced_by_force(whole, tmp_path):
    data, _, ends = whole
    cut_off = tmp_path / "cut.mcap"
    cut_off.write_bytes(data[: ends[4] + 9])
    there = tmp_path / "cut.recovered.mcap"
    there.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="already exists"):
        recover(cut_off)
    assert there.read_bytes() == b"mine"
    assert recover(cut_off, force=True) == there
    assert len(told(there)[0]) == 16  # what the array is, and samples


@pytest.mark.parametrize("none, comes_back", [(MOST_NONE, True), (MOST_NONE + 1, False)])
def test_so_many_messages_may_be_none_and_not_one_more(none, comes_back, tmp_path):
    path, chunk = tmp_path / "cut.mcap", cut_chunks(noise(5), 1000.0, samples=5)[0]
    with path.open("wb") as file:
        made = McapFile(file, Description(SPEC, 0))
        made.add("samples", encode_samples(chunk), int(chunk.t_ns[-1]))
        for _ in range(none):
            made.put("samples", b"none", 1)
        made.flush()
    if comes_back:
        assert all_parts(Recording(recover(path))) == all_parts([chunk])
    else:
        with pytest.raises(RecordingError, match="messages cannot be decoded"):
            recover(path)


def test_without_a_whole_message_nothing_comes_back(tmp_path):
    path = tmp_path / "cut.mcap"
    with path.open("wb") as file:
        made = McapFile(file, Description(SPEC, 0))
        made.put("samples", b"none", 1)
        made.flush()
    with pytest.raises(RecordingError, match="nothing in it is whole"):
        recover(path)
    assert list(tmp_path.iterdir()) == [path]
