"""Symmetries of the array against mechanics, and what each augmentation may and may not do."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactile_rt.calibration.device_calibration import Mirror
from tactile_rt.models.augmentation import (
    Tactile,
    _blur,
    build,
    image,
    mask_steps,
    symmetries,
    tactile_paper,
)
from tactile_rt.models.training.config import AUGMENTATIONS
from tests.helpers.refusals import refusal
from tests.helpers.tiny_sweeps import plate, tiny_array
from tests.helpers.touch_streams import reordered

SPEC = tiny_array()
NAMES = ("columns", "rows", "turn")
STEPS = 6


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def loads(n=8, seed=0):
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(n, STEPS, 5, *SPEC.shape))
    offset, sigma = rng.normal(size=(2, n, *SPEC.shape))
    return tuple(torch.from_numpy(a.astype(np.float32)) for a in (samples, offset, abs(sigma)))


def frames(n=8, seed=0):
    return torch.randn(n, STEPS, 30, 5, 7, generator=generator(seed))


def turned(q):
    """(3, 3) of a unit quaternion, by turning the axes one at a time: q v q*."""
    w, u = q[0], np.array(q[1:])
    return np.stack([v + 2 * np.cross(u, np.cross(u, v) + w * v) for v in np.eye(3)], axis=1)


# Symmetries


@pytest.mark.parametrize("which", range(3), ids=NAMES)
def test_no_whisker_is_lost_and_no_load_changes_its_size(which):
    symmetry = symmetries(SPEC)[which]
    assert sorted(symmetry.source) == list(range(30))
    products = symmetry.matrix @ symmetry.matrix.transpose(0, 2, 1)
    np.testing.assert_allclose(products, np.tile(np.eye(6), (30, 1, 1)), atol=1e-12)


def test_rows_and_columns_are_reversed_where_they_end():
    columns, rows, turn = symmetries(SPEC)
    at = {name: k for k, name in enumerate(SPEC.elements)}
    assert columns.source[at["A0"]] == at["A4"]
    assert columns.source[at["E1"]] == at["E4"]
    assert columns.source[at["C3"]] == at["C3"]
    assert rows.source[at["A2"]] == at["E2"]
    assert rows.source[at["D6"]] == at["C6"]
    corners = [SPEC.elements[k] for k in (turn.source[at["A0"]], turn.source[at["E0"]])]
    assert corners[0][0] == "E"  # the far end of the first column comes to the first row
    assert int(corners[1][1]) >= 4


@pytest.mark.parametrize("which", range(3), ids=NAMES)
def test_a_moment_stays_the_arm_cross_the_force(which):
    """M = r x F of a touch along the whisker and beside it; the arm is a polar vector."""
    symmetry, rng = symmetries(SPEC)[which], np.random.default_rng(0)
    arm, force = rng.normal(size=(2, 30, 3))
    before = np.concatenate([force, np.cross(arm, force)], axis=1)
    after = np.einsum("eij,ej->ei", symmetry.matrix, before[symmetry.source])
    as_force = np.concatenate([arm, np.zeros((30, 3))], axis=1)
    arm_after = np.einsum("eij,ej->ei", symmetry.matrix, as_force[symmetry.source])[:, :3]
    np.testing.assert_allclose(after[:, 3:], np.cross(arm_after, after[:, :3]), atol=1e-12)


@pytest.mark.parametrize("which", range(3), ids=NAMES)
def test_a_load_along_the_whisker_stays_one(which):
    along = np.tile([1.0, 0, 0, 0, 0, 0], (30, 1))
    after = np.einsum("eij,ej->ei", symmetries(SPEC)[which].matrix, along)
    np.testing.assert_allclose(after, along, atol=1e-12)


def test_a_symmetric_array_is_mirrored_as_another_module_mirrors_it():
    """Of whiskers that are each other's mirror images: f' = T f, m' = -T m, with T flipping z."""
    mirror = Mirror(axis="y", element_axis="z")
    right = [
        ((4e-3, y, -1e-3 * r), tiny_array(r).orientations[k])
        for r in range(2)
        for k, y in enumerate((2e-3, 1e-3))
    ]
    left = [mirror.pose(*pose) for pose in right]
    poses = [left[0], left[1], right[1], right[0], left[2], left[3], right[3], right[2]]
    spec = replace(
        SPEC,
        elements=tuple("abcdefgh"),
        grid=tuple((r, c) for r in range(2) for c in range(4)),
        positions=tuple(p for p, _ in poses),
        orientations=tuple(q for _, q in poses),
    )
    columns = symmetries(spec)[0]
    assert list(columns.source) == [3, 2, 1, 0, 7, 6, 5, 4]
    signs = [mirror.sign(c, u) for c, u in zip(spec.channels, spec.units, strict=True)]
    np.testing.assert_allclose(columns.matrix, np.tile(np.diag(signs), (8, 1, 1)), atol=1e-9)


def test_a_bending_keeps_its_direction_in_the_head():
    """Whiskers that all point one way: seen from the head, forces are simply mirrored."""
    one = SPEC.orientations[3]
    spec = replace(SPEC, orientations=(one,) * 30)
    columns, rows, _ = symmetries(spec)
    column = np.array([0, 1.0, 0])
    row = np.array([0, 0, -1.0])
    for symmetry, normal in ((columns, column), (rows, row)):
        r = turned(one)
        image = np.eye(3) - 2 * np.outer(normal, normal)
        force = r @ np.array([0, 0.3, -0.7])  # across the whisker
        seen = r @ symmetry.matrix[0, :3, :3] @ r.T @ force
        x, image_x = r[:, 0], image @ r[:, 0]
        # The image's own direction is turned back to where this whisker points, and no more.
        axis, angle = np.cross(image_x, x), np.arccos(np.clip(image_x @ x, -1, 1))
        axis /= np.linalg.norm(axis)
        f = image @ force
        expected = (
            f * np.cos(angle)
            + np.cross(axis, f) * np.sin(angle)
            + axis * (axis @ f) * (1 - np.cos(angle))
        )
        np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_arrays_without_symmetries_are_refused():
    assert "no grid of whiskers" in refusal(symmetries, reordered(SPEC, range(5)))
    other = replace(SPEC, channels=("fx", "fy", "fz", "mx", "my", "angle"))
    assert "mx is no component" in refusal(symmetries, other)


# Ours


def test_draws_are_the_windows_own():
    tactile = Tactile(SPEC)
    samples = loads(64)[0][:1].expand(64, -1, -1, -1, -1)
    _, offset, sigma = loads(64)
    augmented, _, _ = tactile((samples, offset, sigma), generator())
    assert len({tuple(row[:50]) for row in augmented.flatten(1).tolist()}) == 16  # 8 x reversal
    again, _, _ = tactile((samples, offset, sigma), generator())
    assert torch.equal(augmented, again)


def test_the_baseline_goes_with_the_samples():
    """What is subtracted is transformed as what it is subtracted from."""
    samples, offset, sigma = loads()
    tactile, which = Tactile(SPEC), torch.arange(8)
    reverse = torch.arange(8) % 2 == 0
    a, b, c = tactile.transform((samples, offset, sigma), which, reverse)
    deviation = samples - offset[:, None, None]
    nothing = torch.zeros_like(offset)
    expected, _, _ = tactile.transform((deviation, nothing, sigma), which, reverse)
    torch.testing.assert_close(a - b[:, None, None], expected, atol=1e-5, rtol=1e-5)
    # An orthogonal matrix keeps the sum of the variances of a vector's components.
    for part in (slice(0, 3), slice(3, 6)):
        before = (sigma[..., part] ** 2).sum((1, 2))
        torch.testing.assert_close((c[..., part] ** 2).sum((1, 2)), before)


def test_time_reversal_is_that_of_every_sample_and_of_the_sign():
    samples, offset, sigma = loads()
    which, yes = torch.zeros(8, dtype=torch.int64), torch.ones(8, dtype=torch.bool)
    turned_back, baseline, _ = Tactile(SPEC).transform((samples, offset, sigma), which, yes)
    expected = -samples.flatten(1, 2).flip(1).view(samples.shape)
    torch.testing.assert_close(turned_back, expected)
    torch.testing.assert_close(baseline, -offset)


# The others


def test_the_published_variant_draws_once_for_a_batch_and_loses_whiskers():
    one = frames(1).expand(4, -1, -1, -1, -1)
    outcomes = [tactile_paper(one, generator(seed)) for seed in range(400)]
    assert all(torch.equal(o[0], o[3]) for o in outcomes)
    lost = [int((o[0] == 0).sum()) for o in outcomes]
    assert set(lost) == {0, STEPS * 30 * 10}  # a turned grid has lost two columns of five
    whole = {
        (name, sign): sum(torch.equal(o, sign * view if sign > 0 else backwards(view))
                          for o in outcomes)
        for name, view in {
            "as it was": one, "columns": one.flip(-1), "rows": one.flip(-2),
            "half a turn": one.flip((-1, -2)),
        }.items()
        for sign in (1, -1)
    }  # fmt: skip
    # the eighths: mirrored never (1/2), by columns or by rows (1/4 each); turned by 0 to 3 quarters
    share = {"as it was": 1 / 8, "half a turn": 1 / 8, "columns": 1 / 8, "rows": 1 / 8}
    for (name, _), count in whole.items():
        assert abs(count / len(outcomes) - share[name] / 2) < 0.05, name
    assert sum(whole.values()) + lost.count(STEPS * 30 * 10) == len(outcomes)


def backwards(view):
    """All sub-steps in the other order, with the other sign."""
    return -view.unflatten(2, (5, 6)).flip(1, 2).flatten(2, 3)


def test_image_operations_are_drawn_for_every_window_and_keep_the_shape():
    x = frames(64)
    y = image(x, generator())
    assert y.shape == x.shape
    grey = (y.unflatten(2, (5, 6)).std(3) < 1e-6).flatten(1).all(1)
    assert 0 < grey.sum() < 30
    same = (x == y).flatten(1).all(1)
    assert same.sum() < 20


def test_three_quarters_of_the_steps_are_masked():
    x = frames(16) + 10
    masked = (mask_steps(x, 0.75, generator()) == 0).flatten(2).all(2)
    kept = (mask_steps(x, 0.75, generator()) == x).flatten(2).all(2)
    assert (masked.sum(1) == round(0.75 * STEPS)).all()
    assert (masked ^ kept).all()
    assert len({tuple(row) for row in masked.tolist()}) > 4


@pytest.mark.parametrize("name", AUGMENTATIONS)
@pytest.mark.parametrize("masking", [0.0, 0.5])
def test_every_augmentation_can_be_built(name, masking):
    made = build(name, SPEC, masking)
    before = loads()
    after = made.loads(before, generator())
    changed = not torch.equal(before[0], after[0])
    assert changed == (name == "tactile")
    x = frames()
    draws = generator(4)
    y = made.mask(made.frames(x, draws), draws)
    assert y.shape == x.shape
    assert torch.equal(x, y) == (name in ("none", "tactile") and not masking)


@pytest.mark.parametrize("name", ["image-paper", "image-paper-weak"])
def test_a_row_of_whiskers_is_no_picture(name):
    assert "this array has 1 x 4; take image" in refusal(build, name, plate(1, 4))
    build(name, plate(2, 4)).frames(torch.rand(2, 3, 30, 2, 4), generator())


@pytest.mark.parametrize("grid", [(5, 7), (1, 4), (2, 1)])
def test_a_blur_is_that_of_a_plain_loop_with_edges_repeated(grid):
    frame = torch.randn(2, 3, *grid, generator=torch.Generator().manual_seed(0))
    found = _blur(frame)
    weights = (0.25, 0.5, 0.25)
    for row in range(grid[0]):
        for column in range(grid[1]):
            expected = 0
            for i, a in zip((-1, 0, 1), weights, strict=True):
                for j, b in zip((-1, 0, 1), weights, strict=True):
                    near = min(max(row + i, 0), grid[0] - 1), min(max(column + j, 0), grid[1] - 1)
                    expected = expected + a * b * frame[..., near[0], near[1]]
            torch.testing.assert_close(found[..., row, column], expected)
