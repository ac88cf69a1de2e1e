"""Kunwei KWR75."""

import struct

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, FrameOptions, frame_codec
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

# By hand: 1, -2, 0.5 kgf, 0.25, -0.125, 0 kgf m as float32 (1 is 3F800000, and so on).
GOLDEN = bytes.fromhex("48aa 0000803f 000000c0 0000003f 0000803e 000000be 00000000 0d0a")
LOADS = [9.80665, -19.6133, 4.903325, 2.4516625, -1.22583125, 0.0]
START, STOP, ASK = (bytes.fromhex(x) for x in ("48aa0d0a", "43aa0d0a", "49aa0d0a"))  # datasheet


def kwr75(poll: bool = False, **options: float) -> DescribedFrame:
    return frame_codec("kwr75_polled" if poll else "kwr75")(FrameOptions(**options))


def signal(n: int = 40) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, 1, 6)) * [200, 200, 300, 8, 8, 8]


class TestStreaming(CodecContract):
    case = CodecCase(kwr75, signal, 1e-4, checked=False)


class TestPolled(CodecContract):
    case = CodecCase(lambda: kwr75(poll=True), signal, 1e-4, checked=False)


def test_the_golden_frame() -> None:
    codec = kwr75()
    samples = codec.feed(GOLDEN, T0)
    assert samples.values[0, 0] == pytest.approx(LOADS, rel=1e-6)
    assert samples.valid.all() and samples.count is None and samples.ticks is None
    assert codec.encode(chunk_of(codec, np.array([[LOADS]]))) == [GOLDEN]


def test_an_answer_to_a_single_request_begins_otherwise() -> None:
    codec = kwr75(poll=True)
    assert codec.feed(GOLDEN, T0) is None
    samples = codec.feed(b"\x49" + GOLDEN[1:], T0)
    assert samples.values[0, 0] == pytest.approx(LOADS, rel=1e-6)


def test_the_ends_of_a_frame_may_occur_inside_it() -> None:
    kilograms = np.array(struct.unpack("<6f", bytes.fromhex("48aa0041" + "0d0a0041" * 5)))
    inside = (9.80665 * kilograms).astype(np.float32)
    codec = kwr75()
    wire = b"".join(codec.encode(chunk_of(codec, np.tile(inside, (20, 1, 1)))))
    values = stacked(decode(codec, wire, range(1, len(wire))), "values")
    assert len(values) == 20 and (values == inside).all()
    # damage is found where it hits an end, and costs that frame
    hurt = bytearray(wire)
    hurt[28 * 5] ^= 1
    hurt[28 * 9 + 27] ^= 1
    codec = kwr75()
    values = stacked(decode(codec, bytes(hurt)), "values")
    assert len(values) == 18 and codec.stats.corrupt == 2
    assert (values == inside).all()


def test_the_commands() -> None:
    host, device = kwr75(), kwr75()
    assert [s.send for s in host.commands(Command.START)] == [STOP, START]
    assert not device.streaming
    for byte in STOP + START:
        assert device.respond(bytes((byte,))) == b""
    assert device.streaming and host.commands(Command.POLL) == () and not host.polls
    device.respond(b"\xaa\x0d" + host.commands(Command.STOP)[0].send)
    assert not device.streaming
    asks = kwr75(poll=True)
    assert asks.polls and [s.send for s in asks.commands(Command.START)] == [STOP]
    device = kwr75(poll=True)
    device.respond(asks.commands(Command.POLL)[0].send + ASK)
    assert device.polled == 2 and not device.streaming


def test_a_rate_is_checked() -> None:
    assert kwr75(rate_hz=250.0).spec.rate_hz == 250.0 and kwr75().spec.rate_hz == 1000.0
    with pytest.raises(ConfigError, match="rate_hz must be positive, not -1"):
        kwr75(rate_hz=-1.0)
