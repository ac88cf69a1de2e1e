"""Every effect alone against its definition, and all of them under any cutting into chunks."""

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import welch

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk, concatenate
from tactile_rt.sim_backend.sensor import FULL_SCALE, Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel

PERIOD_NS = 1_000_000

EVERYTHING = SensorModel(
    gain=0.05,
    crosstalk_channels=0.02,
    crosstalk_elements=0.03,
    bias_force=1e-5,
    bias_moment=5e-8,
    drift_force=2e-5,
    drift_moment=1e-7,
    drift_time_s=0.5,
    noise_force=1e-5,
    noise_moment=5e-8,
    flicker_force=1e-5,
    flicker_moment=5e-8,
    bandwidth_hz=100.0,
    hysteresis_force=2e-6,
    hysteresis_moment=2e-8,
    dead_probability=0.2,
    range_force=2e-4,
    range_moment=2e-6,
    resolution_force=1e-6,
    resolution_moment=1e-8,
    latency_ms=2.5,
    jitter_ms=1.5,
    drop_probability=0.2,
)


def grid_spec(rows: int = 3, columns: int = 4) -> ArraySpec:
    """A full grid of elements with forces and moments, and a temperature."""
    cells = [(r, c) for r in range(rows) for c in range(columns)]
    return ArraySpec(
        name="grid",
        elements=tuple(f"{'ABCDEFGHIJ'[r]}{c}" for r, c in cells),
        grid=tuple(cells),
        positions=((0.0, 0.0, 0.0),) * len(cells),
        orientations=((1.0, 0.0, 0.0, 0.0),) * len(cells),
        channels=("fx", "fy", "fz", "mx", "my", "mz", "temperature"),
        units=("N", "N", "N", "N m", "N m", "N m", "K"),
        rate_hz=1e9 / PERIOD_NS,
        frame="mount",
    )


SPEC = grid_spec()
FORCE, MOMENT, OTHER = slice(0, 3), slice(3, 6), slice(6, 7)
SCALE = np.array([1e-4] * 3 + [1e-6] * 3 + [300.0])


def stream(values: NDArray[np.float64], period_ns: int = PERIOD_NS) -> Chunk:
    """Evenly spaced, wholly valid samples, the first of them at 7 s."""
    seq = np.arange(len(values), dtype=np.int64)
    valid = np.ones(values.shape[:2], dtype=np.bool_)
    return Chunk(seq, 7_000_000_000 + seq * period_ns, values.astype(np.float32), valid)


def rest(n: int, spec: ArraySpec = SPEC) -> Chunk:
    """No load at all."""
    return stream(np.zeros((n, *spec.shape)))


def busy(n: int) -> Chunk:
    """Loads of a sweep's size, a few of them far beyond any range."""
    rng = np.random.default_rng(5)
    return stream(rng.standard_t(3, (n, *SPEC.shape)) * SCALE)


def sensed(model: SensorModel, chunk: Chunk, seed: int = 0, spec: ArraySpec = SPEC) -> Chunk:
    """What the host receives of one chunk."""
    received = Sensor(model, spec, seed).push(chunk)
    assert received is not None
    return received


def same(one: Chunk, other: Chunk) -> None:
    for name in ("seq", "t_ns", "values", "valid"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


# All together


def test_off_by_default_it_passes_the_very_same_chunk() -> None:
    chunk = busy(20)
    sensor = Sensor(SensorModel(), SPEC)
    assert sensor.push(chunk) is chunk
    assert not sensor.dead.any() and not sensor.bias.any()
    assert sensor.saturated == sensor.dropped == 0


def test_every_field_does_something() -> None:
    """No effect is forgotten: switching any one off changes the stream."""
    chunk = busy(300)
    everything = replace(EVERYTHING, dead_row_probability=0.5)
    full = sensed(everything, chunk)
    for f in fields(SensorModel):
        less = sensed(replace(everything, **{f.name: f.default}), chunk)
        values, times = (
            np.array_equal(getattr(less, p), getattr(full, p)) for p in ("values", "t_ns")
        )
        assert not (values and times), f.name


BUSY = busy(60)
WHOLE = Sensor(EVERYTHING, SPEC, 11)
RECEIVED = WHOLE.push(BUSY)


@settings(max_examples=60, deadline=None)
@given(cuts=st.sets(st.integers(1, len(BUSY) - 1)))
def test_the_cutting_into_chunks_changes_nothing(cuts: set[int]) -> None:
    edges = itertools.pairwise([0, *sorted(cuts), len(BUSY)])
    sensor = Sensor(EVERYTHING, SPEC, 11)
    out = [sensor.push(BUSY.select(slice(a, b))) for a, b in edges]
    assert RECEIVED is not None
    same(concatenate([c for c in out if c is not None]), RECEIVED)
    assert (sensor.saturated, sensor.dropped) == (WHOLE.saturated, WHOLE.dropped)
    assert sensor.saturated > 0 and sensor.dropped > 0


def test_the_seed_decides_everything() -> None:
    chunk = busy(50)
    same(sensed(EVERYTHING, chunk, 3), sensed(EVERYTHING, chunk, 3))
    other = sensed(EVERYTHING, chunk, 4)
    first = sensed(EVERYTHING, chunk, 3)
    assert not np.array_equal(first.t_ns[:5], other.t_ns[:5])
    assert not np.array_equal(first.values[0], other.values[0])
    model = SensorModel(noise_force=1e-5)
    one, two = (Sensor(model, SPEC, [1, s]).push(chunk) for s in (2, 3))
    assert one is not None and two is not None and not np.array_equal(one.values, two.values)


def test_the_input_is_left_alone_and_types_are_kept() -> None:
    chunk = busy(50)
    copies = [p.copy() for p in vars(chunk).values()]
    received = sensed(EVERYTHING, chunk)
    for part, copy in zip(vars(chunk).values(), copies, strict=True):
        np.testing.assert_array_equal(part, copy)
    assert [p.dtype for p in vars(received).values()] == ["int64", "int64", "float32", "bool"]


def test_switching_an_effect_on_leaves_the_draws_of_the_others_alone() -> None:
    chunk = rest(400)
    noisy = SensorModel(noise_force=1e-5, noise_moment=1e-7)
    noise = sensed(noisy, chunk).values
    for more in (
        {"bias_force": 1e-4},
        {"drift_moment": 1e-5},
        {"gain": 0.1, "crosstalk_channels": 0.1},
        {"jitter_ms": 1.0},
    ):
        both = sensed(replace(noisy, **more), chunk).values
        alone = sensed(replace(SensorModel(), **more), chunk).values
        np.testing.assert_allclose(both - alone, noise, rtol=0, atol=1e-10)
    kept = sensed(replace(noisy, drop_probability=0.3), chunk)
    np.testing.assert_array_equal(kept.values, noise[kept.seq])


def test_channels_of_other_units_have_no_force_or_moment_errors() -> None:
    chunk = busy(200)
    only = replace(EVERYTHING, gain=0, crosstalk_elements=0, dead_probability=0, drop_probability=0)
    only = replace(only, bandwidth_hz=0)
    received = sensed(only, chunk)
    np.testing.assert_array_equal(received.values[..., OTHER], chunk.values[..., OTHER])


# Values


def test_noise_is_white_with_the_stated_deviation() -> None:
    n = 4000
    values = sensed(SensorModel(noise_force=2e-5, noise_moment=3e-8), rest(n)).values
    np.testing.assert_allclose(values[..., FORCE].std(axis=0), 2e-5, rtol=0.06)
    np.testing.assert_allclose(values[..., MOMENT].std(axis=0), 3e-8, rtol=0.06)
    flat = (values[..., :6] / ([2e-5] * 3 + [3e-8] * 3)).reshape(n, -1)
    assert np.abs(flat.mean(axis=0)).max() < 5 / np.sqrt(n)
    across = np.corrcoef(flat.T) - np.eye(flat.shape[1])
    along = (flat[1:] * flat[:-1]).mean(axis=0)
    assert np.abs(across).max() < 6 / np.sqrt(n) and np.abs(along).max() < 6 / np.sqrt(n)


def test_bias_is_constant_and_spread_over_channels() -> None:
    spec = grid_spec(10, 40)
    sensor = Sensor(SensorModel(bias_force=1e-4, bias_moment=2e-6), spec, 2)
    received = sensor.push(rest(5, spec))
    assert received is not None
    assert (received.values == received.values[0]).all()
    np.testing.assert_allclose(received.values[0], sensor.bias, rtol=1e-6)
    assert received.values[0, :, FORCE].std() == pytest.approx(1e-4, rel=0.07)
    assert received.values[0, :, MOMENT].std() == pytest.approx(2e-6, rel=0.07)


@pytest.mark.parametrize("period_ns", [PERIOD_NS, 50 * PERIOD_NS])
def test_drift_has_its_spread_and_forgets_in_its_time(period_ns: int) -> None:
    """Against the autocovariance sigma^2 exp(-t / tau), at two sample rates."""
    sigma, tau, spec = 1e-4, 0.4, grid_spec(10, 20)
    chunk = stream(np.zeros((900, *spec.shape)), period_ns)
    model = SensorModel(drift_force=sigma, drift_time_s=tau)
    drift = sensed(model, chunk, 1, spec).values[..., FORCE].reshape(len(chunk), -1) / sigma
    for sample in (0, 450, 899):  # 600 channels: the spread is the same at all times
        assert drift[sample].std() == pytest.approx(1, rel=0.12)
    for lag in (1, 8, 400):
        expected = np.exp(-lag * period_ns * 1e-9 / tau)
        measured = (drift[:-lag] * drift[lag:]).mean() / (drift**2).mean()
        assert measured == pytest.approx(expected, abs=0.05)
    step = np.diff(drift, axis=0).std()
    assert step == pytest.approx(np.sqrt(2 - 2 * np.exp(-period_ns * 1e-9 / tau)), rel=0.05)


def test_drift_goes_on_through_a_gap_in_time() -> None:
    spec = grid_spec(10, 20)
    chunk = rest(2, spec)
    late = replace(chunk, t_ns=chunk.t_ns + np.array([0, 3_000_000_000]))
    drift = sensed(SensorModel(drift_force=1, drift_time_s=1), late, 1, spec).values[..., FORCE]
    alike = np.corrcoef(drift[0].ravel(), drift[1].ravel())[0, 1]
    assert alike == pytest.approx(np.exp(-3), abs=0.12)


def test_gain_is_a_constant_factor_of_each_channel() -> None:
    spec = grid_spec(10, 40)
    chunk = stream(np.linspace(1, 3, 5)[:, None, None] * np.ones((5, *spec.shape)))
    factor = sensed(SensorModel(gain=0.02), chunk, 1, spec).values / chunk.values
    np.testing.assert_allclose(factor, np.broadcast_to(factor[0], factor.shape), rtol=1e-6)
    assert factor[0].std() == pytest.approx(0.02, rel=0.07)
    assert factor[0].mean() == pytest.approx(1, abs=0.002)


def test_channels_leak_a_bounded_share_of_full_scale_and_not_into_themselves() -> None:
    share = 0.04
    model = SensorModel(crosstalk_channels=share)
    full = np.array([FULL_SCALE.get(u, 0.0) for u in SPEC.units])
    leaks = []
    for source in range(6):
        values = np.zeros((2, *SPEC.shape))
        values[:, 5, source] = full[source] * np.array([1.0, -0.5])
        out = sensed(model, stream(values), 3).values.astype(float)
        assert not np.delete(out, 5, axis=1).any(), "stays within the element"
        assert out[0, 5, source] == pytest.approx(full[source])
        assert out[0, 5, 6] == 0
        np.testing.assert_allclose(out[1], -0.5 * out[0], rtol=1e-6)
        leaks += list(np.delete(out[0, 5, :6] / full[:6], source))
    assert np.abs(leaks).max() <= share and np.abs(leaks).max() > 0.8 * share
    assert min(leaks) < 0 < max(leaks)


def test_elements_leak_into_their_neighbours_on_the_grid() -> None:
    values = np.zeros((1, *SPEC.shape))
    at = {cell: i for i, cell in enumerate(SPEC.grid)}
    values[0, at[0, 1]] = SCALE
    values[0, at[1, 2]] = 10 * SCALE
    out = sensed(SensorModel(crosstalk_elements=0.1), stream(values)).values[0] / SCALE
    expected = {(0, 0): 0.1, (0, 1): 1, (0, 2): 1.1, (1, 1): 1.1}
    expected |= {(1, 2): 10, (1, 3): 1, (2, 2): 1}
    for cell, i in at.items():
        np.testing.assert_allclose(out[i], expected.get(cell, 0.0), rtol=1e-6)


def test_an_untrustworthy_reading_leaks_nothing() -> None:
    chunk = busy(3)
    chunk.values[1, 4] = np.nan
    chunk.valid[1, 4] = False
    model = SensorModel(gain=0.1, crosstalk_channels=0.1, crosstalk_elements=0.1)
    out = sensed(model, chunk)
    np.testing.assert_array_equal(out.valid, chunk.valid)
    untouched = chunk.values.copy()
    untouched[1, 4] = 0
    same(out, sensed(model, replace(chunk, values=untouched)))


def test_saturation_clips_and_counts() -> None:
    values = np.zeros((4, *SPEC.shape))
    values[0, 0, 0], values[1, 2, 1], values[2, 3, 5] = 3e-4, -1.5e-4, 1e-5
    values[3, 1, 0], values[3, 1, 4] = 0.5e-4, -2e-6
    sensor = Sensor(SensorModel(range_force=1e-4, range_moment=2e-6), SPEC)
    out = sensor.push(stream(values))
    assert out is not None
    expected = values.copy()
    expected[0, 0, 0], expected[1, 2, 1], expected[2, 3, 5] = 1e-4, -1e-4, 2e-6
    np.testing.assert_array_equal(out.values, expected.astype(np.float32))
    assert sensor.saturated == 3


def test_quantisation_rounds_to_the_nearest_step() -> None:
    values = np.zeros((1, *SPEC.shape))
    values[0, :6, 0] = np.array([0.4, 0.6, -0.6, 7.2, -7.49, 0.0]) * 1e-5
    values[0, :3, 3] = np.array([2.6, -3.4, 0.2]) * 1e-8
    out = sensed(SensorModel(resolution_force=1e-5, resolution_moment=1e-8), stream(values))
    np.testing.assert_allclose(out.values[0, :6, 0] / 1e-5, [0, 1, -1, 7, -7, 0], rtol=1e-6)
    np.testing.assert_allclose(out.values[0, :3, 3] / 1e-8, [3, -3, 0], rtol=1e-6)
    force_only = sensed(SensorModel(resolution_force=1e-5), stream(values)).values
    np.testing.assert_array_equal(force_only[0, :, 3], values[0, :, 3].astype(np.float32))


def test_flicker_has_the_density_and_the_allan_deviation_it_should() -> None:
    """A^2 / f over three decades; an Allan deviation of A sqrt(2 ln 2) at every averaging time."""
    spec = grid_spec(2, 2)
    wanted = 1e-5
    n, rate = 60_000, 1e9 / PERIOD_NS
    out = sensed(SensorModel(flicker_force=wanted), rest(n, spec), 4, spec)
    force = out.values[..., FORCE].reshape(n, -1).astype(np.float64)
    f, density = welch(force, rate, nperseg=n // 6, axis=0)
    for low, high in ((0.3, 3), (3, 30), (30, 0.2 * rate)):
        band = (f > low) & (f < high)
        found = (density[band].mean(axis=1) * f[band]).mean()
        assert found == pytest.approx(wanted**2, rel=0.2), (low, high)
    for samples in (4, 40, 400):
        means = force[: n // samples * samples].reshape(-1, samples, force.shape[1]).mean(axis=1)
        allan = np.sqrt(np.mean(np.diff(means, axis=0) ** 2) / 2)
        assert allan == pytest.approx(wanted * np.sqrt(2 * np.log(2)), rel=0.15), samples
    assert not out.values[..., MOMENT].any()


def test_a_bandwidth_damps_and_delays_as_a_first_order_low_pass() -> None:
    corner, n = 5.0, 4000
    t = np.arange(n) * PERIOD_NS * 1e-9
    for hertz in (0.5, 5.0, 10.0):
        values = np.zeros((n, *SPEC.shape))
        values[:, 0, 0] = np.sin(2 * np.pi * hertz * t)
        out = sensed(SensorModel(bandwidth_hz=corner), stream(values)).values[:, 0, 0]
        late = slice(n // 2, None)
        gain = 2 * np.mean(out[late] * np.exp(-2j * np.pi * hertz * t[late])) * 1j
        # the load of a sample is held from the sample before on: a step of the exact filter
        z = np.exp(2j * np.pi * hertz * PERIOD_NS * 1e-9)
        keep = np.exp(-2 * np.pi * corner * PERIOD_NS * 1e-9)
        assert gain == pytest.approx((1 - keep) / (1 - keep / z), abs=0.02)
    step = np.zeros((n, *SPEC.shape))
    step[10:] = SCALE
    out = sensed(SensorModel(bandwidth_hz=corner), stream(step)).values
    expected = 1 - np.exp(-2 * np.pi * corner * PERIOD_NS * 1e-9 * np.arange(1, 51))
    np.testing.assert_allclose(out[10:60, 1, 3] / SCALE[3], expected, rtol=1e-5)


def test_hysteresis_is_a_loop_of_the_stated_width_at_every_rate() -> None:
    half = 2e-5
    for n in (200, 2000):
        there_and_back = 1e-4 * np.sin(np.linspace(0, 4 * np.pi, n))
        values = np.zeros((n, *SPEC.shape))
        values[:, 0, 0] = there_and_back
        out = sensed(SensorModel(hysteresis_force=half), stream(values)).values[:, 0, 0]
        second = slice(n // 2, None)
        load, reading = there_and_back[second], out[second]
        rising = np.gradient(load) > 0
        assert abs(reading - load).max() <= half * (1 + 1e-5)
        up = np.interp(0.0, load[rising], reading[rising])
        down = np.interp(0.0, load[~rising][::-1], reading[~rising][::-1])
        assert down - up == pytest.approx(2 * half, rel=0.05)
    small = np.zeros((50, *SPEC.shape))
    small[:, 0, 0] = half * 0.99 * np.sin(np.arange(50))
    assert not sensed(SensorModel(hysteresis_force=half), stream(small)).values.any()


def test_dead_elements_read_their_bias_for_ever_and_look_valid() -> None:
    spec = grid_spec(10, 40)
    rng = np.random.default_rng(0)
    chunk = stream(rng.standard_normal((20, *spec.shape)))
    sensor = Sensor(SensorModel(dead_probability=0.25), spec, 1)
    out = sensor.push(chunk)
    assert out is not None
    assert sensor.dead.mean() == pytest.approx(0.25, abs=0.06)
    assert not out.values[:, sensor.dead].any() and out.valid.all()
    np.testing.assert_array_equal(out.values[:, ~sensor.dead], chunk.values[:, ~sensor.dead])

    model = replace(EVERYTHING, drop_probability=0, resolution_force=0, range_force=0)
    sensor = Sensor(replace(model, resolution_moment=0, range_moment=0), spec, 1)
    out = sensor.push(chunk)
    assert out is not None
    stuck = out.values[:, sensor.dead]
    np.testing.assert_array_equal(stuck, np.broadcast_to(stuck[0], stuck.shape))
    np.testing.assert_allclose(stuck[0], sensor.bias[sensor.dead], rtol=1e-6)


# Time


def test_latency_moves_the_time_stamps_and_nothing_else() -> None:
    chunk = busy(20)
    out = sensed(SensorModel(latency_ms=3.25), chunk)
    np.testing.assert_array_equal(out.t_ns, chunk.t_ns + 3_250_000)
    assert out.values is chunk.values and out.seq is chunk.seq and out.valid is chunk.valid


@pytest.mark.parametrize("jitter_ms", [0.5, 1.0, 1.5, 5.0, 20.0])
def test_jitter_of_any_length_keeps_its_mean_and_the_order(jitter_ms: float) -> None:
    """At a kilohertz, where most samples would overtake each other if each were late by itself."""
    n = 400_000 if jitter_ms > 4 else 60_000
    spec = replace(grid_spec(1, 1), rate_hz=1000.0)
    chunk = rest(n, spec)
    out = sensed(SensorModel(latency_ms=2.0, jitter_ms=jitter_ms), chunk, 3, spec)
    gaps = np.diff(out.t_ns)
    assert (gaps > 0).all()
    assert (gaps == 1).mean() < 0.01, "nothing piles up"
    delay = (out.t_ns - chunk.t_ns) * 1e-6 - 2.0
    assert delay.min() >= 0
    assert delay.mean() == pytest.approx(jitter_ms, rel=0.15 if jitter_ms > 4 else 0.05)
    assert delay.std() == pytest.approx(jitter_ms, rel=0.25 if jitter_ms > 4 else 0.1)


def test_dropped_samples_leave_gaps_and_are_counted() -> None:
    chunk = busy(5000)
    sensor = Sensor(SensorModel(drop_probability=0.1), SPEC, 1)
    out = sensor.push(chunk)
    assert out is not None
    assert len(out) + sensor.dropped == 5000
    assert sensor.dropped == pytest.approx(500, abs=5 * np.sqrt(450))
    assert (np.diff(out.seq) >= 1).all() and (np.diff(out.seq) > 1).any()
    for part in ("t_ns", "values", "valid"):
        np.testing.assert_array_equal(getattr(out, part), getattr(chunk, part)[out.seq])
    # Independent: a drop is followed by a drop no more often than by anything else.
    lost = np.setdiff1d(np.arange(5000), out.seq)
    assert (np.diff(lost) == 1).mean() == pytest.approx(0.1, abs=0.06)


# Configuration


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"noise_force": -1e-6}, "noise_force must be 0 or more, not -1e-06"),
        ({"jitter_ms": 1e300}, "jitter_ms must be at most 1e[+]06, not 1e[+]300"),
        ({"crosstalk_elements": 1.5}, "crosstalk_elements must lie between 0 and 1, not 1.5"),
        ({"drop_probability": 1}, "drop_probability must be less than 1, not 1"),
        ({"drift_time_s": 0}, "drift_time_s must be more than 0"),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        SensorModel(**given)


def test_whole_rows_die() -> None:
    rows = {row for row, _ in SPEC.grid}
    counts = []
    for seed in range(300):
        dead = Sensor(SensorModel(dead_row_probability=0.3), SPEC, seed).dead
        of_row = {row: {bool(d) for d, (r, _) in zip(dead, SPEC.grid, strict=True) if r == row}
                  for row in rows}  # fmt: skip
        assert all(len(both) == 1 for both in of_row.values())
        counts.append(sum(True in both for both in of_row.values()))
    assert np.mean(counts) == pytest.approx(0.3 * len(rows), rel=0.15)
    alone = SensorModel(dead_probability=0.3)
    both = SensorModel(dead_probability=0.3, dead_row_probability=1e-9)
    assert (Sensor(alone, SPEC, 4).dead == Sensor(both, SPEC, 4).dead).all()
