"""Strain-gauge whiskers on HX711 converters."""

import struct

import numpy as np
import pytest

from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.hx711_whisker import Hx711Whisker, Hx711WhiskerOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked


def hx711(**options: float) -> Hx711Whisker:
    return Hx711Whisker(Hx711WhiskerOptions(**options))


def signal(n: int = 40, whiskers: int = 9) -> np.ndarray:
    return np.random.default_rng(1).uniform(-0.016, 0.016, size=(n, whiskers, 2))


class TestNine(CodecContract):
    case = CodecCase(hx711, signal, 3e-9, checked=False)


class TestOne(CodecContract):
    case = CodecCase(lambda: hx711(whiskers=1), lambda: signal(whiskers=1), 3e-9, checked=False)


# One whisker, 1 mV and -2.5 mV, and the ending, from hx711_array.ino and IEEE 754 by hand
GOLDEN = bytes.fromhex("0000803f000020c00d0a0000fd44")


def test_a_golden_frame() -> None:
    samples = hx711(whiskers=1).feed(GOLDEN, T0)
    assert samples is not None and samples.valid.all()
    assert samples.values[0, 0] == pytest.approx([1e-3, -2.5e-3], rel=1e-6)
    codec = hx711(whiskers=1)
    assert codec.encode(chunk_of(codec, np.array([[[1e-3, -2.5e-3]]]))) == [GOLDEN]


def test_the_board_is_told_how_many_whiskers_after_its_reset() -> None:
    host, device = hx711(whiskers=3, indicator=True), hx711(whiskers=3)
    wait, tell, mark = host.commands(Command.START)
    assert wait.send == b"" and wait.pause_s == 1.5
    assert tell.send == b"N=3\n" and tell.expect == b"OK" and mark.send == b"S"
    assert not device.streaming
    assert device.respond(b"N=0\nN=12\nhello\n") == b"" and not device.streaming
    answer = b"".join(device.respond(bytes((b,))) for b in tell.send)
    assert answer == b"OK\r\n" and device.streaming
    device.respond(mark.send)
    assert device.recording
    (end,) = host.commands(Command.STOP)
    device.respond(end.send)
    assert not device.recording and device.streaming  # the board knows no stop
    # the answer stands before the first frame
    wire = answer + b"".join(device.encode(chunk_of(device, signal(3, 3))))
    samples = host.feed(wire, T0)
    assert samples is not None and len(samples) == 3
    assert host.stats.skipped == 4 and host.stats.corrupt == 0

    (tell,) = hx711(reset=False).commands(Command.START)
    assert tell.send == b"N=9\n" and tell.expect is None
    assert hx711().commands(Command.STOP) == ()


def test_a_saturated_converter_is_not_valid() -> None:
    full = 4.3 * 1000 / 128
    rows = [
        (0x7FFFFF / 2**24 * full, 0.0),
        (0.0, -0x800000 / 2**24 * full),
        (0x7FFFF0 / 2**24 * full, -0x7FFFF0 / 2**24 * full),
        (float("nan"), 0.0),
        (float("inf"), 0.0),
    ]
    wire = b"".join(struct.pack("<2f", *row) + GOLDEN[8:] for row in rows)
    wire += bytes.fromhex("010080ff00000000") + GOLDEN[8:]  # a signalling NaN, made by damage
    samples = hx711(whiskers=1).feed(wire, T0)
    assert samples.valid[:, 0].tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize(
    ("hurt", "lost", "left"),
    [
        (lambda p: [*p[:3], p[3][:-1] + b"!", *p[4:]], 1, 9),  # an ending
        (lambda p: [*p[:3], p[3][:-5] + b"!!!!!", p[4][:-1] + b"!", *p[5:]], 2, 8),  # two
        (lambda p: [*p[:3], p[3][:-20], *p[4:]], 2, 8),  # cut short: two in one
        (lambda p: [*p[:3], p[3][3:], *p[4:]], 1, 9),
        (lambda p: [*p[:3], *p[4:]], 0, 9),  # a lost frame leaves no trace
        (lambda p: [p[0][50:], *p[1:]], 0, 9),  # joined in the middle
    ],
)
def test_damaged_frames_are_counted(hurt: object, lost: int, left: int) -> None:
    codec = hx711()
    packets = codec.encode(chunk_of(codec, signal(10)))
    samples = codec.feed(b"".join(hurt(packets)), T0)
    assert samples is not None and len(samples) == left
    assert codec.stats.corrupt == lost == samples.damaged.sum()
    assert codec.stats.intact == left


def test_bytes_without_an_ending_do_not_pile_up() -> None:
    packets = hx711().encode(chunk_of(hx711(), signal(4)))
    stream = b"".join(packets[:2]) + b"\r\n" * 2000 + b"".join(packets[2:])
    whole, cut = hx711(), hx711()
    a, b = decode(whole, stream), decode(cut, stream, range(1, len(stream)))
    assert stacked(a, "damaged").tolist() == stacked(b, "damaged").tolist() == [0, 0, 53]
    assert whole.stats == cut.stats and len(cut._finder._data) == 0
