import itertools

import numpy as np
import pytest

from tactile_rt.classifier.contact import ContactDetector
from tactile_rt.core.stream.sensor_spec import CHANNEL_FLOOR

ELEMENTS, CHANNELS = 30, 6
FLOOR = np.array([CHANNEL_FLOOR["N"]] * 3 + [CHANNEL_FLOOR["N m"]] * 3, dtype=np.float32)
RATED = np.array([10e-6] * 3 + [5e-8] * 3)  # a good sensor's noise per sample, SI
RATE_HZ = 1000 / 9
ALL = np.ones(ELEMENTS, dtype=bool)
QUIET = 150  # samples: a full baseline


def noise(n: int, seed: int = 0, level: float = 1.0) -> np.ndarray:
    """(n, element, channel) white sensor noise."""
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(n, ELEMENTS, CHANNELS)) * RATED * level).astype(np.float32)


def bounded(n: int, seed: int = 0) -> np.ndarray:
    """Noise of the same variance without tails: no sample of it is held for a touch by chance."""
    rng = np.random.default_rng(seed)
    flat = rng.uniform(-1, 1, size=(n, ELEMENTS, CHANNELS)) * np.sqrt(3) * RATED
    return flat.astype(np.float32)


def new() -> ContactDetector:
    return ContactDetector((ELEMENTS, CHANNELS), FLOOR)


def feed(detector: ContactDetector, samples, valid=None) -> list[int]:
    """Indices of the samples with which contact began."""
    valid = itertools.repeat(ALL) if valid is None else valid
    return [
        i for i, (x, v) in enumerate(zip(samples, valid, strict=False)) if detector.update(x, v)
    ]


def taught(seed: int = 0, level: float = 1.0) -> ContactDetector:
    detector = new()
    assert feed(detector, noise(QUIET, seed, level)) == []
    return detector


@pytest.mark.parametrize("level", [0.0, 0.1, 1.0, 30.0])
def test_a_minute_of_white_noise_is_no_contact(level: float) -> None:
    detector = new()
    assert feed(detector, noise(round(60 * RATE_HZ), seed=7, level=level)) == []
    assert not detector.contact


def test_the_first_seconds_after_the_baseline_are_no_contact_either() -> None:
    """With twenty samples the noise itself is known least."""
    for seed in range(60):
        assert feed(new(), noise(100, seed)) == [], seed


def test_an_element_that_was_quiet_by_chance_is_not_believed_to_be() -> None:
    """Few samples may underestimate one element's noise; the array's typical noise is known."""
    samples = noise(200, seed=11)
    samples[:25, 7] *= np.float32(0.3)
    assert feed(new(), samples) == []


@pytest.mark.parametrize(
    ("step", "within"), [(1000.0, 1), (20.0, 1), (10.0, 2), (5.0, 6), (3.5, 15)]
)
def test_a_step_of_one_channel_is_found_within_a_few_samples(step: float, within: int) -> None:
    for seed, element, channel in ((0, 0, 0), (1, 12, 3), (2, 29, 5)):
        samples = noise(QUIET + 50, seed)
        samples[QUIET:, element, channel] += step * RATED[channel]
        (onset,) = feed(new(), samples)
        assert QUIET + 1 <= onset <= QUIET + within


def test_a_touch_is_found_without_noise_too() -> None:
    """A simulation is silent: there the assumed floor is the noise."""
    samples = np.zeros((QUIET + 10, ELEMENTS, CHANNELS), dtype=np.float32)
    samples[QUIET:, 3, 0] = 10 * FLOOR[0]
    assert feed(new(), samples) == [QUIET + 1]
    samples[QUIET:, 3, 0] = FLOOR[0]
    assert feed(new(), samples) == []


def test_the_baseline_removes_a_constant_offset() -> None:
    offset = np.random.default_rng(1).normal(size=(ELEMENTS, CHANNELS)) * RATED * 1e4
    samples = (noise(600).astype(np.float64) + offset).astype(np.float32)
    detector = new()
    assert feed(detector, samples) == []
    assert (abs(detector.offset - offset) < 5 * RATED / np.sqrt(100)).all()
    samples[0] = samples[-1]
    samples[:2, 5, 1] += 20 * RATED[1]
    assert feed(detector, samples[:2]) == [1]


def test_the_baseline_follows_drift_before_contact() -> None:
    n = 4000
    drift = 0.003 * RATED * np.arange(n)[:, None, None]  # 12 sigma in 36 s
    samples = (noise(n) + drift).astype(np.float32)
    samples[n - 10 :, 17, 2] += 12 * RATED[2]
    detector = new()
    assert feed(detector, samples) in ([n - 9], [n - 8])
    assert (abs(detector.offset - drift[n - 10]) < 0.8 * RATED).all()


@pytest.mark.parametrize("slope", [0.01, 0.02])
def test_touches_on_a_drift_begin_and_end(slope: float) -> None:
    """A sensor that warms up, touched every four seconds: once its slope is known, in a second."""
    n = 9000
    samples = noise(n) + (slope * RATED * np.arange(n)[:, None, None]).astype(np.float32)
    begins = np.arange(800, n - 400, 450)
    for at in begins:
        samples[at : at + 150, 17, 2] += np.float32(30 * RATED[2])
    detector = new()
    onsets = [onset for onset in feed(detector, samples) if onset > 100]
    assert len(onsets) == len(begins) and (abs(np.array(onsets) - begins) <= 2).all()
    assert not detector.contact
    assert (abs(detector.offset - slope * n * RATED) < 0.8 * RATED).all()
    # The noise about the line, not that of the ramp.
    assert (detector.sigma / RATED).mean() == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("slope", [0.1, 0.2, 0.5])
def test_a_slow_touch_is_caught_though_the_baseline_follows(slope: float) -> None:
    """A load that grows by a fraction of the noise per sample, in all channels of one whisker."""
    samples = noise(QUIET + 200, seed=3)
    samples[QUIET:, 9] += (slope * RATED * np.arange(200)[:, None]).astype(np.float32)
    onsets = feed(new(), samples)
    assert onsets
    load = slope * (onsets[0] - QUIET)  # in sigma, when it was found
    assert load < 5


def test_release_needs_twenty_quiet_samples_in_a_row() -> None:
    detector = taught()
    touch = noise(60, seed=9)
    touch[:, 4, 0] += 50 * RATED[0]
    quiet = noise(200, seed=10)
    assert feed(detector, touch) == [1]
    assert detector.contact and new().doubted == 0
    feed(detector, quiet[:15])
    feed(detector, touch[:1])  # a flicker begins the count anew
    assert detector.contact
    states = []
    for sample in quiet[15:80]:
        assert not detector.update(sample, ALL)
        states.append(detector.contact)
    released = states.index(False)
    # the slow means decay for some samples before the count can begin
    assert 20 - 1 <= released <= 20 + 20
    assert not any(states[released:])
    assert feed(detector, quiet[80:]) == []
    assert feed(detector, touch[:3]) == [1], "the next touch is a new one"


def test_the_count_to_release_begins_when_the_slowest_chart_is_below_its_threshold() -> None:
    silent = np.zeros((200, ELEMENTS, CHANNELS), dtype=np.float32)
    touch = silent[:60].copy()
    touch[:, 4, 0] = 50 * FLOOR[0]
    detector = new()
    feed(detector, silent)
    assert feed(detector, touch) == [1]
    # 3 sigma, the most that a sample adds, times 0.9 to the number of silent samples
    threshold = 40 * (0.1 / 1.9 + 1 / 100) * 99 / 97
    first = int(np.ceil(np.log(np.sqrt(0.83 * threshold) / 3) / np.log(0.9)))
    contact = [detector.update(x, ALL) or detector.contact for x in silent[:60]]
    assert contact.index(False) == first - 1 + 19


def test_a_load_between_release_and_onset_keeps_a_contact_but_begins_none() -> None:
    samples = np.zeros((100, ELEMENTS, CHANNELS), dtype=np.float32)
    # In one channel of one element, in units of the assumed sigma; at the slowest statistic's
    # threshold: 40 (33) times 1/19, the variance of its mean, and 1/100 of the baseline.
    between = np.sqrt(36.5 * (1 / 19 + 1 / 100))
    samples[:, 2, 1] = between * FLOOR[1]
    silent = np.zeros((QUIET, ELEMENTS, CHANNELS), dtype=np.float32)

    detector = new()
    feed(detector, silent)
    assert feed(detector, samples) == []

    detector = new()
    feed(detector, silent)
    assert feed(detector, samples[:20] * 20) == [1]
    assert feed(detector, samples) == []
    assert detector.contact
    feed(detector, samples * 0.9)
    assert not detector.contact


def test_the_baseline_is_that_of_the_last_hundred_quiet_samples_but_fifteen() -> None:
    rng = np.random.default_rng(5)
    offset = rng.normal(size=(ELEMENTS, CHANNELS)) * RATED * 100
    spread = rng.uniform(0.02, 3, size=(ELEMENTS, CHANNELS))  # some below the floor
    samples = (bounded(400) * spread + offset).astype(np.float32)
    detector = new()
    for i, sample in enumerate(samples, 1):
        detector.update(sample, ALL)
        if i in (25, 26, 35, 36, 60, 115, 116, 250, 400):
            # The first twenty need not wait as long as those after them.
            window = samples[: max(i - 15, 20)][-100:].astype(np.float64)
            assert detector.offset == pytest.approx(window.mean(axis=0), rel=1e-6, abs=1e-12)
            sigma = np.maximum(window.std(axis=0, ddof=1), FLOOR)
            assert detector.sigma == pytest.approx(sigma, rel=1e-5)
    assert (detector.sigma == FLOOR).any() and (detector.sigma > FLOOR).any()


def test_at_an_onset_all_quiet_samples_but_five_are_the_baseline_and_then_it_stays() -> None:
    quiet, touch = bounded(QUIET), bounded(300, seed=2)
    touch[:, 8] += (30 * RATED).astype(np.float32)
    detector = new()
    assert feed(detector, quiet) == []
    assert feed(detector, touch[:2]) == [1]
    assert detector.doubted == 5 + 1  # those that waited, and the first one above
    # The sample that only might have been an onset is not learnt from either.
    window = quiet[: QUIET - 5][-100:].astype(np.float64)
    assert detector.offset == pytest.approx(window.mean(axis=0), rel=1e-5, abs=1e-12)
    assert detector.sigma == pytest.approx(window.std(axis=0, ddof=1), rel=1e-5)
    offset, sigma = detector.offset.copy(), detector.sigma.copy()
    feed(detector, touch[2:])
    assert detector.contact
    assert np.array_equal(detector.offset, offset)
    assert np.array_equal(detector.sigma, sigma)


def test_a_faint_touch_is_not_part_of_its_own_baseline() -> None:
    """It was there for about ten samples when it is found; those are no longer quiet."""
    samples = np.zeros((QUIET + 60, ELEMENTS, CHANNELS), dtype=np.float32)
    samples[QUIET:, 6] = 0.9 * FLOOR
    detector = new()
    onset = next(i for i, sample in enumerate(samples) if detector.update(sample, ALL))
    assert QUIET + 8 <= onset <= QUIET + 20
    assert detector.doubted == onset - 153 + 1  # from the first that was suspicious
    assert (detector.offset[6] < 0.04 * FLOOR).all()


def test_a_touch_below_the_noise_is_found() -> None:
    """0.8 sigma in every channel of one whisker, for a third of a second, at ten seeds."""
    for seed in range(10):
        samples = noise(QUIET + 40, seed)
        samples[QUIET:, 13] += (0.8 * RATED).astype(np.float32)
        (onset,) = feed(new(), samples)
        assert onset > QUIET


@pytest.mark.parametrize("size", [10.0, 1e3, 1e6])
def test_one_wild_sample_is_no_touch(size: float) -> None:
    samples = noise(QUIET + 100, seed=4)
    samples[QUIET, 5] += (size * RATED).astype(np.float32)
    samples[QUIET + 60 :, 6, 0] += np.float32(20 * RATED[0])
    assert feed(new(), samples) == [QUIET + 61]


def test_what_came_just_before_a_contact_is_not_learnt_after_it() -> None:
    """The samples that wait when contact begins may be its beginning."""
    detector = new()
    samples = np.zeros((QUIET + 140, ELEMENTS, CHANNELS), dtype=np.float32)
    samples[QUIET : QUIET + 5, 3, 0] = FLOOR[0]  # too faint to be found
    samples[QUIET + 5 : QUIET + 15, 3, 0] = 20 * FLOOR[0]
    assert feed(detector, samples) == [QUIET + 6]
    assert not detector.contact
    assert (detector.offset == 0).all()


def test_a_young_baseline_is_trusted_less() -> None:
    """Of 20 samples the mean is off by a fifth of sigma, of 100 by a tenth; and so is sigma."""
    pulse = np.zeros((2, ELEMENTS, CHANNELS), dtype=np.float32)
    pulse[:, 3, 0] = np.sqrt(28.5) * FLOOR[0]
    # 26 (1 + 1/20) 19/17 > 28.5 > 26 (1 + 1/100) 99/97
    for quiet, onsets in ((25, []), (QUIET, [1])):
        detector = new()
        feed(detector, np.zeros((quiet, ELEMENTS, CHANNELS), dtype=np.float32))
        assert feed(detector, pulse) == onsets


def test_nothing_is_reported_before_the_baseline_is_complete() -> None:
    samples = noise(25)
    samples[10:24:3] += np.float32(1e-2)
    detector = new()
    ready = []
    for sample in samples:
        assert not detector.update(sample, ALL)
        ready.append(detector.ready)
        assert not detector.contact
    # twenty, and five that wait: they might already belong to a touch
    assert ready == [False] * 24 + [True]


@pytest.mark.parametrize("garbage", [0.0, 1.0, np.nan, np.inf])
def test_a_dead_element_neither_touches_nor_counts_as_rest(garbage: float) -> None:
    n = QUIET + 100
    samples = noise(n)
    samples[:, 7] = garbage
    valid = np.tile(ALL, (n, 1))
    valid[:, 7] = False
    samples[QUIET + 50 :, 20, 0] += 30 * RATED[0]
    detector = new()
    assert feed(detector, samples, valid) == [QUIET + 51], "the others still feel"
    assert (detector.offset[7] == 0).all()
    assert np.array_equal(detector.sigma[7], FLOOR)
    assert np.isfinite(detector.offset).all() and np.isfinite(detector.sigma).all()


def test_an_element_that_dies_during_contact_does_not_hold_it() -> None:
    detector = taught()
    touch = noise(10)
    touch[:, 3] += (100 * RATED).astype(np.float32)
    assert feed(detector, touch) == [1]
    touch[:] = noise(10, seed=4)
    touch[:, 3] = np.nan
    dead = ALL.copy()
    dead[3] = False
    for _ in range(6):
        feed(detector, touch, itertools.repeat(dead))
    assert not detector.contact


@pytest.mark.parametrize("period", [2, 3, 10])
def test_the_baseline_of_an_element_with_gaps_is_that_of_its_valid_samples(period: int) -> None:
    """A loose connector on a whisker with an offset: zeros in its gaps are not its baseline."""
    n = 300
    samples = bounded(n)
    offset = 50 * RATED
    samples[:, 11] += offset.astype(np.float32)
    valid = np.tile(ALL, (n, 1))
    valid[:, 11] = np.arange(n) % period == 0
    samples[~valid] = 0.0
    detector = new()
    assert feed(detector, samples, valid) == []
    there = samples[: n - 15][-100:, 11][valid[: n - 15][-100:, 11]].astype(np.float64)
    if len(there) >= 20:
        assert detector.offset[11] == pytest.approx(there.mean(axis=0), rel=1e-5)
        sigma = np.maximum(there.std(axis=0, ddof=1), FLOOR)
        assert detector.sigma[11] == pytest.approx(sigma, rel=1e-5)


def test_an_element_that_comes_late_has_a_baseline_before_it_can_touch() -> None:
    n = QUIET + 200
    samples = noise(n)
    samples[:, 11] += np.float32(1e-3)
    valid = np.tile(ALL, (n, 1))
    valid[:QUIET, 11] = False
    samples[n - 10 :, 11] += (20 * RATED).astype(np.float32)
    assert feed(new(), samples, valid) == [n - 9]


def test_an_element_that_was_not_a_number_feels_again() -> None:
    detector = taught()
    gap = noise(30, seed=1)
    gap[:, 11] = np.nan
    invalid = ALL.copy()
    invalid[11] = False
    assert feed(detector, gap, itertools.repeat(invalid)) == []
    back = noise(20, seed=2)
    back[10:, 11, 0] += 20 * RATED[0]
    assert feed(detector, back) == [11]


@pytest.mark.parametrize(
    ("ramp", "jitter", "moves"),
    [(1.0, 1.2, True), (1.0, 1.5, False), (0.0, 1.5, False), (0.01, 0.0, False), (0.6, 0.0, True)],
)
def test_a_first_baseline_moves_if_it_wanders_more_than_neighbours_differ(ramp, jitter, moves):
    """A ramp of twenty has 66 times the variance that its steps tell; with a jitter 10 or 7."""
    at = np.arange(25)
    samples = np.zeros((25, ELEMENTS, CHANNELS), dtype=np.float32)
    samples[:, 4, 1] = (ramp * at + jitter * (-1.0) ** at) * FLOOR[1]
    detector = new()
    feed(detector, samples)
    assert detector.ready and detector.moves == moves


def test_a_constant_that_is_exact_in_binary_has_no_noise() -> None:
    detector = new()
    samples = np.full((300, ELEMENTS, CHANNELS), 0.125, dtype=np.float32)
    assert feed(detector, samples) == []
    assert (detector.offset == np.float32(0.125)).all()
    assert (detector.sigma == FLOOR).all()


def test_a_sensor_that_comes_back_in_the_middle_of_a_touch_does_not_take_it_for_its_baseline():
    detector, touch = taught(), np.float32(1000 * RATED)
    feed(detector, noise(300, 1), itertools.repeat(~ALL))  # longer than the baseline
    assert feed(detector, noise(60, 2) + touch) != []
    feed(detector, noise(60, 3))
    assert not detector.contact
    assert feed(detector, noise(300, 4)) == []


REST, TOUCH, MOVE = 60, 40, 10  # samples


def touches(how_many: int, size: float = 100.0, seed: int = 0) -> np.ndarray:
    """(n, element, channel) touches, each with a way there, a hold of its own and a way back."""
    rng = np.random.default_rng(seed)
    parts = []
    for _ in range(how_many):
        load = size * RATED * rng.normal(size=(ELEMENTS, CHANNELS))
        way = np.linspace(0, 1, MOVE)[:, None, None]
        hold = np.ones((TOUCH, 1, 1))
        parts.append(np.concatenate([np.zeros((REST, 1, 1)), way, hold, way[::-1]]) * load)
    clean = np.concatenate(parts)
    return (clean + noise(len(clean), seed + 1)).astype(np.float32)


def test_a_baseline_that_was_taken_in_a_touch_is_found_out_wherever_it_was_taken() -> None:
    samples = touches(7)
    touch = REST + TOUCH + 2 * MOVE
    for start in range(0, touch, 3):
        detector = new()
        contact, ready = [], []
        for sample in samples[start:]:
            detector.update(sample, ALL)
            contact.append(detector.contact)
            ready.append(detector.ready)
        assert all(ready[25:])
        # From the fifth touch on all is as it was never otherwise.
        ends = np.arange(5, 8) * touch - start
        for end in ends:
            assert contact[end - MOVE - 5], (start, end)
            assert not contact[end - touch + REST - 5], (start, end)


@pytest.mark.parametrize("late", [False, True])
def test_it_is_found_out_with_the_third_return_and_not_before(late: bool) -> None:
    """Whatever an element says that comes when it has begun, and has no baseline."""
    samples = touches(4)[REST + MOVE :]
    touch = REST + TOUCH + 2 * MOVE
    valid = np.tile(ALL, (len(samples), 1))
    if late:
        valid[: TOUCH + MOVE, 11] = False
        samples[:, 11] = noise(len(samples), 6, level=1e4)[:, 11]
    detector = new()
    contact = []
    for sample, trusted in zip(samples, valid, strict=True):
        detector.update(sample, trusted)
        contact.append(detector.contact)
    first = TOUCH + 2 * MOVE + 2  # where the first rest is known to be a contact
    third = TOUCH + MOVE + 2 * touch
    assert all(contact[first : third + 20])
    assert not any(contact[third + 45 : third + REST])


@pytest.mark.parametrize("wild", [0, 25])
def test_what_is_held_for_long_is_not_taken_for_rest(wild: int) -> None:
    """Though now and then a sample is wild, and the hand moves to other places and back."""
    detector = taught()
    hold = touches(9, seed=3) + (1000 * RATED).astype(np.float32)
    still = (noise(600, 5) + 1000 * RATED).astype(np.float32)
    if wild:
        hold[::wild], still[::wild] = 1.0, 1.0
    # It was quiet for longer than anything is held.
    feed(detector, noise(1000, 9))
    assert len(feed(detector, still)) == 1
    for sample in np.concatenate([hold, still]):
        detector.update(sample, ALL)
        assert detector.contact


def test_a_hold_without_a_move_is_never_taken_for_rest() -> None:
    detector = taught()
    still = (noise(6000, 5) + 1000 * RATED).astype(np.float32)
    still[::130] = 1.0  # glitches are no moves
    feed(detector, still)
    assert detector.contact
