import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk, SourceStats, concatenate
from tactile_rt.recording.description import describe
from tactile_rt.sim_backend import source as source_module
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.objects.catalogue import CATEGORIES
from tactile_rt.sim_backend.source import CHUNK_SAMPLES, REST_SAMPLES, SimOptions, SimSource
from tactile_rt.sim_backend.sweep_simulation import ringing
from tactile_rt.sim_backend.world import PROFILES
from tactile_rt.sources.opening import open_source
from tests.helpers.source_contract import take


def fast(**options: str | float) -> SimSource:
    """A source that does not wait for the clock."""
    return SimSource("mouse", SimOptions(pace="fast", **options))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def two_passes() -> tuple[SimSource, Chunk]:
    """A stream to its end, and the source that it came from."""
    source = fast(objects="bottle-3,gear", sweeps=2, seed=4)
    return source, concatenate(list(source))


def test_the_same_seed_gives_the_same_stream() -> None:
    n = REST_SAMPLES + 200
    one, same, other = (fast(objects="mug-1,bowl-1", seed=s) for s in (3, 3, 4))
    a, b, c = take(one, n), take(same, n), take(other, n)
    assert np.abs(a.values).max() > 0
    np.testing.assert_array_equal(a.values, b.values)
    np.testing.assert_array_equal(a.t_ns, b.t_ns)
    assert one.passes == same.passes != other.passes
    assert not np.array_equal(a.values, c.values)


def test_loads_are_felt_only_while_an_object_passes(two_passes: tuple[SimSource, Chunk]) -> None:
    source, stream = two_passes
    assert {p.name for p in source.passes} == {"bottle-3", "gear-0"}
    assert {p.category for p in source.passes} == {"bottle", "gear"}
    assert stream.valid.all()
    starts = [int(np.searchsorted(stream.t_ns, p.start_ns)) for p in source.passes]
    assert starts[0] == 0
    for passed, start, end in zip(source.passes, starts, [*starts[1:], len(stream)], strict=True):
        felt = np.abs(stream.values[start:end, :, :3]).max(axis=(1, 2)) > 1e-9
        assert not felt[:REST_SAMPLES].any(), "rest comes first"
        gap = passed.sweep.gap_mm / passed.sweep.speed_mm_s * 1e3
        onset = int(np.argmax(felt)) - REST_SAMPLES
        assert gap - 8 <= onset <= gap + 8  # ms
        assert felt.sum() > 100 and not felt[-1]


def test_it_rests_after_the_last_object_so_that_its_episode_ends(
    two_passes: tuple[SimSource, Chunk],
) -> None:
    _, stream = two_passes
    assert (stream.values[-REST_SAMPLES:] == 0).all()
    assert stream.values[-2 * REST_SAMPLES : -REST_SAMPLES].any()


def test_an_object_comes_several_times_in_succession() -> None:
    with fast(objects="bottle-1,mug-1", sweeps=2, repeat=2) as source:
        for _ in source:
            pass
    names = [p.name for p in source.passes]
    assert sorted(names) == ["bottle-1"] * 2 + ["mug-1"] * 2
    assert names[0] == names[1] and names[2] == names[3]
    assert len({p.sweep for p in source.passes}) == 4  # but never twice the same way


def test_a_whisker_that_is_dragged_along_is_followed_until_it_is_free() -> None:
    """A whisker of 75 mm is bent by far more than a bottle is thick, and slips off behind it."""
    url = "sim:mlx_hex?objects=bottle-128&sweeps=1&pace=fast&seed=1&distance_mm=50&yaw_deg=10"
    with open_source(f"{url}&speed_mm_s=30") as source:
        values = concatenate(list(source)).values[:, 0]
    load = np.linalg.norm(values - np.median(values[:400], axis=0), axis=1)
    (loaded,) = np.nonzero(load > 0.1 * load.max())
    assert load[loaded[-1]] < 0.5 * load.max(), "it swings before it is at rest"


def test_sweeps_are_drawn_as_a_recipe_draws_them(tmp_path: Path) -> None:
    recipe = tmp_path / "fast.toml"
    recipe.write_text(
        """name = "fast"
        [sweeps]
        speed_mm_s = { between = [100, 200] }
        roll_deg = { each = [10, 20] }
        height_mm = -1
        """
    )
    with fast(objects="mug", sweeps=6, recipe=str(recipe), height_mm=1) as source:
        list(source)
    passed = [p.sweep for p in source.passes]
    assert all(100 <= s.speed_mm_s <= 200 and s.height_mm == 1 for s in passed)
    assert {s.roll_deg for s in passed} == {10, 20}
    with pytest.raises(ConfigError, match="no recipe 'wide2'; did you mean wide24"):
        open_source("sim:mouse?recipe=wide2")


def test_all_categories_come_when_none_is_named() -> None:
    with fast() as source:
        assert source.read() is not None
        assert source.passes[0].category in CATEGORIES


def test_a_recording_names_the_version_of_the_engine(two_passes: tuple[SimSource, Chunk]) -> None:
    assert describe(two_passes[0], session={"who": "Ada"}).session == {"engine": "2", "who": "Ada"}


def test_its_url_takes_the_sensor_model() -> None:
    url = "sim:mouse?objects=mug&pace=fast&noise_force=1e-5&noise_moment=5e-8&latency_ms=2.5"
    with open_source(url) as source:
        noisy = take(source, REST_SAMPLES)
    np.testing.assert_array_equal(noisy.t_ns, noisy.seq * 1_000_000 + 2_500_000)
    noise = noisy.values.reshape(len(noisy), -1, 2, 3).std(axis=(0, 1, 3))
    np.testing.assert_allclose(noise, [1e-5, 5e-8], rtol=0.02)


def test_dropped_samples_are_missing_and_everything_else_comes_as_it_would(
    two_passes: tuple[SimSource, Chunk],
) -> None:
    source, clean = two_passes
    # So many that whole chunks of nine go missing now and then.
    with fast(objects="bottle-3,gear", sweeps=2, seed=4, drop_probability=0.7) as poor:
        left = concatenate(list(poor))
    assert poor.stats == SourceStats(delivered=len(left), missing=len(clean) - len(left))
    assert poor.stats.missing / len(clean) == pytest.approx(0.7, abs=0.05)
    assert np.diff(left.seq // CHUNK_SAMPLES).max() > 1
    for part in ("seq", "t_ns", "values", "valid"):
        np.testing.assert_array_equal(getattr(left, part), getattr(clean, part)[left.seq])
    assert poor.passes == source.passes


class Clock:
    """A clock that goes on only while somebody sleeps; stands in for the module `time`."""

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """What simulated sources take for the time: no busy machine is late by it."""
    ours = Clock()
    monkeypatch.setattr(source_module, "time", ours)
    return ours


def test_in_real_time_samples_come_when_they_are_due(clock: Clock) -> None:
    with SimSource("mouse", SimOptions(objects="mug")) as source:
        began = clock.now_ns
        chunks = []
        for _ in range(33):
            chunk = source.read()
            assert chunk is not None and chunk.t_ns[-1] == clock.now_ns
            chunks.append(chunk)
        stream = concatenate(chunks)
        assert stream.t_ns[0] == began
        assert stream.t_ns[-1] - stream.t_ns[0] == (len(stream) - 1) * 1_000_000


def test_a_read_without_patience_gets_none_until_samples_are_due(clock: Clock) -> None:
    with SimSource("mouse", SimOptions(objects="mug")) as source:
        chunks, refused = [], 0
        while len(chunks) < 12:  # over 100 ms
            before = clock.now_ns
            chunk = source.read(0.0)
            assert clock.now_ns == before
            if chunk is None:
                refused += 1
                clock.sleep(1e-3)
            else:
                assert chunk.t_ns[-1] <= clock.now_ns
                chunks.append(chunk)
        stream = concatenate(chunks)  # what was refused was not lost
        np.testing.assert_array_equal(stream.seq, np.arange(len(stream)))
        assert refused == len(stream) - 1  # a sample a millisecond


def test_a_read_waits_no_longer_than_asked(clock: Clock) -> None:
    with SimSource("mouse", SimOptions(objects="mug")) as source:
        source.read()
        for _ in range(20):
            began = clock.now_ns
            chunk = source.read(0.002)
            took = clock.now_ns - began
            assert took == 2_000_000 if chunk is None else took < 2_000_000 + 1


def test_a_simulation_without_a_processor_stands_still_and_counts_it(clock: Clock) -> None:
    with (
        SimSource("mouse", SimOptions(objects="mug", seed=2)) as source,
        fast(objects="mug", seed=2) as whole,
    ):
        chunks = []
        for number in range(90):
            if number == 30:
                clock.sleep(0.09)  # late, and caught up with
            if number == 60:
                clock.sleep(0.5)
            chunk = source.read()
            assert chunk is not None and chunk.t_ns[-1] <= clock.now_ns
            chunks.append(chunk)
        stream = concatenate(chunks)
        (at,) = np.flatnonzero(np.diff(stream.seq) != 1)
        left_out = int(stream.seq[at + 1] - stream.seq[at]) - 1
        assert 400 < left_out <= 500, "a sample a millisecond"
        assert source.stats == SourceStats(delivered=len(stream), dropped=left_out)
        assert np.array_equal(stream.t_ns - stream.t_ns[0], 1_000_000 * stream.seq)
        # What it felt goes on from where it stood.
        np.testing.assert_array_equal(stream.values, take(whole, len(stream)).values)


def test_its_url_takes_randomised_arrays() -> None:
    """Drawn afresh for every sweep; objects come as they would, and the spec is the design's."""
    url = "sim:mouse?objects=mug-1,bowl-1&pace=fast&sweeps=2&seed=3&young_modulus=0.3&mount_mm=0.2"
    with (
        open_source(url) as one,
        open_source(url) as same,
        fast(objects="mug-1,bowl-1", sweeps=2, seed=3) as plain,
    ):
        stream, again = (concatenate(list(source)) for source in (one, same))
        ideal = concatenate(list(plain))
        assert isinstance(one, SimSource)
        assert one.spec == plain.spec
        assert [p.name for p in one.passes] == [p.name for p in plain.passes]
        assert one.passes[0].sweep == plain.passes[0].sweep
    np.testing.assert_array_equal(stream.values, again.values)
    n = REST_SAMPLES + 500
    felt, meant = stream.values[:n], ideal.values[:n]
    assert 0.01 < np.linalg.norm(felt - meant) / np.linalg.norm(meant) < 1


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"friction": 1.5}, "friction is relative and must be less than 1, not 1.5"),
        ({"profile": "quick"}, "no profile 'quick': there are realtime, dataset, accurate"),
        ({"repeat": 0}, "repeat 1 or more"),
    ],
)
def test_bad_options_are_refused(options: dict[str, int], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        SimOptions(**options)  # type: ignore[arg-type]


def test_what_is_compiled_is_so_before_the_clock_begins(monkeypatch) -> None:
    asked: list[int] = []
    simulation = source_module.draw_simulation

    def told(*arguments):
        sweep, made = simulation(*arguments)
        made.advance = asked.append
        return sweep, made

    monkeypatch.setattr(source_module, "draw_simulation", told)
    source_module.compile_simulator.cache_clear()
    SimSource("mouse", SimOptions(objects="mug")).close()
    fast(objects="mug").close()
    assert asked == [1]


ROBOT = Path(__file__).parents[2] / "docs" / "arrays" / "robot.toml"


def test_whiskers_that_ring_as_they_should_are_not_told_of() -> None:
    for profile in PROFILES.values():
        assert ringing((load_array("mouse"),), profile) == ""
        assert ringing((load_array(str(ROBOT)),), profile) == ""


def test_whiskers_that_ring_too_shortly_are_told_of_in_one_line() -> None:
    array = load_array(str(ROBOT))
    wires = tuple(replace(w, damping_ratio=0.001 * (i + 1)) for i, w in enumerate(array.whiskers))
    line = ringing((replace(array, whiskers=wires),), PROFILES["realtime"])
    assert "of 8 whiskers ring shorter than they should at steps of 0.5 ms, A0 with a" in line
    assert "instead of 0.001" in line and line.count("\n") == 0


def test_loads_beyond_the_sensor_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    url = f"sim:{ROBOT}?objects=bottle-3&pace=fast&sweeps=1&seed=4&range_force=1e-5"
    with caplog.at_level(logging.WARNING), open_source(url) as source:
        list(source)
    told = [r.getMessage() for r in caplog.records]
    assert sum("is beyond the 1e-05 N that the sensor can read" in line for line in told) == 1
