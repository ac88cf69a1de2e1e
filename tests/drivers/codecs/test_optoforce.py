"""OptoForce sensors on USB and on a CAN bus."""

import numpy as np
import pytest

from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.optoforce import (
    OptoForceCan,
    OptoForceCanOptions,
    OptoForceOptions,
    OptoForceSerial,
)
from tests.helpers.codec_contract import (
    T0,
    CodecCase,
    CodecContract,
    chunk_of,
    decode,
    join,
    stacked,
)

# The first bytes of a recording of an OMD-45-FH-2000N at 100 Hz: the end of something, the answer
# to its settings, three samples and part of a fourth (alknemeyer/optoforce 0.2.1, MIT licence,
# tests/test-data.bin and EXPECTED of tests/test_all.py).
CAPTURE = bytes.fromhex(
    "6227"
    "aa0050010000fb"
    "aa07080a2d6a0000fff7fffb00070551"
    "aa07080a2d6b0000fff9fffe000c055c"
    "aa07080a2d6c0000fff30001000a0359"
    "aa07080a2d6d0000fff300"
)
COUNTS = [[-9, -5, 7], [-7, -2, 12], [-13, 1, 10]]
NEWTONS = [  # as the same project tells them, for 7925 counts at 300 N, 8641 at 300, 6049 at 2000
    [-0.34069400630914826, -0.17359101955792156, 2.3144321375433954],
    [-0.26498422712933756, -0.06943640782316862, 3.967597950074392],
    [-0.4921135646687697, 0.03471820391158431, 3.3063316250619934],
]
SENSITIVITY = f"{7925 / 300!r},{8641 / 300!r},{6049 / 2000!r}"

# Four sensors and a 6D one by hand, from the format: counter 0x0102, status 0, loads 1, 2, 3 ...
# 4x3D: AA + 07 + 08 + 1C + 01 + 02 + 1 + ... + 12 = 0xD5 + 3 + 78 = 0x126
FOUR = bytes.fromhex(
    "aa07081c 0102 0000 0001 0002 0003 0004 0005 0006 0007 0008 0009 000a 000b 000c 0126"
)
# 6D: AA + 07 + 08 + 10 + 01 + 02 + 1 + ... + 6 = 0xC9 + 3 + 21 = 0xE1
SIX = bytes.fromhex("aa070810 0102 0000 0001 0002 0003 0004 0005 0006 00e1")
GOLDEN = [("4x3d", FOUR, 12), ("6d", SIX, 6)]


def serial(model: str = "3d", **options: object) -> OptoForceSerial:
    return OptoForceSerial(OptoForceOptions(model, **options))


def can(model: str = "3d", **options: object) -> OptoForceCan:
    return OptoForceCan(OptoForceCanOptions(model, **options))


def counts(elements: int, channels: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(1).integers(-9000, 9000, (n, elements, channels)).astype(float)


class TestOneSerial(CodecContract):
    case = CodecCase(
        lambda: serial(counts=SENSITIVITY), lambda: counts(1, 3) * 0.01, [0.02, 0.02, 0.2]
    )


class TestFourSerial(CodecContract):
    case = CodecCase(lambda: serial("4x3d"), lambda: counts(4, 3))


class TestSixSerial(CodecContract):
    case = CodecCase(lambda: serial("6d", rate_hz=1000), lambda: counts(1, 6))


class TestOneCan(CodecContract):
    case = CodecCase(can, lambda: counts(1, 3))


class TestFourCan(CodecContract):
    case = CodecCase(lambda: can("4x3d"), lambda: counts(4, 3))


def test_the_capture() -> None:
    codec = serial()
    samples = codec.feed(CAPTURE, T0)
    assert samples is not None and samples.values[:, 0].tolist() == COUNTS
    assert samples.count.tolist() == [11626, 11627, 11628]
    assert samples.status.tolist() == [0, 0, 0] and samples.valid.all()
    assert (codec.stats.intact, codec.stats.corrupt, codec.stats.skipped) == (3, 0, 9)
    assert set(codec.spec.units) == {"1"}
    newton = serial(counts=SENSITIVITY)
    assert newton.feed(CAPTURE, T0).values[:, 0] == pytest.approx(np.array(NEWTONS), rel=1e-6)
    assert newton.spec.units == ("N", "N", "N")
    sent = newton.encode(chunk_of(newton, np.array(NEWTONS)[:, None], first=11626))
    assert b"".join(sent) == CAPTURE[9:57]


@pytest.mark.parametrize(("model", "message", "loads"), GOLDEN)
def test_the_golden_messages(model: str, message: bytes, loads: int) -> None:
    expected = np.arange(1, loads + 1).reshape(serial(model).spec.shape)
    pieces = [CanFrame(0x100, message[at : at + 8]) for at in range(0, len(message), 8)]
    for codec, wire in ((serial(model), message), (can(model), pieces)):
        samples = codec.feed(wire, T0)
        assert samples is not None and samples.values[0].tolist() == expected.tolist()
        assert samples.count.tolist() == [0x0102]
        assert codec.encode(chunk_of(codec, samples.values, first=0x50102)) == [wire]


def test_the_last_frame_on_can_may_be_filled() -> None:
    codec = can("4x3d")
    sent = [
        f._replace(data=f.data.ljust(8, b"\0"))
        for f in join(codec, codec.encode(chunk_of(codec, counts(4, 3))))
    ]
    host = can("4x3d")
    assert sum(map(len, decode(host, sent))) == 40
    assert (host.stats.intact, host.stats.corrupt, host.stats.incomplete) == (40, 0, 0)


@pytest.mark.parametrize("load", [0, 1])
@pytest.mark.parametrize("parts", [*((k,) for k in range(5)), (0, 4), (1, 3), (3, 4), (2, 3, 4)])
def test_frames_lost_on_can_cost_one_sample(parts: tuple[int, ...], load: int) -> None:
    codec = can("4x3d")
    packets = codec.encode(chunk_of(codec, load * counts(4, 3)))  # zeros are no filling
    packets[5] = [f for k, f in enumerate(packets[5]) if k not in parts]
    host = can("4x3d")
    samples = decode(host, join(codec, packets))
    assert stacked(samples, "count").tolist() == [n for n in range(40) if n != 5]
    assert (host.stats.incomplete, host.stats.corrupt) == (1, 0)
    assert stacked(samples, "damaged").sum() == 0  # missing, and the counter shows it


@pytest.mark.parametrize(
    ("status", "valid"),
    [
        (0, [1, 1, 1, 1]),
        (0b010_000_000000_0_000, [0, 0, 0, 0]),  # the board has an error, no sensor is named
        (0b000_001_000000_0_011, [1, 1, 0, 1]),  # sensor 3 is not connected
        (0b000_000_001000_0_100, [1, 1, 1, 0]),  # fz of sensor 4 is overloaded
        (0b000_010_000000_1_001, [0, 0, 0, 0]),  # several, and which ones is not told
        (0b000_000_000000_0_010, [1, 1, 1, 1]),  # a number without an error
    ],
)
def test_status_bits(status: int, valid: list[int]) -> None:
    message = FOUR[:6] + status.to_bytes(2, "big") + FOUR[8:-2]
    samples = serial("4x3d").feed(message + sum(message).to_bytes(2, "big"), T0)
    assert samples.valid[0].tolist() == [bool(v) for v in valid]
    assert samples.status.tolist() == [status]


def test_a_device_is_configured() -> None:
    # the settings of alknemeyer/optoforce, tests/test_all.py: 100 Hz, 15 Hz, no zero
    (start,) = serial().commands(Command.START)
    assert start.send == bytes([170, 0, 50, 3, 10, 4, 0, 0, 237])
    assert start.expect == bytes.fromhex("aa0050010000fb") and start.expect in CAPTURE
    (start,) = serial(rate_hz=1000, filter_hz=1.5, zero=True).commands(Command.START)
    assert start.send == bytes([170, 0, 50, 3, 1, 6, 255, 1, 229])
    device, host = serial(), serial()
    (stop,) = host.commands(Command.STOP)
    assert device.streaming
    device.respond(stop.send)
    assert not device.streaming
    wrong = start.send[:-1] + b"\0"
    assert device.respond(wrong)[4] == 1 and not device.streaming
    answer = b"".join(device.respond(start.send[k : k + 1]) for k in range(9))
    assert answer == start.expect and device.streaming
    # an answer among the samples is no damage
    sent = device.encode(chunk_of(device, counts(1, 3)))
    samples = decode(host, b"".join([*sent[:7], sent[7][:11], answer, *sent[8:]]))
    assert sum(map(len, samples)) == 39 and host.stats.corrupt == 0


def test_a_device_on_can_is_configured() -> None:
    device, host = can(host_id=0x201, device_id=0x200), can(host_id=0x201, device_id=0x200)
    (start,) = host.commands(Command.START)
    # 16 bytes in two frames, as RCPRG-ros-pkg/optoforce_can sends them
    assert [f.id for f in start.send] == [0x201] * 2 and [len(f.data) for f in start.send] == [8, 8]
    (stop,) = host.commands(Command.STOP)
    device.respond(stop.send)
    assert not device.streaming
    answer = [f for sent in start.send for f in device.respond([sent])]
    assert [f.id for f in answer] == [start.expect] and device.streaming
    assert host.feed(answer, T0) is None
    assert len(host.feed(join(device, device.encode(chunk_of(device, counts(1, 3)))), T0)) == 40
    assert host.stats.corrupt == host.stats.incomplete == 0


def test_each_sensor_may_have_its_own_sensitivity() -> None:
    own = serial("4x3d", counts="1,1,1,2,2,2,4,4,4,8,8,8").feed(FOUR, T0)
    assert own.values[0].tolist() == [[1, 2, 3], [2, 2.5, 3], [1.75, 2, 2.25], [1.25, 1.375, 1.5]]
