"""ATI six-axis sensors on RS-485."""

import os
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.ati_485 import Ati485, Ati485Options
from tactile_rt.drivers.links import SerialLink
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

# Request and answer as constants of a public firmware for this sensor.
REQUEST, ANSWER = bytes.fromhex("0a4655a39d"), bytes.fromhex("0a4601a262")

# By hand from the format: gauges 0 to 5 are 1, -1, 256, 0, 32767, -32768, sent 0 2 4 1 3 5; the
# bytes sum to 1022 = 7 x 128 + 126.
GAUGES = [1, -1, 256, 0, 32767, -32768]
GOLDEN = bytes.fromhex("0001 0100 7fff ffff 0000 8000 7e")


def ati(**options: object) -> Ati485:
    return Ati485(Ati485Options(**options))


def signal(n: int = 40) -> np.ndarray:
    return np.random.default_rng(1).integers(-32768, 32768, (n, 1, 6)).astype(float)


def frame(gauges: np.ndarray) -> bytes:
    """A frame as the format has it, not as the codec makes it."""
    words = [int(gauges[k]) & 0xFFFF for k in (0, 2, 4, 1, 3, 5)]
    body = bytes(b for word in words for b in (word >> 8, word & 255))
    return body + bytes((sum(body) % 128,))


def places(one: bytes) -> list[int]:
    """Where frames can begin in an endless repetition of one."""
    twice = one * 2
    return [k for k in range(13) if sum(twice[k : k + 12]) % 128 == twice[k + 12] % 128]


def ambiguous() -> bytes:
    draw = np.random.default_rng(3)
    while True:
        one = frame(draw.integers(-2000, 2000, 6))
        if len(places(one)) == 2:
            return one


def wander(draw: np.random.Generator, n: int) -> list[bytes]:
    """What a hardly loaded sensor sends: each gauge moves by a few counts, at random."""
    steps = draw.integers(-2, 3, (n, 6)).cumsum(axis=0) + draw.integers(-20_000, 20_000, 6)
    return [frame(row) for row in steps]


class TestAti485(CodecContract):
    case = CodecCase(ati, signal, checked=False)


def test_the_golden_frame() -> None:
    codec = ati()
    samples = codec.feed(ANSWER + GOLDEN, T0)
    assert samples.values[0, 0].tolist() == GAUGES
    assert samples.valid.all() and samples.status.tolist() == [0]
    assert codec.encode(chunk_of(codec, np.array([[GAUGES]]))) == [GOLDEN]
    samples = codec.feed(GOLDEN[:-1] + b"\xfe", T0)  # bit 7 is the status
    assert not samples.valid.any() and samples.status.tolist() == [1]
    assert codec.stats.skipped == codec.stats.corrupt == 0
    sent = codec.encode(chunk_of(codec, np.array([[[1e9, -1e9, np.nan, np.inf, 0, 0]]])))[0]
    assert codec.feed(sent, T0).values[0, 0].tolist() == [32767, -32768, 0, 32767, 0, 0]


def test_it_locks_within_eight_changing_frames_wherever_it_joins() -> None:
    draw = np.random.default_rng(4)
    needed = []
    for trial in range(600):
        sent = wander(draw, 30)
        start = trial % 13
        wire = b"".join(sent)[start:]
        codec = ati()
        samples = decode(codec, wire, range(13, 13 * 12, 13))  # frame by frame, until it is sure
        first = 13 if start else 0
        told = stacked(samples, "values")
        expected = stacked(decode(ati(), ANSWER + b"".join(sent)[first:]), "values")
        # all of it, though what came before the lock had to wait
        assert np.array_equal(told, expected[len(expected) - len(told) :])
        assert len(told) >= 29 - 1 and codec.stats.corrupt == 0
        assert codec.lock_confidence > 0.999999
        needed.append(samples[0].arrived_ns[0])
    assert (max(needed) - T0) // 13 <= 8


def test_constant_frames_that_pass_at_two_places_wait_for_a_change() -> None:
    one = ambiguous()
    codec = ati()
    assert codec.lock_confidence == 0
    assert decode(codec, (one * 500)[5:]) == []
    assert codec.lock_confidence == 0.5 and codec.stats.intact == 0
    assert len(codec._data) < 1000
    changed = wander(np.random.default_rng(5), 8)
    samples = codec.feed(b"".join(changed), T0)
    assert samples is not None and codec.lock_confidence > 0.999999
    expected = stacked(decode(ati(), ANSWER + one + b"".join(changed)), "values")
    assert np.array_equal(samples.values[-9:], expected)  # those of the constant that waited, too


def test_constant_frames_that_pass_at_one_place_are_told() -> None:
    draw = np.random.default_rng(6)
    alone = 0
    for _ in range(300):
        one = frame(draw.integers(-2000, 2000, 6))
        codec = ati()
        samples = decode(codec, (one * 40)[7:])
        if len(places(one)) == 1:
            alone += 1
            alike = stacked(decode(ati(), ANSWER + one), "values")
            assert (stacked(samples, "values") == alike).all()
            assert codec.lock_confidence == 1
        else:
            assert samples == []
    assert 0.75 < alone / 300 < 0.91  # 83 %


def test_after_the_answer_to_start_constant_frames_are_no_question() -> None:
    one = ambiguous()
    codec = ati()
    samples = codec.feed(b"noise" + ANSWER + one * 3, T0)
    assert len(samples) == 3 and codec.lock_confidence == 1 and codec.stats.skipped == 5
    # a damaged frame among them, then again two places: the one that was right stays it
    hurt = bytes((one[0] ^ 1,)) + one[1:]
    samples = codec.feed(hurt + one * 5, T0)
    assert len(samples) == 5 and samples.damaged.tolist() == [1, 0, 0, 0, 0]
    assert codec.lock_confidence == 0.5  # bytes may have been lost: the sums cannot tell


@pytest.mark.parametrize("change", [-5, -1, 1, 20])
def test_lost_and_inserted_bytes_cost_a_frame(change: int) -> None:
    sent = wander(np.random.default_rng(7), 40)
    hurt = bytearray(b"".join(sent))
    at = 13 * 10 + 4
    if change < 0:
        del hurt[at : at - change]
    else:
        hurt[at:at] = b"U" * change
    codec = ati()
    samples = decode(codec, ANSWER + bytes(hurt))
    told = stacked(samples, "values")
    whole = stacked(decode(ati(), ANSWER + b"".join(sent)), "values")
    assert np.array_equal(told, np.delete(whole, 10, axis=0))
    lost = 1 if change < 2 else round((13 + change) / 13)
    assert codec.stats.corrupt == lost and stacked(samples, "damaged").sum() == lost


def test_what_the_sum_cannot_see() -> None:
    codec = ati()
    wire = bytearray(ANSWER + b"".join(wander(np.random.default_rng(8), 20)))
    wire[5 + 13 * 4 + 2] ^= 0x80  # as cannot_detect says
    assert len(stacked(decode(codec, bytes(wire)), "values")) == 20 and codec.stats.corrupt == 0


def test_a_matrix_gives_loads(tmp_path: Path) -> None:
    table = np.diag([0.01, 0.01, 0.02, 1e-4, 1e-4, 1e-4])
    table[0, 5] = 0.003
    file = tmp_path / "ft.txt"
    np.savetxt(file, table, delimiter=",")
    codec = ati(matrix=str(file))
    assert codec.spec.units == ("N",) * 3 + ("N m",) * 3
    samples = codec.feed(ANSWER + GOLDEN, T0)
    assert samples.values[0, 0] == pytest.approx(table @ GAUGES, rel=1e-6)
    assert codec.encode(chunk_of(codec, samples.values)) == [GOLDEN]


@pytest.mark.parametrize(
    ("text", "why"),
    [("1 2 3", "6 x 6 numbers, not 3"), ("a" * 9, "not a table"), ("1 " * 36, "singular")],
)
def test_a_wrong_matrix_is_named(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "m").write_text(text)
    with pytest.raises(ConfigError, match=why):
        ati(matrix=str(tmp_path / "m"))
    with pytest.raises(ConfigError, match="No such file"):
        ati(matrix=str(tmp_path / "none"))


def test_the_commands() -> None:
    host, device = ati(), ati()
    jam, start = host.commands(Command.START)
    assert jam.send == bytes(14) and jam.pause_s > 0
    assert (start.send, start.expect) == (REQUEST, ANSWER)
    assert device.respond(jam.send + REQUEST) == ANSWER and device.streaming
    assert device.respond(REQUEST) == b""  # deaf to Modbus
    device.respond(host.commands(Command.STOP)[0].send)
    assert not device.streaming


def test_its_even_parity_does_not_lock_a_pty() -> None:
    master, slave = os.openpty()
    try:
        assert ati().parity == "E"
        for _ in range(2):  # a pty refuses parity from the second time on
            SerialLink(os.ttyname(slave), 115_200, ati().parity).close()
    finally:
        os.close(master)
        os.close(slave)
