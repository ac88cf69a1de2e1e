"""The input stage against the same arithmetic in plain numpy."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.ead import InputStage, paper_units
from tests.helpers.tiny_sweeps import plate, tiny_array

EMPTY = {(0, 5), (0, 6), (1, 5), (1, 6), (4, 6)}
POSITIONS = tuple((r, c) for r in range(5) for c in range(7) if (r, c) not in EMPTY)
CLIP = (5e-3, 5e-3, 5e-3, 5e-6, 5e-6, 4e-6)
SCALE = (2e-6, 2e-6, 1e-6, 1e-8, 1e-8, 3e-8)


def oracle(samples, offset, sigma):
    """One frame at a time, one number at a time: (sub-step, element, channel) in float64."""
    frame = np.zeros((samples.shape[0] * 6, 5, 7))
    for k, i, c in np.ndindex(samples.shape):
        v = min(max(float(samples[k, i, c]) - float(offset[i, c]), -CLIP[c]), CLIP[c])
        s = np.hypot(SCALE[c], 3 * float(sigma[i, c]))
        frame[k * 6 + c, *POSITIONS[i]] = np.sign(v) * np.log1p(abs(v) / s)
    return frame


@pytest.mark.parametrize("steps", [(), (3,), (2, 2)])
def test_equals_the_arithmetic(steps):
    rng = np.random.default_rng(0)
    magnitude = np.array(CLIP) * 10 ** rng.uniform(-5, 0.5, (2, *steps, 5, 30, 6))
    samples = (magnitude * rng.choice([-1, 0, 1], magnitude.shape)).astype(np.float32)
    offset = (1e-2 * np.array(CLIP) * rng.normal(size=(2, 30, 6))).astype(np.float32)
    sigma = (1e-3 * np.array(CLIP) * rng.uniform(0, 1, (2, 30, 6))).astype(np.float32)
    stage = InputStage(POSITIONS, (5, 7), CLIP, SCALE)
    found = stage(*map(torch.from_numpy, (samples, offset, sigma))).numpy()
    assert found.shape == (2, *steps, 30, 5, 7)
    assert found.dtype == np.float32
    for b, *at in np.ndindex(2, *steps):
        expected = oracle(samples[b, *at], offset[b], sigma[b])
        np.testing.assert_allclose(found[b, *at], expected, atol=2e-5, rtol=2e-5)


def test_order_of_elements_is_that_of_the_samples():
    stage = InputStage(POSITIONS[::-1], (5, 7), CLIP, SCALE)
    samples = torch.zeros(1, 5, 30, 6)
    samples[0, 3, 0, 1] = 1e-3  # first element: the last position, E5
    frame = stage(samples, torch.zeros(1, 30, 6), torch.zeros(1, 30, 6))
    assert frame.nonzero().tolist() == [[0, 3 * 6 + 1, 4, 5]]


def test_silence_is_zero_and_noise_stays_small():
    rng = torch.Generator().manual_seed(0)
    stage = InputStage(POSITIONS, (5, 7), CLIP, SCALE)
    sigma = torch.full((4, 30, 6), 1e-4)
    offset = torch.randn(4, 30, 6, generator=rng)
    at_rest = offset[:, None].expand(4, 5, 30, 6)
    assert not stage(at_rest, offset, sigma).any()
    noise = 1e-4 * torch.randn(4, 5, 30, 6, generator=rng)
    assert stage(noise, torch.zeros_like(offset), sigma).abs().max() < 1.0


def loads(batch: int = 2) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Samples, offset and sigma, none of them zero."""
    rng = torch.Generator().manual_seed(0)
    shapes = (batch, 5, 30, 6), (batch, 30, 6), (batch, 30, 6)
    samples, offset, sigma = (1e-4 * torch.randn(shape, generator=rng) for shape in shapes)
    return samples, offset, sigma.abs()


BAD = [torch.nan, torch.inf, -torch.inf]


@pytest.mark.parametrize("bad", BAD)
def test_a_sample_that_is_no_number_is_no_load_and_changes_nothing_else(bad):
    stage = InputStage(POSITIONS, (5, 7), CLIP, SCALE)
    samples, offset, sigma = loads()
    whole = stage(samples, offset, sigma)
    struck = torch.rand(samples.shape, generator=torch.Generator().manual_seed(1)) < 0.2
    found = stage(samples.masked_fill(struck, bad), offset, sigma)
    at_rest = torch.where(struck, offset[:, None].expand_as(samples), samples)
    assert torch.equal(found, stage(at_rest, offset, sigma))
    assert struck.sum() > 300 and torch.count_nonzero(found) < torch.count_nonzero(whole)
    assert torch.equal(found[found != 0], whole[found != 0])


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("which", [1, 2])
def test_a_channel_whose_baseline_or_noise_is_no_number_is_silent(bad, which):
    stage = InputStage(POSITIONS, (5, 7), CLIP, SCALE)
    arrays = loads()
    whole = stage(*arrays)
    arrays[which][1, 7, 2] = bad  # of the second in the batch
    found = stage(*arrays)
    row, column = POSITIONS[7]
    silent = torch.zeros_like(whole, dtype=torch.bool)
    silent[1, 2::6, row, column] = True
    assert (found[silent] == 0).all() and (whole[silent] != 0).all()
    assert torch.equal(found[~silent], whole[~silent])


@pytest.mark.parametrize(
    ("positions", "clip", "scale", "match"),
    [
        (((0, 0), (0, 0)), CLIP, SCALE, "share"),
        (((0, 0), (5, 0)), CLIP, SCALE, "outside"),
        (((0, 0),), CLIP, SCALE[:5], "6 clip limits, but 5 scales"),
        (((0, 0),), (*CLIP[:5], 0.0), SCALE, "positive"),
    ],
)
def test_refuses(positions, clip, scale, match):
    with pytest.raises(ConfigError, match=match):
        InputStage(positions, (5, 7), clip, scale)


@pytest.mark.parametrize("shape", [(1, 5, 31, 6), (1, 5, 30, 3)])
def test_refuses_samples_of_another_array(shape):
    stage = InputStage(POSITIONS, (5, 7), CLIP, SCALE)
    with pytest.raises(ValueError, match="30 x 6"):
        stage(torch.zeros(shape), torch.zeros(1, *shape[2:]), torch.zeros(1, *shape[2:]))


def test_everything_it_needs_is_stored_with_it():
    stage = InputStage(POSITIONS, (5, 7), CLIP, SCALE)
    other = InputStage(POSITIONS[::-1], (5, 7), [1.0] * 6, [1.0] * 6)
    other.load_state_dict(stage.state_dict())
    samples = 1e-4 * torch.randn(1, 5, 30, 6, generator=torch.Generator().manual_seed(0))
    rest = torch.zeros(1, 30, 6)
    torch.testing.assert_close(other(samples, rest, rest), stage(samples, rest, rest))


def test_the_papers_units_without_a_logarithm():
    spec = tiny_array()
    clip, unit = paper_units(spec)
    stage = InputStage(spec.grid, (5, 7), clip, unit, "paper")
    samples = torch.zeros(1, 5, 30, 6)
    samples[0, 2, 7] = torch.tensor([1e-3, -2.5e-3, 7.0, 1e-6, -3e-2, float("nan")])
    offset = torch.full((1, 30, 6), 0.0)
    offset[0, 7, 0] = 4e-4
    frame = stage(samples, offset, torch.full((1, 30, 6), 1e-3))  # whatever the noise was
    found = frame[0, 12:18, *spec.grid[7]]
    torch.testing.assert_close(found, torch.tensor([0.6, -2.5, 1000.0, 1.0, -1000.0, 0.0]))
    assert frame.count_nonzero() == 5 + 4  # and the baseline in the other sub-steps


def test_the_papers_units_are_of_forces_and_moments():
    with pytest.raises(ConfigError, match="this array has V; take log"):
        paper_units(replace(plate(1, 2), units=("N", "N", "V", "N m", "N m", "N m")))
