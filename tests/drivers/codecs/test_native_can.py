"""The native protocol over CAN and CAN FD."""

import dataclasses
import random
import zlib

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.framing import crc16_xmodem
from tactile_rt.drivers.codecs.native_can import NativeCan, NativeCanOptions
from tactile_rt.drivers.codecs.native_common import DeviceDescription
from tactile_rt.testing import small_spec
from tests.helpers.codec_contract import (
    T0,
    CodecCase,
    CodecContract,
    chunk_of,
    decode,
    join,
    stacked,
)

SPEC = small_spec(5)


def native(spec: ArraySpec = SPEC, **options: object) -> NativeCan:
    codec = NativeCan(NativeCanOptions(**options))  # type: ignore[arg-type]
    codec.spec = spec
    return codec


def signal(n: int = 30, spec: ArraySpec = SPEC) -> np.ndarray:
    return np.random.default_rng(1).uniform(-1, 1, size=(n, *spec.shape)) * [0.09, 9e-4]


def whiskers(elements: int) -> ArraySpec:
    """Six channels each."""
    channels, units = ("fx", "fy", "fz", "mx", "my", "mz"), ("N",) * 3 + ("N m",) * 3
    return dataclasses.replace(small_spec(elements), channels=channels, units=units)


class TestClassicInt16(CodecContract):
    case = CodecCase(native, signal, (0.1 / 32767, 1e-3 / 32767))


class TestClassicFloat(CodecContract):
    case = CodecCase(lambda: native(format="float32"), signal)


class TestFd(CodecContract):
    case = CodecCase(lambda: native(format="float32", fd=True), signal)


# Two elements with fy = 1.5 N, mz = -2 N m and fy = 0.25 N, mz = 0 N m; sequence 0x1234, 1,234,567
# us (0x12d687), status 0, flags float32; made by hand from the table in the module. The payload is
# 03 | 0000c03f 000000c0 | 0000803e 00000000 | CRC: 19 bytes in parts of 6, 6, 6 and 1.
GOLDEN = [
    CanFrame(0x102, bytes.fromhex("3412 87d61200 00 e1")),
    CanFrame(0x103, bytes.fromhex("34 00 03 0000c03f 00")),
    CanFrame(0x103, bytes.fromhex("34 01 0000c0 000080")),
    CanFrame(0x103, bytes.fromhex("34 02 3e 00000000 1b")),
    CanFrame(0x103, bytes.fromhex("34 03 7e")),
]


def test_a_golden_sample() -> None:
    codec = native(small_spec(2))
    samples = codec.feed(GOLDEN, T0)
    assert samples.values.tolist() == [[[1.5, -2.0], [0.25, 0.0]]]
    assert samples.count is not None and samples.count.tolist() == [0x1234]
    assert samples.ticks is not None and samples.ticks.tolist() == [1_234_567]
    assert samples.status is not None and samples.status.tolist() == [0]
    assert samples.valid.all() and samples.arrived_ns.tolist() == [T0]
    device = native(small_spec(2), format="float32")
    chunk = chunk_of(device, samples.values, first=0x51234)  # the counter wraps at 2^16
    chunk = dataclasses.replace(chunk, t_ns=np.array([1_234_567_000]))
    assert device.encode(chunk) == [GOLDEN]


def test_a_golden_int16_sample_in_one_long_frame() -> None:
    # 03 | 0x4000 0xc000 | 0x0001 0x7fff | CRC: 11 bytes and 2 before them make 13, sent as 16
    head = CanFrame(0x102, bytes.fromhex("0700 01000000 05 d2"), fd=True)
    payload = bytes.fromhex("03 0040 00c0 0100 ff7f")
    check = crc16_xmodem(head.data + payload).to_bytes(2, "little")
    part = CanFrame(0x103, b"\x07\x00" + payload + check + bytes(3), fd=True)
    samples = native(small_spec(2)).feed([head, part], T0)
    assert samples.status.tolist() == [5]
    counts = np.array([[16384, -16384], [1, 32767]])
    expected = counts * [0.1 / 32767, 1e-3 / 32767]
    np.testing.assert_allclose(samples.values[0], expected, rtol=1e-6)


def test_thirty_whiskers_fit_the_bus() -> None:
    spec = whiskers(30)
    codec = native(spec)
    values = np.zeros((1, *spec.shape))
    (packet,) = codec.encode(chunk_of(codec, values))
    assert len(packet) == 62  # at 110 Hz 6,820 of the some 9,000 frames/s of 1 Mbit/s
    spec = whiskers(35)
    codec = native(spec, fd=True)
    (packet,) = codec.encode(chunk_of(codec, np.zeros((1, *spec.shape))))
    assert len(packet) == 8 and {len(f.data) for f in packet[1:-1]} == {64}


def test_a_device_describes_itself_and_starts_when_told() -> None:
    for fd in (False, True):
        device, host = native(fd=fd), NativeCan(NativeCanOptions(fd=fd))
        assert not device.streaming
        for step in host.commands(Command.START):
            answer = device.respond(step.send)
            assert answer[-1].id == step.expect  # the description is whole when the answer is seen
            for frame in answer:
                host.feed([frame], T0)
        assert host.spec == SPEC and device.streaming
        for step in host.commands(Command.STOP):
            device.respond(step.send)
        assert not device.streaming
        device.respond(host.whisk(8.0, 0.5, -0.1).send)
        assert device.whisking == pytest.approx((8.0, 0.5, -0.1))
        device.respond(host.whisk(1e9, np.nan, -4.0).send)
        assert device.whisking == pytest.approx((65.535, 0.0, -3.2767))


def test_what_a_device_answers() -> None:
    device = native()
    for data, answer in (
        (b"\x03", [b"\x06\x03\x00"]),
        (b"\x09", [b"\x06\x09\x01"]),  # a type of a later version
        (b"\x05\x00", [b"\x06\x05\x01"]),  # of another length
        (b"\x06\x03\x00", []),  # an echo
        (b"", []),
    ):
        assert [f.data for f in device.respond([CanFrame(0x100, data)])] == answer
    nameless = NativeCan(NativeCanOptions())
    assert [f.data for f in nameless.respond([CanFrame(0x100, b"\x01")])] == [b"\x06\x01\x02"]


def test_a_description_by_hand() -> None:
    text = DeviceDescription.of(SPEC).to_json()
    whole = len(text).to_bytes(2, "little") + text + zlib.crc32(text).to_bytes(4, "little")
    pieces = [
        CanFrame(0x104, bytes((2, i & 255, i >> 8)) + whole[5 * i : 5 * i + 5])
        for i in range(-(-len(whole) // 5))
    ]
    host = NativeCan(NativeCanOptions())
    host.feed(pieces, T0)
    assert host.spec == SPEC
    for wrong in (pieces[:3] + pieces[4:], [*pieces[:-1], CanFrame(0x104, b"\x02\x00\x01\x00")]):
        host = NativeCan(NativeCanOptions())
        host.feed(wrong, T0)
        assert host.spec is None
        host.feed(pieces, T0)  # asked again
        assert host.spec == SPEC


def test_one_lost_part_costs_only_its_elements() -> None:
    # 1 + 60 + 2 bytes: element i is in bytes 1 + 12 i to 12 + 12 i of 11 parts
    spec = whiskers(5)
    device = native(spec)
    values = signal(3)[:, :, :1] * ([1.0] * 3 + [0.01] * 3)
    packets = device.encode(chunk_of(device, values))
    for lost in range(11):
        host = native(spec)
        wire = [*packets[0], *packets[1][: 1 + lost], *packets[1][2 + lost :], *packets[2]]
        samples = decode(host, wire, range(1, len(wire)))
        valid, got = stacked(samples, "valid"), stacked(samples, "values")
        assert valid is not None and got is not None and valid.shape == (3, 5)
        hit = range(6 * lost, 6 * lost + 6)
        expected = [not any(1 + 12 * i <= b < 13 + 12 * i for b in hit) for i in range(5)]
        expected = [e and lost > 0 for e in expected]  # the first part says which are valid
        assert valid[1].tolist() == expected and valid[[0, 2]].all()
        np.testing.assert_allclose(got[1][valid[1]], values[1][valid[1]], atol=0.1 / 32767)
        assert host.stats.incomplete == 1 and stacked(samples, "count").tolist() == [0, 1, 2]


def test_an_inverted_bit_is_never_taken_for_a_value() -> None:
    device, values = native(), signal(3)
    packets = device.encode(chunk_of(device, values))
    for at, hurt in enumerate(packets[1]):
        for bit in range(8 * len(hurt.data)):
            data = bytearray(hurt.data)
            data[bit // 8] ^= 1 << bit % 8
            host = native()
            middle = [*packets[1][:at], CanFrame(hurt.id, bytes(data)), *packets[1][at + 1 :]]
            samples = decode(host, [*packets[0], *middle, *packets[2]])
            count, valid = stacked(samples, "count"), stacked(samples, "valid")
            assert count.tolist() in ([0, 1, 2], [0, 2]) and valid[[0, -1]].all()
            off = np.abs(stacked(samples, "values") - values[count])[valid]
            assert (off <= np.array([0.1, 1e-3]) / 32767).all()
            assert host.stats.corrupt or host.stats.incomplete


def test_a_lost_header_loses_the_sample_and_only_it() -> None:
    device, host = native(), native()
    packets = device.encode(chunk_of(device, signal()))
    samples = decode(host, [*packets[0], *packets[1][1:], *packets[2]])
    assert stacked(samples, "count").tolist() == [0, 2] and stacked(samples, "valid").all()
    assert host.stats.incomplete == 1
    late = native()  # that a stream is entered in the middle of a sample is no loss
    assert len(stacked(decode(late, [*packets[0][2:], *packets[1]]), "count")) == 1
    assert late.stats.incomplete == 0


def test_any_loss_leaves_right_values_or_invalid_ones() -> None:
    device, values = native(), signal(200)
    packets = device.encode(chunk_of(device, values))
    draw = random.Random(5)
    for _ in range(20):
        host, rate = native(), draw.choice((0.02, 0.2, 0.6))
        kept = [[f for f in p if draw.random() > rate] for p in packets]
        samples = decode(host, join(host, kept))
        count, valid = stacked(samples, "count"), stacked(samples, "valid")
        assert set(count.tolist()) <= {k for k, p in enumerate(kept) if p and p[0].id == 0x102}
        off = np.abs(stacked(samples, "values") - values[count])[valid]
        assert (off <= np.array([0.1, 1e-3]) / 32767).all()


def test_a_frame_that_comes_twice_changes_nothing() -> None:
    device, host = native(), native()
    (packet,) = device.encode(chunk_of(device, signal(1)))
    samples = decode(host, [f for frame in packet for f in (frame, frame)])
    assert len(samples) == 1 and samples[0].valid.all() and host.stats.incomplete == 0
    again = host.feed(packet, T0)  # the sample sent twice is delivered twice: the counter shows it
    assert again is not None and len(again) == 1


def test_what_is_not_of_this_device_is_skipped() -> None:
    host = native()
    foreign = [
        CanFrame(0x102, GOLDEN[0].data, extended=True),
        CanFrame(0x0FF, GOLDEN[0].data),
        CanFrame(0x105, GOLDEN[0].data),
        CanFrame(0x103, b"", remote=True),
        CanFrame(0x100, b"\x03"),  # another host's command
    ]
    assert host.feed(foreign, T0) is None
    assert host.stats.skipped == 5 and host.stats.intact == host.stats.corrupt == 0
    host.feed([GOLDEN[0]._replace(data=GOLDEN[0].data[:7]), CanFrame(0x103, b"\x34\x00")], T0)
    assert host.stats.corrupt == 2


def test_another_array_does_not_slip_in_between_samples() -> None:
    device, host = native(), NativeCan(NativeCanOptions())
    other = native(small_spec(4)).respond([CanFrame(0x100, b"\x01")])
    mine = device.respond([CanFrame(0x100, b"\x01")])
    packets = device.encode(chunk_of(device, signal(2)))
    samples = host.feed([*mine, *packets[0], *other, *packets[1]], T0)
    assert samples is not None and samples.values.shape == (2, 5, 2)
    assert host.spec == SPEC and host.stats.corrupt == 1
    host.forget()  # after a reconnection another device may answer
    host.feed(other, T0)
    assert host.spec == small_spec(4)


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match=r"base must be from 0 to 0x7fb.*not 0x7fc"):
        NativeCanOptions(base=0x7FC)
    with pytest.raises(ConfigError, match="format must be one of"):
        NativeCanOptions(format="int8")
    spec = whiskers(130)
    said = r"130 elements of 6 channels do not fit in the 256 frames .*: use fd"
    with pytest.raises(ConfigError, match=said):
        native(spec).encode(chunk_of(native(spec), np.zeros((1, *spec.shape))))
