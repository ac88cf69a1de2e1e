"""From loads to readings: against closed forms, and however the stream is cut."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from tactile_rt import testing
from tactile_rt.classifier.contact import ContactDetector
from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk, concatenate
from tactile_rt.core.stream.sensor_spec import ChannelSpec, MagnetSpec, SensorSpec, channel_limits
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.transducer import Transducer, device_spec, dipole_field
from tactile_rt.sources.opening import open_source
from tests.helpers.source_tree import ROOT

MAGNETS = ROOT / "docs" / "arrays" / "magnets.toml"
MZ = ChannelSpec(name="mz", unit="N m", range=1.0, noise_density=1e-7)
MAGNET = MagnetSpec(
    moment_a_m2=7.8e-4, sensor_mm=(-4, 0.5, 0), position_mm=(-1, 0, 0.2), axis=(1, 0.2, 0)
)
PLACE = ("A0",)


def chunk_of(values: np.ndarray) -> Chunk:
    n = len(values)
    loads = np.zeros((n, 1, 8), dtype=np.float32)
    loads[:, 0, 5] = values
    return Chunk(np.arange(n), np.arange(n) * 1_000_000, loads, np.ones((n, 1), dtype=bool))


def cut(chunk: Chunk, at: list[int]) -> list[Chunk]:
    edges = [0, *sorted({a % len(chunk) for a in at} - {0}), len(chunk)]
    return [chunk.select(slice(a, b)) for a, b in itertools.pairwise(edges)]


def test_a_dipole_on_its_axis_and_beside_it() -> None:
    at = MagnetSpec(moment_a_m2=0.01, sensor_mm=(20, 0, 0))
    still = np.zeros(2)
    assert dipole_field(at, still) == pytest.approx([2e-7 * 0.01 / 0.02**3, 0, 0])
    beside = dataclasses.replace(at, sensor_mm=(0, 20, 0))
    assert dipole_field(beside, still) == pytest.approx([-1e-7 * 0.01 / 0.02**3, 0, 0])


@given(st.floats(-1, 1), st.floats(-1, 1))
def test_a_turned_magnet_seen_from_its_own_frame_is_a_still_one(y: float, z: float) -> None:
    turn = Rotation.from_rotvec([0, y, z])
    seen = turn.inv().apply(MAGNET.sensor_mm)
    still = dataclasses.replace(MAGNET, sensor_mm=tuple(seen))
    expected = turn.apply(dipole_field(still, np.zeros(2)))
    assert dipole_field(MAGNET, np.array([y, z])) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("rate_hz", [1000.0, 333.0, 100.0, 80.0, 7.0])
def test_a_ramp_is_sampled_at_the_device_s_own_times(rate_hz: float) -> None:
    sensor = SensorSpec(channels=(MZ,), rate_hz=rate_hz)
    out = Transducer(sensor, PLACE).push(chunk_of(np.arange(2000) * 1e-3))
    assert out is not None
    assert len(out) == int(1.999 * rate_hz) + 1
    assert out.t_ns.tolist() == np.rint(np.arange(len(out)) / rate_hz * 1e9).tolist()
    assert out.values[:, 0, 0] == pytest.approx(out.t_ns * 1e-9, abs=1e-6)


def test_the_low_pass_is_down_by_3_db_at_its_corner() -> None:
    sensor = SensorSpec(channels=(MZ,), bandwidth_hz=20)
    wave = np.sin(2 * np.pi * 20 * np.arange(4000) * 1e-3)
    out = Transducer(sensor, PLACE).push(chunk_of(wave))
    assert out is not None
    assert abs(out.values[2000:]).max() == pytest.approx(np.sqrt(0.5), rel=0.03)
    steady = Transducer(sensor, PLACE).push(chunk_of(np.ones(10)))
    assert steady is not None
    assert steady.values == pytest.approx(1.0), "it was so for ever before"


@settings(max_examples=30)
@given(st.lists(st.integers(1, 499), max_size=12), st.sampled_from([80.0, 333.0, 1000.0]))
def test_cutting_the_stream_changes_nothing(at: list[int], rate_hz: float) -> None:
    sensor = SensorSpec(channels=(MZ,), rate_hz=rate_hz, bandwidth_hz=40)
    whole = chunk_of(np.random.default_rng(0).normal(size=500))
    expected = Transducer(sensor, PLACE).push(whole)
    assert expected is not None
    parts = Transducer(sensor, PLACE)
    got = concatenate([c for piece in cut(whole, at) if (c := parts.push(piece)) is not None])
    for name in ("seq", "t_ns", "values", "valid"):
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))


def test_the_noise_has_the_density_that_is_described() -> None:
    sensor = SensorSpec(channels=(MZ,), rate_hz=200)
    mouse = device_spec(load_animals("mouse"))
    spec = dataclasses.replace(mouse, channels=("mz",), units=("N m",), rate_hz=200.0)
    n = 20_000
    (still,) = testing.cut_chunks(np.zeros((n, *spec.shape)), 200.0, samples=n)
    read = Sensor(SensorModel(), spec, 0, sensor).push(still)
    assert read is not None
    _, density = welch(read.values[:, :, 0], fs=200, nperseg=256, axis=0)
    assert np.sqrt(density[2:-2].mean()) == pytest.approx(1e-7, rel=0.01)
    exact = Sensor(SensorModel(), spec, 0, sensor, drawn=False).push(still)
    assert exact is not None
    assert not exact.values.any()


def test_magnets_are_streamed_as_their_device_would() -> None:
    url = f"sim:{MAGNETS}?pace=fast&sweeps=1&seed=1&objects=mug-3"
    with open_source(url) as source:
        assert source.spec.channels == ("bx", "by", "bz")
        assert source.spec.units == ("T", "T", "T")
        assert source.spec.rate_hz == 80
        read = concatenate(list(source))
    assert np.ptp(np.diff(read.t_ns)) <= 1
    assert np.diff(read.t_ns).mean() == 12_500_000
    quiet = read.values[:40].astype(np.float64)
    field = 2e-7 * 7.8e-4 / 3e-3**3
    assert quiet.mean(axis=0)[:, 0] == pytest.approx(field, abs=5e-6), "the magnet at rest"
    noise = np.array([1.2e-7, 8e-8, 8e-8]) * np.sqrt(80 / 2)
    noise = np.hypot(noise, np.array([2.42e-7, 1.5e-7, 1.5e-7]) / np.sqrt(12))
    assert quiet.std(axis=0).mean(axis=0) == pytest.approx(noise, rel=0.1)
    steps = (read.values / np.array([2.42e-7, 1.5e-7, 1.5e-7])).astype(np.float64)
    assert abs(steps - np.rint(steps)).max() < 0.01
    assert abs(read.values - quiet.mean(axis=0)).max() > 1e-5, "it is touched"


def test_every_touch_of_a_sensor_that_drifts_begins_and_ends() -> None:
    with open_source(f"sim:{MAGNETS}?pace=fast&sweeps=6&seed=1") as source:
        period_ns = round(1e9 / source.spec.rate_hz)
        sensor = load_animals(str(MAGNETS))[0].sensor
        limits = channel_limits(source.spec, sensor, period_ns)
        detector = ContactDetector(source.spec.shape, limits.floor)
        resampler = Resampler(period_ns, source.spec.rate_hz)
        begun = []
        for chunk in source:
            out = resampler.push(chunk)
            for k in range(0 if out is None else len(out)):
                assert out is not None
                if detector.update(out.values[k], out.valid[k]):
                    begun.append(int(out.t_ns[k]))
        passes = [p.start_ns for p in source.passes]
    assert len(passes) == 6
    ends = [*passes[1:], np.inf]
    assert all(any(a < t < b for t in begun) for a, b in zip(passes, ends, strict=True))
    assert not detector.contact


@pytest.mark.parametrize(
    "change, why",
    [
        (("rate_hz = 80", "rate_hz = 2000"), "rate_hz must be at most 1000"),
        (("mount_stiffness_nm_rad = 2e-4\nmount_damping_nms_rad = 2e-7\n", ""), "is rigid"),
        (('field = "x" ', 'feild = "x" '), "feild"),
        (("range = 7.9e-3", "range = -1"), "range must be 0 or more, not -1"),
    ],
)
def test_files_that_cannot_be(change: tuple[str, str], why: str, tmp_path: Path) -> None:
    text = MAGNETS.read_text()
    assert change[0] in text
    file = tmp_path / "mine.toml"
    file.write_text(text.replace(*change))
    with pytest.raises(ConfigError, match=r"sensor|channel|mine\.toml") as error:
        open_source(f"sim:{file}")
    assert why in str(error.value)
    assert "\n" not in str(error.value)


def test_mujoco_refuses_a_sensor_that_reads_how_bases_rotate() -> None:
    with pytest.raises(ConfigError, match="the engine mujoco does not report how bases rotate"):
        with open_source(f"sim:{MAGNETS}?profile=mujoco&objects=mug-1&sweeps=1") as source:
            list(source)
