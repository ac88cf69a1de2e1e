"""Logs of lines as recordings: what a device sent is what comes back."""

import random

import can
import numpy as np
import pytest

from bench.drivers.fuzzing import all_codecs, wire_of
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import concatenate
from tactile_rt.drivers.logs import read_log
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording import Recording
from tactile_rt.recording.checking import compare_decoding
from tactile_rt.recording.importing.wire import import_wire


def imported(path, output, rate_hz=0.0, **fields):
    made = import_wire(read_log(path), output, fields, rate_hz)
    return made, concatenate(list(Recording(output)))


def serial_names():
    with all_codecs() as codecs:
        names = [name.split()[1] for name in codecs if name.startswith("serial")]
    return [n for n in names if n not in ("native", "ascii_line")]


@pytest.mark.parametrize("name", serial_names())
def test_raw_bytes_are_what_the_codec_finds_at_its_rate(tmp_path, name):
    codec = make_codec("serial", name, {})
    (tmp_path / "raw.bin").write_bytes(b"".join(wire_of(codec)))
    expected = make_codec("serial", name, {}).feed((tmp_path / "raw.bin").read_bytes(), 0)
    made, chunk = imported(tmp_path / "raw.bin", tmp_path / "out.mcap", codec=name)
    assert made.samples == len(expected) == len(chunk)
    assert chunk.values.tobytes() == expected.values.tobytes()
    assert (made.corrupt, made.missing) == (0, 0)
    steps = np.diff(chunk.t_ns)
    assert steps == pytest.approx(1e9 / codec.spec.rate_hz, rel=0.01, abs=1e6)
    again = compare_decoding(tmp_path / "out.mcap")
    assert (again.equal, again.differing) == (len(chunk), 0) and again.time_ns <= 1000


def test_a_rate_is_the_recordings(tmp_path):
    codec = make_codec("serial", "anyskin", {})
    (tmp_path / "raw.bin").write_bytes(b"".join(wire_of(codec)))
    made, chunk = imported(tmp_path / "raw.bin", tmp_path / "o.mcap", rate_hz=400, codec="anyskin")
    assert made.rate_hz == Recording(tmp_path / "o.mcap").spec.rate_hz == 400
    assert np.diff(chunk.t_ns) == pytest.approx(2_500_000, abs=1)


def test_what_a_counter_tells_is_missing_takes_time(tmp_path):
    packets = wire_of(make_codec("serial", "optoforce", {}))
    (tmp_path / "raw.bin").write_bytes(b"".join(packets[:10] + packets[15:]))
    made, chunk = imported(tmp_path / "raw.bin", tmp_path / "o.mcap", codec="optoforce")
    assert (made.samples, made.missing) == (len(packets) - 5, 5)
    assert np.diff(chunk.t_ns).max() == pytest.approx(60e6, rel=0.01)


def test_a_can_log_keeps_its_times(tmp_path):
    packets = wire_of(make_codec("can", "xela", {}))
    with can.Logger(tmp_path / "run.blf") as log:
        for k, packet in enumerate(packets):
            for frame in packet:
                log(can.Message(1.7e9 + 0.02 * k, frame.id, is_extended_id=False, data=frame.data))
    made, chunk = imported(tmp_path / "run.blf", tmp_path / "o.mcap", codec="xela")
    assert (made.samples, made.corrupt) == (len(packets), 0)
    assert made.seconds == pytest.approx(0.02 * (len(packets) - 1), abs=0.02)
    about = Recording(tmp_path / "o.mcap").description
    assert about.utc_offset_ns == pytest.approx(1.7e18, abs=1e6)
    assert (about.wire, about.codec) == ("can", "xela")
    assert compare_decoding(tmp_path / "o.mcap").equal == len(chunk)


def test_a_device_that_describes_itself_is_known_by_that(tmp_path):
    from tests.drivers.test_sniffing import a_second

    (tmp_path / "raw.bin").write_bytes(a_second("serial", "native", {}))
    made, chunk = imported(tmp_path / "raw.bin", tmp_path / "o.mcap", codec="native")
    assert Recording(tmp_path / "o.mcap").spec.shape == chunk.values.shape[1:] == (5, 6)
    assert made.samples > 900 and made.missing == 0
    assert np.diff(chunk.t_ns) == pytest.approx(1e6, abs=2e3)  # by its own clock
    assert compare_decoding(tmp_path / "o.mcap").time_ns == 0


def test_one_that_has_not_is_told_what_it_is(tmp_path):
    from tactile_rt.sources.synthetic import synthetic_spec

    codec = make_codec("serial", "native", {})
    codec.spec = synthetic_spec(5, 6, 1000.0)
    (tmp_path / "raw.bin").write_bytes(b"".join(wire_of(codec)))
    with pytest.raises(ConfigError, match=r"none describes the array: give array=FILE\.json"):
        imported(tmp_path / "raw.bin", tmp_path / "o.mcap", codec="native")
    (tmp_path / "array.json").write_text(codec.spec.to_json())
    array = str(tmp_path / "array.json")
    made, _ = imported(tmp_path / "raw.bin", tmp_path / "o.mcap", codec="native", array=array)
    assert made.samples == 40
    assert compare_decoding(tmp_path / "o.mcap").equal == 40


def test_cut_anywhere_and_damaged_nothing_raises_and_nothing_is_half_written(tmp_path):
    draw = random.Random(5)
    whole = b"".join(wire_of(make_codec("serial", "bota", {})))
    for k in range(30):
        data = bytearray(whole[draw.randrange(len(whole)) : draw.randrange(len(whole))])
        for _ in range(draw.randrange(4)):
            if data:
                data[draw.randrange(len(data))] = draw.randrange(256)
        (tmp_path / "raw.bin").write_bytes(data)
        output = tmp_path / f"{k}.mcap"
        try:
            made, chunk = imported(tmp_path / "raw.bin", output, codec="bota")
        except RecordingError:
            assert not output.exists()
        else:
            assert made.samples == len(chunk) and (np.diff(chunk.t_ns) > 0).all()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"codec": "botta"}, "no serial codec 'botta'"),
        ({"codec": "bota", "sink": "9"}, "no option 'sink'"),
        ({"codec": "xela"}, "codec xela speaks over can:"),
        ({"codec": "bota", "array": "x.json"}, "array= is not for codec bota"),
        ({}, "--as needs codec=NAME"),
    ],
)
def test_what_cannot_be_is_one_line(tmp_path, fields, why):
    (tmp_path / "raw.bin").write_bytes(b"\xaa" * 100)
    with pytest.raises(ConfigError, match=why):
        imported(tmp_path / "raw.bin", tmp_path / "o.mcap", **fields)
    assert not (tmp_path / "o.mcap").exists()


def test_lines_have_the_time_at_which_a_terminal_had_them(tmp_path):
    path = tmp_path / "monitor.txt"
    path.write_text("".join(f"[12:00:{k / 50:06.3f}] {k},{k + 1}\n" for k in range(100)))
    fields = {"codec": "ascii_line", "columns": "A0.fx,A0.fy"}
    made = import_wire(read_log(path), tmp_path / "out.mcap", fields)
    assert (made.samples, made.rate_hz, made.notes) == (100, 50, [])  # nobody told another rate
    assert made.seconds == pytest.approx(1.98)
    chunk = concatenate(list(Recording(tmp_path / "out.mcap")))
    assert chunk.values[7, 0].tolist() == [7, 8]
    made = import_wire(read_log(path), tmp_path / "out.mcap", fields, 1000)
    assert round(made.rate_hz) == 50 and made.notes[0].startswith("they came at 50 Hz, not at 1000")


@pytest.mark.parametrize(
    "pattern", ["{:02}:{:02}:{:06.3f} -> ", "{}:{}:{:.3f} -> ", "[{:02}:{}:{:.3f}] "]
)
@pytest.mark.parametrize("begin", [32_703, 86_390])
def test_times_of_day_of_a_terminal_go_on_after_midnight(tmp_path, pattern, begin):
    times = [begin + k / 2 for k in range(60)]
    times[21], times[22] = times[22], times[21]
    lines = (
        pattern.format(int(t) // 3600 % 24, int(t) // 60 % 60, t % 60) + f"{k},{k % 7}\n"
        for k, t in enumerate(times)
    )
    (tmp_path / "t.txt").write_text("".join(lines))
    fields = {"codec": "ascii_line", "columns": "A0.v,A1.v"}
    made, chunk = imported(tmp_path / "t.txt", tmp_path / "o.mcap", **fields)
    assert (made.samples, made.seconds, made.rate_hz) == (60, 29.5, 2)
    assert ((chunk.t_ns[[20, 23, 59]] - chunk.t_ns[0]) / 1e9).tolist() == [10, 11.5, 29.5]
