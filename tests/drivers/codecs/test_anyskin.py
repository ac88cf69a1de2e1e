"""AnySkin: frames without beginning, counter or check."""

import struct

import numpy as np
import pytest

from tactile_rt.drivers.codecs.anyskin import AnySkin, AnySkinOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of

MILLI = 1e-3  # T


def anyskin(**options: float) -> AnySkin:
    return AnySkin(AnySkinOptions(**options))


def signal(n: int = 40, chips: int = 5, seed: int = 1) -> np.ndarray:
    """Fields of up to some mT in steps of 0.15 uT, as the chip counts, at room temperature."""
    draw = np.random.default_rng(seed)
    field = 0.15e-6 * draw.integers(-20000, 20000, size=(n, chips, 3))
    return np.concatenate([field, draw.uniform(290, 305, size=(n, chips, 1))], axis=2)


def wire(values: np.ndarray) -> bytes:
    """Frames of (n, chip, (T, x, y, z)) in degrees and microtesla, not made by the codec."""
    return b"".join(struct.pack(f"<{v.size}f", *v.ravel()) + b"\r\n" for v in values)


class TestFive(CodecContract):
    case = CodecCase(anyskin, signal, 2e-7 + np.array([0, 0, 0, 3e-5]), checked=False)


class TestOne(CodecContract):
    case = CodecCase(
        lambda: anyskin(magnetometers=1, temperature=False),
        lambda: signal(chips=1)[..., :3],
        checked=False,
    )


# Three frames of one chip, from the layout of 5X_binary_burst_stream.ino and IEEE 754 by hand:
# 25 C, 100 uT, -50 uT, 1000 uT; the same with x = 0.5 uT; and 25.5 C with z = -1000 uT.
GOLDEN = bytes.fromhex(
    "0000c841" "0000c842" "000048c2" "00007a44" "0d0a"
    "0000c841" "0000003f" "000048c2" "00007a44" "0d0a"
    "0000cc41" "0000c842" "000048c2" "00007ac4" "0d0a"
)  # fmt: skip


def test_golden_frames() -> None:
    codec = anyskin(magnetometers=1)
    samples = codec.feed(GOLDEN, T0)
    assert samples is not None and codec.lock_confidence == 1.0
    expected = [
        [100e-6, -50e-6, 1e-3, 298.15],
        [0.5e-6, -50e-6, 1e-3, 298.15],
        [100e-6, -50e-6, -1e-3, 298.65],
    ]
    assert samples.values[:, 0] == pytest.approx(np.array(expected), rel=1e-6)
    again = anyskin(magnetometers=1).encode(chunk_of(codec, samples.values))
    assert [len(p) for p in again] == [18] * 3 and all(p.endswith(b"\r\n") for p in again)
    sent = [struct.unpack("<4f", p[:16]) for p in again]
    came = [struct.unpack_from("<4f", GOLDEN, 18 * i) for i in range(3)]
    assert np.allclose(sent, came, rtol=1e-7, atol=2e-5)  # K as float32 costs so much


def test_it_finds_its_place_wherever_it_joins() -> None:
    values = signal(14)
    whole = b"".join(anyskin().encode(chunk_of(anyskin(), values)))
    for start in range(82):
        codec = anyskin()
        samples = codec.feed(whole[start : start + 8 * 82], T0)
        assert samples is not None and codec.lock_confidence == 1.0
        first = 0 if start == 0 else 1
        assert np.allclose(samples.values, values[first : first + len(samples)], rtol=1e-6)
        assert len(samples) >= 7
        assert codec.stats.corrupt == 0 and codec.stats.skipped == (82 - start) % 82


# 0D 0A in the mantissa of x of the second chip: 100.05088 and 256.41635 uT, say
INSIDE = [bytes.fromhex(h) for h in ("0d0ac842", "250d0a43", "0d0a8043", "000d0ac4")]


@pytest.mark.parametrize("trap", INSIDE)
@pytest.mark.parametrize("chips", [1, 2, 5])
def test_line_ends_inside_the_floats_do_not_deceive_it(trap: bytes, chips: int) -> None:
    (x,) = struct.unpack("<f", trap)
    draw = np.random.default_rng(5)
    for _ in range(30):
        values = draw.uniform(-2000, 2000, size=(24, chips, 4))
        values[..., 0] = draw.uniform(10, 40, size=(24, chips))
        trapped = draw.integers(chips), draw.integers(1, 4)
        values[:, *trapped] = x
        whole = wire(values)
        start = int(draw.integers(16 * chips + 2))
        codec = anyskin(magnetometers=chips)
        samples = codec.feed(whole[start:], T0)
        assert samples is not None and codec.lock_confidence == 1.0
        first = 24 - len(samples)
        assert first <= 1
        assert np.allclose(samples.values[..., :3] / 1e-6, values[first:, :, 1:], rtol=1e-5)


# One chip at rest, made by hand so that two places fit: bytes 5 and 6, in the mantissa of x, are a
# line end, and the four numbers that begin behind them (8, 8, 34.5, 49.8) are possible too.
TWO_PLACES = bytes.fromhex("4200c841420d0a4200004142000041420d0a")
CHANGED = bytes.fromhex("4200c841420d0b4200004142000041420d0a")


@pytest.mark.parametrize("start", [0, 7])
def test_while_several_places_fit_it_says_so(start: int) -> None:
    codec = anyskin(magnetometers=1)
    still = (TWO_PLACES * 40)[start:]
    assert codec.lock_confidence == 0.0
    assert codec.feed(still[: 8 * 18], T0) is None  # it waits for something to change
    assert codec.feed(still[8 * 18 :], T0) is not None  # for so long
    assert codec.lock_confidence == 0.5
    after = codec.feed((CHANGED + TWO_PLACES) * 4, T0)
    assert after is not None and codec.lock_confidence == 1.0
    right = np.array([[[34.510021, 48.25, 48.25, 25.000126]]] * 2)  # x of the still frame
    right[0, 0, 0] = 34.763927  # and of the changed one
    right[..., :3] *= 1e-6
    right[..., 3] += 273.15
    assert np.allclose(after.values[-2:], right, rtol=1e-3)
    assert codec.stats.corrupt == (1 if start else 0)  # where it had been wrong


def test_a_wrong_place_is_left_when_its_bytes_change() -> None:
    codec = anyskin(magnetometers=1)
    real = wire(np.array([[[25.0, 100.0, -50.0, 1000.0]]]))
    # 5 bytes of a frame, whole frames, then one that is 3 bytes short: the place moves
    moved = real[-5:] + real * 4 + real[3:] + real * 6
    samples = codec.feed(moved, T0)
    assert samples is not None and len(samples) == 10
    assert np.unique(samples.values, axis=0).shape[0] == 1
    assert codec.stats.corrupt == 1 and codec.stats.skipped == 5 + 15
    assert samples.damaged.tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0]


def test_a_damaged_line_end_costs_one_frame_and_no_delay() -> None:
    values = signal(10)
    packets = anyskin().encode(chunk_of(anyskin(), values))
    packets[4] = packets[4][:-1] + b"\x00"
    codec = anyskin()
    got = [codec.feed(p, T0 + i) for i, p in enumerate(packets)]
    assert [0 if s is None else len(s) for s in got] == [0, 0, 3, 1, 0, 1, 1, 1, 1, 1]
    assert got[5].damaged.tolist() == [1] and codec.stats.corrupt == 1
    assert codec.stats.intact == 9 and codec.stats.skipped == 82


def test_frames_that_waited_keep_the_time_at_which_they_came() -> None:
    codec = anyskin()
    packets = codec.encode(chunk_of(codec, signal(6)))
    host = anyskin()
    times: list[int] = []
    for i, packet in enumerate(packets):
        for part in (packet[:50], packet[50:]):
            samples = host.feed(part, T0 + i)
            times += [] if samples is None else samples.arrived_ns.tolist()
    assert times == [T0 + i for i in range(6)]


def test_impossible_readings_are_not_valid() -> None:
    values = np.tile([25.0, 100.0, -50.0, 1000.0], (6, 5, 1))
    values[4, 0, 1] = np.nan
    values[4, 1, 2] = np.inf
    values[4, 2, 0] = 451.8  # a raw temperature of FFFF: a bus that hangs high
    values[4, 3, 3] = 4e5  # more than any gain reaches
    samples = anyskin().feed(wire(values), T0)
    assert samples is not None and len(samples) == 6
    assert samples.valid[4].tolist() == [False] * 4 + [True]
    assert np.delete(samples.valid, 4, axis=0).all()


def test_an_emulated_chip_that_is_not_valid_stays_so_on_the_wire() -> None:
    codec = anyskin()
    chunk = chunk_of(codec, signal(6))
    chunk.valid[:, 2] = False
    chunk.values[3, 4] = np.nan
    chunk.values[0, 0, 0] = 5.0  # T: beyond the chip's range
    samples = anyskin().feed(b"".join(codec.encode(chunk)), T0)
    assert samples is not None and len(samples) == 6
    expected = chunk.valid.copy()
    expected[3, 4] = False
    assert np.array_equal(samples.valid, expected)
    assert samples.values[0, 0, 0] == pytest.approx(0.33)
