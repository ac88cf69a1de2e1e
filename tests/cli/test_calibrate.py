"""`tactile-rt tare` and `calibrate`: what they store, what they say, what they refuse."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.calibration import CalibratedSource, Calibration, load_calibration, save_calibration
from tactile_rt.core.errors import ConfigError
from tactile_rt.sources import opening as sources
from tactile_rt.testing import ArraySource, cut_chunks, small_spec

SPEC = replace(small_spec(2), channels=("s0", "s1"), units=("1", "1"))
CROSS = np.array([[0.02, 0.001], [-0.0003, 0.004]])  # N and N m per count
OFFSET = np.array([[500.0, -200.0], [40.0, 7.0]])  # (element, channel) counts


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path / "config" / "tactile_rt" / "calibration"


@pytest.fixture
def device(monkeypatch):
    """What `gauges:` opens: quiet for 300 ms, or these samples, under this calibration."""

    class Device:
        calibration: Calibration | None = None
        device_id = ""
        values = OFFSET + np.random.default_rng(0).normal(size=(300, 2, 2))

        def open(self, url: str):
            if url != "gauges:":
                raise ConfigError(f"unknown source {url!r}")
            source = ArraySource(SPEC, cut_chunks(self.values, SPEC.rate_hz))
            if self.device_id:
                source.device_id = self.device_id
            return CalibratedSource(source, self.calibration) if self.calibration else source

    made = Device()
    monkeypatch.setattr(sources, "open_source", made.open)
    return made


def write_table(path, loads, noise=0.0, element=0, names=("raw_s1", "raw_s0")):
    """A table of exact readings under these loads, channels in another order than the device's."""
    rng = np.random.default_rng(1)
    raw = loads @ np.linalg.inv(CROSS).T + OFFSET[element] + noise * rng.normal(size=loads.shape)
    rows = "".join(
        f"{r[1]!r},{r[0]!r},{f!r},{m!r}\n"
        for r, (f, m) in zip(raw.tolist(), loads.tolist(), strict=True)
    )
    path.write_text(",".join((*names, "fy", "mz")) + "\n" + rows)
    return path


@pytest.fixture
def loads():
    return np.random.default_rng(2).uniform(-1, 1, size=(30, 2)) * [1, 0.1]


def test_a_tare_is_stored_under_the_name_of_the_array(call, device, home):
    code, out, err = call("tare", "gauges:", "--seconds", 0.2)
    assert (code, err) == (0, "")
    assert "tare of small written to" in out
    stored = load_calibration("small")
    np.testing.assert_allclose([stored.tare["A0"], stored.tare["A1"]], OFFSET, atol=0.3)
    np.testing.assert_allclose(list(stored.noise.values()), 1, atol=0.35)
    assert len(stored.history) == 1
    assert [p.name for p in home.iterdir()] == ["small.toml"]


def test_a_device_that_knows_its_id_keeps_its_own_file(call, device, home):
    device.device_id = "SN-0042"
    assert call("tare", "gauges:")[0] == 0
    assert call("tare", "gauges:", "--device", "left")[0] == 0
    assert sorted(p.name for p in home.iterdir()) == ["SN-0042.toml", "left.toml"]


def test_a_new_tare_keeps_all_else(call, device, tmp_path):
    path = tmp_path / "mine.toml"
    before = replace(
        Calibration.of("left", SPEC),
        matrices={"A0": ((1.0, 2.0), (3.0, 4.0))},
        mapping={"C1": "A0"},
        tare={"A0": (1.0, 1.0)},
    )
    save_calibration(before, path)
    assert call("tare", "gauges:", "--out", path)[0] == 0
    after = load_calibration(path)
    assert replace(after, tare=before.tare, noise={}, changes=0.0, history=()) == before
    np.testing.assert_allclose(after.tare["A0"], OFFSET[0], atol=0.3)


def test_of_a_calibrated_source_the_device_is_tared(call, device):
    """Its own calibration is brought up to date, wherever that came from."""
    device.calibration = replace(Calibration.of("left", SPEC), gain=(3.0, 3.0))
    assert call("tare", "gauges:")[0] == 0
    stored = load_calibration("left")
    assert stored.gain == (3.0, 3.0)
    np.testing.assert_allclose(stored.tare["A1"], OFFSET[1], atol=0.3)


def test_an_array_that_shakes_is_told_from_its_last_tare(call, done, device):
    assert call("tare", "gauges:")[0] == 0
    shaking = 20 * np.sin(np.arange(300) * 0.8)  # fast: no block of the tare sees it move
    device.values = device.values + shaking[:, None, None] * [[0, 0], [0, 1]]
    _, err = done("tare", "gauges:")
    assert "more than 3 times as noisy as when last tared: A1; did" in err


def test_a_touched_array_leaves_the_old_tare(refused, call, device, home):
    assert call("tare", "gauges:")[0] == 0
    before = (home / "small.toml").read_text()
    device.values = device.values + np.where(np.arange(300) > 150, 99.0, 0.0)[:, None, None]
    assert "small: element A0 is being touched: s" in refused("tare", "gauges:")
    assert (home / "small.toml").read_text() == before


def test_a_file_of_another_device_or_array_is_refused(refused, device, tmp_path):
    path = tmp_path / "other.toml"
    save_calibration(Calibration.of("right", SPEC), path)
    text = path.read_text()
    said = refused("tare", "gauges:", "--device", "left", "--out", path)
    assert f"{path} is of device right, not left" in said
    save_calibration(Calibration.of("right", small_spec(2)), path)
    assert "for channels fy, mz; small has s0, s1" in refused("tare", "gauges:", "--out", path)
    assert path.read_text() != text


def test_where_it_cannot_be_written_is_told_before_it_is_read(refused, device, tmp_path):
    device.values = device.values[:3]
    out = tmp_path / "no" / "x.toml"
    assert "no folder" in refused("tare", "gauges:", "--out", out)
    assert "3 valid samples" in refused("tare", "gauges:")


def test_a_table_of_readings_is_fitted_and_stored(call, tmp_path, loads):
    table = write_table(tmp_path / "loads.csv", loads, noise=0.01)
    path = tmp_path / "cell.toml"
    code, out, err = call("calibrate", table, "--out", path)
    assert (code, err) == (0, "")
    assert "residual RMS" in out
    assert "30 loads; condition number" in out
    assert "worst: line " in out
    assert "matrix of cell, element A0, written to" in out
    stored = load_calibration(path)
    assert (stored.device, stored.elements, stored.channels) == ("cell", ("A0",), ("s1", "s0"))
    assert stored.output == (("fy", "mz"), ("N", "N m"))
    np.testing.assert_allclose(
        np.array(stored.matrices["A0"])[:, ::-1], CROSS, rtol=1e-2, atol=1e-5
    )


def test_a_known_device_s_element_gets_its_matrix(call, done, device, tmp_path, loads):
    """Tare, then both elements, then the calibrated source reads the loads."""
    assert call("tare", "gauges:", "--device", "cell")[0] == 0
    for element in (0, 1):
        table = write_table(tmp_path / "loads.csv", loads, element=element)
        _, err = done("calibrate", table, "--device", "cell", "--element", f"A{element}")
        assert ("never valid: A1" in err) == (element == 0)
    stored = load_calibration("cell")
    assert stored.channels == ("s0", "s1"), "the device's order, not the table's"
    assert len(stored.history) == 3
    raw = np.stack([loads @ np.linalg.inv(CROSS).T + o for o in OFFSET], axis=1)
    source = CalibratedSource(ArraySource(SPEC, cut_chunks(raw, 1000.0)), stored)
    assert source.spec.units == ("N", "N m")
    made = np.concatenate([c.values for c in source])
    np.testing.assert_allclose(made, np.stack([loads, loads], axis=1), atol=1e-4)


def test_times_in_a_recording_do_as_well(call, device, tmp_path):
    loads = np.array([[0, 0], [1, 0], [0, 0.1], [-1, 0.05], [0.5, -0.1], [0.2, 0.2]])
    raw = loads @ np.linalg.inv(CROSS).T + OFFSET[1]
    device.values = np.zeros((600, 2, 2))
    device.values[:, 1] = np.repeat(raw, 100, axis=0)
    table = tmp_path / "loads.csv"
    table.write_text(
        "start_s,end_s,fy,mz\n"
        + "".join(f"{k / 10 + 0.01},{k / 10 + 0.09},{f},{m}\n" for k, (f, m) in enumerate(loads))
    )
    command = ("calibrate", table, "--source", "gauges:", "--element", "A1", "--device", "cell")
    assert call(*command)[0] == 0
    stored = load_calibration("cell")
    np.testing.assert_allclose(stored.matrices["A1"], CROSS, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(stored.tare["A1"], OFFSET[1], atol=1e-2)
    assert stored.units == ("1", "1")


def test_samples_that_were_calibrated_as_they_were_recorded_are_no_readings(refused, tmp_path):
    from tactile_rt.recording.description import Description
    from tactile_rt.recording.importing.report import Import, write_chunks

    (chunk,) = cut_chunks(np.zeros((50, 2, 2)), SPEC.rate_hz, 50)
    about = Description(SPEC, 0, "", calibration=Calibration.of("cell", SPEC))
    write_chunks(tmp_path / "run.mcap", about, chunk, Import(), "run")
    (tmp_path / "loads.csv").write_text("start_s,end_s,fy,mz\n0,0.1,1,0\n")
    recorded = f"replay:{tmp_path / 'run.mcap'}?speed=0"
    for words in (("tare", recorded), ("calibrate", tmp_path / "loads.csv", "--source", recorded)):
        said = refused(*words, "--out", tmp_path / "cell.toml")
        assert "its samples are calibrated: from=wire gives the raw ones" in said
    assert not (tmp_path / "cell.toml").exists()


def test_without_a_name_nothing_is_written(done, home, tmp_path, loads):
    table = write_table(tmp_path / "loads.csv", loads)
    out, _ = done("calibrate", table)
    assert "not written: name a --device or a file" in out
    assert not home.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["loads.csv"]


def test_loads_that_do_not_span_the_axes_are_warned_of(done, tmp_path, loads):
    loads[:, 1] = 0.05 * loads[:, 0]
    out, _ = done("calibrate", write_table(tmp_path / "loads.csv", loads, noise=0.1))
    assert "warning: fy and mz were always loaded together" in out


def test_what_does_not_fit_a_known_device_is_refused(refused, device, tmp_path, loads):
    known = replace(
        Calibration.of("cell", SPEC),
        output_channels=("fx", "mz"),
        output_units=("N", "N m"),
        matrices={"A1": ((1.0, 0.0), (0.0, 1.0))},
    )
    path = save_calibration(known)
    before = path.read_text()
    table = write_table(tmp_path / "loads.csv", loads)

    def said(*options):
        return refused("calibrate", table, "--device", "cell", *options)

    assert "--element: name the loaded one of A0, A1" in said()
    assert "--element: cell has no 'A7'; there are A0, A1" in said("--element", "A7")
    assert "are calibrated for fx, mz: give the same columns" in said("--element", "A0")
    write_table(table, loads, names=("raw_s1", "raw_s2"))
    assert "no reading raw_s0; cell has channels s0, s1" in said("--element", "A0")
    assert path.read_text() == before


def test_mistakes_in_a_table_are_one_line(refused, device, tmp_path, loads):
    table = write_table(tmp_path / "loads.csv", loads[:2])
    assert "loads.csv: 2 loads for 2 channels and an offset" in refused("calibrate", table)
    said = refused("calibrate", table, "--source", "gauges:")
    assert "has readings: leave out --source" in said
    table.write_text("start_s,end_s,fy\n0,1,1\n5,6,2\n")
    assert "name the recording they are in with --source" in refused("calibrate", table)
    command = ("calibrate", table, "--source", "gauges:")
    assert "--element: name the loaded one of A0, A1" in refused(*command)
    said = refused(*command, "--element", "A0")
    assert "loads.csv: line 3: no valid sample of A0 from 5 to 6 s" in said
