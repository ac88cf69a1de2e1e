"""Streams at rest: what is recorded comes back bit for bit, whatever happens to the recorder."""

import errno
import re
import struct
import subprocess
import sys
import threading
import time
from contextlib import closing
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.calibration import Calibration, save_calibration
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.recording import Description, Recording, StreamWriter, recover, writer
from tactile_rt.recording.layout import (
    decode_packet,
    decode_samples,
    encode_packet,
    encode_samples,
)
from tactile_rt.recording.writer import McapFile
from tactile_rt.sources.opening import open_source
from tactile_rt.stream import Chunk, ConfigError, EndOfStream, RecordingError, concatenate
from tactile_rt.sweep_set import SweepManifest, write_object
from tactile_rt.testing import ArraySource, FakeCan, FakeSerial, cut, small_spec

pytest.importorskip("mcap")

SPEC = small_spec()
PATIENCE_S = 20.0


def parts(chunk):
    return tuple(getattr(chunk, name).tobytes() for name in ("seq", "t_ns", "values", "valid"))


def all_parts(chunks):
    return [parts(chunk) for chunk in chunks]


def noise(n, shape=SPEC.shape, seed=0):
    return np.random.default_rng(seed).normal(size=(n, *shape)).astype(np.float32)


def odd_chunks():
    """Chunks with all that a stream may have: gaps, invalid elements, NaN, -0, large numbers."""
    chunks = cut(noise(50), 1000.0, samples=7, start_ns=123_456_789)
    values = chunks[1].values.copy()
    values[0, 0], values[1, 1] = np.nan, -0.0
    values[2, 2] = np.float32(1e-42), np.finfo(np.float32).max
    valid = np.isfinite(values).all(axis=2)
    chunks[1] = replace(chunks[1], values=values, valid=valid)
    far = chunks[3]
    chunks[3:] = [replace(c, seq=c.seq + 10**15, t_ns=c.t_ns + 2**60) for c in chunks[3:]]
    assert far.seq[0] != chunks[3].seq[0]
    return chunks


def write(path, chunks, spec=SPEC, **further):
    with StreamWriter(path, ArraySource(spec, chunks), **further) as recorder:
        for chunk in chunks:
            recorder.push(chunk)
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


# what is written


def test_chunks_come_back_bit_for_bit(path, no_thread_left):
    chunks = odd_chunks()
    write(path, chunks)
    back = list(Recording(path))
    assert all_parts(back) == all_parts(chunks)
    assert [c.values.dtype for c in back] == [np.float32] * len(chunks)
    assert back[0].values.flags.writeable  # its reader's own


def test_a_description_comes_back(path):
    before = time.time_ns() - time.monotonic_ns()
    write(path, odd_chunks(), session={"who": "Ada", "why": "a test"}, url="array:x")
    about = Recording(path).description
    assert about.spec == SPEC
    assert about.session == {"who": "Ada", "why": "a test"}
    assert (about.source, about.wire, about.codec) == ("array:x", "", "")
    assert abs(about.utc_offset_ns - before) < 1e9


def test_samples_are_cdr_as_written_by_hand():
    chunk = Chunk(
        np.array([5], np.int64), np.array([-2], np.int64),
        np.array([[[1.5, -2.0]]], np.float32), np.array([[True]]),
    )  # fmt: skip
    golden = bytes.fromhex(
        "00010000"  # CDR, little-endian
        "01000000 00000000 0500000000000000"  # length, padding to 8, seq
        "01000000 00000000 feffffffffffffff"
        "01000000 02000000"  # elements, channels
        "02000000 0000c03f 000000c0"
        "01000000 01"
    )
    assert encode_samples(chunk) == golden
    assert parts(decode_samples(golden, (1, 2))) == parts(chunk)


def test_packets_are_cdr_as_written_by_hand():
    assert encode_packet(b"\x01\xff", "serial") == bytes.fromhex("00010000 00000000 02000000 01ff")
    assert encode_packet(None, "serial") == bytes.fromhex("00010000 01000000 00000000")
    frames = [CanFrame(0x123, b"\xaa"), CanFrame(0x1ABCDEF0, b"", extended=True, remote=True)]
    golden = bytes.fromhex(
        "00010000 00000000 02000000"
        "23010000 00 00 00 00 01000000 aa 000000"
        "f0debc1a 01 00 01 00 00000000"
    )
    assert encode_packet(frames, "can") == golden
    assert decode_packet(golden, "can") == frames


FRAMES = st.lists(
    st.builds(
        CanFrame, st.integers(0, 2**29 - 1), st.binary(max_size=64), st.booleans(), st.booleans(),
        st.booleans(),
    )
)  # fmt: skip


@given(frames=FRAMES, data=st.binary(max_size=100))
def test_packets_come_back(frames, data):
    assert decode_packet(encode_packet(frames, "can"), "can") == frames
    assert decode_packet(encode_packet(data, "serial"), "serial") == data
    assert decode_packet(encode_packet(None, "can"), "can") is None


@given(data=st.binary(max_size=80), keep=st.integers(0, 60))
def test_what_is_no_message_is_refused_or_reads_as_one(data, keep):
    """Whatever is decoded is what its encoding says: nothing is guessed."""
    chunk = cut(noise(1, (1, 2)), 1000.0)[0]
    for made in (encode_samples(chunk)[:keep] + data, data):
        try:
            assert encode_samples(decode_samples(made, (1, 2)))[12:20] == made[12:20]
        except (ValueError, struct.error):
            pass
        for wire in ("serial", "can"):
            try:
                decode_packet(made, wire)
            except (ValueError, struct.error):
                pass


# what other programs read


def cdr(schema, data):
    """A message decoded by nothing but its ros2msg schema."""
    texts = re.split(r"=+\n", schema)
    kinds = {"": texts[0]} | {t.split("\n")[0].removeprefix("MSG: "): t for t in texts[1:]}
    simple = {"bool": "?", "uint8": "B", "uint32": "I", "int64": "q", "float32": "f"}
    at = 0

    def one(kind):
        nonlocal at
        if kind not in simple:
            return message(kind)
        size = struct.calcsize(simple[kind])
        at += -at % size
        (value,) = struct.unpack_from("<" + simple[kind], data, 4 + at)
        at += size
        return value

    def message(kind):
        found = {}
        for line in kinds[kind].splitlines():
            words = line.split("#")[0].split()
            if len(words) == 2 and words[0] != "MSG:":
                base, _, many = words[0].partition("[")
                found[words[1]] = [one(base) for _ in range(one("uint32"))] if many else one(base)
        return found

    made = message("")
    assert at == len(data) - 4
    return made


def test_any_mcap_reader_reads_it_by_the_schemas_in_the_file(path):
    from mcap.reader import make_reader

    chunks = odd_chunks()
    write(path, chunks)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        topics = {c.topic: c.message_encoding for c in summary.channels.values()}
        json = dict.fromkeys(("health", "decisions", "events"), "json")
        assert topics == {"samples": "cdr", **json}
        found = list(reader.iter_messages(topics=["samples"]))
        names = [m.name for m in reader.iter_metadata()]
    assert len(found) == len(chunks)
    assert names == ["tactile_rt", "summary"]
    for chunk, (schema, _, message) in zip(chunks, found, strict=True):
        assert (schema.name, schema.encoding) == ("tactile_rt/msg/Samples", "ros2msg")
        fields = cdr(schema.data.decode(), message.data)
        assert fields["seq"] == chunk.seq.tolist()
        assert fields["t_ns"] == chunk.t_ns.tolist()
        assert (fields["elements"], fields["channels"]) == SPEC.shape
        values = np.array(fields["values"], np.float32)
        assert values.tobytes() == chunk.values.tobytes()
        assert fields["valid"] == chunk.valid.ravel().tolist()
        assert message.log_time == chunk.t_ns[-1] + Recording(path).description.utc_offset_ns


@pytest.mark.parametrize("make", [FakeSerial, FakeCan])
def test_packets_are_read_by_their_schema(make, path):
    record_device(make(noise(50, (4, 6)), pace="fast"), path, 50)
    packets = list(Recording(path).packets())
    from mcap.reader import make_reader

    with path.open("rb") as file:
        for (schema, _, message), (packet, t_ns) in zip(
            make_reader(file).iter_messages(topics=["wire"]), packets, strict=True
        ):
            fields = cdr(schema.data.decode(), message.data)
            assert fields["opened"] == (packet is None)
            assert message.log_time - Recording(path).description.utc_offset_ns == t_ns
            if make is FakeSerial:
                assert bytes(fields["data"]) == (packet or b"")
            else:
                frames = [{**f, "data": bytes(f["data"])} for f in fields["frames"]]
                assert frames == [f._asdict() for f in packet or []]
    assert packets[0][0] is None
    assert len(packets) > 1


# packets decoded again


def record_device(fake, path, samples, during=lambda n: None, suffix=""):
    """Record what a driver reads of an emulated device: (chunks, statistics)."""
    chunks, n, end = [], 0, time.monotonic() + PATIENCE_S
    with (
        fake,
        open_source(fake.url + suffix) as source,
        StreamWriter(path, source) as recorder,
    ):
        while n < samples:
            assert time.monotonic() < end, f"{n} of {samples} samples"
            during(n)
            chunk = source.read(0.05)
            if chunk is not None:
                recorder.push(chunk)
                chunks.append(chunk)
                n += len(chunk)
        stats = replace(source.stats)
    assert recorder.stats.samples == n
    return chunks, stats


def replayed(path, options="from=wire&speed=0"):
    with open_source(f"replay:{path}?{options}") as source:
        return list(source), source


DEVICES = {
    "serial": lambda x, **k: FakeSerial(x, **k),
    "serial, int16": lambda x, **k: FakeSerial(x, options={"format": "int16"}, **k),
    "serial, bota": lambda x, **k: FakeSerial(x[:, :1], "bota", **k),
    "slcan": lambda x, **k: FakeCan(x, **k),
    "virtual": lambda x, **k: FakeCan(x, bus="virtual:recorded", **k),
}


@pytest.mark.parametrize("device", DEVICES)
def test_packets_decode_again_as_they_did_live(device, path, no_thread_left):
    chunks, stats = record_device(DEVICES[device](noise(300, (4, 6)) * 1e-3), path, 300)
    again, source = replayed(path)
    assert all_parts(again) == all_parts(chunks)
    assert source.stats == stats
    assert all_parts(Recording(path)) == all_parts(chunks)


def test_damage_and_a_reconnection_decode_again_as_they_did_live(path, tmp_path):
    kinds = ["bit_flip", "truncate", "duplicate", "drop"]
    faults = FaultSchedule([Fault(kind, rate=40.0) for kind in kinds], seed=1)
    fake = FakeSerial(noise(60_000, (4, 6)), faults=faults, link=str(tmp_path / "whisker"))
    unplugged = []

    def during(n):
        if len(unplugged) < n // 150:
            unplugged.append(n)
            fake.unplug()
            fake.replug(restart=len(unplugged) == 2)

    chunks, stats = record_device(fake, path, 600, during)
    assert len(unplugged) == 3 or len(unplugged) == 4
    assert sum(packet is None for packet, _ in Recording(path).packets()) >= 3
    assert min(stats.corrupt, stats.missing, stats.duplicates) > 0
    again, source = replayed(path)
    assert all_parts(again) == all_parts(chunks)
    assert source.stats == stats


def test_a_device_s_own_clock_is_the_replay_s(path):
    chunks, _ = record_device(FakeSerial(noise(100, (4, 6))), path, 100, suffix="&clock=device")
    assert Recording(path).description.clock == "device"
    assert all_parts(replayed(path)[0]) == all_parts(chunks)


def test_a_calibration_is_applied_again(path, tmp_path):
    with FakeSerial(noise(10, (4, 6))) as fake, open_source(fake.url) as source:
        raw = source.spec
    calibration = replace(Calibration.of("it", raw), gain=(2.0,) * 6, tare={"A0": (0.5,) * 6})
    file = save_calibration(calibration, tmp_path / "it.toml")
    fake = FakeSerial(noise(100, (4, 6)))
    chunks, _ = record_device(fake, path, 100, suffix=f"&calibration={file}")
    assert Recording(path).description.calibration == calibration
    assert all_parts(replayed(path)[0]) == all_parts(chunks)
    whole = concatenate(chunks)
    expected = 2 * (noise(100, (4, 6)) - np.array([0.5, 0, 0, 0], np.float32)[:, None])
    assert np.allclose(whole.values, expected, rtol=1e-6)


def test_options_of_a_codec_are_recorded_and_may_be_replaced(path, tmp_path):
    columns = "A0.fx:N,A0.fy:N"
    fake = FakeSerial(noise(40, (1, 2)), "ascii_line", options={"columns": columns}, pace="fast")
    chunks, _ = record_device(fake, path, 40)
    about = Recording(path).description
    assert (about.wire, about.codec) == ("serial", "ascii_line")
    assert about.codec_options == {"columns": columns}
    assert all_parts(replayed(path)[0]) == all_parts(chunks)
    twice, source = replayed(path, "from=wire&speed=0&columns=B1.fz*2:N,B1.fx:N")
    assert source.spec.channels == ("fz", "fx")
    both = concatenate(twice).values, concatenate(chunks).values
    assert np.array_equal(both[0][:, 0, 0], 2 * both[1][:, 0, 0])
    with pytest.raises(RecordingError, match=r"finds no description .* in its packets"):
        replayed(path, "from=wire&speed=0&codec=native")


def test_health_is_told_when_it_changes(path, tmp_path):
    fake = FakeSerial(noise(9000, (4, 6)), link=str(tmp_path / "whisker"))
    away = []

    def during(n):
        if n > 100 and not away:
            away.append(time.monotonic())
            fake.unplug()
        if away and not fake.emulator.endpoint.heard and time.monotonic() > away[0] + 0.3:
            fake.replug()
            away[0] = float("inf")

    record_device(fake, path, 400, during)
    told = list(Recording(path).health())
    states = [h["state"] for h in told]
    assert states[0] == "connecting"
    assert states[-1] == "closed"
    assert states.index("streaming") < states.index("lost")
    assert told[-1]["device"]["connections"] == 2
    assert told[-1]["stats"]["delivered"] >= 400
    assert told[-1]["recorder"]["samples"] >= 400
    assert sorted(told, key=lambda h: h["t_ns"]) == told


def test_a_tap_hears_what_came_before_it_but_not_what_was_read():
    with FakeSerial(noise(200, (4, 6))) as fake, open_source(fake.url) as source:
        heard, late = [], []
        source.tap(lambda packet, t_ns: heard.append(packet))
        assert heard[0] is None
        assert sum(map(len, heard[1:])) > 0
        before = len(heard)
        while len(heard) < before + 3:
            source.read(0.1)
        source.tap(lambda packet, t_ns: late.append(packet))
        assert not late
        source.tap(None)
        count = len(heard)
        source.read(0.1)
        assert len(heard) == count


# replay


def touches(n=800):
    """Rest, then a touch, on a small array at 1 kHz."""
    values = noise(n, seed=3) * 1e-5
    values[300:700] += 0.5
    return values


def decisions_of(url, model):
    from tactile_rt.classifier.classifier import Classifier

    with open_source(url) as source:
        classifier = Classifier(model, source.spec)
        chunks, decisions = [], []
        for chunk in source:
            chunks.append(parts(chunk))
            decisions += [
                msgspec.json.encode({**d.__dict__, "probabilities": d.probabilities.tolist(),
                                     "latency_s": 0, "late": False})
                for d in classifier.push(chunk)
            ]  # fmt: skip
    return chunks, decisions


@pytest.mark.parametrize("channel", ["samples", "wire"])
def test_every_speed_gives_the_same_chunks_and_decisions(channel, path, tmp_path):
    tiny_model = pytest.importorskip("tests.helpers.tiny_model")
    model = tiny_model.write_model(tmp_path / "tiny.onnx")
    fake = FakeSerial(touches(), spec=SPEC)
    recorded, _ = record_device(fake, path, 800)
    first = decisions_of(f"replay:{path}?from={channel}&speed=0", model)
    assert first[0] == all_parts(recorded)
    assert len(first[1]) >= tiny_model.STEPS
    for speed in (0, 0, 10, 10, 10, 1, 1, 1):
        assert decisions_of(f"replay:{path}?from={channel}&speed={speed}", model) == first


def test_a_replay_keeps_the_recorded_pace(path):
    write(path, cut(noise(400), 1000.0))
    for speed, least in ((4, 0.09), (0, 0.0)):
        with open_source(f"replay:{path}?speed={speed}") as source:
            began = time.monotonic()
            assert not source.live  # it waits for its reader, and loses nothing
            assert source.read() is not None  # the first is due at once
            if speed:
                assert source.read(0) is None
            assert sum(map(len, source)) == 391
            assert time.monotonic() - began >= least
            with pytest.raises(EndOfStream):
                source.read(0)


def test_gaps_of_the_recording_are_counted_as_missing(path):
    chunks = cut(noise(40), 1000.0, samples=10)
    write(path, [chunks[0], chunks[2], chunks[3]])
    again, source = replayed(path, "speed=0")
    assert len(again) == 3
    assert (source.stats.delivered, source.stats.missing) == (30, 10)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("speed=-1", "speed must be 0 .* or more, not -1"),
        ("speed=nan", "speed must be 0"),
        ("sped=1", "no option 'sped'; did you mean speed?"),
        ("from=wires", "from must be samples or wire, not 'wires'"),
        ("from=wire", "no raw packets: .* is no device"),
        ("codec=native", "codec= is for from=wire"),
    ],
)
def test_wrong_options_are_named(options, said, path):
    write(path, cut(noise(10), 1000.0))
    with pytest.raises(ConfigError, match=said):
        open_source(f"replay:{path}?{options}")


# sweep sets


@pytest.fixture
def sweep_set(tmp_path):
    manifest = SweepManifest(SPEC, 9_000_000, 4, ("mug",), {"train": ("mug-1",)})
    manifest.write(tmp_path)
    values = noise(3 * 20).reshape(3, 20, *SPEC.shape)
    write_object(tmp_path, "mug-1", values, {})
    return tmp_path / "mug-1.npz", values


def test_a_stored_object_is_streamed_with_rests_between_its_sweeps(sweep_set):
    file, values = sweep_set
    with open_source(f"replay:{file}?speed=0&rest_s=0.09") as source:
        assert source.spec == replace(SPEC, rate_hz=1e9 / 9e6)
        whole = concatenate(list(source))
    assert np.array_equal(whole.seq, np.arange(90))
    assert np.array_equal(whole.t_ns, whole.seq * 9_000_000)
    assert whole.valid.all()
    stream = whole.values.reshape(3, 30, *SPEC.shape)
    assert np.array_equal(stream[:, 10:], values)
    lead = values[:, :4]
    assert np.array_equal(stream[:, :10], np.concatenate([lead, lead, lead[:, :2]], axis=1))


def test_one_sweep_of_an_object_is_streamed(sweep_set):
    file, values = sweep_set
    with open_source(f"replay:{file}?speed=0&rest_s=0&sweep=2") as source:
        assert np.array_equal(concatenate(list(source)).values, values[2])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("?sweep=3", "has sweeps 0 to 2, not 3"),
        ("?rest_s=-1", "rest_s must be 0 to 3600"),
        ("?from=wire", "no option 'from'"),
        ("?speed=-2", "speed must be 0"),
        ("x.npz", "no sweeps"),
    ],
)
def test_wrong_sweeps_are_named(change, said, sweep_set):
    with pytest.raises(ConfigError, match=said):
        open_source(f"replay:{sweep_set[0]}{change}")


def test_sweeps_without_their_set_are_refused(sweep_set):
    (sweep_set[0].parent / "manifest.json").unlink()
    with pytest.raises(RecordingError, match="not a sweep set"):
        open_source(f"replay:{sweep_set[0]}")


# disks


class Slow:
    """A file whose disk takes nothing for a while, or no more than so many bytes."""

    def __init__(self, file, most=None):
        self.file, self.most, self.open = file, most, threading.Event()
        self.open.set()

    def write(self, data):
        assert self.open.wait(PATIENCE_S)
        if self.most is not None and self.file.tell() + len(data) > self.most:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.fixture
def disk(monkeypatch):
    made = []
    create = writer._create

    def slow(*arguments):
        made.append(Slow(create(*arguments)))
        return made[-1]

    monkeypatch.setattr(writer, "_create", slow)
    return made


def test_what_a_slow_disk_has_no_room_for_is_counted_and_told(path, disk, no_thread_left):
    chunks = cut(noise(3000), 1000.0, samples=10)
    source = ArraySource(SPEC, chunks, live=True)
    with StreamWriter(path, source, queue_bytes=20_000, flush_s=0.0) as recorder:
        disk[0].open.clear()
        began = time.monotonic()
        for chunk in chunks:
            recorder.push(chunk)
        assert time.monotonic() - began < 5  # a stuck disk holds nobody up
        assert recorder.stats.dropped_samples > 2000
        disk[0].open.set()
    stats, back = recorder.stats, list(Recording(path))
    assert sum(map(len, back)) == stats.samples
    assert stats.samples + stats.dropped_samples == 3000
    assert parts(back[-1]) == parts(chunks[-1])  # the oldest went
    assert (
        list(Recording(path).health())[-1]["recorder"]["dropped_samples"] == stats.dropped_samples
    )
    kept = {parts(c) for c in chunks}
    assert all(parts(c) in kept for c in back)


def test_a_source_that_can_wait_waits_for_a_slow_disk(path, disk):
    chunks = cut(noise(3000), 1000.0, samples=10)
    with StreamWriter(path, ArraySource(SPEC, chunks), queue_bytes=20_000) as recorder:
        for chunk in chunks:
            recorder.push(chunk)
    assert recorder.stats.dropped_samples == 0
    assert all_parts(Recording(path)) == all_parts(chunks)


def test_a_full_disk_is_told_and_what_is_written_can_be_recovered(path, disk, no_thread_left):
    chunks = cut(noise(4000), 1000.0, samples=10)
    recorder = StreamWriter(path, ArraySource(SPEC, chunks, live=True), flush_s=0.0)
    disk[0].most = 40_000
    end = time.monotonic() + PATIENCE_S
    with pytest.raises(RecordingError, match=r"run.mcap cannot be written any more \(No space"):
        while time.monotonic() < end:
            for chunk in chunks:
                recorder.push(chunk)
                time.sleep(0.001)
    with pytest.raises(RecordingError, match="No space left"):
        recorder.close()
    recorder.close()
    back = list(Recording(recover(path)))
    assert 0 < len(back)
    assert all_parts(back) == all_parts(chunks[: len(back)])


# broken off


PROGRAM = """
import sys
from tactile_rt.sources.opening import open_source
from tactile_rt.recording import StreamWriter
with open_source("synthetic:4x6") as source, StreamWriter(sys.argv[1], source) as recorder:
    for chunk in source:
        recorder.push(chunk)
        print(chunk.seq[-1], flush=True)
"""


@pytest.mark.parametrize("seconds", np.random.default_rng(5).uniform(0, 1.6, 4).round(3))
def test_of_a_killed_recorder_all_but_the_last_second_is_recovered(seconds, path):
    with subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(path)], stdout=subprocess.PIPE, text=True
    ) as process:
        process.stdout.readline()
        time.sleep(seconds)
        process.kill()
        last = int((process.stdout.read().splitlines() or ["0"])[-1].split()[0])
    with pytest.raises(RecordingError, match="cut short"):
        list(Recording(path))
    back = recover(path)
    assert back.name == "run.recovered.mcap"
    chunks = list(Recording(back))
    seq = np.concatenate([[-1], *(c.seq for c in chunks)])
    assert np.array_equal(seq, np.arange(-1, len(seq) - 1))
    assert seq[-1] >= last - 1000  # at 1 kHz
    assert Recording(back).description.recovered


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording in many pieces: its bytes, its chunks, and where each piece ends in it."""
    from mcap.reader import make_reader

    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    chunks = cut(noise(120), 1000.0, samples=5)
    with path.open("wb") as file:
        made = McapFile(file, Description(SPEC, 1_700_000_000 * 10**9, session={"a": "b"}))
        for i, chunk in enumerate(chunks, 1):
            made.add("samples", encode_samples(chunk), int(chunk.t_ns[-1]))
            if i % 3 == 0:
                made.flush()
        made.finish()
    with path.open("rb") as file:
        pieces = make_reader(file).get_summary().chunk_indexes
    ends = [p.chunk_start_offset + p.chunk_length for p in pieces]
    assert len(ends) == 8
    return path.read_bytes(), chunks, ends


def cut_short(whole, tmp_path, at):
    data, chunks, ends = whole
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:at])
    with pytest.raises(RecordingError, match=re.escape(str(path))):
        list(Recording(path))
    kept = 3 * sum(end <= at for end in ends)
    try:
        back = recover(path, tmp_path / "out.mcap", force=True)
    except RecordingError as error:
        assert kept == 0
        assert str(path) in str(error)
        assert list(tmp_path.iterdir()) == [path]  # nothing half-written
        return False
    assert all_parts(Recording(back)) == all_parts(chunks[:kept])
    assert Recording(back).description.spec == SPEC
    assert Recording(back).description.session == {"a": "b"}
    back.unlink()
    return True


def test_cut_anywhere_all_that_is_whole_is_recovered(whole, tmp_path):
    data, _, ends = whole
    near = {at + d for at in ends for d in (-1, 0, 1)}
    places = near | {0, 1, 8, 9, len(data) - 1, *range(0, len(data), 97)}
    made = [cut_short(whole, tmp_path, at) for at in sorted(places)]
    assert made == sorted(made)  # more of a file never gives less
    assert sum(made) > 100


@settings(max_examples=150)
@given(at=st.floats(0, 1, exclude_max=True), damage=st.binary(min_size=1, max_size=9))
def test_damaged_anywhere_nothing_is_misread(whole, tmp_path_factory, at, damage):
    data, chunks, _ = whole
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    begin = int(at * len(data))
    path.write_bytes(data[:begin] + damage + data[begin + len(damage) :])
    back = []
    try:
        back += Recording(path)
    except RecordingError as error:
        assert str(path) in str(error)
    else:
        assert len(back) == len(chunks)
    assert all_parts(back) == all_parts(chunks[: len(back)])
    try:
        out = recover(path, path.with_name("mended.mcap"), force=True)
    except RecordingError as error:
        assert str(path) in str(error)
        return
    known = all_parts(chunks)
    order = [known.index(p) for p in all_parts(Recording(out))]
    assert order == sorted(order)


def test_a_piece_damaged_in_the_middle_is_left_out(whole, tmp_path):
    data, chunks, ends = whole
    path = tmp_path / "damaged.mcap"
    spoilt = bytearray(data)
    spoilt[ends[3] - 20] ^= 0xFF
    path.write_bytes(spoilt)
    back = []
    with pytest.raises(RecordingError, match="is damaged"):
        back += Recording(path)
    kept = all_parts(Recording(recover(path)))
    assert kept == all_parts(chunks[:9] + chunks[12:])


def test_a_whole_recording_needs_no_recovery(path):
    write(path, cut(noise(10), 1000.0))
    assert recover(path) == path
    assert list(path.parent.iterdir()) == [path]


def foreign(path):
    from mcap.writer import Writer

    with path.open("wb") as file:
        other = Writer(file)
        other.start()
        channel = other.register_channel("x", "json", 0)
        other.add_message(channel, 1, b"{}", 1)
        other.finish()


def newer(path):
    from mcap.writer import Writer

    with path.open("wb") as file:
        other = Writer(file)
        other.start()
        other.add_metadata("tactile_rt", {"version": "2"})
        other.finish()


@pytest.mark.parametrize(
    ("make", "kind", "said"),
    [
        (lambda p: None, ConfigError, "no recording .*run.mcap|No such file"),
        (lambda p: p.mkdir(), ConfigError, "cannot be read: Is a directory"),
        (lambda p: p.write_bytes(b""), RecordingError, "not an MCAP file"),
        (lambda p: p.write_text("seq,t_ns\n"), RecordingError, "not an MCAP file"),
        (foreign, RecordingError, "no recording of tactile-rt"),
        (newer, RecordingError, "of version '2'; this release reads 1"),
    ],
    ids=["missing", "folder", "empty", "text", "another's mcap", "newer"],
)
def test_what_is_no_recording_is_named(make, kind, said, path):
    make(path)
    for read in (Recording, lambda p: list(Recording(p)), recover):
        with pytest.raises(kind, match=said) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)


def test_a_file_that_is_there_is_not_written_over(path):
    path.write_bytes(b"precious")
    with pytest.raises(ConfigError, match="is there already"):
        StreamWriter(path, ArraySource(SPEC, []))
    assert path.read_bytes() == b"precious"
    write(path, cut(noise(10), 1000.0), force=True)
    assert len(list(Recording(path))) == 2
    with pytest.raises(ConfigError, match="no folder"):
        StreamWriter(path.parent / "none" / "x.mcap", ArraySource(SPEC, []))


def test_without_the_extra_it_says_what_to_install(path, monkeypatch):
    write(path, cut(noise(10), 1000.0))
    for name in [n for n in sys.modules if n.partition(".")[0] == "mcap"]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, "mcap", None)
    for use in (
        lambda: StreamWriter(path, ArraySource(SPEC, [])),
        lambda: Recording(path).description,
        lambda: list(Recording(path)),
        lambda: recover(path),
        lambda: open_source(f"replay:{path}"),
    ):
        with pytest.raises(ConfigError, match=r"need mcap, .* pip install 'tactile-rt\[record\]'"):
            use()


def test_readers_may_stop_early(path):
    write(path, cut(noise(100), 1000.0))
    with closing(Recording(path).chunks()) as chunks:
        next(chunks)
    with open_source(f"replay:{path}") as source:
        source.read()
