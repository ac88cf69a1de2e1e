"""The iCub's skin."""

import numpy as np

from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.icub_skin import IcubSkin, IcubSkinOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked


def icub_skin(**options: object) -> IcubSkin:
    return IcubSkin(IcubSkinOptions(**options))  # type: ignore[arg-type]


def signal(n: int = 30, triangles: int = 16) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (n, 12 * triangles, 1)).astype(float)


class TestBoard(CodecContract):
    case = CodecCase(icub_skin, signal, checked=False)


class TestOneTriangle(CodecContract):
    case = CodecCase(
        lambda: icub_skin(triangles="3", firmware="old"), lambda: signal(30, 1), checked=False
    )


def test_a_golden_sample() -> None:
    """By hand from the reading code of icub-main: board 9, triangles 2 and 14."""
    frames = [
        CanFrame(0x492, bytes.fromhex("40 f4f3f2f1f0efee")),
        CanFrame(0x492, bytes.fromhex("c0 edecebeae9 0000")),
        CanFrame(0x49E, bytes.fromhex("40 01020304050607")),
        CanFrame(0x49E, bytes.fromhex("c0 08090a0b0c 8010")),  # taxels 0 and 11 are stuck
    ]
    host = icub_skin(board=9, triangles="2,14")
    samples = host.feed(frames, T0)
    assert samples.values[0, :, 0].tolist() == [*range(0xF4, 0xE8, -1), *range(1, 13)]
    assert np.flatnonzero(~samples.valid[0]).tolist() == [12, 23]
    assert samples.status.tolist() == [0x8010]
    assert {b for b in range(16) if 0x8010 >> b & 1} <= set(host.status_bits)
    old = icub_skin(board=9, triangles="2,14", firmware="old")
    short = [
        f._replace(id=f.id - 0x100, data=f.data[: 8 if f.data[0] == 0x40 else 6]) for f in frames
    ]
    samples = old.feed(short, T0)  # a board without diagnostics
    assert samples is not None and samples.valid.all()


def test_a_triangle_that_was_not_read_is_invalid() -> None:
    host = icub_skin(triangles="0-1")
    frames = [
        CanFrame(0x410, b"\x40" + bytes(7)), CanFrame(0x410, b"\xc0" + bytes(6) + b"\x01"),
        CanFrame(0x411, b"\x40" + bytes(7)), CanFrame(0x411, b"\xc0" + bytes(7)),
    ]  # fmt: skip
    samples = host.feed(frames, T0)
    assert samples is not None and samples.valid[0].tolist() == [False] * 12 + [True] * 12


def test_lost_frames() -> None:
    device, values = icub_skin(triangles="0-2"), signal(3, 3)
    packets = device.encode(chunk_of(device, values))
    for lost in range(6):
        host = icub_skin(triangles="0-2")
        frames = [*packets[0], *packets[1][:lost], *packets[1][lost + 1 :], *packets[2]]
        samples = decode(host, frames, range(1, len(frames)))
        valid, got = stacked(samples, "valid"), stacked(samples, "values")
        first = lost // 2 * 12 + (7 if lost % 2 else 0)
        gone = range(first, first + (5 if lost % 2 else 7))
        assert np.flatnonzero(~valid[1]).tolist() == list(gone) and valid[[0, 2]].all()
        assert np.array_equal(got[valid], values.astype(np.float32)[valid])
        assert host.stats.incomplete == 1


def test_an_invalid_taxel_is_sent_as_stuck() -> None:
    device, host = icub_skin(triangles="5"), icub_skin(triangles="5")
    values = signal(1, 1)
    values[0, 4] = np.nan
    (packet,) = device.encode(chunk_of(device, values))
    assert packet[1].data[6:] == b"\x01\x00"
    samples = host.feed(packet, T0)
    assert samples is not None and np.flatnonzero(~samples.valid[0]).tolist() == [4]


def test_commands() -> None:
    host, device = icub_skin(board=8, triangles="0,15"), icub_skin(board=8)
    sent = [step.send[0] for step in host.commands(Command.START)]
    assert {f.id for f in sent} == {0x208}
    assert [f.data.hex() for f in sent] == [
        "4d0014f5", "50000f02000022", "50000002010022", "500f0f02010022", "0700",
    ]  # fmt: skip
    assert not device.streaming
    device.respond(sent)
    assert device.streaming
    for step in host.commands(Command.STOP):
        device.respond(step.send)
    assert not device.streaming
    old = icub_skin(board=8, triangles="0,15", firmware="old")
    assert [s.send[0].data.hex() for s in old.commands(Command.START)] == [
        "4c01010100200000", "4e0222f00001800a",
    ]  # fmt: skip
    assert old.streaming and not old.commands(Command.STOP)
