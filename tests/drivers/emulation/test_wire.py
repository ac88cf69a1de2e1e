"""Emulated devices on lines that have a speed, with other people's hosts, unmodified."""

import time
from contextlib import contextmanager

import minimalmodbus
import numpy as np
import optoforce
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.catalogue import CODECS
from tactile_rt.drivers.codec import CanFrame, codec_class
from tactile_rt.drivers.codecs.ft300 import Ft300, Ft300Options
from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedSerial
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.drivers.emulation.pseudo_terminal import Wire, bytes_s, frames_s, misheard
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.waiting import PATIENCE_S, until

pytestmark = pytest.mark.usefixtures("no_thread_left")
PATIENT = "&start_s=8&stale_s=8"
SECONDS = 1.5


@contextmanager
def device(codec, source="synthetic:", **further):
    with open_source(source) as opened, EmulatedSerial(opened, codec, **further) as emulated:
        yield emulated


def device_hz(chunks):
    """Rate by the times of the samples, which a busy machine only delays; 0 of none."""
    if not chunks:
        return 0.0
    t_ns = np.concatenate([chunk.t_ns for chunk in chunks])
    return 1e9 * (len(t_ns) - 1) / (t_ns[-1] - t_ns[0])


def newest(chunks, seconds=SECONDS):
    """The chunks of the newest seconds; none while there are fewer."""
    begins = [chunk.t_ns[0] for chunk in chunks]
    since = np.searchsorted(begins, begins[-1] - 1e9 * seconds, "right") if begins else 0
    return chunks[since - 1 :] if since else []


def received(url):
    """What our own driver receives in so many seconds."""
    chunks = []
    with open_source(url + PATIENT) as source:
        until(
            lambda: chunks and chunks[-1].t_ns[-1] - chunks[0].t_ns[0] >= 1e9 * SECONDS,
            meanwhile=lambda: chunks.extend(filter(None, [source.read(0.1)])),
        )
        return chunks, source.stats


def test_what_bytes_and_frames_take():
    assert bytes_s(96, 9600) == pytest.approx(0.1) and bytes_s(100, 11_000, "E") == 0.1
    assert frames_s([CanFrame(1, bytes(8))], 1_000_000) == pytest.approx(111e-6)
    assert frames_s([CanFrame(1, bytes(8), extended=True)], 500_000) == pytest.approx(262e-6)
    assert frames_s([CanFrame(1, remote=True)] * 2, 1_000_000) == pytest.approx(94e-6)
    long = frames_s([CanFrame(1, bytes(64), fd=True)], 1_000_000, 5_000_000)
    assert long == pytest.approx(30e-6 + 548 / 5e6)


def test_one_follows_the_other_and_an_adapter_gathers_them():
    wire = Wire()
    assert [wire.heard_at(0.5, now) for now in (1.0, 1.1, 3.0)] == [1.5, 2.0, 3.5]
    wire.gather_s = 0.016
    assert wire.heard_at(0.001, 8.0) == pytest.approx(8.016)
    assert wire.heard_at(0.001, 8.001) == pytest.approx(8.016)


@given(st.binary(min_size=1, max_size=40), st.sampled_from([9600, 19_200, 115_200, 1_000_000]))
def test_bytes_are_heard_as_they_are_at_their_speed_and_nearly_at_it(data, baud):
    for off in (1.0, 1.02, 0.98):
        assert misheard(data, baud, round(baud * off)) == data


@pytest.mark.parametrize(
    "codec, options, hz",
    [
        ("ft300", {}, 100.0), ("kwr75", {}, 1000.0), ("bota", {"sinc": "64"}, 800.0),
        ("bota", {"sinc": "512"}, 100.0), ("hx711_whisker", {"reset": "false"}, 80.0),
        ("eflesh", {}, 170.0), ("flexitac", {}, 100.0), ("anyskin", {}, 100.0),
        ("optoforce", {"rate_hz": "333"}, 333.0),
    ],
)  # fmt: skip
def test_a_device_sends_at_its_own_rate_whatever_it_measures(codec, options, hz):
    values = np.random.default_rng(0).normal(size=(60_000, 3, 2)).astype(np.float32)
    source = ArraySource(small_spec(rate_hz=1234.0), cut_chunks(values, 1234.0, 10))
    chunks = []
    with (
        EmulatedSerial(source, codec, options=options) as emulated,
        open_source(emulated.url + PATIENT) as received,
    ):
        # Of a machine that stood still the newest seconds tell nothing.
        until(
            lambda: device_hz(newest(chunks)) == pytest.approx(hz, rel=0.01),
            meanwhile=lambda: chunks.extend(filter(None, [received.read(0.1)])),
        )
        assert received.stats.corrupt == 0


def test_the_host_commands_the_rate():
    with device("optoforce", options={"rate_hz": "100"}) as emulated:
        for hz, packet in ((333, "aa0032030300 0000e2"), (30, "aa0032032100 000100")):
            with serial.Serial(emulated.port, 1_000_000, timeout=PATIENCE_S) as host:
                host.write(bytes.fromhex(packet))
                counts = []
                for _ in range(max(hz, 90)):
                    host.read_until(b"\xaa\x07\x08\x0a")
                    counts.append((int.from_bytes(host.read(12)[:2], "big"), time.monotonic()))
            assert emulated.codec.commanded_hz == hz
            # A busy machine reads some late: the median of many spans.
            half = len(counts) // 2
            spans = [np.subtract(counts[k + half], counts[k]) for k in range(half)]
            assert np.median([n / s for n, s in spans]) == pytest.approx(hz, rel=0.2)


def test_a_wire_carries_what_it_can_and_no_more():
    """1,000 frames of 28 bytes a second want 280 kbit/s."""
    with device("kwr75", options={"baud": "57600"}) as emulated:
        assert emulated.url.endswith("codec=kwr75&baud=57600")
        began = time.monotonic()
        with serial.Serial(emulated.port, 57_600, timeout=PATIENCE_S) as host:
            host.write(bytes.fromhex("48aa0d0a"))
            came = len(host.read(57_600 // 10 * 2))
            seconds = time.monotonic() - began
        assert seconds >= 0.98 * came * 10 / 57_600  # never faster
        counts = emulated.log.counts
        assert counts[5] > counts[0]  # most did not fit

    def unlimited_hz():
        with device("kwr75", options={"baud": "0"}) as emulated:
            return device_hz(received(emulated.url)[0])

    full = pytest.approx(1000.0, rel=0.01)
    assert any(unlimited_hz() == full for _ in range(5))  # a busy machine


def test_a_can_bus_carries_what_its_bit_rate_lets_it():
    """35 x 6 float32 at 1 kHz, which a classical bus of 1 Mbit/s carries 63 times a second."""
    plain = {"format": "float32"}
    with (
        open_source("synthetic:35x6") as opened,
        EmulatedCan(opened, "native", options=plain) as emulated,
    ):
        chunks, stats = received(emulated.url)
        whole_ns = np.concatenate([c.t_ns[c.valid.all(axis=1)] for c in chunks])
    n = 16  # over so many a busy machine has let it alone at least once
    at_best = n / (1e-9 * (whole_ns[n:] - whole_ns[:-n]).min())
    on_average = (len(whole_ns) - 1) / (1e-9 * (whole_ns[-1] - whole_ns[0]))
    assert on_average < 63.0 * 1.15 and at_best > 63.0 * 0.85
    assert stats.missing > 5 * len(whole_ns)


def test_a_host_at_another_baud_rate_hears_nonsense():
    with device("ft300") as emulated:
        with serial.Serial(emulated.port, 19_200, timeout=PATIENCE_S) as host:
            host.write(emulated.codec._request)
            assert host.read_until(emulated.codec._echo).endswith(emulated.codec._echo)
            right = host.read(160)
        with serial.Serial(emulated.port, 38_400, timeout=PATIENCE_S) as host:
            wrong = host.read(160)
    assert right.count(b"\x20\x4e") >= 9 and wrong.count(b"\x20\x4e") < 2


def test_an_adapter_that_gathers():
    fault = Fault("gather", at_s=0.5, amount=100)
    with device("kwr75", faults=FaultSchedule([fault])) as emulated:
        with serial.Serial(emulated.port, 460_800, timeout=PATIENCE_S) as host:
            host.write(bytes.fromhex("48aa0d0a"))
            host.read(28 * 800)
            came = []
            while not came or came[-1] - came[0] < 1.0:
                host.read(1)
                came.append(time.monotonic())
                host.read(host.in_waiting)
    gaps = np.diff(came)
    assert (gaps > 0.05).sum() >= 5  # each 100 ms, instead of each millisecond


def test_a_made_up_array_is_of_the_size_that_a_device_measures():
    for codec, options in (("ft300", {}), ("optoforce", {"rate_hz": "1000"}), ("bota", {})):
        with device(codec, options=options) as emulated:
            chunks, _ = received(emulated.url)
        values = np.concatenate([chunk.values for chunk in chunks])
        assert (np.ptp(values[:, 0], axis=0) > 20 * np.finfo(np.float32).eps).all(), codec
        assert len(np.unique(values[:, 0, 0])) > 10, codec


@pytest.mark.parametrize("codec", sorted(n for w, n in CODECS if w == "serial"))
def test_every_device_fits_its_own_wire(codec):
    """At its rate, a device that is not attached by USB sends no more than its line carries."""
    kind = codec_class("serial", codec)
    try:
        made = kind(kind.Options())
    except ConfigError:  # described by its user
        return
    if made.usb or made.spec is None:
        return
    spec = made.spec
    chunk = cut_chunks(np.full((2, *spec.shape), 1e-3), spec.rate_hz)[0]
    size = max(map(len, made.encode(chunk)))
    assert bytes_s(size, made.baud, made.parity) * spec.rate_hz < 1.0


def test_optoforce_reads_its_sensor():
    with device("optoforce") as emulated:
        with optoforce.OptoForce16(port=emulated.port, speed_hz=333) as sensor:
            first = sensor.read(only_latest_data=False)
            readings = [sensor.read(only_latest_data=False) for _ in range(200)]
    counts = [r.count for r in readings]
    assert np.diff([first.count, *counts]).tolist() == [1] * 200
    assert len({r.Fx for r in readings}) > 3


def test_anyskin_reads_its_sensor(capsys):
    sensor_module = pytest.importorskip("anyskin.sensor")
    with device("anyskin") as emulated:
        sensor = sensor_module.AnySkinBase(num_mags=5, port=emulated.port, temp_filtered=False)
        try:
            rows = np.array(sensor.get_data(50))
        finally:
            sensor.close()
    assert rows.shape == (50, 21)
    assert (np.abs(rows[:, 1::4] - 25.0) < 6).all()  # degrees
    assert np.ptp(rows[:, 2]) > 1.0  # microtesla


def test_minimalmodbus_reads_an_ft300_and_lets_it_stream():
    values = np.tile(np.array([[[1.5, -2.25, 10.0, 0.125, -0.5, 0.001]]]), (5000, 1, 1))
    source = ArraySource(Ft300(Ft300Options()).spec, cut_chunks(values, 100.0, 10))
    with EmulatedSerial(source, "ft300") as emulated:
        sensor = minimalmodbus.Instrument(emulated.port, slaveaddress=9)
        sensor.serial.baudrate = 19_200
        sensor.serial.timeout = 3.0  # for so long it waits for what an error does not send
        try:
            until(lambda: any(sensor.read_registers(180, 6)))
            loads = sensor.read_registers(180, 6)
            signed = [x - 65536 if x > 32767 else x for x in loads]
            assert signed == [150, -225, 1000, 125, -500, 1]
            assert sensor.read_registers(190, 3) == [0, 0, 0]
            assert sensor.read_string(510, 4) == "FTS-0001"
            assert sensor.read_register(514) > 2000 and sensor.read_register(410) == 0
            with pytest.raises(minimalmodbus.IllegalRequestError):
                sensor.read_register(999)
            sensor.write_register(410, 0x0200)
            sensor.serial.read_until(b"\x20\x4e")
            frame = sensor.serial.read_until(b"\x20\x4e")
        finally:
            sensor.serial.close()
    assert len(frame) == 16
    assert np.frombuffer(frame[:12], "<i2").tolist() == [150, -225, 1000, 125, -500, 1]


def test_bota_says_that_it_has_begun():
    """As its maker's example waits for it: the text, then the dialogue, then frames."""
    with device("bota") as emulated:
        with serial.Serial(emulated.port, 460_800, timeout=PATIENCE_S) as host:
            assert host.read_until(b"App Init").endswith(b"App Init")
            host.reset_input_buffer()
            for said, answer in (
                (b"C", b"r,0,C,0"), (b"c,0,1,0,4", b"r,0,c,0"), (b"f,256,0,0,1", b"r,0,f,0"),
                (b"R", b"r,0,R,0"),
            ):  # fmt: skip
                host.write(said)
                assert host.read_until(answer).endswith(answer)
            assert emulated.codec.commanded_hz == pytest.approx(200.0)
            host.read_until(b"\xaa")
            assert len(host.read(370)) == 370
