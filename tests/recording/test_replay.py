"""A recording is a stream again, at every speed, and its packets decode again."""

import time
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from tactile_rt.calibration import Calibration, save_calibration
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import EndOfStream, concatenate
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.recording import Recording
from tactile_rt.recording.replay import DEMO
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import write_object
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import FakeCan, FakeSerial, cut_chunks
from tests.helpers.recordings import SPEC, all_parts, noise, parts, record_device, write


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
    values = noise(800, seed=3) * 1e-5  # at 1 kHz
    values[300:700] += 0.5
    for _ in range(5):  # a busy machine may open the line when the touch is under way
        fake = FakeSerial(values, spec=SPEC)
        recorded, _ = record_device(fake, path, 800, force=True)
        first = decisions_of(f"replay:{path}?from={channel}&speed=0", model)
        assert first[0] == all_parts(recorded)
        if len(first[1]) >= tiny_model.STEPS:
            break
    assert len(first[1]) >= tiny_model.STEPS
    for speed in (0, 0, 10, 10, 10, 1, 1, 1):
        assert decisions_of(f"replay:{path}?from={channel}&speed={speed}", model) == first


def test_a_replay_keeps_the_recorded_pace(path):
    write(path, cut_chunks(noise(400), 1000.0))
    for speed, least in ((4, 0.09), (0, 0.0)):
        with open_source(f"replay:{path}?speed={speed}") as source:
            began = time.monotonic()
            assert not source.live  # it waits for its reader, and loses nothing
            assert source.read() is not None  # the first is due at once
            assert sum(map(len, source)) == 391
            assert time.monotonic() - began >= least
            with pytest.raises(EndOfStream):
                source.read(0)


def test_a_replay_gives_nothing_before_its_time(path):
    write(path, cut_chunks(noise(40), 1000.0))
    with open_source(f"replay:{path}?speed=0.0001") as source:
        assert source.read() is not None
        assert source.read(0) is None  # the next is due in 90 s


def test_gaps_of_the_recording_are_counted_as_missing(path):
    chunks = cut_chunks(noise(40), 1000.0, samples=10)
    write(path, [chunks[0], chunks[2], chunks[3]])
    again, source = replayed(path, "speed=0")
    assert len(again) == 3
    assert (source.stats.delivered, source.stats.missing) == (30, 10)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("speed=-1", "speed must be 0 .* or more, not -1"),
        ("speed=nan", "speed: nan is not a finite number"),
        ("sped=1", "no option 'sped'; did you mean speed?"),
        ("from=wires", "from must be samples or wire, not 'wires'"),
        ("from=wire", "no raw packets: .* is no device"),
        ("codec=native", "codec= is for from=wire"),
    ],
)
def test_wrong_options_are_named(options, said, path):
    write(path, cut_chunks(noise(10), 1000.0))
    with pytest.raises(ConfigError, match=said):
        open_source(f"replay:{path}?{options}")


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


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("?sweep=3", "has sweeps 0 to 2, not 3"),
        ("?rest_s=-1", "rest_s must be 0 to 3600"),
        ("?from=wire", "no option 'from'"),
        ("?speed=-2", "speed must be 0"),
        ("x.npz", "no file .*x.npz"),
    ],
)
def test_wrong_sweeps_are_named(change, said, sweep_set):
    with pytest.raises(ConfigError, match=said):
        open_source(f"replay:{sweep_set[0]}{change}")


def test_sweeps_without_their_set_are_refused(sweep_set):
    (sweep_set[0].parent / "manifest.json").unlink()
    with pytest.raises(RecordingError, match="not a sweep set"):
        open_source(f"replay:{sweep_set[0]}")


def passes(url, samples, count):
    """The chunks of so many passes over what has so many samples, and the account of them."""
    taken, chunks = 0, []
    with open_source(url) as source:
        while taken < count * samples:
            chunks.append(source.read())
            taken += len(chunks[-1])
        assert taken == count * samples, "a pass ends with a chunk"
        return concatenate(chunks), source.stats


def check_three(whole, n, rate_hz):
    assert (whole.seq == whole.seq[0] + np.arange(3 * n)).all()
    assert (np.diff(whole.t_ns) > 0).all()
    seams = np.diff(whole.t_ns)[[n - 1, 2 * n - 1]]
    assert seams.tolist() == [round(1e9 / rate_hz)] * 2
    for again in (whole.values[n : 2 * n], whole.values[2 * n :]):
        np.testing.assert_array_equal(again, whole.values[:n])


def test_a_loop_begins_again_and_its_numbers_and_times_go_on(path):
    write(path, cut_chunks(noise(100), SPEC.rate_hz))
    whole, stats = passes(f"replay:{path}?loop=true&speed=0", 100, 3)
    check_three(whole, 100, SPEC.rate_hz)
    assert (stats.delivered, stats.missing) == (300, 0)


def test_packets_are_decoded_anew_in_every_pass_of_a_loop(path):
    chunks, _ = record_device(FakeSerial(noise(90, (4, 6)), log=False), path, 90)
    n = sum(map(len, chunks))
    whole, stats = passes(f"replay:{path}?loop=true&from=wire&speed=0", n, 3)
    check_three(whole, n, 1000.0)
    assert stats.missing == 0


def test_a_sweep_set_loops(sweep_set):
    file, values = sweep_set
    n = values.shape[1]
    url = f"replay:{file}?speed=0&rest_s=0&sweep=1&loop=true"
    with open_source(url) as source:
        rate_hz = source.spec.rate_hz
    check_three(passes(url, n, 3)[0], n, rate_hz)


def test_a_loop_of_nothing_ends(path):
    write(path, [])
    with open_source(f"replay:{path}?loop=true&speed=0") as source:
        assert list(source) == []


def test_the_recording_that_ships_has_a_name_and_a_file_of_that_name_a_path(cwd):
    write(cwd / "demo", cut_chunks(noise(7), SPEC.rate_hz))
    for url, samples in (("demo", sum(map(len, Recording(DEMO)))), ("./demo", 7)):
        with open_source(f"replay:{url}?speed=0") as source:
            assert sum(map(len, source)) == samples
    with pytest.raises(ConfigError, match="no file"):
        open_source(f"replay:{cwd}/none/demo")
