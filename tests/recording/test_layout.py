"""What stands in a recording, byte by byte."""

import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.drivers.codec import CanFrame
from tactile_rt.recording import Recording
from tactile_rt.recording.layout import (
    decode_packet,
    decode_samples,
    encode_packet,
    encode_samples,
)
from tactile_rt.stream import Chunk
from tactile_rt.testing import FakeCan, FakeSerial, cut
from tests.helpers.recordings import SPEC, noise, odd_chunks, parts, record_device, write


def test_samples_are_cdr_as_written_by_hand():
    chunk = Chunk(
        np.array([5], np.int64), np.array([-2], np.int64),
        np.array([[[1.5, -2.0]]], np.float32), np.array([[True]]),
    )  # fmt: skip
    golden = bytes.fromhex(
        "00010000"  # CDR, little-endian
        "01000000 00000000 0500000000000000"  # length, padding to 8, seq
        "01000000 00000000 feffffffffffffff"
        "01000000 02000000"  # elements, channels
        "02000000 0000c03f 000000c0"
        "01000000 01"
    )
    assert encode_samples(chunk) == golden
    assert parts(decode_samples(golden, (1, 2))) == parts(chunk)


def test_packets_are_cdr_as_written_by_hand():
    assert encode_packet(b"\x01\xff", "serial") == bytes.fromhex("00010000 00000000 02000000 01ff")
    assert encode_packet(None, "serial") == bytes.fromhex("00010000 01000000 00000000")
    frames = [CanFrame(0x123, b"\xaa"), CanFrame(0x1ABCDEF0, b"", extended=True, remote=True)]
    golden = bytes.fromhex(
        "00010000 00000000 02000000"
        "23010000 00 00 00 00 01000000 aa 000000"
        "f0debc1a 01 00 01 00 00000000"
    )
    assert encode_packet(frames, "can") == golden
    assert decode_packet(golden, "can") == frames


FRAMES = st.lists(
    st.builds(
        CanFrame, st.integers(0, 2**29 - 1), st.binary(max_size=64), st.booleans(), st.booleans(),
        st.booleans(),
    )
)  # fmt: skip


@given(frames=FRAMES, data=st.binary(max_size=100))
def test_packets_come_back(frames, data):
    assert decode_packet(encode_packet(frames, "can"), "can") == frames
    assert decode_packet(encode_packet(data, "serial"), "serial") == data
    assert decode_packet(encode_packet(None, "can"), "can") is None


@given(data=st.binary(max_size=80), keep=st.integers(0, 60))
def test_what_is_no_message_is_refused_or_reads_as_one(data, keep):
    """Whatever is decoded is what its encoding says: nothing is guessed."""
    chunk = cut(noise(1, (1, 2)), 1000.0)[0]
    for made in (encode_samples(chunk)[:keep] + data, data):
        try:
            assert encode_samples(decode_samples(made, (1, 2)))[12:20] == made[12:20]
        except (ValueError, struct.error):
            pass
        for wire in ("serial", "can"):
            try:
                decode_packet(made, wire)
            except (ValueError, struct.error):
                pass


def cdr(schema, data):
    """A message decoded by nothing but its ros2msg schema."""
    texts = re.split(r"=+\n", schema)
    kinds = {"": texts[0]} | {t.split("\n")[0].removeprefix("MSG: "): t for t in texts[1:]}
    simple = {"bool": "?", "uint8": "B", "uint32": "I", "int64": "q", "float32": "f"}
    simple |= {"int32": "i", "float64": "d"}
    at = 0

    def one(kind):
        nonlocal at
        if kind == "string":
            length = one("uint32")
            at += length
            return data[4 + at - length : 4 + at - 1].decode()
        if kind not in simple:
            return message(kind)
        size = struct.calcsize(simple[kind])
        at += -at % size
        (value,) = struct.unpack_from("<" + simple[kind], data, 4 + at)
        at += size
        return value

    def message(kind):
        found = {}
        for line in kinds[kind].splitlines():
            words = line.split("#")[0].split()
            if len(words) == 2 and words[0] != "MSG:":
                base, _, many = words[0].partition("[")
                found[words[1]] = [one(base) for _ in range(one("uint32"))] if many else one(base)
        return found

    made = message("")
    assert at == len(data) - 4
    return made


def test_any_mcap_reader_reads_it_by_the_schemas_in_the_file(path):
    from mcap.reader import make_reader

    chunks = odd_chunks()
    write(path, chunks)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        topics = {c.topic: c.message_encoding for c in summary.channels.values()}
        names = ("samples", "health", "decisions", "events", "array")
        assert topics == {f"/tactile/{SPEC.name}/{name}": "cdr" for name in names}
        assert reader.get_header().profile == "ros2"
        found = list(reader.iter_messages(topics=[f"/tactile/{SPEC.name}/samples"]))
        names = [m.name for m in reader.iter_metadata()]
    assert len(found) == len(chunks)
    assert names == ["tactile_rt", "summary"]
    for chunk, (schema, _, message) in zip(chunks, found, strict=True):
        assert (schema.name, schema.encoding) == ("tactile_rt_msgs/msg/Samples", "ros2msg")
        fields = cdr(schema.data.decode(), message.data)
        stamp = fields["header"]["stamp"]
        utc_ns = int(chunk.t_ns[-1]) + Recording(path).description.utc_offset_ns
        assert stamp["sec"] * 10**9 + stamp["nanosec"] == min(utc_ns, (2**31 - 1) * 10**9)
        assert fields["header"]["frame_id"] == SPEC.frame
        assert fields["seq"] == chunk.seq.tolist()
        assert fields["t_ns"] == chunk.t_ns.tolist()
        assert (fields["elements"], fields["channels"]) == SPEC.shape
        values = np.array(fields["values"], np.float32)
        assert values.tobytes() == chunk.values.tobytes()
        assert fields["valid"] == chunk.valid.ravel().tolist()
        assert message.log_time == chunk.t_ns[-1] + Recording(path).description.utc_offset_ns


@pytest.mark.parametrize("make", [FakeSerial, FakeCan])
def test_packets_are_read_by_their_schema(make, path):
    record_device(make(noise(50, (4, 6)), pace="fast"), path, 50)
    packets = list(Recording(path).packets())
    wire = f"/tactile/{Recording(path).spec.name}/wire"
    from mcap.reader import make_reader

    with path.open("rb") as file:
        for (schema, _, message), (packet, t_ns) in zip(
            make_reader(file).iter_messages(topics=[wire]), packets, strict=True
        ):
            fields = cdr(schema.data.decode(), message.data)
            assert fields["opened"] == (packet is None)
            assert message.log_time - Recording(path).description.utc_offset_ns == t_ns
            if make is FakeSerial:
                assert bytes(fields["data"]) == (packet or b"")
            else:
                frames = [{**f, "data": bytes(f["data"])} for f in fields["frames"]]
                assert frames == [f._asdict() for f in packet or []]
    assert packets[0][0] is None
    assert len(packets) > 1
