"""Bota Systems SensONE and Rokubi."""

import struct

import numpy as np
import pytest

from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import Command
from tactile_rt.drivers.codecs.bota import Bota, BotaOptions
from tactile_rt.drivers.codecs.framing import crc16_x25
from tests.helpers.codec_contract import T0, CodecCase, CodecContract, chunk_of, decode, stacked

# By hand from the format: AA, status 0, the loads 1, -2, 0.5, -0.25, 0.125 and 4, 305419896 us,
# 25 degrees; the checksum is CRC-16/X-25.
GOLDEN = bytes.fromhex(
    "aa 0000 0000803f 000000c0 0000003f 000080be 0000003e 00008040 78563412 0000c841 0a9b"
)


def wire(loads: list[float], status: int = 0, us: int = 0, celsius: float = 25.0) -> bytes:
    payload = struct.pack("<H6fIf", status, *loads, us, celsius)
    return b"\xaa" + payload + struct.pack("<H", crc16_x25(payload))


def signal(n: int = 30) -> np.ndarray:
    return np.random.default_rng(1).normal(size=(n, 1, 6)) * [9, 9, 30, 0.3, 0.3, 0.1]


def warm(n: int = 30) -> np.ndarray:
    rng = np.random.default_rng(2)
    return np.concatenate([signal(n), rng.normal(300, 5, (n, 1, 1))], axis=2)


class TestBota(CodecContract):
    case = CodecCase(lambda: Bota(BotaOptions()), signal)


class TestWithTemperature(CodecContract):
    case = CodecCase(lambda: Bota(BotaOptions(temperature=True, sinc=64)), warm, [0] * 6 + [1e-4])


def test_the_golden_frame() -> None:
    assert wire([1, -2, 0.5, -0.25, 0.125, 4], us=0x12345678) == GOLDEN
    codec = Bota(BotaOptions())
    samples = codec.feed(GOLDEN, T0)
    assert samples is not None and samples.values.dtype == np.float32
    assert samples.values.tolist() == [[[1, -2, 0.5, -0.25, 0.125, 4]]]
    assert samples.ticks.tolist() == [0x12345678] and samples.arrived_ns.tolist() == [T0]
    assert samples.status.tolist() == [0] and samples.valid.all()
    chunk = Chunk(
        np.array([3]), np.array([(0x12345678 + (5 << 32)) * 1000]), samples.values, samples.valid
    )
    assert Bota(BotaOptions()).encode(chunk) == [GOLDEN]  # its clock has wrapped five times


@pytest.mark.parametrize("bit", range(16))
def test_status_bits(bit: int) -> None:
    samples = Bota(BotaOptions()).feed(wire([1] * 6, status=1 << bit), T0)
    assert samples.status.tolist() == [1 << bit]
    assert samples.valid.all() == (bit not in (1, 2, 3))
    assert set(Bota(BotaOptions()).status_bits) == {0, 1, 2, 3}


def test_the_beginning_may_stand_in_a_payload() -> None:
    like = struct.unpack("<f", b"\xaa\xaa\xaa\xaa")[0]
    frame = wire([like] * 6, us=0xAAAAAAAA)
    assert frame.count(b"\xaa") > 28
    codec = Bota(BotaOptions())
    samples = decode(codec, frame[20:] + frame * 30)  # joined in the middle
    values = stacked(samples, "values")
    assert len(values) == 30 and (values == np.float32(like)).all()
    assert codec.stats.corrupt == 0 and codec.stats.skipped == 17


def test_boot_text_is_no_damage() -> None:
    codec = Bota(BotaOptions())
    boot = b"c,0,1,0,4\r\nApp Init\r\nname: BFT-SENS-SER-M8\r\nS/N: 4711\r\nFW version: 2.1.0\r\n"
    frame = wire([1] * 6)
    samples = decode(codec, boot + 2 * frame + frame[:9] + boot + 2 * frame)  # reset while running
    assert sum(map(len, samples)) == 4 and codec.stats.corrupt == 0
    assert codec.stats.skipped == 2 * len(boot) + 9
    assert stacked(samples, "damaged").sum() == 0


def test_a_device_is_configured_and_runs() -> None:
    host = Bota(BotaOptions(sinc=64, skip_fir=True, temperature_compensation=True))
    assert host.spec.rate_hz == pytest.approx(800)
    assert Bota(BotaOptions()).spec.rate_hz == pytest.approx(100)  # 0.00001953125 s x 512
    start = host.commands(Command.START)
    assert [step.send for step in start] == [b"C", b"c,1,1,0,4", b"f,64,0,0,1", b"R"]
    assert all(len(step.send) <= 64 for step in start)
    device = Bota(BotaOptions())
    assert device.streaming  # from power-on
    running = []
    for step in start:
        answer = b"".join(device.respond(step.send[k : k + 1]) for k in range(len(step.send)))
        assert step.expect in answer
        assert host.feed(answer, T0) is None
        running.append(device.streaming)
    assert running == [False, False, False, True]
    assert sum(map(len, decode(host, b"".join(device.encode(chunk_of(device, signal())))))) == 30
    assert host.stats.corrupt == 0
    for step in host.commands(Command.STOP):
        assert step.expect in device.respond(step.send)
    assert not device.streaming and host.commands(Command.POLL) == ()


def test_a_running_device_takes_no_settings() -> None:
    device = Bota(BotaOptions())
    assert device.respond(b"f,64,0,0,1") == b"r,0,f,1\r\n"
    device.respond(b"C")
    assert b"App Init" in device.respond(b"#") and device.streaming


def test_what_has_no_value_is_sent_as_invalid() -> None:
    codec = Bota(BotaOptions())
    values = signal(3)
    values[1, 0, 2], values[2, 0, 0] = np.nan, np.inf
    chunk = chunk_of(codec, values)
    chunk.valid[0] = False
    sent = b"".join(codec.encode(chunk))
    samples = codec.feed(sent, T0)
    assert not samples.valid.any() and np.isfinite(samples.values).all()
    # what is not finite is no measurement, whatever the status says
    assert not Bota(BotaOptions()).feed(wire([np.nan] + [0] * 5), T0).valid.any()
