"""Emulated devices on real lines, read with plain `os.read`, pyserial and python-can."""

import errno
import os
import select
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.stream import Chunk, EndOfStream, Source, concatenate
from tactile_rt.drivers.codec import Command, Samples, SerialCodec
from tactile_rt.drivers.codecs.native import NativeOptions, NativeSerial
from tactile_rt.drivers.codecs.native_can import NativeCan, NativeCanOptions
from tactile_rt.drivers.emulation.emulator import Emulator
from tactile_rt.drivers.emulation.endpoints import BusEndpoint, SerialEndpoint, SlcanEndpoint
from tactile_rt.drivers.emulation.faults import Fate, Fault, FaultSchedule
from tactile_rt.drivers.emulation.transmitter import fit
from tactile_rt.drivers.slcan import SlcanDecoder, encode, opening
from tactile_rt.testing import ArraySource, FakeCan, FakeSerial, cut_chunks, small_spec
from tactile_rt.testing.fixtures import fake_can, fake_serial  # noqa: F401
from tests.helpers.waiting import PATIENCE_S, read_chunks, until

SPEC = small_spec(4)


@pytest.fixture(autouse=True)
def nothing_left(no_thread_left: None) -> Iterator[None]:
    """Fail a test that leaves a descriptor behind, or a thread."""
    before = len(os.listdir("/proc/self/fd"))
    yield
    # what other files started in this process (Zenoh has threads of its own) may come and go
    until(lambda: len(os.listdir("/proc/self/fd")) <= before)


def signal(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, *SPEC.shape)).astype(np.float32)


def native(n: int = 0, values: np.ndarray | None = None, **options: Any) -> Emulator:
    made = ArraySource(SPEC, cut_chunks(signal(n) if values is None else values, SPEC.rate_hz))
    source = options.pop("source", made)
    options = {"pace": "fast", "endpoint": SerialEndpoint(), **options}
    return Emulator(NativeSerial(NativeOptions()), source, **options)


class Host:
    """A plain program that has a port open and decodes what comes."""

    def __init__(self, path: str, codec: Any = None, start: bool = True) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self.codec = codec or NativeSerial(NativeOptions())
        self.came = b""
        self.samples: list[Samples] = []
        for step in self.codec.commands(Command.START) if start else ():
            os.write(self.fd, step.send)
            while step.expect is not None and step.expect not in self.came:
                assert self.read(PATIENCE_S), "no answer"

    def read(self, timeout: float) -> bool:
        if not select.select([self.fd], [], [], timeout)[0]:
            return False
        try:
            data = os.read(self.fd, 65_536)
        except OSError as error:  # the other end is closing; once it is closed, nothing is read
            if error.errno != errno.EIO:
                raise
            data = b""
        self.came += data
        samples = self.codec.feed(data, time.monotonic_ns())
        if samples is not None:
            self.samples.append(samples)
        return bool(data)

    def read_all(self, device: Emulator) -> None:
        end = time.monotonic() + PATIENCE_S
        over = False
        while self.read(0.1) or not over:
            assert time.monotonic() < end
            over = device.done  # from then on, what is left can be read at once
        self.close()

    def __getattr__(self, name: str) -> np.ndarray:
        return np.concatenate([getattr(s, name) for s in self.samples])

    def close(self) -> None:
        os.close(self.fd)


def hear_all(device: Emulator) -> tuple[Emulator, Host]:
    """Read all that a device sends."""
    with device:
        host = Host(device.endpoint.pty.path)
        host.read_all(device)
    return device, host


def test_every_sample_comes_as_it_is_over_a_pty() -> None:
    values = np.frombuffer(np.random.default_rng(1).bytes(500 * 4 * 2 * 4), "<f4")
    values = np.where(np.isfinite(values), values, np.float32(0)).reshape(500, 4, 2)
    device, host = hear_all(native(values=values))  # all bytes, so also ^C, ^D, ^S, CR and LF
    assert host.codec.spec == SPEC
    assert np.array_equal(host.values.view(np.uint32), values.view(np.uint32))
    assert host.count.tolist() == list(range(500))
    assert np.diff(host.ticks).tolist() == [1000] * 499
    assert host.codec.stats.corrupt == host.codec.stats.skipped == 0, "no echo, nothing cooked"
    assert device.log.seq.tolist() == list(range(500)) and device.log.sent == 500
    assert set(device.log.fate) == {Fate.SENT}
    assert (device.log.t_ns // 1000).tolist() == host.ticks.tolist()


def test_it_waits_for_its_host_and_stops_when_told() -> None:
    with native(5000) as device:
        time.sleep(0.05)
        assert device.log.sent == 0 and not device.wait(0.01)
        host = Host(device.endpoint.pty.path)
        while device.log.sent < 100:
            host.read(PATIENCE_S)
        os.write(host.fd, host.codec.commands(Command.STOP)[0].send)
        until(lambda: not device.codec.streaming)
        until(lambda: len(host.count) >= device.log.sent, meanwhile=lambda: host.read(0.1))
        while host.read(0.2):
            pass  # its answer to the command, and what was on its way; all, if it does not stop
        assert len(host.count) == device.log.sent < 5000
        os.write(host.fd, host.codec.commands(Command.START)[-1].send)
        host.read_all(device)
    assert host.count.tolist() == list(range(5000)), "the counter stands still meanwhile"


DAMAGE = [
    Fault("bit_flip", rate=20, amount=3),
    Fault("truncate", rate=20, amount=20),
    Fault("duplicate", rate=20, amount=2),
    Fault("burst", rate=20, amount=50),
    Fault("drop", rate=20, amount=2),
    Fault("stall", at_s=1.0, duration_s=0.2),
]


def test_the_log_says_what_a_host_gets_sample_by_sample() -> None:
    values = signal(5000)
    device, host = hear_all(native(values=values, faults=FaultSchedule(DAMAGE, seed=5)))
    log = device.log
    copies = np.bincount(host.count, minlength=5000)
    fate = log.fate
    assert log.seq.tolist() == list(range(5000))
    assert (copies[fate == Fate.SENT] == 1).all()
    assert (copies[fate == Fate.DUPLICATED] == 3).all()
    assert (copies[fate >= Fate.CORRUPTED] == 0).all()
    assert np.array_equal(host.values, values[host.count]), "nothing damaged comes through"
    assert (fate[:500] == Fate.SENT).all() and (fate[-500:] == Fate.SENT).all()
    for each in (Fate.CORRUPTED, Fate.TRUNCATED, Fate.DUPLICATED, Fate.DROPPED):
        assert log.counts[each] > 40
    assert log.counts[Fate.OVERFLOWED] == log.counts[Fate.UNHEARD] == 0
    assert log.duplicated == 2 * log.counts[Fate.DUPLICATED]
    lost = log.counts[Fate.CORRUPTED] + log.counts[Fate.TRUNCATED] + log.counts[Fate.DROPPED]
    assert log.sent + log.duplicated == len(host.count) + lost


def test_counter_and_clock_begin_where_wanted_and_wrap() -> None:
    device, host = hear_all(native(100, start_count=2**32 - 40, start_tick=2**32 - 60_000))
    assert host.count.tolist() == [*range(2**32 - 40, 2**32), *range(60)]
    assert host.ticks[0] == 2**32 - 60_000 and host.ticks[60] == 0 and host.ticks[-1] == 39_000
    assert device.log.seq[-1] == 2**32 + 59, "not wrapped in the log"


def test_the_clock_drifts_jumps_and_restarts() -> None:
    faults = [
        Fault("clock_jump", at_s=1.0, amount=-0.25),
        Fault("clock_drift", at_s=2.0, duration_s=1.0, amount=1000),
        Fault("sequence_reset", at_s=4.0),
        Fault("clock_jump", at_s=4.5, amount=-2),  # below zero: before the wrap
    ]
    _, host = hear_all(native(5500, faults=FaultSchedule(faults), drift_ppm=-200))
    t = host.ticks.astype(float)
    assert t[999] == pytest.approx(999_000 * (1 - 200e-6), abs=1.5)
    assert t[1000] - t[999] == pytest.approx(1000 - 250_000, abs=1.5)
    assert t[2000] - t[1000] == pytest.approx(1e6 * (1 - 200e-6), abs=1.5)
    assert t[3000] - t[2000] == pytest.approx(1e6 * (1 + 1000e-6), abs=1.5)
    assert t[3900] - t[3000] == pytest.approx(0.9e6 * (1 - 200e-6), abs=1.5)
    assert t[4000] == 0 and host.count[4000] == 0 and host.count[3999] == 3999
    assert t[4500] == pytest.approx(2**32 - 1_500_000 - 100, abs=1.5)
    assert len(t) == 5500


def test_a_host_that_does_not_read_loses_what_does_not_fit_and_stops_nobody() -> None:
    endpoint = SerialEndpoint(fifo_bytes=20_000)
    source = ArraySource(SPEC, cut_chunks(signal(3000), 1000.0), live=True)
    with native(endpoint=endpoint, source=source) as device:
        host = Host(endpoint.pty.path)
        until(lambda: device.log.sent == 3000)
        host.read_all(device)
    counts = device.log.counts
    assert counts[Fate.OVERFLOWED] > 0 and counts[Fate.SENT] + counts[Fate.OVERFLOWED] == 3000
    assert np.array_equal(host.count, np.flatnonzero(device.log.fate == Fate.SENT))
    assert host.codec.stats.corrupt == host.codec.stats.skipped == 0, "whole samples only"


def test_a_host_that_goes_is_noticed_and_the_next_finds_nothing_stale() -> None:
    source = ArraySource(SPEC, cut_chunks(signal(200_000), 1000.0), live=True)
    endpoint = SerialEndpoint(fifo_bytes=30_000)
    with native(endpoint=endpoint, source=source) as device:
        first = Host(device.endpoint.pty.path)
        until(lambda: device.log.counts[Fate.OVERFLOWED])
        first.close()
        until(lambda: device.log.counts[Fate.UNHEARD])
        host = Host(device.endpoint.pty.path, first.codec, start=False)
        first.codec.forget()
        assert host.read(PATIENCE_S)
        gone = device.log.seq[device.log.fate == Fate.UNHEARD]
        while not host.samples:
            host.read(PATIENCE_S)
        assert host.count[0] > gone[0]
        host.close()


def test_unplugged_it_is_gone_and_replugged_it_is_there_under_its_name(tmp_path: Path) -> None:
    link = tmp_path / "whisker0"
    link.symlink_to("/dev/pts/99999")  # left by one that was killed
    with FakeSerial(signal(100_000), spec=SPEC, link=str(link)) as device:
        assert device.port == str(link) and link.is_symlink()
        for k in range(20):
            host = Host(device.port)
            while len(host.samples) < 3:
                assert host.read(PATIENCE_S)
            old = os.readlink(link)
            device.unplug()
            assert not link.is_symlink()
            end = time.monotonic() + PATIENCE_S
            while host.read(0.1):
                assert time.monotonic() < end
            assert select.select([host.fd], [], [], 0)[0] and not host.read(0)
            with pytest.raises(FileNotFoundError):
                os.open(str(link), os.O_RDWR)
            device.replug(restart=bool(k % 2))
            assert device.codec.streaming == (not k % 2), "without power it forgets"
            host.close()
            assert os.readlink(link).startswith("/dev/pts/") and old
        counts = device.log.counts
        assert counts[Fate.OVERFLOWED] == 0
    assert not link.is_symlink()


def test_a_schedule_unplugs_and_replugs(tmp_path: Path) -> None:
    faults = FaultSchedule([Fault("unplug", at_s=0.6, duration_s=0.3)])
    link = tmp_path / "port"
    with native(1500, faults=faults, endpoint=SerialEndpoint(link)) as device:
        host = Host(str(link))
        until(lambda: device.log.counts[Fate.UNHEARD], meanwhile=lambda: host.read(0.1))
        while host.read(0.0):
            pass  # what had come before
        until(link.is_symlink)
        again = Host(str(link), host.codec, start=False)
        again.read_all(device)
        host.close()
    unheard = np.flatnonzero(device.log.fate == Fate.UNHEARD)
    assert set(range(600, 900)) <= set(unheard)
    assert all(s.count[-1] < 600 for s in host.samples), "if it had a turn before"
    assert again.count[0] >= 900 and again.count[-1] == 1499


def test_a_name_that_is_taken_is_not_taken_away(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigError, match="file already exists: name another link"):
        native(1, endpoint=SerialEndpoint(tmp_path / "file")).start()
    with pytest.raises(ConfigError, match="No such file or directory"):
        native(1, endpoint=SerialEndpoint(tmp_path / "no" / "port")).start()
    with native(1, endpoint=SerialEndpoint(tmp_path / "port")):
        with pytest.raises(ConfigError, match="port already exists"):
            native(1, endpoint=SerialEndpoint(tmp_path / "port")).start()


def native_can(n: int, endpoint: Any, **options: Any) -> Emulator:
    source = ArraySource(SPEC, cut_chunks(signal(n) * 1e-3, SPEC.rate_hz))
    codec = NativeCan(NativeCanOptions(format="float32"))
    return Emulator(codec, source, endpoint, **{"pace": "fast", **options})


def test_slcan_sends_nothing_before_the_channel_is_open() -> None:
    with native_can(400, SlcanEndpoint()) as device:
        fd = os.open(device.endpoint.pty.path, os.O_RDWR | os.O_NOCTTY)
        host, decoder = NativeCan(NativeCanOptions()), SlcanDecoder()
        asked = b"".join(encode(step.send) for step in host.commands(Command.START))
        os.write(fd, asked)
        answers = b""
        while len(answers) < 2:  # two frames while closed: two errors
            assert select.select([fd], [], [], PATIENCE_S)[0]
            answers += os.read(fd, 65_536)
        assert not select.select([fd], [], [], 0.1)[0]
        assert answers == b"\a\a" and device.log.sent == 0
        os.write(fd, b"".join(opening(1_000_000)) + asked)
        samples = []
        over = False
        while (ready := select.select([fd], [], [], 0.1)[0]) or not over:
            if ready:
                samples.append(host.feed(decoder.feed(os.read(fd, 65_536)), 0))
            over = device.done
        os.close(fd)
    counts = np.concatenate([s.count for s in samples if s is not None])
    values = np.concatenate([s.values for s in samples if s is not None])
    assert counts.tolist() == list(range(400))
    assert np.array_equal(values, (signal(400) * 1e-3).astype(np.float32))


def test_python_can_reads_it() -> None:
    with native_can(200, SlcanEndpoint()) as device:
        channel = device.address.split(":", 2)[2]
        with can.Bus(channel, "slcan", sleep_after_open=0, bitrate=1_000_000) as bus:
            host = NativeCan(NativeCanOptions())
            for step in host.commands(Command.START):
                for frame in step.send:
                    bus.send(can.Message(arbitration_id=frame.id, data=frame.data,
                                         is_extended_id=False))  # fmt: skip
            counts: list[int] = []
            end = time.monotonic() + PATIENCE_S
            while len(counts) < 200 and time.monotonic() < end:
                with suppress(can.CanOperationError):  # the kernel may wake a read for nothing
                    if (message := bus.recv(0.5)) is not None:
                        frame = (message.arbitration_id, bytes(message.data), False, False, False)
                        samples = host.feed([frame], 0)  # type: ignore[list-item]
                        counts += [] if samples is None else samples.count.tolist()
            assert counts == list(range(200))


def test_faults_of_a_bus() -> None:
    faults = [
        Fault("can_error", at_s=0.6, amount=3),
        Fault("burst", at_s=0.7, amount=24),
        Fault("truncate", at_s=0.8, amount=2),
        Fault("bit_flip", at_s=0.9, amount=1),
        Fault("drop", at_s=1.0),
        Fault("duplicate", at_s=1.1),
    ]
    with native_can(2000, BusEndpoint("virtual:faults"), faults=FaultSchedule(faults)) as device:
        with can.Bus("faults", "virtual") as bus:
            bus.send(can.Message(arbitration_id=0x100, data=[3], is_extended_id=False))
            assert device.wait(PATIENCE_S)
            messages = list(iter(lambda: bus.recv(0.1), None))
    errors = [m for m in messages if m.is_error_frame]
    foreign = [m for m in messages if m.is_extended_id and not m.is_error_frame]
    ours = [m for m in messages if 0x102 <= m.arbitration_id <= 0x103 and not m.is_error_frame]
    per_sample = len(device.codec.encode(cut_chunks(signal(1), 1000.0)[0])[0])
    assert len(errors) == 3 and len(foreign) == 3
    assert len(ours) == 2000 * per_sample - 2 - 1 - per_sample + per_sample
    assert device.log.fate[[800, 900, 1000, 1100]].tolist() == [
        Fate.TRUNCATED, Fate.CORRUPTED, Fate.DROPPED, Fate.DUPLICATED,
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="can_error: a serial line has no error frames"):
        native(1, faults=FaultSchedule(faults))


class Asked(SerialCodec):
    """Sends a sample, as text, for each question mark."""

    streaming = False
    polls = True

    def __init__(self) -> None:
        super().__init__(SPEC)

    def feed(self, packet: bytes, t_ns: int) -> None:
        return None

    def encode(self, chunk: Chunk) -> list[bytes]:
        return [b"%d\n" % round(float(v[0, 0])) for v in chunk.values]

    def respond(self, packet: bytes) -> bytes:
        self.polled += packet.count(b"?")
        return b""

    def forget(self) -> None:
        pass


@pytest.mark.parametrize("pace", ["fast", "realtime"])
def test_a_polled_device_answers_polls_only(pace: str) -> None:
    values = np.arange(20_000, dtype=np.float32)[:, None, None] * np.ones(SPEC.shape, np.float32)
    source = ArraySource(SPEC, cut_chunks(values, 1000.0))
    with Emulator(Asked(), source, SerialEndpoint(), pace=pace) as device:
        fd = os.open(device.endpoint.pty.path, os.O_RDWR | os.O_NOCTTY)
        assert not select.select([fd], [], [], 0.1)[0] and device.log.sent == 0
        came = []
        for n in range(1, 30):
            os.write(fd, b"?" if n % 7 else b"??")
            want = 1 if n % 7 else 2
            text = b""
            while text.count(b"\n") < want:
                assert select.select([fd], [], [], PATIENCE_S)[0]
                text += os.read(fd, 100)
            came += [int(x) for x in text.split()]
        assert not select.select([fd], [], [], 0.05)[0]
        os.close(fd)
        assert device.log.sent == len(came) == 33
    if pace == "fast":
        assert came == list(range(33)), "the next one each time"
    else:
        assert came == sorted(came), "the newest one each time"


def test_a_commanded_array_moves() -> None:
    class Moving(ArraySource):
        moved: tuple[float, ...] = ()

        def set_whisking(self, *how: float) -> None:
            self.moved = how

    source = Moving(SPEC, cut_chunks(signal(100_000), 1000.0))
    with Emulator(NativeSerial(NativeOptions()), source, SerialEndpoint()) as device:
        host = Host(device.endpoint.pty.path)
        os.write(host.fd, host.codec.whisk(8.0, 0.5, -0.25).send)
        until(lambda: source.moved)
        assert source.moved == (8.0, 0.5, -0.25)
        host.close()


def test_an_array_is_fitted_to_the_device_s() -> None:
    source, device = small_spec(3), small_spec(5)
    chunk = cut_chunks(signal(2)[:, :3], 1000.0)[0]
    wide = fit(source, device)(chunk)
    assert np.array_equal(wide.values[:, :3], chunk.values) and not wide.values[:, 3:].any()
    assert wide.valid.tolist() == [[True] * 3 + [False] * 2] * 2
    narrow = fit(device, source)(wide)
    assert np.array_equal(narrow.values, chunk.values) and narrow.valid.all()
    turned = type(source)(**{**vars(source), "channels": ("mz", "t"), "units": ("N m", "K")})
    by_name = fit(source, turned)(chunk).values
    assert np.array_equal(by_name[..., 0], chunk.values[..., 1]) and not by_name[..., 1].any()
    named = type(source)(**{**vars(source), "channels": ("x", "y")})
    assert np.array_equal(fit(source, named)(chunk).values, chunk.values), "else by place"
    assert fit(source, source)(chunk) is chunk


class Broken(Source):
    def read(self, timeout: float | None = None) -> Chunk | None:
        raise SourceError("the array is on fire")

    def close(self) -> None:
        pass


def test_a_source_that_breaks_is_told() -> None:
    with native(source=Broken(SPEC)) as device:
        host = Host(device.endpoint.pty.path)
        with pytest.raises(SourceError, match="on fire"):
            device.wait(PATIENCE_S)
        host.close()


def test_so_is_a_wrong_combination() -> None:
    with pytest.raises(ConfigError, match="a serial codec cannot speak over a can endpoint"):
        native(1, endpoint=SlcanEndpoint())
    with pytest.raises(ConfigError, match="pace must be one of realtime, fast, not 'slow'"):
        native(1, pace="slow")
    with pytest.raises(ConfigError, match="INTERFACE:CHANNEL"):
        BusEndpoint("vcan0")
    with pytest.raises(ConfigError, match="can:nosuch:x: "):
        native_can(1, BusEndpoint("nosuch:x")).start()


def test_a_stream_of_known_length_stops_there() -> None:
    endless = ArraySource(SPEC, cut_chunks(signal(5000), 1000.0), live=True)
    faults = FaultSchedule([Fault("drop", rate=100)])
    device, _ = hear_all(native(source=endless, pace="realtime", seconds=2.0, faults=faults))
    assert device.log.sent == 2000
    assert device.log.counts[Fate.DROPPED] > 20
    assert (device.log.fate[1501:] == Fate.SENT).all()


def test_closing_needs_nobody() -> None:
    device = native(10_000)
    device.start()
    device.close()
    device.close()
    with pytest.raises(EndOfStream):
        while True:
            device.source.read()


def test_fakes_are_opened_by_their_url(fake_serial: Any, fake_can: Any) -> None:  # noqa: F811
    from tactile_rt.sources.opening import open_source

    values = signal(300)
    serial_device = fake_serial(values, "native", spec=SPEC, pace="fast")
    slcan_device = fake_can(values, "native", spec=SPEC, pace="fast", options={"format": "float32"})
    can_options = {"spec": SPEC, "pace": "fast", "options": {"format": "float32"}}
    bus_device = fake_can(values, bus="virtual:mine", **can_options)
    for device in (serial_device, slcan_device, bus_device):
        with open_source(device.url) as source:
            assert source.spec == SPEC
            assert np.array_equal(concatenate(read_chunks(source, 300)).values, values)
    assert bus_device.port == "virtual:mine" and slcan_device.port.startswith("slcan:/dev/pts/")
    with pytest.raises(ConfigError, match="a signal must be"):
        FakeSerial(np.zeros(3))
    with pytest.raises(ConfigError, match="no can codec 'nativ'"):
        FakeCan(values, "nativ")
