"""Robotiq TSF-85."""

import dataclasses

import numpy as np
import pytest

from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.tsf85 import Tsf85, Tsf85Options
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

# By hand from the format: taxel k of finger 0 counts k, of finger 1 256 + k; then one packet with
# both fingers' times (66,000 ms), finger 0's dynamic value, -2, and its temperature.
TAXELS = [
    "9a 77 58 39 10" + "".join(f"00{k:02x}" for k in range(28)),
    "9a 00 58 39 14" + "".join(f"01{k:02x}" for k in range(28)),
]
REST = "9a 00 58 18 70 00000000000101d0 74 00000000000101d0 20 fffe 60 0a00"
# A finger lying still, flat: 1 g along z at +-2 g, 1 deg/s about x at +-250 deg/s.
MOTION = "9a 00 58 11 24 0007 34 0000 0000 4000 44 0083 0000 0000"


def tsf85(**options: object) -> Tsf85:
    return Tsf85(Tsf85Options(**options))


def taxels(n: int = 30) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 65536, (n, 56, 1)).astype(float)


def fingers(n: int = 30) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, 2, 7)) * [5000, 5, 5, 5, 1, 1, 1]


STEP = np.array([0.5] + [9.80665 / 32768] * 3 + [np.deg2rad(125) / 32768] * 3) * 1.001


class TestTaxels(CodecContract):
    case = CodecCase(tsf85, taxels, checked=False, settles=False)


class TestOneFingerOfAnOlderFirmware(CodecContract):
    case = CodecCase(
        lambda: tsf85(fingers=1, times=False, period_ms=10),
        lambda: taxels()[:, :28],
        checked=False,
    )


class TestFingers(CodecContract):
    case = CodecCase(lambda: tsf85(signals="fingers"), fingers, STEP, checked=False)


def test_golden_packets() -> None:
    codec = tsf85()
    wire = [bytes.fromhex(x) for x in (*TAXELS, REST)]
    assert codec.feed(wire[0], T0) is None and codec.feed(wire[1], T0) is None
    samples = codec.feed(wire[2], T0 + 5)
    assert samples.values[0, :, 0].tolist() == [*range(28), *range(256, 284)]
    assert samples.ticks.tolist() == [66_000] and samples.arrived_ns.tolist() == [T0 + 5]
    assert samples.valid.all() and codec.stats.intact == 3 and codec.stats.corrupt == 0
    again = codec.encode(
        dataclasses.replace(chunk_of(codec, samples.values), t_ns=np.array([66_000_000_000]))
    )
    sent = codec.feed(again[0], T0)
    assert np.array_equal(sent.values, samples.values) and sent.ticks.tolist() == [66_000]
    # the taxels' packets are the golden ones, but for the CRC
    assert again[0][61:122] == wire[1] and again[0][2:61] == wire[0][2:]


def test_golden_motion() -> None:
    codec = tsf85(signals="fingers", times=False)
    assert codec.feed(bytes.fromhex(MOTION), T0) is None  # finger 1; finger 0 is to come
    samples = codec.feed(bytes.fromhex(MOTION.replace("24", "20").replace("34", "30"))
                         .replace(b"\x44\x00\x83", b"\x40\xff\x7d"), T0)  # fmt: skip
    assert samples.values[0, 1, [0, 3, 4]] == pytest.approx([7, 9.80665, 0.017444], rel=1e-3)
    assert samples.values[0, 0, [0, 3, 4]] == pytest.approx([7, 9.80665, -0.017444], rel=1e-3)


def test_signals_may_come_in_any_order_and_others_are_passed_over() -> None:
    codec = tsf85()
    parts = [bytes.fromhex(x) for x in (REST, MOTION, *reversed(TAXELS))]
    samples = codec.feed(b"".join(parts), T0)
    assert samples.values[0, 28:, 0].tolist() == list(range(256, 284))


def test_a_lost_packet_makes_a_finger_invalid() -> None:
    codec = tsf85()
    packets = codec.encode(chunk_of(codec, taxels(3)))
    # 61 bytes for each finger's taxels, then the rest
    wire = packets[0] + packets[1][61:] + packets[2] + packets[0][:61]
    samples = decode(codec, wire)[0]
    assert len(samples) == 3 and samples.ticks.tolist() == [0, 1, 2]
    usable = samples.valid.reshape(3, 2, 28).all(axis=2)
    assert usable.tolist() == [[True, True], [False, True], [True, True]]
    assert np.array_equal(samples.values[samples.valid], taxels(3)[samples.valid])
    assert codec.stats.incomplete == 1
    # without its time a sample cannot be told
    codec = tsf85()
    wire = packets[0] + packets[1][:122] + packets[2]
    assert stacked(decode(codec, wire), "ticks").tolist() == [0, 2]
    assert codec.stats.incomplete == 1


def test_damage_of_the_structure_costs_a_packet() -> None:
    codec = tsf85()
    wire = bytearray(b"".join(codec.encode(chunk_of(codec, taxels(10)))))
    size = len(wire) // 10
    wire[4 * size + 3] ^= 8  # a length
    samples = decode(codec, bytes(wire))[0]
    assert len(samples) >= 9 and codec.stats.corrupt == 1 and samples.damaged.sum() == 1


def test_the_start_byte_may_occur_inside_a_packet() -> None:
    codec = tsf85()
    values = np.full((20, 56, 1), 0x9A9A)
    wire = b"".join(codec.encode(chunk_of(codec, values)))
    assert len(stacked(decode(codec, wire, range(1, len(wire))), "values")) == 20
    joined = decode(tsf85(), wire[30:])  # in the middle of the first packet
    assert (stacked(joined, "values") == 0x9A9A).all() and len(stacked(joined, "values")) == 19


def test_the_commands() -> None:
    host, device = tsf85(period_ms=20), tsf85()
    stop, start = host.commands(Command.START)
    assert (stop.send[2:], start.send[2:]) == (b"\x58\x01\x00", b"\x58\x01\x14")
    assert host.spec.rate_hz == 50 and not device.streaming
    for byte in b"\x9a noise" + start.send:
        assert device.respond(bytes((byte,))) == b""
    assert device.streaming
    device.respond(host.commands(Command.STOP)[0].send + bytes.fromhex("9a006100"))
    assert not device.streaming and device.polled == 1
