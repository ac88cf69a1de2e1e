"""ATI transducers on CAN."""

import struct

import numpy as np
import pytest

from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.ati_can import AtiCan, AtiCanOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

RESOLUTION = [290 / 32767 / 2] * 3 + [10 / 32767 / 2] * 3


def ati(**options: float) -> AtiCan:
    return AtiCan(AtiCanOptions(**options))  # type: ignore[arg-type]


def started() -> AtiCan:
    """A host that has read an emulated board's calibration."""
    device, host = ati(), ati()
    for step in host.commands(Command.START):
        answer = device.respond(step.send)
        assert any(f.id == step.expect for f in answer)
        host.feed(answer, T0)
    return host


def signal(n: int = 30) -> np.ndarray:
    full = [290.0] * 3 + [10.0] * 3
    return np.random.default_rng(1).uniform(-1, 1, (n, 1, 6)) * full


class TestAti(CodecContract):
    case = CodecCase(started, signal, RESOLUTION, checked=False)


def wire(device: AtiCan, n: int) -> tuple[list[CanFrame], list[CanFrame], np.ndarray]:
    """First frames, second frames and values of n samples."""
    values = signal(n)
    packets = device.encode(chunk_of(device, values))
    return [p[0] for p in packets], [p[1] for p in packets], values


def test_a_golden_sample() -> None:
    """By hand from the board's manual as the public driver reads it, base identifier 0x7F."""
    host = ati()
    # 1,000 counts per lbf, 500 counts per lbf-in
    host.feed(
        [CanFrame(0x7F7, bytes.fromhex("000003e8 000001f4")), CanFrame(0x7F8, b"\x01\x01")], T0
    )
    matrix = np.array(
        [[0.5, -1, 2, 0, 0, 0], [0, 3, 0, 0, 0.25, 0], [1, 1, 1, 1, 1, 1],
         [0, 0, 0, 0, 0, 4], [0, 0, -2, 0, 0, 0], [8, 0, 0, 0.125, 0, 0]]
    )  # fmt: skip
    for row in matrix:
        for i in range(3):
            host.feed([CanFrame(0x7F2 + i, struct.pack(">2f", *row[2 * i : 2 * i + 2]))], T0)
    # status 0; gauges 0, 2, 4 = 1000, -2, 256; gauges 1, 3, 5 = -32768, 7, 1
    first = CanFrame(0x7F0, bytes.fromhex("0000 03e8 fffe 0100"))
    second = CanFrame(0x7F1, bytes.fromhex("8000 0007 0001"))
    samples = host.feed([first, second], T0)
    assert samples is not None and samples.valid.all()
    counts = matrix @ [1000, -32768, -2, 7, 256, 1]
    expected = counts * ([4.4482216 / 1000] * 3 + [0.11298483 / 500] * 3)
    np.testing.assert_allclose(samples.values[0, 0], expected, rtol=1e-6)


def test_pipelined_replies_are_paired_in_order() -> None:
    device, host = ati(), started()
    a, b, values = wire(device, 6)
    samples = decode(host, [a[0], a[1], b[0], b[1], a[2], b[2], a[3], a[4], b[3], a[5], b[4], b[5]])
    got = stacked(samples, "values")
    assert got is not None and len(got) == 6
    assert (np.abs(got - values)[:, 0] <= np.array(RESOLUTION) * 1.001).all()


def test_a_lost_first_frame_costs_its_sample() -> None:
    device, host = ati(), started()
    a, b, values = wire(device, 3)
    got = stacked(decode(host, [a[0], b[0], b[1], a[2], b[2]]), "values")
    assert got is not None and host.stats.incomplete == 1
    assert (np.abs(got - values[[0, 2]])[:, 0] <= np.array(RESOLUTION) * 1.001).all()


def test_a_lost_second_frame_mixes_few_samples() -> None:
    device, host = ati(), started()
    a, b, values = wire(device, 200)
    frames = [f for pair in zip(a, b, strict=True) for f in pair]
    del frames[21]
    got = stacked(decode(host, frames), "values")
    assert got is not None and host.stats.incomplete == 1 and len(got) == 199
    assert (np.abs(got[100:] - values[101:])[:, 0] <= np.array(RESOLUTION) * 1.001).all()


def test_without_the_matrix_there_is_no_sample() -> None:
    device, host = ati(), ati()
    a, b, _ = wire(device, 1)
    assert host.feed([*a, *b], T0) is None and host.stats.intact == 2


def test_a_row_that_comes_twice() -> None:
    device, host = ati(), ati()
    for step in host.commands(Command.START):
        host.feed(device.respond(step.send), T0)
        if step.send[0].id == 0x7F2:
            host.feed(device.respond(step.send), T0)
    a, b, values = wire(device, 1)
    samples = host.feed([*a, *b], T0)
    assert (np.abs(samples.values - values) <= np.array(RESOLUTION) * 1.001).all()


def test_status_bits() -> None:
    host = started()
    for bit, valid in ((4, False), (6, False), (11, True), (14, True)):
        status = (1 << bit | 1 << 15).to_bytes(2, "big")
        samples = host.feed([CanFrame(0x7F0, status + bytes(6)), CanFrame(0x7F1, bytes(6))], T0)
        assert samples.status.tolist() == [1 << bit | 1 << 15] and bit in host.status_bits
        assert samples.valid.tolist() == [[valid]]


def test_commands() -> None:
    host, device = ati(base=2, calibration=3), ati(base=2)
    assert host.polls and not device.streaming
    asked = [(f.id, f.data) for step in host.commands(Command.START) for f in step.send]
    rows = [(0x22, bytes((i,))) for i in range(6)]
    assert asked == [(0x26, b"\x03"), (0x27, b""), (0x28, b""), *rows]
    (poll,) = host.commands(Command.POLL)
    assert list(poll.send) == [CanFrame(0x20)]
    device.respond(poll.send)
    device.respond(poll.send)
    assert device.polled == 2


def test_what_is_no_reply_is_refused() -> None:
    host = started()
    wrong = [
        CanFrame(0x7F0, bytes(7)), CanFrame(0x7F1, bytes(8)), CanFrame(0x7F7, bytes(8)),
        CanFrame(0x7F8, b"\x09\x01"), CanFrame(0x7F3, bytes(8)),
    ]  # fmt: skip
    assert host.feed(wrong, T0) is None and host.stats.corrupt == 5


def test_what_another_host_asks_is_no_damage() -> None:
    """Its requests have the identifiers of the replies, and no data or the number of a row."""
    host = started()
    before = host.stats.intact, host.stats.corrupt
    asked = [step.send[0] for step in ati(calibration=-1).commands(Command.START)]
    asked += [ati().commands(Command.POLL)[0].send[0]] * 816
    assert host.feed(asked, T0) is None
    assert (host.stats.intact, host.stats.corrupt) == before
    assert host.stats.skipped == len(asked)
    first, second, values = wire(ati(), 1)
    found = host.feed([first[0], asked[-1], second[0]], T0)
    assert found is not None and found.values[0] == pytest.approx(values[0], abs=0.01)
