"""Files of MCAP's own writer, read record by record, within bounds."""

from io import BytesIO

import numpy as np
import pytest
from mcap.reader import NonSeekingReader
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Message,
    MessageIndex,
    Metadata,
)
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer

from tactile_rt.recording import records
from tactile_rt.recording.records import read_records, read_whole_records

WAYS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "without chunks": {"use_chunking": False},
    "without an index": {"index_types": IndexType.NONE, "use_statistics": False},
    "without checksums": {"enable_crcs": False},
    "a sum of all": {"enable_data_crcs": True},
}


def written(n=60, size=50, chunk=300, metadata=2, attachment=0, **options):
    """A file: two channels, messages of random bytes that can be packed a little."""
    file, draw = BytesIO(), np.random.default_rng(0)
    writer = Writer(file, chunk_size=chunk, **options)
    writer.start()
    schema = writer.register_schema("s", "json", b"{}")
    channels = [writer.register_channel(f"c{k}", "json", schema) for k in range(2)]
    for k in range(metadata):
        writer.add_metadata(f"m{k}", {"key": "x" * 40})
    if attachment:
        writer.add_attachment(1, 2, "a", "b", bytes(attachment))
    for k in range(n):
        data = draw.integers(0, 3, size, dtype=np.uint8).tobytes()
        writer.add_message(channels[k % 2], 100 + k, data, 200 + k, k)
    writer.finish()
    return file.getvalue()


def messages(found):
    return [
        (m.channel_id, m.sequence, m.log_time, m.publish_time, m.data)
        for m in found
        if isinstance(m, Message)
    ]


def peer(data):
    """What MCAP's own reader reads."""
    return messages(m for _, _, m in NonSeekingReader(BytesIO(data)).iter_messages())


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("attachment", [0, 500])
def test_what_mcap_s_own_writer_wrote_is_read_as_its_own_reader_does(way, attachment, monkeypatch):
    if way == "lz4":
        pytest.importorskip("lz4")
    monkeypatch.setattr(records, "PIECE", 64)
    data = written(**WAYS[way], attachment=attachment)
    found = list(read_records(BytesIO(data)))
    assert messages(found) == peer(data) and len(messages(found)) == 60
    assert [m.name for m in found if isinstance(m, Metadata)] == ["m0", "m1"]
    assert {c.topic for c in found if isinstance(c, Channel)} == {"c0", "c1"}


@pytest.mark.parametrize("piece", range(20, 60))
def test_pieces_are_found_wherever_they_begin(piece, monkeypatch):
    monkeypatch.setattr(records, "PIECE", piece)
    data = written(n=20)
    assert messages(read_whole_records(BytesIO(data))) == peer(data)


def test_what_is_cut_off_or_damaged_is_told_and_its_whole_pieces_come_back():
    data = written()
    every = peer(data)
    for end in range(0, len(data), 7):
        found = messages(read_whole_records(BytesIO(data[:end])))
        assert found == every[: len(found)]
        with pytest.raises(ValueError):
            list(read_records(BytesIO(data[:end])))
    back = []
    for at in range(60, len(data) - 60, 11):
        damaged = bytearray(data)
        damaged[at] ^= 0x40
        found = messages(read_whole_records(BytesIO(bytes(damaged))))
        assert set(found) <= set(every)
        back.append(len(every) - len(found))
    assert max(back) <= 10  # one piece at most


def test_a_piece_without_a_checksum_is_not_believed_where_there_is_damage():
    data = written(enable_crcs=False)
    assert len(messages(read_records(BytesIO(data)))) == 60
    assert messages(read_whole_records(BytesIO(data))) == []


def bounded(data, bound, value, monkeypatch, read=read_records):
    """Whether it is read when a bound is this."""
    with monkeypatch.context() as patched:
        patched.setattr(records, bound, value)
        try:
            return len(messages(read(BytesIO(data)))) == 60
        except ValueError as error:
            assert "\n" not in str(error)
            return False


def test_so_many_other_records_are_read_and_not_one_more(monkeypatch):
    data = written(metadata=30, use_statistics=False, index_types=IndexType.NONE)
    ours = (Message, Chunk, MessageIndex, ChunkIndex, DataEnd, Footer)
    others = sum(not isinstance(r, ours) for r in StreamReader(BytesIO(data)).records)
    assert others > 33
    assert bounded(data, "MOST_OTHERS", others, monkeypatch)
    assert not bounded(data, "MOST_OTHERS", others - 1, monkeypatch)
    few = written(metadata=0)
    assert bounded(few, "MOST_OTHERS", 5, monkeypatch, read_whole_records)  # header, each channel
    assert not bounded(few, "MOST_OTHERS", 3, monkeypatch, read_whole_records)


def test_so_much_metadata_is_read_and_not_a_byte_more(monkeypatch):
    data = written(metadata=3, use_statistics=False)
    each = 4 + 2 + 4 + 4 + 3 + 4 + 40  # name and one pair, each with its length
    assert bounded(data, "MOST_METADATA", 3 * each, monkeypatch)
    assert not bounded(data, "MOST_METADATA", 3 * each - 1, monkeypatch)


def largest(data):
    """Bytes that the largest chunk unpacks to, and those of all, packed size of the largest."""
    chunks = [
        c for c in StreamReader(BytesIO(data), emit_chunks=True).records if isinstance(c, Chunk)
    ]
    sizes = [c.uncompressed_size for c in chunks]
    return max(sizes), sum(sizes), max(len(c.data) for c in chunks)


def test_a_chunk_may_unpack_to_so_much_and_not_to_a_byte_more(monkeypatch):
    data = written()
    most, _, packed = largest(data)
    assert packed + 100 < most
    assert bounded(data, "MOST_UNPACKED", most, monkeypatch)
    assert not bounded(data, "MOST_UNPACKED", most - 1, monkeypatch)


def test_all_chunks_may_unpack_to_so_much_of_the_file_and_what_is_free(monkeypatch):
    data = written()
    _, every, _ = largest(data)
    monkeypatch.setattr(records, "MOST_RATIO", 0)
    assert bounded(data, "FREE", every, monkeypatch)
    assert not bounded(data, "FREE", every - 1, monkeypatch)
    monkeypatch.setattr(records, "MOST_RATIO", 1)
    # when the last one is unpacked nearly all of the file has been read
    assert bounded(data, "FREE", max(0, every - len(data) // 2), monkeypatch)
    assert not bounded(data, "FREE", every - len(data), monkeypatch)


def test_what_only_looks_like_chunks_is_looked_at_so_often_and_no_more(monkeypatch):
    """A file of nothing but marks, each with a length of its own: n of them cost n^2 bytes."""
    data = written(n=4)
    begin = data.index(records.MARK) - records.MARK_AT
    (length,) = np.frombuffer(data[begin + 1 : begin + 9], "<u8").tolist()
    one = data[begin : begin + 9 + length]
    false = bytearray(one)
    false[-3] ^= 1
    file = bytes(records.MAGIC) + bytes(false) * 10 + one
    monkeypatch.setattr(records, "MOST_LOOKS", 0)
    with monkeypatch.context() as patched:
        patched.setattr(records, "FREE", 11 * length)
        assert len(messages(read_whole_records(BytesIO(file)))) == 3
        patched.setattr(records, "FREE", 11 * length - 1)
        with pytest.raises(ValueError, match="look like a chunk"):
            list(read_whole_records(BytesIO(file)))
