"""XELA uSkin patches."""

import numpy as np

from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.xela import Xela, XelaOptions
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked


def xela(**options: int) -> Xela:
    return Xela(XelaOptions(**options))


def signal(n: int = 30) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 65536, size=(n, 16, 3)).astype(float)


class TestXela(CodecContract):
    case = CodecCase(xela, signal, checked=False)


def test_a_golden_sample() -> None:
    # By hand from the reading code of the public driver: identifier 1808 + taxel, x, y and z in
    # bytes 1-2, 3-4 and 5-6, the high one first; byte 0 and what follows do not matter.
    frames = [
        CanFrame(1808 + i, bytes((0xEE, 0x81, i, 0x7F, 0xFF, 0x00, 0x10, 0xDD))) for i in range(16)
    ]
    samples = xela().feed(frames, T0)
    assert samples is not None and samples.valid.all()
    assert samples.values[0].tolist() == [[0x8100 + i, 0x7FFF, 0x0010] for i in range(16)]
    assert samples.count is None and samples.ticks is None


def test_lost_taxels_are_invalid_and_the_next_sample_is_whole() -> None:
    device, values = xela(), signal(3)
    packets = device.encode(chunk_of(device, values))
    for lost in range(16):
        host = xela()
        wire = [*packets[0], *packets[1][:lost], *packets[1][lost + 1 :], *packets[2]]
        samples = decode(host, wire, range(1, len(wire)))
        valid, got = stacked(samples, "valid"), stacked(samples, "values")
        assert valid.sum(axis=1).tolist() == [16, 15, 16] and not valid[1, lost]
        assert np.array_equal(got[valid], values.astype(np.float32)[valid])
        assert host.stats.incomplete == 1


def test_entering_in_the_middle_is_no_loss() -> None:
    device, host = xela(), xela()
    packets = device.encode(chunk_of(device, signal(2)))
    assert len(decode(host, [*packets[0][5:], *packets[1]])) == 1
    assert host.stats.incomplete == 0


def test_an_invalid_taxel_is_not_sent() -> None:
    device, host = xela(), xela()
    values = signal(2)
    values[0, 3, 1] = np.nan
    values[1, 4] = (-5.0, 70_000.0, 0.5)
    (samples,) = decode(host, [f for p in device.encode(chunk_of(device, values)) for f in p])
    assert not samples.valid[0, 3] and samples.valid.sum() == 31
    assert samples.values[1, 4].tolist() == [0.0, 65535.0, 0.0]


def test_it_streams_when_told() -> None:
    device = xela(board=3)
    (step,) = device.commands(Command.START)
    assert list(step.send) == [CanFrame(0x203, b"\x07\x00")]
    xela(board=2).respond(step.send)
    assert not device.streaming
    device.respond(step.send)
    assert device.streaming
