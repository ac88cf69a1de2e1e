"""What stands in a recording, byte by byte."""

import struct

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.recording.layout import decode_packet, decode_samples, encode_packet, encode_samples
from tactile_rt.testing import cut_chunks
from tests.helpers.recordings import noise, parts


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
    chunk = cut_chunks(noise(1, (1, 2)), 1000.0)[0]
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
