"""Figures of merit against independent implementations."""

from dataclasses import replace

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from tactile_rt.classifier.contact import ContactDetector
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import MOUSE, ArraySpec
from tactile_rt.core.stream.sensor_spec import channel_limits
from tactile_rt.models import onsets
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import OFFSET, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import (
    accuracy,
    at_temperature,
    auroc,
    bootstrap,
    deciding_step,
)
from tactile_rt.models.onsets import find_onsets
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import Sweeps
from tests.helpers.tiny_sweeps import plate

ELEMENTS = 8
SPEC = plate(1, ELEMENTS)
NOISE, FLOOR, _, _ = channel_limits(SPEC)


def sweeps(n: int, samples: int = 150, seed: int = 0) -> np.ndarray:
    """Contacts of all sizes on some elements, from a sample of their own on; the last has none."""
    rng = np.random.default_rng(seed)
    ramp = np.clip(np.arange(samples) - rng.integers(30, 120, (n, 1)), 0, None)[..., None, None]
    size = (
        rng.lognormal(0, 2, (n, 1, ELEMENTS, 6)) * NOISE * (rng.random((n, 1, ELEMENTS, 1)) < 0.4)
    )
    size[-1] = 0
    return (ramp / 20 * size).astype(np.float32)


def a_set(values: np.ndarray) -> SweepSet:
    manifest = SweepManifest(SPEC, 9_000_000, 20, ("mug", "car"), {"test": ("mug-0",)})
    labels = np.arange(len(values)) % 2
    names = np.array([f"{manifest.categories[k]}-{i}" for i, k in enumerate(labels)])
    return SweepSet(manifest, Sweeps(values, labels, names), NOISE, FLOOR)


@pytest.mark.parametrize("level", [0.0, 0.5, 3.0])
def test_many_sweeps_at_once_are_the_detector_one_by_one(level: float) -> None:
    values = sweeps(2 * onsets.BATCH // 8, samples=164)
    rng = np.random.default_rng(1)
    values = values + (level * NOISE * rng.normal(size=values.shape)).astype(np.float32)
    found = find_onsets(values, FLOOR)
    valid = np.ones(ELEMENTS, dtype=np.bool_)
    for i, sweep in enumerate(values):
        detector = ContactDetector((ELEMENTS, 6), FLOOR)
        begins = (k for k, sample in enumerate(sweep) if detector.update(sample, valid))
        assert found.start[i] == next(begins, -1)
        assert np.array_equal(found.offset[i], detector.offset)
        assert np.array_equal(found.sigma[i], detector.sigma)
    assert found.start[-1] == -1
    assert len(set(found.start.tolist())) > 10


def test_batches_of_sweeps_do_not_see_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    values = sweeps(9)
    whole = find_onsets(values, FLOOR)
    monkeypatch.setattr(onsets, "BATCH", 2)
    parts = find_onsets(values, FLOOR)
    assert np.array_equal(whole.start, parts.start)
    assert np.array_equal(whole.offset, parts.offset)


def test_auroc_is_scikit_learns() -> None:
    rng = np.random.default_rng(0)
    # rounded, so that there are ties
    known = np.round(rng.normal(1.0, 1.0, 300), 1).astype(np.float32)
    unknown = np.round(rng.normal(0.0, 1.0, 120), 1).astype(np.float32)
    truth = np.repeat([1, 0], [300, 120])
    wanted = roc_auc_score(truth, np.concatenate([known, unknown]))
    assert auroc(known, unknown) == pytest.approx(wanted, abs=1e-12)


def test_a_sweep_without_contact_scores_lowest() -> None:
    some = np.array([0.2, 0.9], dtype=np.float32)
    none = np.full(2, np.nan, dtype=np.float32)
    assert auroc(some, none) == 1.0
    assert auroc(none, some) == 0.0
    assert auroc(none, none) == 0.5


def test_an_interval_knows_how_many_objects_there_are_not_how_many_sweeps() -> None:
    rng = np.random.default_rng(0)
    right = rng.random(100) < 0.7
    single = accuracy(right, np.array([f"o{i}" for i in range(100)]))
    # Every sweep of an object alike: ten times the sweeps say nothing more.
    many = accuracy(np.repeat(right, 10), np.repeat([f"o{i}" for i in range(100)], 10))
    assert many.value == single.value
    assert (many.low, many.high) == (single.low, single.high)
    deviation = np.sqrt(right.mean() * (1 - right.mean()) / 100)
    assert single.high - single.low == pytest.approx(2 * 1.96 * deviation, rel=0.1)


def test_seeds_that_disagree_widen_an_interval() -> None:
    objects = np.array([f"o{i}" for i in range(200)])
    alike = np.tile(np.arange(200) % 2 == 0, (3, 1))
    apart = np.stack([np.arange(200) % 10 < k for k in (3, 5, 7)])
    assert accuracy(alike, objects).value == accuracy(apart, objects).value == 0.5
    width = [i.high - i.low for i in (accuracy(alike, objects), accuracy(apart, objects))]
    assert width[1] > 1.5 * width[0]


def test_the_points_between_two_conditions_are_told_from_the_same_sweeps() -> None:
    objects = np.array([f"o{i}" for i in range(400)])
    better = np.arange(400) % 4 != 0
    worse = better & (np.arange(400) % 20 != 1)
    lost = accuracy(better.astype(float) - worse, objects)
    assert lost.value == pytest.approx(0.05)
    assert 0.02 < lost.low < 0.05 < lost.high < 0.08


def test_any_statistic_has_the_interval_of_a_mean() -> None:
    rng = np.random.default_rng(3)
    objects = np.repeat([f"o{i}" for i in range(60)], 5)
    right = rng.random(300) < 0.6
    one = bootstrap(lambda at: float(right[at].mean()), objects, 2000)
    other = accuracy(right, objects)
    assert one.value == other.value
    assert one.low == pytest.approx(other.low, abs=0.01)
    assert one.high == pytest.approx(other.high, abs=0.01)


def test_a_temperature_is_what_divides_the_logits() -> None:
    logits = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)

    def softmax(z: np.ndarray) -> np.ndarray:
        return np.exp(z) / np.exp(z).sum(axis=-1, keepdims=True)

    scaled = at_temperature(softmax(logits).astype(np.float32), 2.5)
    assert np.allclose(scaled, softmax(logits / 2.5), atol=1e-6)


def test_a_decision_counts_from_when_it_stays_right() -> None:
    def posteriors(right: str) -> np.ndarray:
        return np.array([[0.9, 0.1] if one == "1" else [0.2, 0.8] for one in right])

    all_of = np.stack([posteriors(one) for one in ("0110", "0111", "1111", "1011")])
    assert deciding_step(all_of.astype(np.float32), np.zeros(4, int)).tolist() == [0, 2, 1, 3]


# ---- what goes wrong with a sensor


def seen_by(
    disturbance: Disturbance, values: np.ndarray, spec: ArraySpec = SPEC, seed: int = 0
) -> tuple[np.ndarray, ...]:
    """The windows, offsets and sigmas that a network is given."""
    seen: list[tuple[np.ndarray, ...]] = []

    def run(samples: np.ndarray, offset: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        seen.append((samples.copy(), offset, sigma))
        return np.zeros((len(samples), MOUSE.steps, 2), dtype=np.float32)

    data = a_set(values)
    data = replace(data, manifest=replace(data.manifest, spec=spec))
    measures.predict(data, run, disturbance=disturbance, seed=seed)
    return tuple(np.concatenate(part) for part in zip(*seen, strict=True))


def test_an_offset_after_the_baseline_is_in_the_windows_and_not_in_it() -> None:
    values = sweeps(70)
    clean, there = seen_by(Disturbance(), values), seen_by(Disturbance(offset=0.5), values)
    added = (there[0] - clean[0]).astype(np.float64)
    size = 0.5 * OFFSET * NOISE
    assert np.allclose(np.abs(added), size, rtol=1e-2)
    assert np.ptp(np.sign(added), axis=(1, 2)).max() == 0, "constant within a sweep"
    assert 0.3 < (added > 0).mean() < 0.7
    assert np.array_equal(there[1], clean[1])
    assert np.array_equal(there[2], clean[2])


def test_rest_before_a_sweep_is_its_baseline_and_not_its_window() -> None:
    data = replace(a_set(sweeps(30)), window="sweep")
    plain, rested = (
        next(measures.cut_windows(data, disturbance=Disturbance(rest=rest))) for rest in (0, 80)
    )
    assert np.array_equal(plain.samples, rested.samples)
    noisy = next(measures.cut_windows(data, disturbance=Disturbance(rest=80, noise=1.0)))
    assert noisy.sigma.mean(axis=(0, 1)) == pytest.approx(NOISE, rel=0.02)
    assert np.abs(noisy.offset).mean(axis=(0, 1)) == pytest.approx(NOISE * 0.08, rel=0.15)


def test_dead_whiskers_are_silent_and_as_many_as_said() -> None:
    values = sweeps(40)
    values[:, 20:] += np.float32(1e-9)  # nobody is silent of itself
    samples, *_ = seen_by(Disturbance(dead=3), values)
    dead = (samples == 0).all(axis=(1, 2, 4))
    assert (dead.sum(axis=1) == 3).all()
    assert len({tuple(row) for row in dead}) > 10, "others in every sweep"


def test_a_dead_row_is_dead_as_a_whole() -> None:
    values = sweeps(40)
    values[:, 20:] += np.float32(1e-9)
    spec = replace(SPEC, grid=tuple((i // 2, i % 2) for i in range(ELEMENTS)))
    samples, *_ = seen_by(Disturbance(rows=1), values, spec)
    dead = (samples == 0).all(axis=(1, 2, 4)).reshape(len(samples), -1, 2)
    assert (dead.all(axis=2).sum(axis=1) == 1).all() and (dead.sum(axis=(1, 2)) == 2).all()
    assert len({tuple(row) for row in dead[..., 0]}) == ELEMENTS // 2, "another in every sweep"


def test_a_drift_begins_with_the_contact_and_reaches_its_size_at_the_end() -> None:
    values = sweeps(70)
    clean, there = seen_by(Disturbance(), values), seen_by(Disturbance(drift=0.5), values)
    added = (there[0] - clean[0]).astype(np.float64)  # (sweep, step, sub-step, element, channel)
    size = 0.5 * OFFSET * NOISE
    assert np.allclose(np.abs(added[:, -1, -1]), size, rtol=1e-2)
    assert np.abs(added[:, 0, 0]).max() < 0.02 * size.max()
    assert np.array_equal(there[1], clean[1])


def test_swapped_wires_exchange_x_and_y_of_forces_and_of_moments() -> None:
    values = sweeps(30)
    clean, there = seen_by(Disturbance(), values)[0], seen_by(Disturbance(swapped=True), values)[0]
    assert np.array_equal(there, clean[..., [1, 0, 2, 4, 3, 5]])


def test_a_gain_error_scales_all_of_a_whisker_alike() -> None:
    # Detected alike, because the steps are far above every threshold.
    values = np.zeros((30, 150, ELEMENTS, 6), dtype=np.float32)
    values[:, 60:] = 1e-2 * NOISE / NOISE[0]
    clean, there = seen_by(Disturbance(), values)[0], seen_by(Disturbance(gain=0.2), values)[0]
    gain = there / clean  # (sweep, step, sub-step, element, channel)
    assert np.allclose(gain, gain[:, :1, :1, :, :1], rtol=1e-5)
    assert np.std(gain[:, 0, 0, :, 0]) == pytest.approx(0.2, rel=0.2)
    assert np.mean(gain[:, 0, 0, :, 0]) == pytest.approx(1.0, abs=0.05)


def test_noise_is_the_rated_one_and_repeats_with_its_seed() -> None:
    values = np.zeros((40, 150, ELEMENTS, 6), dtype=np.float32)
    rng = [np.random.default_rng(k) for k in (0, 0, 1)]
    data = a_set(values)
    noisy = [Disturbance(noise=2.0).disturb_samples(values, data, r) for r in rng]
    assert np.allclose(noisy[0].std(axis=(0, 1, 2)), 2 * NOISE, rtol=0.02)
    assert np.array_equal(noisy[0], noisy[1])
    assert not np.array_equal(noisy[0], noisy[2])


def test_a_sensor_cannot_be_better_than_ideal() -> None:
    for field in ("noise", "dead"):
        with pytest.raises(ConfigError, match=f"{field} must be .*, not -1"):
            replace(Disturbance(), **{field: -1})


def test_a_draw_without_one_of_two_kinds_tells_nothing() -> None:
    assert np.isnan(auroc(np.ones(3, np.float32), np.zeros(0, np.float32)))
    assert np.isnan(auroc(np.zeros(0, np.float32), np.ones(3, np.float32)))
    objects = np.array(["a", "b", "c"])
    scores = np.array([0.9, 0.8, 0.1], dtype=np.float32)  # c is the only one of its kind

    def area(at: np.ndarray) -> float:
        return auroc(scores[at[at < 2]], scores[at[at == 2]])

    found = bootstrap(area, objects)
    assert (found.value, found.low, found.high) == (1.0, 1.0, 1.0)
