"""What will not work soon: memory that grows, samples that come later and later."""

import numpy as np
import pytest

from tactile_rt.daemon.trends import EVERY_S, Trends

HALF_AN_HOUR = np.arange(0.0, 1810.0, 5.0)


def foreseen(resident_mb, late_ms=lambda t: 0.0, free_mb=1000.0):
    trends = Trends(lambda: free_mb * 1e6)
    for t in HALF_AN_HOUR:
        trends.look(t, int(1e6 * resident_mb(t)), {"hand": 1e-3 * late_ms(t)})
    return [(one.part, one.what, one.why) for one in trends.foresee()]


def test_memory_that_grows_until_none_is_left():
    (found,) = foreseen(lambda t: 100 + t / 36)  # 100 MB an hour
    assert found[:2] == ("daemon", "memory full soon")
    assert found[2] == "it grows by 100 MB an hour, and 1000 MB are free"
    assert not foreseen(lambda t: 100 + t / 36, free_mb=2500)  # in more than a day


def test_samples_that_come_later_and_later():
    (found,) = foreseen(lambda t: 100, lambda t: 2 + t / 100)
    assert found[:2] == ("hand", "jitter grows")
    assert found[2] == "its samples come 17 ms late, and came 5 ms late"


@pytest.mark.parametrize(
    "resident_mb, late_ms",
    [
        (lambda t: 100 + 50 * (t > 120), lambda t: 0.5 + t / 900),  # at first; to 2.5 ms
        (lambda t: 150 - 40 * np.exp(-t / 100), lambda t: 8 + t / 300),  # by 1.5
        (lambda t: 100 + t / 36 * (t % 600 > 300), lambda t: 3 + 40 * (t % 700 < EVERY_S)),
    ],
)
def test_what_settles_comes_back_or_is_small_is_no_trend(resident_mb, late_ms):
    assert not foreseen(resident_mb, late_ms, free_mb=300.0)
