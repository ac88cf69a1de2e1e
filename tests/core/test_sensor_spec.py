"""What an array's file says of its sensor, and what a network may believe of it."""

import dataclasses

import numpy as np
import pytest

from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.core.stream.sensor_spec import (
    LOADS,
    ChannelSpec,
    MagnetSpec,
    SensorSpec,
    channel_limits,
)
from tactile_rt.testing import small_spec

MZ = ChannelSpec(name="mz", unit="N m", range=1e-3, noise_density=1e-7)
MAGNET = MagnetSpec(moment_a_m2=1e-3, sensor_mm=(-4, 0, 0))
SENSOR = SensorSpec(channels=(MZ,))
FIELD = ChannelSpec(name="b", unit="T", field="x", range=5e-3, resolution=2e-7)


def test_a_channel_called_as_a_load_reads_it() -> None:
    assert MZ.sensitivity.tolist() == [0, 0, 0, 0, 0, 1, 0, 0]
    bridge = dataclasses.replace(MZ, name="v", unit="V", of={"my": 3.0, "turn_z": -2.0})
    assert bridge.sensitivity.tolist() == [0, 0, 0, 0, 3, 0, 0, -2]
    assert not FIELD.sensitivity.any()


def test_a_matrix_takes_the_place_of_what_the_channels_say() -> None:
    sensor = SensorSpec(channels=(MZ,), matrix={"A1": ((1, 2, 3, 4, 5, 6),)})
    assert sensor.sensitivity("A0").tolist() == [MZ.sensitivity.tolist()]
    assert sensor.sensitivity("A1").tolist() == [[1, 2, 3, 4, 5, 6, 0, 0]]
    assert not sensor.feels_turns
    turned = dataclasses.replace(sensor, matrix={"A1": ((0,) * 7 + (1.0,),)})
    assert turned.feels_turns
    assert SensorSpec(channels=(FIELD,), magnet=MAGNET).feels_turns


@pytest.mark.parametrize("rate_hz, period_ms", [(1000, 9), (400, 9), (1000 / 9, 9), (80, 12.5)])
def test_rated_noise_is_what_the_resampler_leaves(rate_hz: float, period_ms: float) -> None:
    sensor = SensorSpec(channels=(MZ,), rate_hz=rate_hz)
    n, elements = 4000, 20
    rng = np.random.default_rng(0)
    values = sensor.noise() * rng.normal(size=(n, elements, 1))
    t_ns = np.rint(np.arange(n) * 1e9 / rate_hz).astype(np.int64)
    chunk = Chunk(np.arange(n), t_ns, values.astype(np.float32), np.ones((n, elements), bool))
    out = Resampler(round(period_ms * 1e6), rate_hz).push(chunk)
    spec = dataclasses.replace(small_spec(), channels=("mz",), units=("N m",))
    limits = channel_limits(spec, sensor, round(period_ms * 1e6))
    assert out.values.std() == pytest.approx(limits.noise[0], rel=0.02)


def test_noise_is_its_density_over_what_passes() -> None:
    wide = SensorSpec(channels=(MZ,), rate_hz=200)
    assert wide.noise() == pytest.approx([1e-7 * 10])
    slow = dataclasses.replace(wide, bandwidth_hz=10)
    assert slow.noise() == pytest.approx([1e-7 * np.sqrt(10 * np.pi / 2)])
    loose = dataclasses.replace(wide, bandwidth_hz=1000)
    assert loose.noise() == pytest.approx(wide.noise()), "what is beyond folds into the samples"


def test_a_sensor_that_rounds_is_no_quieter_than_its_step() -> None:
    spec = dataclasses.replace(small_spec(), channels=("b",), units=("T",))
    sensor = SensorSpec(channels=(FIELD,), magnet=MAGNET, rate_hz=80)
    limits = channel_limits(spec, sensor, 12_500_000)
    assert limits.noise == pytest.approx([2e-7 / np.sqrt(12)])
    assert limits.floor == pytest.approx([2e-7 / np.sqrt(12)])
    assert limits.clip == pytest.approx([5e-3])


def test_without_a_sensor_only_forces_and_moments_are_believed() -> None:
    spec = dataclasses.replace(small_spec(), channels=("fx", "mx"), units=("N", "N m"))
    limits = channel_limits(spec)
    assert limits.noise == pytest.approx([1e-5, 5e-8])
    assert limits.floor == pytest.approx(0.2 * limits.noise)
    field = dataclasses.replace(spec, channels=("a", "b"), units=("N", "T"))
    with pytest.raises(ConfigError, match=r"channels in T cannot be learnt from .*\[sensor\]"):
        channel_limits(field)


@pytest.mark.parametrize(
    "spec, what, why",
    [
        (MZ, {"range": 0.0}, "range must be more than 0"),
        (MZ, {"noise_density": 0.0}, "needs noise_density, resolution, or both"),
        (MZ, {"of": {"fq": 1.0}}, f"of has no 'fq': there are {', '.join(LOADS)}"),
        (MZ, {"field": "w"}, "field must be x, y or z"),
        (MZ, {"field": "x", "of": {"fx": 1.0}}, "not both"),
        (MZ, {"name": "volts"}, "volts is no load; say what it reads with of"),
        (MZ, {"unit": "V"}, "mz is in N m; say what it reads"),
        (SENSOR, {"channels": ()}, "at least one [[sensor.channel]]"),
        (SENSOR, {"channels": (MZ, MZ)}, "two channels are called 'mz'"),
        (SENSOR, {"rate_hz": 0.0}, "rate_hz must be more than 0"),
        (SENSOR, {"channels": (FIELD,)}, "there is no [sensor.magnet]"),
        (SENSOR, {"matrix": {"A0": ((1.0, 2.0),)}}, "matrix of whisker A0 must have 1 rows"),
        (
            SENSOR,
            {"channels": (FIELD,), "magnet": MAGNET, "matrix": {"A0": ((0.0,) * 6,)}},
            "which a matrix cannot describe",
        ),
        (MAGNET, {"moment_a_m2": 0.0}, "must not be 0"),
        (MAGNET, {"sensor_mm": (0, 0, 0)}, "must be apart"),
        (MAGNET, {"sensor_mm": (0, 0, float("inf"))}, "must be finite"),
    ],
)
def test_specs_that_cannot_be(spec, what, why):
    with pytest.raises(ConfigError) as error:
        dataclasses.replace(spec, **what)  # type: ignore[type-var]
    assert why in str(error.value)
