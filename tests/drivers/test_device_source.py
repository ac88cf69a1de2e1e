"""Devices as sources, through real lines: pyserial over a pty, slcan over a pty, python-can."""

import os
import threading
import time

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.stream import EndOfStream
from tactile_rt.drivers.emulation.faults import Fate, Fault, FaultSchedule
from tactile_rt.drivers.health import State
from tactile_rt.drivers.links import SerialLink
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import FakeCan, FakeSerial
from tests.helpers.waiting import PATIENCE_S, until

PATIENT = f"&start_s={PATIENCE_S:g}&stale_s={PATIENCE_S:g}"  # a busy machine is not a silent device


def signal(n=2000, elements=4, channels=6):
    """Values that tell their sample's number."""
    draw = np.random.default_rng(7)
    values = draw.normal(size=(n, elements, channels)) * 1e-3
    values[:, 0, 0] = np.arange(n) * 1e-5
    return values.astype(np.float32)


def take(source, n, over=lambda: False):
    """Read until n samples have come, or nothing comes any more because it is over."""
    chunks, have, end = [], 0, time.monotonic() + PATIENCE_S
    ended = False
    while have < n:
        assert time.monotonic() < end, f"{have} of {n} samples in {PATIENCE_S} s"
        chunk = source.read(0.1)
        if chunk is not None:
            chunks.append(chunk)
            have += len(chunk)
        elif ended:
            break
        else:
            ended = over()  # from then on, what is left can be read at once
    return chunks


DEVICES = {
    "serial native": lambda x, **k: FakeSerial(x, **k),
    "slcan native": lambda x, **k: FakeCan(x, options={"format": "float32"}, **k),
    "virtual native": lambda x, **k: FakeCan(
        x, options={"format": "float32"}, bus=f"virtual:{threading.get_native_id()}-{id(x)}", **k
    ),
}


@pytest.fixture(params=DEVICES)
def device(request):
    """Makes a device on each kind of line."""
    return DEVICES[request.param]


def test_what_a_device_measures_arrives_bit_for_bit(device, no_thread_left):
    values = signal()
    with device(values, pace="fast") as fake, open_source(fake.url + PATIENT) as source:
        chunks = take(source, len(values))
        assert np.array_equal(np.concatenate([c.values for c in chunks]), values)
        seq = np.concatenate([c.seq for c in chunks])
        assert np.array_equal(seq, np.arange(len(values)))
        assert source.stats.delivered == len(values)
        assert source.stats.missing == source.stats.corrupt == source.stats.duplicates == 0
        assert source.health.state == State.STREAMING
        assert source.spec == fake.source.spec


@pytest.mark.parametrize("kind", ["bit_flip", "truncate", "duplicate", "drop", "burst"])
def test_every_sample_is_accounted_for(kind):
    values = signal(6000)
    faults = FaultSchedule([Fault(kind, rate=20.0)], seed=1)
    with (
        FakeSerial(values, faults=faults, pace="fast") as fake,
        open_source(fake.url + PATIENT) as source,
    ):
        chunks = take(source, len(values), lambda: fake.done)
        assert fake.wait(PATIENCE_S)  # what has come may not be in its log yet
        log, stats = fake.log, source.stats
        assert log.sent == len(values)
        received = stats.delivered + stats.corrupt + stats.missing + stats.dropped
        assert log.sent + log.duplicated == received + stats.duplicates
        fate = np.asarray(log.fate)
        assert stats.duplicates == (fate == Fate.DUPLICATED).sum()
        assert stats.missing == (fate == Fate.DROPPED).sum()
        assert stats.corrupt == np.isin(fate, (Fate.CORRUPTED, Fate.TRUNCATED)).sum()
        if kind != "burst":
            assert (fate != Fate.SENT).sum() > 50  # something did happen
        # sample by sample: what came is what was sent, and what did not come was lost
        seq = np.concatenate([c.seq for c in chunks])
        lost = np.isin(fate, (Fate.DROPPED, Fate.CORRUPTED, Fate.TRUNCATED))
        assert np.array_equal(seq, np.flatnonzero(~lost))
        assert source.measured[0] == seq[-1] + 1  # what was lost was measured
        assert np.array_equal(np.concatenate([c.values for c in chunks]), values[seq])


def test_a_device_that_is_unplugged_comes_again(tmp_path, no_thread_left):
    link = str(tmp_path / "whisker0")
    before = len(os.listdir("/proc/self/fd"))
    with FakeSerial(signal(60_000), link=link) as fake, open_source(fake.url + PATIENT) as source:
        take(source, 50)
        for connections in range(2, 7):
            fake.unplug()
            until(lambda: source.health.state == State.LOST, meanwhile=lambda: source.read(0.01))
            assert source.health.reason
            assert source.read(0.0) is None  # nothing old is given out as new
            fake.replug()
            take(source, 20)
            assert source.health.state == State.STREAMING
            assert source.health.connections == connections
        log, stats = fake.log, source.stats
        unheard = int(np.isin(np.asarray(log.fate), (Fate.UNHEARD, Fate.OVERFLOWED)).sum())
        assert unheard > 0
        assert stats.missing >= unheard  # and what was on its way
    until(lambda: len(os.listdir("/proc/self/fd")) <= before)  # other libraries' come and go


def test_without_reconnection_a_lost_line_breaks_the_source(tmp_path):
    link = str(tmp_path / "whisker0")
    with FakeSerial(signal(60_000), link=link) as fake:
        with open_source(f"{fake.url}&reconnect=false") as source:
            take(source, 20)
            fake.unplug()
            with pytest.raises(SourceError, match="whisker0: the line is gone"):
                take(source, 10**6)
            with pytest.raises(EndOfStream):
                source.read(0.0)


def test_a_silent_device_is_stale_not_fresh():
    with FakeSerial(signal(300)) as fake, open_source(f"{fake.url}&stale_s=0.2") as source:
        take(source, 300)
        assert source.health.state == State.STREAMING  # nobody has looked
        until(lambda: not source.read(0.0) and source.health.state == State.STALE)
        assert "no sample for" in source.health.reason


def test_a_frame_at_the_end_of_what_waited_while_nobody_read_is_not_lost(monkeypatch):
    receive, held = SerialLink.receive, []

    def cut(link, timeout_s):
        if not held and (found := receive(link, timeout_s)) is not None:
            held.extend((part, found[1] + 2 * 10**9) for part in (found[0][:-9], found[0][-9:]))
        return held.pop(0) if held else None

    with FakeSerial(signal(3000), "native") as fake, open_source(fake.url) as source:
        take(source, 100)
        monkeypatch.setattr(SerialLink, "receive", cut)
        take(source, 300)
        assert (source.stats.missing, source.stats.corrupt) == (0, 0)


def test_a_device_that_restarts_goes_on(tmp_path):
    link = str(tmp_path / "whisker0")
    with FakeSerial(signal(60_000), link=link) as fake, open_source(fake.url + PATIENT) as source:
        first = take(source, 50)
        fake.unplug()
        until(lambda: source.health.state == State.LOST, meanwhile=lambda: source.read(0.01))
        fake.replug(restart=True)
        again = take(source, 50)
        t = np.concatenate([c.t_ns for c in first + again])
        assert (np.diff(t) > 0).all()
        assert source.health.counter_resets + source.health.clock_steps >= 1
        assert source.stats.missing < 60_000  # not what a counter that began anew would suggest


def test_what_a_device_says_of_itself_is_a_fault_but_for_what_is_none(device):
    with device(signal(60_000)) as fake, open_source(fake.url + PATIENT) as source:
        fails = ("a sensor fails",)
        for status, told in ((0b111, (3, fails)), (0b101, (2, fails)), (0b101, (2, ()))):
            fake.codec.status = status
            until(
                lambda told=told: (len(source.health.status), source.health.faults) == told,
                meanwhile=lambda: source.read(0.01),
            )


def test_whisking_commands_reach_the_device():
    with FakeSerial(signal(5000)) as fake, open_source(fake.url) as source:
        take(source, 10)
        source.set_whisking(8.0, 0.6, -0.1)
        until(lambda: fake.codec.whisking is not None, meanwhile=lambda: source.read(0.01))
        assert fake.codec.whisking == pytest.approx((8.0, 0.6, -0.1))


def test_a_passive_device_has_no_whisking_command():
    with FakeSerial(np.zeros((3000, 1, 6)), "bota") as fake, open_source(fake.url) as source:
        with pytest.raises(SourceError, match="codec bota has no whisking command"):
            source.set_whisking(8.0, 0.6, 0.0)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("serial:///dev/ttyUSB77?codec=native", "/dev/ttyUSB77: no such port: is it plugged in"),
        ("serial://{}/notes.txt?codec=native", r"notes\.txt: not a serial port"),
        ("can:socketcan:can77?codec=xela", "can:socketcan:can77: "),
    ],
)
def test_a_line_that_is_not_there(url, said, tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(SourceError, match=said):
        open_source(url.format(tmp_path))


def test_a_port_in_use():
    with FakeSerial(signal(20_000)) as fake, open_source(fake.url):
        with pytest.raises(SourceError, match="in use by another program"):
            open_source(fake.url)


@pytest.mark.parametrize(
    "codec, said",
    [
        (
            "ascii_line&columns=A0.fx,A0.fy,A0.fz",
            r"sample: what comes is not text: wrong baud rate\?",
        ),
        (
            "kwr75",
            r"sample: (nothing begins with 48 AA|\d+ frames began, and none ends with 0D 0A)",
        ),
        ("anyskin", "sample: nothing ends with 0D 0A every 82 bytes"),
        ("mlx_hex", "no whole mlx_hex sample: wrong codec, or wrong baud"),
    ],
)
def test_a_wrong_codec_says_what_did_not_fit(codec, said):
    with FakeSerial(signal(20_000), pace="realtime") as fake:
        with open_source(fake.url) as source:
            take(source, 5)
            source._link.send = lambda packet: None
        with pytest.raises(SourceError, match=said):
            open_source(f"{fake.url.partition('?')[0]}?codec={codec}&start_s=1")


def test_a_silent_line():
    device, host = os.openpty()
    try:
        with pytest.raises(SourceError, match=r"nothing came for 0\.3 s: is the device on"):
            open_source(f"serial://{os.ttyname(host)}?codec=anyskin&start_s=0.3")
    finally:
        os.close(device)
        os.close(host)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("serial:///dev/ttyUSB0", "needs codec="),
        ("serial:?codec=bota", "needs a port"),
        ("serial:///dev/x?codec=botta", "no serial codec 'botta'.*did you mean bota"),
        ("serial:///dev/x?codec=xela", "xela speaks over can:, not over serial:"),
        ("serial:///dev/x?codec=bota&parity=Q", "parity must be N, E or O"),
        ("can:can0?codec=xela", "needs an interface and a channel"),
        ("can:sockettcan:can0?codec=xela", "sockettcan"),
        ("can:virtual:x?codec=native&stale_s=-1", "stale_s must be 0 or more, not -1"),
    ],
)
def test_a_wrong_url_is_explained(url, said):
    with pytest.raises(ConfigError, match=said):
        open_source(url)


@pytest.mark.parametrize(
    ("codec", "clock", "said"),
    [
        ("bota", "none", "clock must be host or device, not 'none'"),
        ("optoforce", "device", "codec optoforce sends no time: it needs clock=host"),
    ],
)
def test_a_clock_that_a_device_has_not(codec, clock, said):
    values = np.zeros((100, 1, 6 if codec == "bota" else 3))
    with FakeSerial(values, codec) as fake, pytest.raises(ConfigError, match=said):
        open_source(f"{fake.url}&clock={clock}")


@pytest.mark.skipif(not os.path.isdir("/sys/class/net/vcan0"), reason="no kernel CAN (vcan0)")
def test_socketcan():
    values = signal()
    with FakeCan(values, bus="socketcan:vcan0", pace="fast") as fake:
        with open_source(fake.url) as source:
            assert len(np.concatenate([c.seq for c in take(source, 100)])) >= 100
