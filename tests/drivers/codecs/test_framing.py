"""Frames of one length in a stream of bytes, samples in several frames."""

import itertools
import random
import re

import numpy as np
import pytest

from tactile_rt.drivers.codec import SerialCodec, WireStats
from tactile_rt.drivers.codecs.bota import Bota
from tactile_rt.drivers.codecs.framing import FrameFinder, Rounds
from tactile_rt.drivers.codecs.ft300 import Ft300
from tactile_rt.drivers.codecs.optoforce import OptoForceSerial
from tests.helpers.codec_contract import chunk_of, decode, held

SIZE = 6  # "<>", three bytes, their sum


def frame(k: int) -> bytes:
    return b"<>" + bytes((k, k, 0, 2 * k & 255))


def finder(stats: WireStats, parts: bool = False) -> FrameFinder:
    def good(message: bytes) -> bool:
        return sum(message[2:5]) & 255 == message[5]

    return FrameFinder(b"<>", SIZE, good, re.compile(b"READY"), stats, parts)


@pytest.mark.parametrize(
    ("stream", "damaged", "skipped"),
    [
        ([frame(1), frame(2)], [0, 0], 0),
        ([b"half", frame(1)], [0], 4),  # joined in the middle
        ([frame(9)[:5], frame(1)], [0], 5),
        ([frame(9)[:5] + b"?", frame(1)], [1], 6),  # the first of all is damaged
        ([frame(1), frame(9)[:5] + b"?", frame(2)], [0, 1], 6),
        ([frame(1), b"=" + frame(9)[1:], frame(2)], [0, 1], 6),
        ([frame(1), b"xyz", frame(2)], [0, 0], 3),  # noise beside whole frames
        ([frame(1), b"x" * 6, frame(2)], [0, 0], 6),
        ([frame(1), b"x" * 4 + frame(9)[:5] + b"?", frame(2)], [0, 1], 10),
        ([frame(1), frame(9)[:5] + b"?" + b"x" * 4, frame(2)], [0, 1], 10),
        ([frame(1), frame(9)[:5] + b"?" + frame(8)[:4], frame(2)], [0, 2], 10),
        ([frame(1), frame(9)[:4] + b"=" + frame(8)[1:], frame(2)], [0, 2], 10),
        ([frame(1), (frame(9)[:5] + b"?") * 3, frame(2)], [0, 3], 18),
        ([frame(1), frame(9)[:1], frame(2)], [0, 1], 1),
        ([frame(1), frame(9)[:5], frame(8)[:4], frame(2)], [0, 2], 9),  # two in succession
        ([frame(1), frame(9)[:2], frame(2)], [0, 1], 2),  # cut short
        ([frame(1), frame(9)[:4], b"READY", frame(2)], [0, 0], 9),  # begun anew
        ([b"hello READY", frame(9)[:5] + b"?", frame(1)], [1], 17),
        ([frame(1), (frame(9)[:5] + b"?") * 200, frame(2)], [0, 200], 1200),  # more than is kept
    ],
)
def test_damage_between_frames(stream: list[bytes], damaged: list[int], skipped: int) -> None:
    wire = b"".join(stream)
    draw = random.Random(1)
    for cuts in ([], range(1, len(wire)), draw.sample(range(1, len(wire)), 3)):
        stats = WireStats()
        found = finder(stats)
        edges = [0, *sorted(cuts), len(wire)]
        told = [found.find(wire[a:b]) for a, b in itertools.pairwise(edges)]
        assert [d for _, ds in told for d in ds] == damaged
        good = [part for part in stream if part in map(frame, range(256))]
        assert [f for fs, _ in told for f in fs] == good
        assert stats == WireStats(len(good), sum(damaged), skipped, 0)


@pytest.mark.parametrize("codec", [Ft300, Bota, OptoForceSerial])
def test_every_loss_is_counted_and_nothing_else(codec: type[SerialCodec]) -> None:
    device, draw = codec(codec.Options()), random.Random(7)
    flips = 1 if codec is OptoForceSerial else 3  # two can cancel each other in a sum
    signal = np.random.default_rng(7).uniform(-30, 30, (4000, *device.spec.shape))
    wire, lost = b"", []
    for k, packet in enumerate(device.encode(chunk_of(device, signal))):
        fate = draw.choice(("flip", "cut", "noise")) if k % 3 == 1 else ""
        if fate == "flip":
            damaged = bytearray(packet)
            for bit in draw.sample(range(8 * len(packet)), flips):
                damaged[bit // 8] ^= 1 << bit % 8
            packet = bytes(damaged)
        elif fate == "cut":
            left = draw.randrange(1, len(packet) - 1)  # the next may make good one missing byte
            packet = packet[:left]
        elif fate == "noise":  # that does not look like a beginning
            packet = b"\x55" + draw.randbytes(draw.randrange(60)) + packet
        if fate in ("flip", "cut"):
            lost.append(k)
        wire += packet
    host = codec(codec.Options())
    values = np.concatenate([s.values for s in decode(host, wire, range(100, len(wire), 100))])
    left = np.delete(np.arange(4000), lost)
    assert len(values) == 4000 - len(lost) and np.abs(values - signal[left]).max() < 0.51
    # once in a hundred times noise looks like a frame with a damaged beginning
    assert host.stats.corrupt == pytest.approx(len(lost), abs=8)


def test_a_missing_part_is_incomplete() -> None:
    stats = WireStats()
    found = finder(stats, parts=True)
    found.find(frame(1) + frame(2)[:4] + frame(3) + frame(4)[:5] + b"?" + frame(5))
    assert stats == WireStats(3, 1, 0, 1)


def test_what_is_kept_is_bounded_and_forgotten() -> None:
    stats = WireStats()
    found = finder(stats)
    found.find(frame(1))
    for _ in range(1000):
        found.find(b"<" * 1000)
        assert held(found) < 65 * SIZE + 200
    assert stats.corrupt * SIZE == pytest.approx(1e6, rel=1e-3)  # it shows before a frame comes
    found.find(frame(9)[:5])
    found.forget()
    assert found.find(frame(1))[1] == [0]


def test_rounds() -> None:
    rounds: Rounds[str] = Rounds(3)
    assert [rounds.add(i, c) for i, c in ((1, "x"), (2, "y"))] == [[], []]  # entered in the middle
    assert [rounds.add(i, c) for i, c in enumerate("abc")][2] == [["a", "b", "c"]]
    assert rounds.add(2, "c") == []  # the same frame twice
    assert rounds.add(0, "d") == [] and rounds.add(0, "d") == []
    assert rounds.add(0, "e") == [["d", None, None]]
    assert rounds.add(2, "f") == [["e", None, "f"]]
    assert rounds.add(1, "g") == [] and rounds.add(1, "h") == [[None, "g", None]]
    assert rounds.end() == [[None, "h", None]] and rounds.end() == []
    single: Rounds[str] = Rounds(1)
    assert single.add(0, "a") == single.add(0, "a") == [["a"]]
