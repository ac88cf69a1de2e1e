"""What is looked at of a touch: the same alone and in a batch, at once and step by step."""

from typing import Any

import numpy as np
import onnxruntime
import pytest

from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.stream import ArraySpec
from tactile_rt.teaching.features import FeatureNetwork
from tactile_rt.teaching.model import FewShot, write_features
from tactile_rt.testing import small_spec
from tests.helpers.made_up_touches import wrench_spec

SIGMA = 0.01


class Run:
    """A feature network, and its runs on episodes (touch, sample, element, channel)."""

    def __init__(self, path: Any, spec: ArraySpec) -> None:
        self.taught = FewShot(spec, np.full(len(spec.channels), SIGMA, np.float32))
        write_features(path, self.taught)
        self.session: onnxruntime.InferenceSession = load_model(path)[0]
        self.spec, self.network = spec, self.taught.network

    def __call__(self, loads: np.ndarray, offset: float = 0.0, sigma: float = SIGMA) -> np.ndarray:
        """(touch, step, feature)."""
        timing, n = self.taught.timing, len(loads)
        fed = {
            "offset": np.full((n, *self.spec.shape), offset, np.float32),
            "sigma": np.full((n, *self.spec.shape), sigma, np.float32),
        }
        states = self.network.state()
        state = {name: np.zeros((n, *shape), np.float32) for name, shape in states.items()}
        names = ["embedding", *(f"{name}_next" for name in states)]
        found = []
        for k in range(timing.steps):
            samples = loads[:, k * timing.substeps : (k + 1) * timing.substeps] + offset
            out, *after = self.session.run(
                names, {"samples": samples.astype(np.float32), **fed, **state}
            )
            state = dict(zip(states, after, strict=True))
            found.append(out)
        return np.stack(found, axis=1)


@pytest.fixture(scope="module", params=["one element", "a row of three"])
def run(request, tmp_path_factory):
    spec = wrench_spec() if request.param == "one element" else small_spec(rate_hz=100.0)
    return Run(tmp_path_factory.mktemp("features") / "features.onnx", spec)


@pytest.fixture(scope="module")
def loads(run):
    shape = (4, run.taught.timing.samples, *run.spec.shape)
    smooth = np.random.default_rng(0).normal(size=shape).cumsum(axis=1)
    return smooth / 4


def test_a_touch_is_the_same_alone_and_among_others(run, loads):
    together = run(loads)
    alone = np.concatenate([run(one[None]) for one in loads])
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-5)


def test_the_future_does_not_matter(run, loads):
    other = loads.copy()
    half = run.taught.timing.steps // 2
    other[:, half * run.taught.timing.substeps :] = 7.0
    np.testing.assert_array_equal(run(other)[:, :half], run(loads)[:, :half])
    assert np.abs(run(other)[:, half:] - run(loads)[:, half:]).max() > 0.01


def test_no_number_is_no_load(run, loads):
    holes, zeros = loads.copy(), loads.copy()
    holes[:, 3:9, 0] = np.nan
    holes[:, 11, 0] = -np.inf
    zeros[:, 3:9, 0] = zeros[:, 11, 0] = 0
    found = run(holes)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found, run(zeros))


def test_where_a_sensor_rests_and_in_which_units_it_tells_does_not_matter(run, loads):
    peaks = len(set(run.spec.units))
    plain = run(loads)
    np.testing.assert_allclose(run(loads, offset=2.0), plain, rtol=1e-3, atol=1e-3)
    milli = run(1000 * loads, sigma=1000 * SIGMA)
    np.testing.assert_allclose(milli[..., :-peaks], plain[..., :-peaks], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(milli[..., -peaks:], plain[..., -peaks:] + np.log(1000), rtol=1e-4)


def test_silence_and_the_largest_numbers_stay_numbers(run, loads):
    for extreme in (0 * loads, 1e9 * np.sign(loads), 1e-12 * loads):
        assert np.isfinite(run(extreme)).all()
    assert np.isfinite(run(loads, sigma=np.inf)).all(), "an element without a baseline"


def test_every_sensor_of_a_kind_is_looked_at_alike(run):
    timing = run.taught.timing
    again = FeatureNetwork.draw(run.spec, timing.substeps, timing.steps)
    np.testing.assert_array_equal(again.kernels, run.network.kernels)
    np.testing.assert_array_equal(again.thresholds, run.network.thresholds)
    assert (np.diff(again.dilations) >= 0).all()
