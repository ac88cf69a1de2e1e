import itertools
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.stream import NS_PER_S, Chunk, concatenate
from tactile_rt.testing import cut_chunks, small_spec

PERIOD_NS = 9_000_000
MS = 1_000_000
SHAPE = small_spec().shape


def stream(t_ns, values, valid=None) -> Chunk:
    """A chunk of samples at any times; values (n,) go to every element and channel."""
    t_ns = np.asarray(t_ns, dtype=np.int64)
    values = np.asarray(values, dtype=np.float32)
    if values.ndim == 1:
        values = np.broadcast_to(values[:, None, None], (len(values), *SHAPE)).copy()
    if valid is None:
        valid = np.ones(values.shape[:2], dtype=bool)
    return Chunk(np.arange(len(t_ns)), t_ns, values, valid)


def push_all(resampler: Resampler, chunks: Iterable[Chunk]) -> list[Chunk]:
    return [out for chunk in chunks if (out := resampler.push(chunk)) is not None]


def resample(*chunks: Chunk, period_ns: int = PERIOD_NS, rate_hz: float = 1000.0) -> Chunk:
    return concatenate(push_all(Resampler(period_ns, rate_hz), chunks))


def regular(values, rate_hz: float = 1000.0, start_ns: int = 0) -> Chunk:
    t_ns = start_ns + np.round(np.arange(len(values)) * NS_PER_S / rate_hz)
    return stream(t_ns, values)


@st.composite
def messy_streams(draw: st.DrawFn) -> tuple[Chunk, list[int]]:
    """Jitter, lost and repeated samples, silences, NaN and dead elements; and where to cut it."""
    odd = st.sampled_from([ms * MS for ms in (0, -3, 25, 999, 1_000, 1_001, 3_333)])
    steps = draw(st.lists(st.integers(800_000, 1_200_000) | odd, min_size=20, max_size=60))
    rng = np.random.default_rng(draw(st.integers(0, 1000)))
    t_ns = draw(st.integers(-NS_PER_S, 10**15)) + np.cumsum(steps)
    values = rng.normal(size=(len(steps), *SHAPE)).astype(np.float32)
    values[rng.random(values.shape) < 0.05] = np.nan
    valid = rng.random(values.shape[:2]) < 0.9
    cuts = draw(st.lists(st.integers(1, len(steps) - 1), max_size=12, unique=True).map(sorted))
    return stream(t_ns, values, valid), cuts


@settings(max_examples=60)
@given(messy_streams(), st.sampled_from([200.0, 1000.0, 1e9 / PERIOD_NS]))
def test_the_result_does_not_depend_on_how_the_stream_was_cut(messy, rate_hz) -> None:
    chunk, cuts = messy
    edges = [0, *cuts, len(chunk)]
    whole, pieces = Resampler(PERIOD_NS, rate_hz), Resampler(PERIOD_NS, rate_hz)
    expected = whole.push(chunk)
    got = push_all(pieces, (chunk.select(slice(a, b)) for a, b in itertools.pairwise(edges)))
    assert pieces.out_of_order == whole.out_of_order
    if expected is None:
        assert got == []
        return
    joined = concatenate(got)
    for name in ("seq", "t_ns", "values", "valid"):
        assert np.array_equal(getattr(joined, name), getattr(expected, name)), name


def naive(chunk: Chunk, centre: int, half_width: int) -> np.ndarray:
    """The docstring's formula, in float64: (element, channel)."""
    dt = (chunk.t_ns - centre).astype(float)
    weight = np.where(abs(dt) < half_width, (1 + np.cos(np.pi * dt / half_width)) / 2, 0.0)
    usable = chunk.valid & np.isfinite(chunk.values).all(axis=2)
    weights = weight[:, None, None] * usable[:, :, None]
    total = weights.sum(axis=0)
    return (weights * np.nan_to_num(chunk.values)).sum(axis=0) / np.where(total > 0, total, np.nan)


@settings(max_examples=60)
@given(
    st.integers(0, 1000), st.sampled_from([40.0, 130.0, 500.0, 1000.0, 4000.0]), st.floats(0, 0.3)
)
def test_every_output_is_the_weighted_mean_of_the_documented_kernel(seed, rate_hz, jitter) -> None:
    rng = np.random.default_rng(seed)
    n = round(0.4 * rate_hz) + 3
    times = (np.arange(n) + jitter * rng.uniform(-1, 1, n)) * NS_PER_S / rate_hz
    values = rng.normal(size=(n, *SHAPE))
    chunk = stream(np.round(times), values, rng.random((n, SHAPE[0])) < 0.95)
    out = resample(chunk, rate_hz=rate_hz)
    half_width = max(PERIOD_NS, round(NS_PER_S / rate_hz))
    assert np.array_equal(out.t_ns, chunk.t_ns[0] + half_width + out.seq * PERIOD_NS)
    assert np.array_equal(out.seq, np.arange(len(out)))
    for k in range(len(out)):
        expected = naive(chunk, int(out.t_ns[k]), half_width)
        good = out.valid[k]
        assert out.values[k][good] == pytest.approx(expected[good], abs=1e-5)
        assert (out.values[k][~good] == 0).all()


@given(st.floats(-1e3, 1e3, width=32), st.floats(20, 5000), st.integers(1, 40))
def test_a_constant_stays_that_constant(value, rate_hz, period_ms) -> None:
    period_ns = period_ms * MS
    n = round(rate_hz * (4 * period_ms / 1e3 + 4 / rate_hz)) + 2
    out = resample(regular(np.full(n, value), rate_hz), period_ns=period_ns, rate_hz=rate_hz)
    assert len(out) >= 2
    assert out.valid.all()
    assert out.values == pytest.approx(value, rel=1e-5)  # sums of up to 400 float32


@pytest.mark.parametrize(
    ("rate_hz", "tolerance"), [(1000.0, 1e-5), (1e9 / PERIOD_NS * 2.5, 1e-5), (457.0, 0.01)]
)
def test_impulse_is_conserved_wherever_it_falls(rate_hz: float, tolerance: float) -> None:
    for at in range(100, 100 + round(rate_hz * 0.03)):
        values = np.zeros(250)
        values[at] = 1.0
        out = resample(regular(values, rate_hz), rate_hz=rate_hz)
        impulse = out.values[:, 0, 0].sum() * PERIOD_NS / NS_PER_S
        assert impulse == pytest.approx(1 / rate_hz, rel=tolerance)


@pytest.mark.parametrize("f_hz", [1.0, 10.0, 30.0, 500 / 9, 80.0, 1000 / 9, 140.0, 200.0, 460.0])
def test_a_sine_is_attenuated_as_the_window_s_transform_says(f_hz: float) -> None:
    # The window's spectrum from numpy's own Hann and FFT; an analytic signal (cosine and sine in
    # two channels) makes amplitude and phase of every single output comparable with it.
    window = np.hanning(19) / np.hanning(19).sum()
    padded = np.zeros(9000)
    padded[: len(window)] = window
    spectrum = np.fft.fft(np.roll(padded, -9))
    assert abs(spectrum.imag).max() < 1e-12
    gain = np.interp(f_hz, np.arange(4500) * 1000 / 9000, spectrum.real[:4500])

    n = 600
    phase = 2 * np.pi * f_hz * np.arange(n) / 1000
    values = np.zeros((n, *SHAPE))
    values[:, :, 0], values[:, :, 1] = np.cos(phase)[:, None], np.sin(phase)[:, None]
    out = resample(stream(np.arange(n) * MS, values))
    measured = out.values[:, 0, 0] + 1j * out.values[:, 0, 1]
    expected = gain * np.exp(2j * np.pi * f_hz * out.t_ns / NS_PER_S)
    assert abs(measured - expected).max() < 2e-5


@pytest.mark.parametrize("period_ns", [PERIOD_NS, MS, 7_777_777])
def test_a_stream_of_the_output_s_period_passes_unchanged(period_ns: int) -> None:
    values = np.random.default_rng(0).normal(size=(50, *SHAPE)).astype(np.float32)
    chunk = stream(12345 + np.arange(50) * period_ns, values)
    out = resample(chunk, period_ns=period_ns, rate_hz=NS_PER_S / period_ns)
    assert np.array_equal(out.values, values[1:-1])
    assert np.array_equal(out.t_ns, chunk.t_ns[1:-1])


def test_the_delay_is_one_output_period() -> None:
    resampler = Resampler(PERIOD_NS, 1000.0)
    for chunk in cut_chunks(np.zeros((60, *SHAPE)), 1000.0, samples=1):
        out = resampler.push(chunk)
        if out is not None:
            assert chunk.t_ns[0] - out.t_ns.tolist() == [PERIOD_NS]
    assert resampler.push(stream([60 * MS], [0.0])) is None  # 63 ms completes the next one


def test_invalid_samples_do_not_count_and_other_elements_do_not_suffer() -> None:
    n = 90
    values = np.random.default_rng(0).normal(size=(n, *SHAPE))
    clean = resample(stream(np.arange(n) * MS, values))
    valid = np.ones((n, SHAPE[0]), dtype=bool)
    valid[30:60, 1] = False
    values[30:60, 1] = 1e30  # what an untrustworthy element says must not matter
    out = resample(stream(np.arange(n) * MS, values, valid))
    assert np.array_equal(out.values[:, [0, 2]], clean.values[:, [0, 2]])
    assert out.valid[:, [0, 2]].all()
    centre = out.t_ns / MS
    # A quarter of the kernel's weight lies more than 2.4 ms to one side of its centre.
    assert not out.valid[(centre >= 32) & (centre <= 57), 1].any()
    assert out.valid[(centre <= 31) | (centre >= 58), 1].all()
    assert np.isfinite(out.values).all() and abs(out.values).max() < 10
    untouched = (centre <= 30 - 9) | (centre >= 59 + 9)
    assert np.array_equal(out.values[untouched], clean.values[untouched])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_one_bad_channel_makes_the_element_s_sample_invalid(bad: float) -> None:
    n = 60
    values = np.random.default_rng(0).normal(size=(n, *SHAPE))
    values[::3, 2, 1] = bad
    flagged = np.ones((n, SHAPE[0]), dtype=bool)
    flagged[::3, 2] = False
    out = resample(stream(np.arange(n) * MS, values))
    values[::3, 2] = 0.0
    expected = resample(stream(np.arange(n) * MS, values, flagged))
    assert np.array_equal(out.values, expected.values)
    assert out.valid.all()


@pytest.mark.parametrize("start", range(9))
def test_a_lost_sample_is_the_same_as_one_marked_invalid(start: int) -> None:
    t = np.arange(start, 300)  # ms; 60 ms are lost
    there = (t < 100) | (t >= 160)
    values = np.random.default_rng(0).normal(size=(len(t), *SHAPE))
    marked = resample(stream(t * MS, values, np.repeat(there[:, None], SHAPE[0], axis=1)))
    lost = resample(stream(t * MS, values).select(there))
    for name in ("seq", "t_ns", "values", "valid"):
        assert np.array_equal(getattr(lost, name), getattr(marked, name)), name
    centre = lost.t_ns / MS
    assert not lost.valid[(centre >= 102) & (centre <= 157)].any()
    assert lost.valid[(centre <= 101) | (centre >= 158)].all()


@pytest.mark.parametrize("rate_hz", [30.0, 60.0, 100.0])
def test_a_slow_sensor_s_jitter_is_not_taken_for_loss(rate_hz: float) -> None:
    rng = np.random.default_rng(0)
    t_ns = (np.arange(200) + rng.uniform(-0.2, 0.2, 200)) * NS_PER_S / rate_hz
    out = resample(stream(t_ns, np.ones(200)), rate_hz=rate_hz)
    assert out.valid.all()


def test_a_lost_sample_of_a_jittering_stream_is_not_replaced_by_its_neighbour() -> None:
    """Here the kernel just touches the neighbours, with next to no weight."""
    rng = np.random.default_rng(0)
    t_ns = np.arange(50) * PERIOD_NS + rng.integers(-300_000, 300_000, 50)
    chunk = stream(t_ns, np.arange(50.0)).select(np.arange(50) != 20)
    out = resample(chunk, rate_hz=NS_PER_S / PERIOD_NS)
    near = abs(out.t_ns - 20 * PERIOD_NS) < PERIOD_NS // 2
    assert near.sum() == 1
    assert not out.valid[near].any()
    assert out.valid[~near].all()


@pytest.mark.parametrize("silence_ms", [1_002, 5_000, 100_000])
def test_a_long_silence_restarts_on_the_same_grid(silence_ms: int) -> None:
    t = np.concatenate([np.arange(0, 100), 99 + silence_ms + np.arange(100)])
    out = resample(stream(t * MS, np.where(t < 200, 1.0, 2.0)))
    centre = out.t_ns / MS
    assert np.array_equal(out.t_ns, PERIOD_NS + out.seq * PERIOD_NS)
    assert not ((centre > 99) & (centre < 99 + silence_ms)).any()
    assert out.valid.all()
    # The first output after the silence has its whole kernel after it.
    after = centre > 200
    assert centre[after].min() - 9 >= 99 + silence_ms
    assert centre[after].min() - 9 < 99 + silence_ms + 9
    assert out.values[after] == pytest.approx(2.0)
    assert out.values[~after] == pytest.approx(1.0)


def test_a_short_silence_is_filled_with_invalid_outputs() -> None:
    t = np.concatenate([np.arange(0, 100), 99 + 1000 + np.arange(100)])
    out = resample(stream(t * MS, np.ones(200)))
    assert np.array_equal(np.diff(out.seq), np.ones(len(out) - 1))
    assert 105 <= (~out.valid[:, 0]).sum() <= 112


def test_a_slow_sensor_is_interpolated_and_its_period_is_no_silence() -> None:
    """0.5 Hz: every sample comes after more than a second."""
    t_ns = np.arange(8) * 2 * NS_PER_S
    out = resample(stream(t_ns, np.arange(8.0)), period_ns=500 * MS, rate_hz=0.5)
    # from 2 s, the first with a whole kernel, to 12 s, the last
    assert len(out) == 21 and out.valid.all()
    assert (np.diff(out.values[:, 0, 0]) > 0).all()
    assert out.values[::4, 0, 0].tolist() == [1, 2, 3, 4, 5, 6]


def test_samples_out_of_order_are_left_out_and_counted() -> None:
    values = np.random.default_rng(0).normal(size=(100, *SHAPE))
    good = stream(np.arange(100) * MS, values)
    order = [*range(50), 49, 20, *range(50, 100), 99]  # a repeat, a straggler, a repeat at the end
    bad = good.select(np.array(order))
    expected = resample(good)
    for step in (1, 7, 200):
        resampler = Resampler(PERIOD_NS, 1000.0)
        pieces = (bad.select(slice(i, i + step)) for i in range(0, len(bad), step))
        out = concatenate(push_all(resampler, pieces))
        assert resampler.out_of_order == 3
        assert np.array_equal(out.values, expected.values)


def test_the_caller_s_samples_are_left_alone() -> None:
    chunk = regular(np.random.default_rng(0).normal(size=100))
    before = replace(chunk, values=chunk.values.copy(), t_ns=chunk.t_ns.copy())
    out = resample(chunk.select(slice(0, 50)), chunk.select(slice(50, 100)))
    out.values[:] = np.nan
    assert np.array_equal(chunk.values, before.values)
    assert np.array_equal(chunk.t_ns, before.t_ns)


@pytest.mark.parametrize("start_ns", [0, 1, 4_500_000, 9_000_000, -31_000_001, 10**15 + 7])
@pytest.mark.parametrize("rate_hz", [70.0, 1000.0])
def test_aligned_outputs_are_at_whole_periods_of_the_clock(start_ns: int, rate_hz: float) -> None:
    resampler = Resampler(PERIOD_NS, rate_hz, aligned=True)
    half = resampler.half_width_ns
    samples = regular(np.arange(400.0), rate_hz, start_ns)
    pieces = (samples.select(slice(n, n + 7)) for n in range(0, 400, 7))
    found = concatenate(push_all(resampler, pieces))
    periods = range((start_ns - 10**9) // PERIOD_NS, (int(samples.t_ns[-1]) + 10**9) // PERIOD_NS)
    filled = [
        k for k in periods
        if k * PERIOD_NS - half >= samples.t_ns[0] and k * PERIOD_NS + half <= samples.t_ns[-1]
    ]  # fmt: skip
    assert found.seq.tolist() == filled
    assert found.t_ns.tolist() == [k * PERIOD_NS for k in filled]


def test_no_more_is_kept_than_the_next_output_needs() -> None:
    resampler = Resampler(PERIOD_NS, 1000.0)
    for n in range(100):
        resampler.push(regular(np.ones(50), start_ns=n * 50 * MS))
        assert resampler._held is not None and len(resampler._held) <= 2 * 9 + 1


def test_a_silence_begins_beyond_one_second_or_two_kernels() -> None:
    for rate_hz, longest_ns in ((1000.0, NS_PER_S), (0.5, 4 * NS_PER_S)):
        for more in (0, 1):
            resampler = Resampler(PERIOD_NS, rate_hz)
            resampler.push(regular(np.ones(60), rate_hz))
            last = round(59 * NS_PER_S / rate_hz)
            out = resampler.push(regular(np.ones(60), rate_hz, start_ns=last + longest_ns + more))
            assert out is not None
            unbroken = bool((np.diff(out.seq) == 1).all()) and (
                out.t_ns[0] < last + longest_ns - resampler.half_width_ns
            )
            assert unbroken == (not more), (rate_hz, more)
