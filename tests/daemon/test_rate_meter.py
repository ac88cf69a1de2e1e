"""A device that is slow is told from one that loses, bursts, hiccups or is merely cheap."""

import numpy as np
import pytest

from tactile_rt.daemon.rate_meter import RateMeter

S = 1e9


def slow_of(times_s, counts, nominal):
    """For each sample, as it comes: whether it is slow."""
    meter, found = RateMeter(), []
    for t, n in zip(times_s, counts, strict=True):
        meter.add(int(n), round(t * S))
        found.append(meter.judge(nominal, 0.0)[1])
    return np.array(found)


def bursts(times_s, every_s):
    return np.ceil(times_s / every_s) * every_s


@pytest.mark.parametrize("nominal", [1000.0, 110.0, 7.0])
@pytest.mark.parametrize("share", [0.5, 0.85, 0.1])
def test_a_slow_device_is_told_within_two_seconds_and_no_longer_when_it_is_well(nominal, share):
    slow = 3.0 + np.arange(1, round(9 * nominal * share)) / (nominal * share)
    well = slow[-1] + np.arange(1, round(5 * nominal)) / nominal
    times = np.concatenate([np.arange(0.0, 3.0, 1 / nominal), slow, well])
    found = slow_of(times, np.arange(len(times)), nominal)
    told, gone = times[found][0], times[found][-1]
    assert 3.0 < told <= max(5.0, slow[4]) and slow[-1] <= gone <= slow[-1] + 2.0
    assert found[(times >= told) & (times <= slow[-1])].all()


@pytest.mark.parametrize("share", [1.0, 0.95])
@pytest.mark.parametrize("nominal", [1000.0, 80.0, 7.0])
def test_what_is_no_slowness_is_none(nominal, share):
    n = np.arange(round(20 * nominal * share))
    times = n / (nominal * share)
    kept = np.random.default_rng(0).random(len(n)) < 0.5
    away = (times < 5) | (times > 9)  # a reconnection
    hiccup = times + 0.4 * (times > 5) + 0.3 * (times > 5.3)
    jitter = times + np.random.default_rng(0).uniform(0, min(0.02, 0.1 / nominal), len(n))
    for t, count in (
        (times, n), (times[kept], n[kept]), (bursts(times, 0.016), n), (np.sort(jitter), n),
        (hiccup, n), (times[away], n[away]), (times[away], np.arange(int(away.sum()))),
        (bursts(times, 0.25 if nominal > 10 else 0.02), n),
    ):  # fmt: skip
        assert not slow_of(t, count, nominal).any()
