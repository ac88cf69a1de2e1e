"""Aidin AFT200 force/torque sensor."""

import numpy as np
import pytest

from tactile_rt.drivers.codec import CanFrame, Command
from tactile_rt.drivers.codecs.aft200 import Aft200, Aft200Options
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked


def aft200(**options: float) -> Aft200:
    return Aft200(Aft200Options(**options))  # type: ignore[arg-type]


def signal(n: int = 30) -> np.ndarray:
    full = [200.0] * 3 + [15.0] * 3
    return np.random.default_rng(1).uniform(-1, 1, (n, 1, 6)) * full


class TestAft200(CodecContract):
    case = CodecCase(aft200, signal, [0.005] * 3 + [0.001] * 3, checked=False)


def test_a_golden_sample() -> None:
    # by hand: force = count / 100 - 300 N, torque = count / 500 - 50 N m; two bytes are not used
    force = CanFrame(1, bytes.fromhex("7530 7531 ffff aabb"))  # 30,000, 30,001, 65,535
    torque = CanFrame(2, bytes.fromhex("61a8 0000 61a7 aabb"))  # 25,000, 0, 24,999
    samples = aft200().feed([force, torque], T0)
    assert samples is not None and samples.valid.all()
    expected = [0.0, 0.01, 355.35, 0.0, -50.0, -0.002]
    np.testing.assert_allclose(samples.values[0, 0], expected, atol=1e-5)


def test_forces_and_torques_of_one_sample_only() -> None:
    device, values = aft200(), signal(3)
    packets = device.encode(chunk_of(device, values))
    for lost in (0, 1):
        host = aft200()
        frames = [*packets[0], packets[1][1 - lost], *packets[2]]
        samples = decode(host, frames)
        assert stacked(samples, "valid")[:, 0].tolist() == [True, False, True]
        assert host.stats.incomplete == 1
        np.testing.assert_allclose(stacked(samples, "values")[2], values[2], atol=0.006)


def test_commands() -> None:
    host, device = aft200(rate_hz=300, bias=True, sensor=5), aft200(sensor=5)
    sent = [step.send[0] for step in host.commands(Command.START)]
    assert sent == [
        CanFrame(0x102, bytes.fromhex("05 05 0d05 00000000")),  # 3,333 us
        CanFrame(0x102, bytes.fromhex("05 02 01 0000000000")),
        CanFrame(0x102, bytes.fromhex("05 03 01 0000000000")),
    ]
    assert host.commands(Command.START)[1].pause_s == 1.0
    assert host.spec.rate_hz == pytest.approx(1e6 / 3333)
    device.respond(sent[:2])
    assert not device.streaming
    device.respond(sent)
    assert device.streaming and not aft200().respond(sent)
