"""The synthetic array."""

import numpy as np

from tactile_rt.core.stream import concatenate
from tactile_rt.sources.synthetic import SyntheticOptions, SyntheticSource


def test_one_at_rest_only_has_noise() -> None:
    made = SyntheticSource("35x6", SyntheticOptions(seconds=6.0, pace="fast", touches=False))
    values = concatenate(list(made)).values
    touched = SyntheticSource("35x6", SyntheticOptions(seconds=6.0, pace="fast"))
    assert np.abs(values).max() < 0.05 * np.abs(concatenate(list(touched)).values).max()
    assert values.std(axis=0).min() > 0
