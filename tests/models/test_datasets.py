"""Training windows: the detector's onsets, noise of three kinds, and nothing lost on the way."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import MOUSE
from tactile_rt.models.datasets import SweepSet, drawn_as, join_sets, windows
from tactile_rt.models.evaluation.measures import cut_windows
from tactile_rt.models.training.batches import TrainingBatches, draw_partners
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import Sweeps
from tests.helpers.tiny_sweeps import plate

ELEMENTS, CHANNELS, SAMPLES, LEAD = 4, 6, 170, 30
SPEC = plate(1, ELEMENTS)
RATED = np.array([10e-6] * 3 + [5e-8] * 3, dtype=np.float32)
FLOOR = np.array([2e-6] * 3 + [1e-8] * 3, dtype=np.float32)


def touches(n: int, size: float = 100.0) -> np.ndarray:
    """(sweep, sample, element, channel) silent until `LEAD`, then a load that tells the sweep."""
    values = np.zeros((n, SAMPLES, ELEMENTS, CHANNELS), dtype=np.float32)
    values[:, LEAD:] = size * RATED * (1 + np.arange(n)[:, None, None, None])
    return values


def sweeps(values: np.ndarray) -> SweepSet:
    names = np.array([f"mug-{i}" for i in range(len(values))])
    manifest = SweepManifest(SPEC, 9_000_000, LEAD, ("mug",), {"train": tuple(names)})
    return SweepSet(manifest, Sweeps(values, np.arange(len(values)), names), RATED, FLOOR)


def drawn(batches: TrainingBatches, epochs: int = 1) -> list[np.ndarray]:
    """Samples, offset, sigma and labels of whole epochs."""
    parts = [[a.numpy() for a in batch] for k in range(epochs) for batch in batches.epoch(k)]
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


def noise_level(samples: np.ndarray) -> np.ndarray:
    """(window,) noise in units of the rated, by the spread of what is constant late in it."""
    late = samples.reshape(len(samples), -1, ELEMENTS, CHANNELS)[:, 40:100].astype(np.float64)
    return (late.std(axis=1) / RATED).mean(axis=(1, 2))


def test_windows_are_cut_where_they_start_and_repeat_the_last_sample() -> None:
    values = np.arange(2 * SAMPLES, dtype=np.float32).reshape(2, SAMPLES, 1, 1)
    cut = windows(values, np.array([7, SAMPLES - 3]))
    assert cut.shape == (2, MOUSE.steps, MOUSE.substeps, 1, 1)
    assert cut[0].ravel().tolist() == list(range(7, 7 + MOUSE.steps * MOUSE.substeps))
    last = 2 * SAMPLES - 1
    assert cut[1].ravel()[:4].tolist() == [last - 2, last - 1, last, last]
    assert (cut[1].ravel()[2:] == last).all()


def test_an_epoch_has_every_sweep_once_and_depends_on_seed_and_number_alone() -> None:
    data = sweeps(touches(12))
    batches = TrainingBatches(data, 4, seed=1)
    assert len(batches) == 3
    first = drawn(batches)
    assert sorted(first[3]) == list(range(12))
    for a, b in zip(first, drawn(TrainingBatches(data, 4, seed=1)), strict=True):
        assert np.array_equal(a, b)
    other = [a.numpy() for a in next(batches.epoch(1))]
    assert not np.array_equal(other[0], first[0][:4])
    seeded = [a.numpy() for a in next(TrainingBatches(data, 4, seed=2).epoch(0))]
    assert not np.array_equal(seeded[0], first[0][:4])


def test_two_views_of_an_epoch_share_the_sweeps_and_nothing_that_is_drawn() -> None:
    batches = TrainingBatches(sweeps(touches(24)), 8, seed=1)
    for one, other in zip(batches.epoch(3), batches.epoch(3, view=1), strict=True):
        (samples, offset, sigma, labels), (samples2, offset2, sigma2, labels2) = one, other
        assert labels.tolist() == labels2.tolist()
        # no window is the same twice, clean ones included: gains differ
        alike = np.isclose(samples.numpy(), samples2.numpy(), rtol=1e-6, atol=0)
        assert (alike & (samples != 0).numpy()).mean() < 0.01
        assert not np.array_equal(offset, offset2) or not np.array_equal(sigma, sigma2)


@given(st.lists(st.integers(0, 5), min_size=1, max_size=30), st.integers(0, 2**32 - 1))
def test_partners_are_others_of_the_same_object(objects: list[int], seed: int) -> None:
    names = np.array([f"mug-{i}" for i in objects])
    found = draw_partners(names, np.random.default_rng(seed))
    assert sorted(found) == list(range(len(names)))  # each is the partner of one
    assert (names[found] == names).all()
    for i, name in enumerate(names):
        assert (found[i] == i) == ((names == name).sum() == 1)


def test_all_others_of_an_object_are_as_likely_as_partners() -> None:
    drawn = [draw_partners(np.array(["a"] * 4), np.random.default_rng(i))[0] for i in range(3000)]
    assert np.allclose(np.bincount(drawn, minlength=4) / 3000, [0, 1 / 3, 1 / 3, 1 / 3], atol=0.04)


def test_the_second_view_is_of_another_sweep_of_the_object() -> None:
    """Sweeps are told by their labels, each sweep's own; objects have three."""
    data = sweeps(touches(24))
    data.sweeps.objects[:] = [f"mug-{i // 3}" for i in range(24)]
    batches = TrainingBatches(data, 8, seed=1, two_sweeps=True)
    for one, other in zip(batches.epoch(3), batches.epoch(3, view=1), strict=True):
        a, b = one[3].numpy(), other[3].numpy()
        assert (a != b).all() and (a // 3 == b // 3).all()
    data.sweeps.objects[:] = [f"mug-{i}" for i in range(24)]
    with pytest.raises(ConfigError, match="no object has two sweeps"):
        TrainingBatches(data, 8, seed=1, two_sweeps=True)


def test_a_third_is_clean_a_third_rated_and_a_third_between() -> None:
    samples = drawn(TrainingBatches(sweeps(touches(60)), 20, seed=0), epochs=20)[0]
    level = noise_level(samples)
    assert len(level) == 1200
    clean, rated = level < 1e-9, abs(level - 1) < 0.06
    assert np.mean(clean) == pytest.approx(1 / 3, abs=0.05)
    assert np.mean(rated) == pytest.approx(1 / 3 + 0.06 / 3, abs=0.05)
    between = level[~clean & ~rated]
    assert between.max() < 1 and np.mean(between < 0.47) == pytest.approx(0.5, abs=0.08)


def test_the_baseline_is_as_wrong_as_one_of_few_noisy_samples() -> None:
    samples, offset, sigma, _ = drawn(TrainingBatches(sweeps(touches(60)), 20, seed=0), epochs=20)
    level = noise_level(samples)
    clean, rated = level < 1e-9, abs(level - 1) < 0.06
    assert (offset[clean] == 0).all() and (sigma[clean] == FLOOR).all()
    error = offset[rated] / RATED
    quiet = np.arange(20, 60)
    assert error.mean() == pytest.approx(0, abs=0.01)
    assert error.std() == pytest.approx(np.sqrt((1 / quiet).mean()), rel=0.05)
    assert (sigma[rated] / RATED).mean() == pytest.approx(1, abs=0.03)


def test_a_touch_that_noise_hides_is_learnt_where_it_is_found_without() -> None:
    data = sweeps(touches(8, size=0.25)[:1].repeat(8, axis=0))
    assert (data.noisy_starts[0] >= LEAD).all(), "found in silence, above the assumed floor"
    assert (data.noisy_starts[-1] == -1).any(), "but not in noise"
    assert sorted(drawn(TrainingBatches(data, 4, seed=0))[3]) == list(range(8))


def test_sweeps_without_a_touch_are_left_out_and_too_few_are_refused() -> None:
    values = touches(6)
    values[[1, 4]] = 0
    assert sorted(drawn(TrainingBatches(sweeps(values), 2, seed=0))[3]) == [0, 2, 3, 5]
    with pytest.raises(ConfigError, match="a batch of 5 is more than the 4 sweeps"):
        TrainingBatches(sweeps(values), 5, seed=0)


def with_faults(values: np.ndarray, **faults: float) -> SweepSet:
    """Silent of all that is drawn, but for these."""
    data = sweeps(values)
    recipe = {"faults": {"gain": 0.0, "dead": 0.0, **faults}}
    return replace(data, manifest=replace(data.manifest, recipe=recipe))


def test_a_row_of_whiskers_dies_as_a_whole_and_as_often_as_said() -> None:
    data = with_faults(touches(60), dead_row=0.3)
    spec = replace(SPEC, grid=((0, 0), (0, 1), (1, 0), (1, 1)))
    data = replace(data, manifest=replace(data.manifest, spec=spec))
    samples = drawn(TrainingBatches(data, 20, seed=0), epochs=10)[0]
    # what a dead whisker reads is noise
    touching = np.abs(samples).reshape(len(samples), -1, ELEMENTS, CHANNELS)
    dead = (np.median(touching, axis=1) < 10 * RATED).all(axis=2)  # (window, element)
    assert np.array_equal(dead[:, 0], dead[:, 1]) and np.array_equal(dead[:, 2], dead[:, 3])
    assert dead.mean(axis=0) == pytest.approx(0.3, abs=0.06)
    assert not np.array_equal(dead[:, 0], dead[:, 2])


def test_what_has_come_since_the_baseline_is_constant_or_grows_and_stays_in_the_samples() -> None:
    values = touches(60)
    still, grown = (
        drawn(TrainingBatches(with_faults(values, **{name: 3.0}), 20, seed=0), epochs=8)
        for name in ("offset", "drift")
    )
    for samples, offset, _, labels in (still, grown):
        clean = (offset == 0).all(axis=(1, 2))
        assert clean.mean() == pytest.approx(1 / 3, abs=0.05), "the baseline knows nothing of it"
        true = 100.0 * RATED * (1 + labels[clean, None, None])  # of `touches`
        late = samples[clean].reshape(clean.sum(), -1, ELEMENTS, CHANNELS)[:, 60:100]
        error = (late - true[:, None]) / RATED
        # half have none, the others evenly from nothing to 3 of the rated noise
        size = 3 / np.sqrt(6) * (1.0 if samples is still[0] else 80 / 110)
        assert error.std() == pytest.approx(size, rel=0.2)
        slope = np.ptp(error, axis=1).mean()
        assert slope < 1e-2 if samples is still[0] else slope > 0.2


def test_a_set_may_ask_for_more_than_the_rated_noise() -> None:
    samples = drawn(TrainingBatches(with_faults(touches(60), noise=3.0), 20, seed=0), epochs=20)[0]
    level = noise_level(samples)
    assert np.mean(level < 1e-9) == pytest.approx(1 / 3, abs=0.05)
    assert np.mean(abs(level - 1) < 0.06) == pytest.approx(1 / 3 + 0.12 / 9, abs=0.05)
    assert level.max() == pytest.approx(3, abs=0.1)
    assert np.mean(level > 1.06) == pytest.approx(1.94 / 9, abs=0.04)


def test_things_of_no_category_and_loads_that_no_touch_makes_have_labels_of_their_own() -> None:
    data = with_faults(touches(60), implausible=0.4)
    labels = np.zeros(60, dtype=np.int64)
    labels[40:] = -1
    data = replace(data, sweeps=replace(data.sweeps, labels=labels))
    assert data.refusals == (
        "unknown", "swapped channels", "turned channels", "wrong gain", "missing elements",
    )  # fmt: skip
    samples, _, _, given = drawn(TrainingBatches(data, 20, seed=0), epochs=20)
    share = np.bincount(given, minlength=6) / len(given)
    assert share[0] == pytest.approx(0.6 * 2 / 3, abs=0.05)
    assert share[1] == pytest.approx(0.6 / 3, abs=0.05)
    assert share[2:] == pytest.approx(0.1, abs=0.03)
    late = np.median(samples.reshape(len(samples), -1, ELEMENTS, CHANNELS)[:, 40:], axis=1)
    assert (late[given <= 1] / RATED).min() > 50, "no sound touch is changed"
    turned = (late / RATED < -50).any(axis=(1, 2))
    assert np.array_equal(turned, given == 3)
    gone = (np.abs(late) < 20 * RATED).all(axis=2).sum(axis=1)
    assert set(gone[given == 5]) == {2, 3} and not gone[given != 5].any()


def test_sets_are_joined_by_the_names_of_their_categories() -> None:
    one, other = sweeps(touches(3)), sweeps(touches(2))
    manifest = replace(
        other.manifest, categories=("cup", "mug"), split={"train": ("cup-0", "mug-9")}
    )
    there = replace(
        other,
        manifest=manifest,
        sweeps=Sweeps(other.sweeps.values, np.array([0, -1]), np.array(["cup-0", "x-1"])),
    )
    one = replace(one, sweeps=replace(one.sweeps, labels=np.zeros(3, dtype=np.int64)))
    both = join_sets([one, there])
    assert both.manifest.categories == ("mug", "cup")
    assert both.sweeps.labels.tolist() == [0, 0, 0, 1, -1]
    assert both.manifest.split["train"] == ("mug-0", "mug-1", "mug-2", "cup-0", "mug-9")
    assert np.array_equal(both.sweeps.values, np.concatenate([touches(3), touches(2)]))
    fast = replace(there, manifest=replace(manifest, period_ns=1_000_000))
    with pytest.raises(ConfigError, match="cannot be joined: the period of their samples"):
        join_sets([one, fast])


def test_faults_rise_to_what_is_said_in_the_easy_epochs() -> None:
    batches = TrainingBatches(with_faults(touches(300), noise=2.0), 20, seed=0)
    batches.easy_epochs = 4
    largest = []
    for epoch in range(6):
        samples = np.concatenate([batch[0].numpy() for batch in batches.epoch(epoch)])
        largest.append(noise_level(samples).max())
    assert largest[0] < 1e-9
    assert largest[1:4] == pytest.approx([0.5, 1.0, 1.5], abs=0.15)
    assert largest[4:] == pytest.approx([2.0, 2.0], abs=0.2)


SOUND = dict.fromkeys(("noise", "gain", "dead"), 0.0)


def test_windows_may_begin_with_the_sweep_and_have_nothing_drawn():
    """As the paper does: what is drawn is the order."""
    values = touches(6)
    data = drawn_as(sweeps(values), {"window": "sweep", "faults": SOUND})
    samples, offset, sigma, labels = drawn(TrainingBatches(data, 6, 0, jitter=0))
    assert sorted(labels.tolist()) == list(range(6))
    flat = samples.reshape(6, -1, ELEMENTS, CHANNELS)
    np.testing.assert_array_equal(flat, values[labels, LEAD : LEAD + flat.shape[1]])
    assert not offset.any()
    np.testing.assert_array_equal(sigma, np.broadcast_to(FLOOR, sigma.shape))


def test_windows_that_begin_with_the_sweep_have_a_baseline_alike_in_training_and_in_validation():
    """A magnetometer reads its magnet's field at rest."""
    values = touches(40) + np.float32(3e-3)
    data = drawn_as(sweeps(values), {"window": "sweep", "faults": SOUND})
    samples, offset, *_, labels = drawn(TrainingBatches(data, 40, 0, jitter=0))
    (cut,) = cut_windows(data)
    seen = samples - offset[:, None, None]
    np.testing.assert_allclose(
        seen, (cut.samples - cut.offset[:, None, None])[labels], rtol=1e-5, atol=1e-7
    )


def test_a_run_says_by_how_much_windows_begin_elsewhere():
    data = drawn_as(sweeps(touches(40)), {"window": "sweep", "faults": SOUND})
    for jitter in (0, 3):
        samples, *_ = drawn(TrainingBatches(data, 40, 0, jitter=jitter), epochs=3)
        silent = (samples.reshape(120, -1, ELEMENTS * CHANNELS) == 0).all(2).sum(1)
        assert set(silent.tolist()) == set(range(jitter + 1))
