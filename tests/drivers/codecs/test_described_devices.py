"""Devices of which the description of their frame is all: golden frames, and the contract."""

import struct

import numpy as np
import pytest

from tactile_rt.drivers.catalogue import CODECS, FRAMES
from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, FrameOptions, frame_codec
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of

DRAW = np.random.default_rng(4)


def device(name: str) -> DescribedFrame:
    return frame_codec(name)(FrameOptions())


class TestPaXini(CodecContract):
    case = CodecCase(
        lambda: device("paxini_px6ax"),
        lambda: 0.1 * np.random.default_rng(1).integers(0, 120, (30, 31, 3)),
        1e-6,
    )


class TestFlexiTac(CodecContract):
    case = CodecCase(
        lambda: device("flexitac"),
        lambda: np.random.default_rng(1).integers(0, 160, (30, 384, 1)).astype(float),
        checked=False,
    )


class TestEFlesh(CodecContract):
    case = CodecCase(
        lambda: device("eflesh"), lambda: 1e-3 * np.random.default_rng(1).normal(size=(30, 5, 3))
    )


def test_paxini() -> None:
    """The request and its sum as in public drivers and a capture; the answer by hand."""
    codec = device("paxini_px6ax")
    (ask,) = codec.commands(Command.POLL)
    assert ask.send.hex() == "55aa09000300fbf00300007b008c" and codec.polls
    assert sum(ask.send) % 256 == 0
    # header, length 133, module 3, read, address 1008, 123 bytes, good; 30 bytes of sums, taxels
    body = bytes.fromhex("aa55 8500 03 00 fb f0030000 7b00 00") + bytes(30)
    body += bytes.fromhex("0aff14") + bytes.fromhex("807fff") + bytes(29 * 3)
    answer = body + bytes((-sum(body) & 0xFF,))
    samples = codec.feed(answer, T0)
    assert samples.values[0, :2] == pytest.approx(
        np.array([[1.0, -0.1, 2.0], [-12.8, 12.7, 25.5]]), rel=1e-6
    )
    assert samples.valid.all() and codec.spec.elements[30] == "T30"
    failed = bytearray(body)
    failed[13] = 1
    samples = codec.feed(bytes(failed) + bytes((-sum(failed) & 0xFF,)), T0)
    assert not samples.valid.any()
    assert codec.feed(answer[:-1] + b"\0", T0) is None


def test_flexitac() -> None:
    codec = device("flexitac")
    assert codec.baud == 2_000_000
    assert codec.spec.grid[:2] == ((0, 0), (0, 1)) and codec.spec.grid[-1] == (11, 31)
    counts = DRAW.integers(0, 160, 384).astype(np.uint8)  # 0xAA is 170: no marker inside
    samples = codec.feed(b"\xaa\x55" + counts.tobytes(), T0)
    assert samples.values[0, :, 0].tolist() == counts.tolist()


def test_eflesh() -> None:
    codec = device("eflesh")
    field = [100.0, -50.0, 1000.0, *range(12)]
    body = b"\xaa\x55\x07" + struct.pack("<15f", *field)
    check = 0
    for byte in body[2:]:
        check ^= byte
    samples = codec.feed(body + bytes((check,)), T0)
    assert samples.values[0].ravel() == pytest.approx(1e-6 * np.array(field), rel=1e-6)
    assert samples.count.tolist() == [7] and codec.count_bits == 8
    assert codec.feed(body + bytes((check ^ 1,)), T0) is None


@pytest.mark.parametrize("name", sorted(p.stem for p in FRAMES.glob("*.toml")))
def test_a_device_is_described_in_thirty_lines_and_found_by_its_name(name: str) -> None:
    lines = (FRAMES / f"{name}.toml").read_text().splitlines()
    assert lines[0].startswith("# ") and any("Source" in line for line in lines[:4])
    assert sum(bool(line) and line[0] != "#" for line in lines) <= 30
    assert max(map(len, lines)) <= 132
    assert ("serial", name) in CODECS
    codec = device(name)
    values = DRAW.normal(size=(3, *codec.spec.shape)) * 1e-4
    if "K" in codec.spec.units:
        values[..., codec.spec.units.index("K")] += 300
    sent = codec.encode(chunk_of(codec, values))
    assert {len(packet) for packet in sent} == {codec.frame.mapping.length}
