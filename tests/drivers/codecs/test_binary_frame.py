"""Binary frames described in a TOML file: as exact as the codecs that were written by hand."""

import random
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import concatenate
from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.binary_frame import BinaryFrame, BinaryFrameOptions
from tactile_rt.drivers.codecs.framing import crc16_modbus
from tactile_rt.drivers.codecs.optoforce import OptoForceOptions, OptoForceSerial
from tactile_rt.drivers.emulation.device import EmulatedSerial
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, cut_chunks
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, join, mutations
from tests.helpers.waiting import PATIENCE_S, read_chunks

EXAMPLE = Path(__file__).parents[3] / "docs/codecs/binary_frame.toml"
OPTOFORCE = """
name = "optoforce"
baud = 1000000
order = "big"
length = 16
sync = "AA 07 08 0A"
checksum = { name = "sum16" }
between = ["AA 00 50 01 .. .. .."]
[count]
at = 4
type = "uint16"
[status]
at = 6
type = "uint16"
invalid = [4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15]
[[values]]
at = 8
type = "int16"
channels = ["fx", "fy", "fz"]
scale = [0.5, 0.25, 0.125]
"""


def described(text, folder):
    path = folder / "frame.toml"
    path.write_text(text)
    return BinaryFrame(BinaryFrameOptions(str(path)))


def example():
    return BinaryFrame(BinaryFrameOptions(str(EXAMPLE)))


def signal(n=40):
    draw = np.random.default_rng(0)
    forces = draw.integers(-30000, 30000, (n, 4)) * 0.25e-3
    return np.stack([forces, draw.integers(0, 255, (n, 4)) * 500.0], axis=2)


class TestExample(CodecContract):
    case = CodecCase(example, signal, [2e-7, 1e-2])


def test_it_says_what_a_codec_by_hand_says_whatever_comes(tmp_path):
    def by_hand():
        return OptoForceSerial(OptoForceOptions(counts="2,4,8"))

    values = np.random.default_rng(1).normal(size=(60, 1, 3)) * 900.0
    made = by_hand()
    wire = join(made, made.encode(chunk_of(made, values)))
    packets = [wire, *mutations(wire, random.Random(2), 200_000)]
    ours, other = described(OPTOFORCE, tmp_path), by_hand()
    assert (ours.spec.channels, ours.spec.units) == (other.spec.channels, other.spec.units)
    for packet in packets:
        a, b = ours.feed(packet, T0), other.feed(packet, T0)
        assert (a is None) == (b is None)
        if a is None:
            continue
        # The product is rounded once here, and not to float32 before.
        assert np.allclose(a.values, b.values, rtol=2e-7, atol=0.0, equal_nan=True)
        for what in ("valid", "arrived_ns", "damaged", "count", "status"):
            mine, yours = getattr(a, what), getattr(b, what)
            assert (mine is None) == (yours is None) and np.array_equal(mine, yours)
    assert ours.stats == other.stats and ours.stats.corrupt > 50


def test_a_frame_by_hand():
    """As the example's comment describes it."""
    body = bytes.fromhex("a55a 0201 10270000 80 0100 ffff 0080 ff7f 00 01 02 ff")
    codec = example()
    samples = codec.feed(body + crc16_modbus(body).to_bytes(2, "little") + b"\r", T0)
    assert samples is not None and samples.valid.all()
    assert samples.values[0, :, 0] == pytest.approx([0.25e-3, -0.25e-3, -8.192, 8.19175], rel=1e-6)
    assert samples.values[0, :, 1].tolist() == [0.0, 500.0, 1000.0, 127_500.0]
    assert (samples.count.tolist(), samples.ticks.tolist()) == ([0x0102], [10_000])
    assert samples.status.tolist() == [0x80] and codec.status_bits[7] == "a taxel is broken"
    assert (codec.count_bits, codec.tick_ns, codec.tick_bits) == (16, 10_000.0, 32)
    assert (codec.baud, codec.spec.rate_hz) == (921_600, 250.0)
    assert codec.spec.units == ("N", "Pa")
    body = bytearray(body)
    body[8] |= 1
    body += codec.frame.seal(bytearray(body + bytes(3)))[21:23] + b"\r"
    assert not codec.feed(bytes(body), T0).valid.any()


FIELD = 'length = {length}\nsync = "55"\n[[values]]\nat = 1\nelements = 2\nchannels = ["x"]\n'


@pytest.mark.parametrize(
    "kind, order, raw, value",
    [
        ("int8", "little", "80", -128), ("uint8", "little", "80", 128),
        ("int16", "big", "8001", -32767), ("uint16", "little", "0180", 32769),
        ("int24", "little", "ffffff", -1), ("int24", "big", "800000", -8_388_608),
        ("uint24", "big", "010203", 0x010203), ("uint24", "little", "030201", 0x010203),
        ("int32", "big", "fffffffe", -2), ("uint32", "little", "00000080", 2**31),
        ("int64", "little", "feffffffffffffff", -2), ("float32", "big", "3f800000", 1.0),
        ("float64", "little", "000000000000f0bf", -1.0),
    ],
)  # fmt: skip
def test_numbers_of_all_types(kind, order, raw, value, tmp_path):
    size = len(raw) // 2
    text = f'order = "{order}"\n' + FIELD.format(length=1 + 2 * size) + f'type = "{kind}"\n'
    codec = described(text, tmp_path)
    wire = b"\x55" + bytes.fromhex(raw) + bytes(size)
    samples = codec.feed(wire, T0)
    assert samples.values[0, :, 0].tolist() == [value, 0]
    if "64" not in kind:
        assert codec.encode(chunk_of(codec, samples.values)) == [wire]


@pytest.mark.parametrize(
    "by, stride, first",
    [
        ("element", 0, [0, 1, 2]), ("channel", 0, [0, 2, 4]), ("element", 7, [0, 1, 2]),
        ("channel", 5, [0, 5, 10]),
    ],
)  # fmt: skip
def test_numbers_are_by_element_or_by_channel_and_need_not_touch(by, stride, first, tmp_path):
    text = (
        'length = 19\nsync = "55"\n[[values]]\nat = 1\ntype = "uint8"\nelements = 2\n'
        f'channels = ["a", "b", "c"]\nby = "{by}"\nstride = {stride}\n'
    )
    codec = described(text, tmp_path)
    wire = b"\x55" + bytes(range(18))
    samples = codec.feed(wire, T0)
    assert samples.values[0, 0].tolist() == first
    step = 1 if by == "channel" else stride or 3
    assert samples.values[0, 1].tolist() == [x + step for x in first]


def test_a_matrix_has_rows_and_columns(tmp_path):
    text = FIELD.replace("elements = 2", "elements = [3, 4]").format(length=13) + 'type = "uint8"\n'
    spec = described(text, tmp_path).spec
    assert spec.elements[:5] == ("A0", "A1", "A2", "A3", "B0")
    assert spec.grid == tuple((r, c) for r in range(3) for c in range(4))


def test_what_is_out_of_range_or_only_looked_at_makes_its_element_invalid(tmp_path):
    text = (
        'length = 5\nsync = "55"\n[[values]]\nat = 1\ntype = "int8"\nelements = 2\nstride = 2\n'
        'channels = ["x"]\nvalid = [-5, 5]\n'
        '[[values]]\nat = 2\ntype = "uint8"\nelements = 2\nstride = 2\nchannels = ["-"]\n'
        "possible = [0, 100]\nsmallest = 3\n"
    )
    codec = described(text, tmp_path)
    assert codec.spec.channels == ("x",)
    bad = [(-6, 0), (0, 101), (0, 2)]
    for x, state in ((5, 0), *bad, (1, 3)):
        good = (x, state) not in bad
        samples = codec.feed(bytes((0x55, x & 255, state, 0, 100)), T0)
        assert samples.valid.tolist() == [[good, True]] and samples.values[0, 0, 0] == x


@pytest.mark.parametrize(
    "name, check",
    [
        ("sum8", "dd"), ("negative_sum8", "23"), ("xor8", "31"), ("sum16", "01dd"),
        ("crc16_modbus", "4b37"), ("crc16_xmodem", "31c3"), ("crc16_ccitt_false", "29b1"),
        ("crc16_x25", "906e"), ("crc32", "cbf43926"),
    ],
)  # fmt: skip
def test_checksums_are_the_published_ones(name, check, tmp_path):
    """Of "123456789", by the catalogue of parametrised CRC algorithms, and sums by hand."""
    size = len(check) // 2
    text = (
        f'order = "big"\nlength = {9 + size}\nsync = "31"\nchecksum = {{ name = "{name}" }}\n'
        '[[values]]\nat = 1\ntype = "uint8"\nelements = 8\nchannels = ["x"]\n'
    )
    codec = described(text, tmp_path)
    assert codec.feed(b"123456789" + bytes.fromhex(check), T0) is not None
    hurt = bytes((*bytes.fromhex(check)[:-1], bytes.fromhex(check)[-1] ^ 1))
    assert codec.feed(b"123456789" + hurt, T0) is None


MISTAKES = [
    ("at = 21", "at = 20", r"byte 20 belongs to both checksum and values\[1\]"),
    ("at = 17", "at = 21", r"byte 21 belongs to both checksum and values\[1\]"),
    ("length = 24", "length = 19", r"reaches byte \d+; a frame has 19"),
    ('"crc16_modbus"', '"crc17"', r"checksum 'crc17' is not known; there are sum8, .*crc32"),
    ('"A5 5A"', '"A5 5"', r"sync: write bytes in hexadecimal, AA 07, not 'A5 5'"),
    ("5A\"\nends = \"0D\"", "5A\"\nusually = \"A5 5B\"", r"usually must begin with sync"),
    ('sync = "A5 5A"\nends = "0D"', "", r"bytes that begin or end each frame"),
    ('elements = ["A0", "A1", "B0", "B1"]   #', "elements = [2, 2, 2]  #", r"rows \(26 at most\)"),
    ('elements = ["A0", "A1", "B0", "B1"]   #', "elements = [2, 101]  #", r"100 columns at most"),
    ('unit = "kPa"', 'unit = "torr"', r"values\[1\]: unknown unit 'torr'; there are N, mN"),
    ("scale = 0.5", "scale = 0", r"values\[1\]: scale must be numbers other than 0"),
    ("scale = 0.5", "scale = [1.0, 2.0]", r"scale must be one number, or one per channel"),
    ('type = "uint8"\nelements', 'type = "uint9"\nelements', r":\d+: values\[1\]\.type"),
    ('channels = ["fx"]', 'channels = ["pressure"]', r"A0\.pressure appears twice"),
    ('"B1"]\nchannels = ["pressure"]', '"B2"]\nchannels = ["pressure"]', r"no column B1.pressure"),
    ("0 = \"it cal", "9 = \"it cal", r"status.bits: '9' is not a bit of status"),
    ("tick_us = 10.0", "tick_us = 0", r"time.tick_us: expected a number > 0"),
    ("length = 24", "length = 24\nspeed = 3", r"no key 'speed'"),
    ('send = "A5 45"', 'send = "begin"', r"stop: write bytes in hexadecimal"),
    ("version = 1 ", "version = 2 ", r"this release reads 1, not 2"),
]  # fmt: skip


@pytest.mark.parametrize("old, new, said", MISTAKES)
def test_a_mistake_is_one_line_that_names_the_file_and_the_key(old, new, said, tmp_path):
    text = EXAMPLE.read_text()
    assert text.count(old) >= 1
    with pytest.raises(ConfigError, match=said) as caught:
        described(text.replace(old, new, 1), tmp_path)
    assert "\n" not in str(caught.value) and "frame.toml" in str(caught.value)


def test_without_a_mapping_it_says_what_to_give():
    with pytest.raises(ConfigError, match=r"needs mapping=FILE.toml"):
        BinaryFrameOptions()


def test_the_host_starts_stops_and_asks_and_the_device_obeys(tmp_path):
    device, host = example(), example()
    (start,) = host.commands(Command.START)
    assert not device.streaming and start.expect == bytes.fromhex("a506")
    assert device.respond(b"\x00" + start.send[:1]) == b""
    assert device.respond(start.send[1:]) == start.expect and device.streaming
    (stop,) = host.commands(Command.STOP)
    assert device.respond(stop.send) == b"" and not device.streaming
    asked = described(
        'poll = "text:r\\n"\n' + FIELD.format(length=3) + 'type = "uint8"\n', tmp_path
    )
    assert asked.polls and not asked.streaming
    assert asked.respond(b"r\nr\n") == b"" and asked.polled == 2


def test_a_described_sensor_streams_over_a_line():
    """Its emulator, a pty, and our own way to open it; the description's start is answered."""
    values = signal(200).astype(np.float32)
    source = ArraySource(example().spec, cut_chunks(values, 250.0, 10))
    options = {"mapping": str(EXAMPLE)}
    with EmulatedSerial(source, "binary_frame", options=options, pace="fast") as device:
        url = f"{device.url}&start_s={PATIENCE_S:g}"
        assert "codec=binary_frame" in url and "mapping=" in url
        with open_source(url) as opened:
            found = read_chunks(opened, 200)
            assert opened.stats.missing == opened.stats.corrupt == 0
            assert opened.health.connections == 1
    assert concatenate(found).values == pytest.approx(values, rel=1e-6, abs=1e-2)
