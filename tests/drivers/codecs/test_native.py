"""The native protocol over a serial line."""

import dataclasses
import json

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codecs.native import NativeOptions, NativeSerial, frame
from tactile_rt.drivers.codecs.native_common import MessageType
from tactile_rt.testing import small_spec
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of

SPEC = small_spec(5)


def native(**options: str) -> NativeSerial:
    codec = NativeSerial(NativeOptions(**options))
    codec.spec = SPEC
    return codec


def signal(n: int = 30) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, *SPEC.shape)) * [0.03, 3e-4]


class TestFloat(CodecContract):
    case = CodecCase(native, signal)


class TestInt16(CodecContract):
    case = CodecCase(lambda: native(format="int16"), signal, (0.1 / 32767, 1e-3 / 32767))


# Made by hand from docs/reference/native-protocol.md; the checksums bit by bit from the parameters
# of https://reveng.sourceforge.io/crc-catalogue. One element, fy = 1.5 N and mz = -2 N m, counter
# 7, 1,234,567 us ...
GOLDEN = bytes.fromhex(
    "5452 10 00 0900 0000 07000000 87d61200 01 02 40ac"  # TR, sample, float32 ... header's CRC
    "01 0000c03f 000000c0 88d0d33c"
)
# ... and the next, 1 ms later, in counts, at the ends of its range, and its status says so
GOLDEN_INT16 = bytes.fromhex(
    "5452 10 01 0500 0100 08000000 6fda1200 01 02 e74c 01 ff7f 0180 1a477511"
)


def test_golden_frames() -> None:
    codec = NativeSerial(NativeOptions())
    codec.spec = small_spec(1)
    samples = codec.feed(GOLDEN + GOLDEN_INT16, T0)
    assert samples.values[0].tolist() == [[1.5, -2.0]]
    assert samples.values[1, 0] == pytest.approx([0.1, -1e-3])  # the default scales
    assert samples.count.tolist() == [7, 8] and samples.ticks.tolist() == [1_234_567, 1_235_567]
    assert samples.status.tolist() == [0, 1] and 0 in codec.status_bits
    assert samples.valid.all() and samples.arrived_ns.tolist() == [T0, T0]
    again = NativeSerial(NativeOptions())
    again.spec = codec.spec
    chunk = chunk_of(again, samples.values[:1], first=7)
    assert again.encode(dataclasses.replace(chunk, t_ns=np.array([1_234_567_000]))) == [GOLDEN]


def test_a_header_and_the_payload_of_another_frame_do_not_pass() -> None:
    device, host = native(), native()
    one, two = device.encode(chunk_of(device, signal(2)))
    assert host.feed(one[:20] + two[20:], T0) is None  # as if exactly a frame's length was lost
    assert host.stats.corrupt == 1
    assert host.feed(two, T0).count.tolist() == [1]


def test_a_description_is_plain_json() -> None:
    answer = native().respond(frame(MessageType.DESCRIBE))
    fields = json.loads(answer[20:-4])
    assert fields["spec"]["elements"] == ["A0", "A1", "A2", "A3", "A4"]
    assert fields["scale"] == pytest.approx([0.1 / 32767, 1e-3 / 32767])
    host = NativeSerial(NativeOptions())
    # what a later version of the firmware adds does not disturb
    host.feed(frame(MessageType.DESCRIPTION, json.dumps({**fields, "later": 1}).encode()), T0)
    assert host.spec == SPEC and host.serial_number == ""
    numbered = native(serial_number="X1").respond(frame(MessageType.DESCRIBE))
    assert numbered[20:-4] == answer[20:-5] + b',"serial":"X1"}'
    host.feed(numbered, T0)
    assert host.serial_number == "X1"


@pytest.mark.parametrize(
    "text",
    [b"", b"[]", b"{}", b'{"spec":{},"scale":[1]}', b'{"spec":{"name":"\xff"},"scale":[1]}',
     b'{"spec":1,"scale":1}',
     b'{"spec":' + SPEC.to_json().encode() + b',"scale":[1e300,1]}'],
)  # fmt: skip
def test_what_is_no_description_is_refused(text: bytes) -> None:
    host = NativeSerial(NativeOptions())
    assert host.feed(frame(MessageType.DESCRIPTION, text), T0) is None
    assert host.spec is None and host.stats.corrupt == 1


def test_what_is_no_number_is_invalid_in_either_format() -> None:
    values = signal(1)
    values[0, 1, 0], values[0, 3, 1] = np.nan, np.inf
    for form in ("float32", "int16"):
        device = native(format=form)
        samples = native().feed(device.encode(chunk_of(device, values))[0], T0)
        assert samples.valid[0].tolist() == [True, False, True, False, True]


def test_an_array_too_large_for_the_format_is_named() -> None:
    device = native()
    device.spec = small_spec(256)
    with pytest.raises(ConfigError, match="256 elements of 2 channels"):
        device.encode(chunk_of(device, np.zeros((1, 256, 2))))


def test_an_echo_is_not_answered() -> None:
    device = native()
    wire = b"".join(device.encode(chunk_of(device, signal(2))))
    wire += frame(MessageType.ACK, b"\x03\x00") + frame(MessageType.DESCRIPTION, b"{}")
    assert device.respond(wire) == b""
    unknown = frame(MessageType.ACK, b"\x09\x01")
    assert device.respond(frame(9)) == unknown  # but what it does not know
    nan = device.whisk(float("nan"), 0, 0).send
    assert device.respond(nan) == frame(MessageType.ACK, b"\x05\x02") and device.whisking is None
    assert device.respond(frame(MessageType.WHISK, b"short")) == frame(MessageType.ACK, b"\x05\x01")


def test_a_sample_of_another_array_is_refused() -> None:
    device, host = native(), native()
    host.spec = small_spec(4)
    assert host.feed(b"".join(device.encode(chunk_of(device, signal()))), T0) is None
    assert host.stats.corrupt == 30
