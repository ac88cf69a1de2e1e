"""Which codec bytes and frames speak: each, emulated for a second, and what is none."""

import random
import time
from contextlib import suppress

import pytest

from bench.drivers.fuzzing import COLUMNS, DBC, MAPPING
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import EndOfStream
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.codecs.column_guess import guess_line_columns
from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedSerial
from tactile_rt.drivers.sniffing import sniff_bytes, sniff_frames
from tactile_rt.sources.opening import open_source
from tests.helpers.source_tree import ROOT
from tests.helpers.waiting import PATIENCE_S

DESCRIBED = ("ascii_line", "binary_frame", "can-dbc")  # are no codec without a description
BINARY = ROOT / "docs" / "codecs" / "binary_frame.toml"


@pytest.fixture(scope="module")
def descriptions(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pad")
    (folder / "pad.dbc").write_text(DBC)
    (folder / "pad.toml").write_text(MAPPING)
    return {
        "ascii_line": {"columns": COLUMNS},
        "binary_frame": {"mapping": str(BINARY)},
        "can-dbc": {"mapping": str(folder / "pad.toml")},
    }


def a_second(wire: str, name: str, options: dict[str, str]):
    """What an emulated device sends over its line in a second of its time: bytes, or frames."""
    heard: list = []
    kind = EmulatedSerial if wire == "serial" else EmulatedCan
    with open_source("synthetic:5x6?pace=fast&seconds=1") as signal:
        device = kind(signal, name, options=options, pace="fast", log=False)
        with device, open_source(f"{device.url}&start_s={PATIENCE_S}") as source:
            source.tap(lambda packet, _: heard.append(packet))
            end = time.monotonic() + PATIENCE_S
            with suppress(EndOfStream):
                while source.read(0.05) is not None or not device.done:
                    assert time.monotonic() < end
    packets = [packet for packet in heard if packet is not None]
    return b"".join(packets) if wire == "serial" else [f for packet in packets for f in packet]


@pytest.mark.parametrize(("wire", "name"), CODECS)
def test_a_second_of_every_codec_cut_anywhere_is_known(wire, name, descriptions):
    try:
        came = a_second(wire, name, descriptions.get(name, {}))
    except ConfigError as error:
        pytest.skip(str(error))  # what it needs is not installed
    further = [(name, descriptions[name])] if name in ("binary_frame", "can-dbc") else []
    draw = random.Random(len(came))
    part = came[draw.randrange(1, len(came) // 8) : len(came) - draw.randrange(1, 9)]
    if name == "ascii_line":
        assert sniff_bytes(part) == []
        words = guess_line_columns(part)
        assert words == ["T0.value", "T1.value", "T2.value", "T3.value"]
        return
    fits = (sniff_bytes if wire == "serial" else sniff_frames)(part, further)
    assert fits and fits[0].codec == name and fits[0].corrupt <= 3, fits  # those that were cut
    if name not in DESCRIBED:
        assert fits[0].options == {}


@pytest.mark.parametrize(
    ("wire", "name", "options"),
    [
        ("serial", "anyskin", {"magnetometers": "1"}),
        ("serial", "hx711_whisker", {"whiskers": "4"}),
        ("serial", "optoforce", {"model": "6d"}),
        ("serial", "tsf85", {"fingers": "1"}),
        ("serial", "tsf85", {"times": "false"}),
        ("can", "xela", {"first_id": "0x300"}),
        ("can", "icub_skin", {"board": "3", "triangles": "0,1,4", "firmware": "new"}),
        ("can", "optoforce", {"model": "6d", "device_id": "0x123"}),
        ("can", "native", {"base": "0x240"}),
    ],
)
def test_so_are_the_options_that_change_its_frames(wire, name, options):
    came = a_second(wire, name, options)[5:]
    best = (sniff_bytes if wire == "serial" else sniff_frames)(came)[0]
    assert (best.codec, best.options) == (name, options)


def test_damage_leaves_it_known():
    came = bytearray(a_second("serial", "bota", {}))
    draw = random.Random(4)
    for _ in range(15):
        came[draw.randrange(len(came))] ^= 1 << draw.randrange(8)
    best = sniff_bytes(bytes(came))[0]
    assert best.codec == "bota" and best.corrupt > 0


def test_a_device_among_others_on_a_bus_is_known():
    draw = random.Random(1)
    frames = a_second("can", "aft200", {})
    others = [CanFrame(draw.randrange(0x300, 0x600), draw.randbytes(8)) for _ in frames]
    mixed = [f for pair in zip(frames, others, strict=True) for f in pair]
    assert sniff_frames(mixed)[0].codec == "aft200"


@pytest.mark.parametrize(
    ("name", "share"), [("anyskin", 0.3), ("flexitac", 0.2), ("native", 0.3), ("bota", 0.3)]
)
def test_noise_before_it_leaves_it_known(name, share):
    came = a_second("serial", name, {})
    noise = random.Random(7).randbytes(int(share * len(came)))
    assert sniff_bytes(noise + came[7:])[0].codec == name


def test_a_car_has_no_sensor():
    # two identifiers in a row that come as often as each other, as cars have them
    draw = random.Random(5)
    frames = []
    for k in range(500):
        frames.append(CanFrame(0x1CF, bytes([0x80, 5, 0, 0, 0, k % 256])))
        frames += [CanFrame(draw.randrange(0x300, 0x600), draw.randbytes(8)) for _ in range(5)]
        frames.append(CanFrame(0x1D0, bytes(7) + bytes([10])))
    assert sniff_frames(frames) == []


@pytest.mark.parametrize(
    "data",
    [b"", b"\0" * 5000, b"\xaa\x55" * 2000, b"\r\n" * 2000, b"AAAA" * 900]
    + [random.Random(size).randbytes(size) for size in (10, 3000, 30_000)],
)
def test_nothing_fits_what_says_nothing(data):
    assert sniff_bytes(data) == [] and guess_line_columns(data) is None


def test_nothing_fits_random_frames():
    draw = random.Random(2)
    anywhere = [CanFrame(draw.randrange(2048), draw.randbytes(8)) for _ in range(4000)]
    few = [CanFrame(draw.choice((0x101, 0x120, 2, 0x7F0)), draw.randbytes(8)) for _ in range(2000)]
    zeros = [CanFrame(0x100, bytes(8))] * 500
    for frames in (anywhere, few, zeros, []):
        assert sniff_frames(frames) == []


def test_a_codec_to_try_is_refused_before_anything_is_fed():
    with pytest.raises(ConfigError, match="no serial codec 'botta'"):
        sniff_bytes(b"abcdef", [("botta", {})])
