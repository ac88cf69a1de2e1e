"""Robotiq FT 150 and FT 300."""

import numpy as np
import pytest

from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.framing import crc16_modbus
from tactile_rt.drivers.codecs.ft300 import Ft300, Ft300Options
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

# The request that many public drivers send as a constant, and that the CRC is checked by.
START = bytes.fromhex("09 10 019a 0001 02 0200 cdca")

# By hand from the format: 1.00, -1.00, 327.67 N, 0.001, -0.001, -32.768 N m.
GOLDEN = bytes.fromhex("204e 6400 9cff ff7f 0100 ffff 0080 51c0")
LOADS = [1.0, -1.0, 327.67, 0.001, -0.001, -32.768]
STEP = [0.005] * 3 + [0.0005] * 3  # half a count


def checked(data: bytes) -> bytes:
    return crc16_modbus(data).to_bytes(2, "little")


def ft300(**options: int) -> Ft300:
    return Ft300(Ft300Options(**options))


def signal(n: int = 40) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, 1, 6)) * [40, 40, 90, 4, 4, 4]


class TestFt300(CodecContract):
    case = CodecCase(ft300, signal, np.array(STEP) * 1.001)


def test_the_golden_frame() -> None:
    codec = ft300()
    samples = codec.feed(GOLDEN, T0)
    assert samples is not None and samples.valid.all() and samples.arrived_ns.tolist() == [T0]
    assert samples.values[0, 0] == pytest.approx(LOADS, rel=1e-6)
    assert samples.count is None and samples.ticks is None and samples.status is None
    assert codec.encode(chunk_of(codec, np.array([[LOADS]]))) == [GOLDEN]
    too_much = np.array([[[1e9, -1e9, np.nan, np.inf, -np.inf, 0]]])
    load = np.frombuffer(codec.encode(chunk_of(codec, too_much))[0][2:-2], "<i2")
    assert load.tolist() == [32767, -32768, 0, 32767, -32768, 0]


def test_a_streaming_device_takes_no_request_until_it_is_jammed() -> None:
    host, device = ft300(), ft300()
    assert not device.streaming
    jam, request = host.commands(Command.START)
    assert jam.send == b"\xff" * 50 and jam.pause_s >= 0.1 and request.send == START
    for _ in range(2):  # the second time it streams
        assert device.respond(jam.send[:20]) == device.respond(jam.send[20:]) == b""
        assert not device.streaming
        answer = b"".join(device.respond(START[k : k + 1]) for k in range(len(START)))
        # the answer repeats address, function, register and number: 09 10 01 9a 00 01
        assert answer == request.expect == START[:6] + checked(START[:6])
        assert device.streaming
        assert device.respond(START) == b"" and device.streaming
        assert device.respond(b"\xff" * 49 + b"\0") == b"" and device.streaming
    (stop,) = host.commands(Command.STOP)
    device.respond(stop.send)
    assert not device.streaming and host.commands(Command.POLL) == ()


def test_a_request_that_is_damaged_or_for_another_is_not_answered() -> None:
    device = ft300(slave=3)
    assert device.respond(START) == b"" and not device.streaming
    own = b"\x03" + START[1:-2]
    assert device.respond(own + b"\0\0") == b"" and not device.streaming
    assert device.respond(own + checked(own)) and device.streaming


def test_an_answer_and_an_echo_among_the_frames_are_no_damage() -> None:
    device, host = ft300(), ft300()
    frames = device.encode(chunk_of(device, signal()))
    echo = START[:6] + checked(START[:6])
    heard = b"".join([*frames[:7], frames[7][:9], b"\xff" * 50, START, echo, *frames[8:]])
    samples = decode(host, heard)
    assert sum(map(len, samples)) == 39
    assert host.stats.corrupt == stacked(samples, "damaged").sum() == 0
    assert host.stats.skipped == 9 + 50 + 11 + 8
