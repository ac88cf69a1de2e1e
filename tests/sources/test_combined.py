"""Several arrays as one."""

import dataclasses

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import concatenate
from tactile_rt.sources.combined import CombinedSource, MemberArray, combine_specs
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, cut_chunks, small_spec

HEAD = 'name = "a"\nrate_hz = 1\n'
ONE = HEAD + '[[source]]\nname = "x"\nurl = "{}"'
LEFT, RIGHT = small_spec(3), small_spec(2, rate_hz=500.0)
PARTS = [
    MemberArray("left", ""),
    # turned by a quarter about z: x becomes y
    MemberArray("right", "", (0.0, -0.04, 0.0), (2**-0.5, 0.0, 0.0, 2**-0.5)),
]


def wave(spec, seconds, lag_s=0.0):
    t = np.arange(round(seconds * spec.rate_hz)) / spec.rate_hz + lag_s
    return np.sin(2 * np.pi * 3 * t)[:, None, None] * np.ones(spec.shape)


def combined(lag_ns=0, right_seconds=2.0):
    right = cut_chunks(
        wave(RIGHT, right_seconds, lag_ns / 1e9), 500.0, start_ns=10_000_000_000 + lag_ns
    )
    left = cut_chunks(wave(LEFT, 2.0), 1000.0, start_ns=10_000_000_000)
    members = [ArraySource(LEFT, left), ArraySource(RIGHT, right)]
    return CombinedSource(members, PARTS, "head", 250.0)


def test_the_spec_holds_both_arrays_in_one_frame():
    spec = combine_specs([LEFT, RIGHT], PARTS, "head", 250.0)
    assert spec.elements == ("left.A0", "left.A1", "left.A2", "right.A0", "right.A1")
    assert spec.grid == ((0, 0), (0, 1), (0, 2), (1, 0), (1, 1))
    assert (spec.name, spec.frame, spec.rate_hz) == ("head", "head", 250.0)
    np.testing.assert_allclose(spec.positions[4], (-0.002, -0.04, 0.0), atol=1e-12)
    np.testing.assert_allclose(spec.orientations[4], (2**-0.5, 0, 0, 2**-0.5), atol=1e-12)


@pytest.mark.parametrize("lag_ns", [0, 700_000, 130_000_000])
def test_samples_of_one_moment_come_together(lag_ns):
    with combined(lag_ns) as source:
        chunks = list(source)
    whole = concatenate(chunks)
    t, values, valid = whole.t_ns, whole.values, whole.valid
    assert (np.diff(t) == 4_000_000).all() and (t % 4_000_000 == 0).all()
    both = valid.all(axis=1)
    assert both.sum() > 400
    np.testing.assert_allclose(values[both, 0], values[both, 4], atol=0.02)
    truth = np.sin(2 * np.pi * 3 * (t[both] - 10_000_000_000) / 1e9)
    np.testing.assert_allclose(values[both, 0, 0], truth, atol=0.02)
    assert source.stats.delivered == len(t)


def test_an_array_that_ends_is_left_out():
    with combined(right_seconds=1.0) as source:
        whole = concatenate(list(source))
    assert whole.valid[-200:, :3].all() and not whole.valid[-200:, 3:].any()
    assert (whole.values[-200:, 3:] == 0).all()


def test_arrays_that_measure_different_things_are_refused():
    other = dataclasses.replace(RIGHT, units=("Pa", "N m"))
    with pytest.raises(ConfigError, match=r"right measures fy, mz \(Pa, N m\), left"):
        combine_specs([LEFT, other], PARTS, "head", 250.0)


def test_a_file_combines_urls(tmp_path):
    path = tmp_path / "head.toml"
    path.write_text(
        'name = "head"\nrate_hz = 500\n'
        '[[source]]\nname = "left"\nurl = "synthetic:4x2?seconds=1&pace=fast"\n'
        '[[source]]\nname = "right"\nurl = "synthetic:3x2?seconds=1&pace=fast&rate_hz=700"\n'
    )
    with open_source(f"combined:{path}") as source:
        assert source.spec.shape == (7, 2)
        assert not source.live
        n = sum(len(c) for c in source)
    assert 480 <= n <= 500


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "needs a key 'name'"),
        (HEAD + "source = []", "no \\[\\[source\\]\\]"),
        (
            HEAD + 'source = [{name="x", url="y", pose=1}]',
            r":3: source\[0\] has no key 'pose'; there are name, url, pos",
        ),
        ("name = ", ":1: not TOML: Invalid value"),
        ('name = "a"\nrate_hz = 0', ":2: rate_hz: expected a number > 0"),
        (ONE.format("synthetic:5"), r":5: source\[0\]\.url: synthetic:5 is not a size"),
        (ONE.format("combined:head.toml"), r":5: source\[0\]\.url: head\.toml combines itself"),
    ],
)
def test_a_wrong_file_is_named(cwd, text, said):
    path = cwd / "head.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=said) as caught:
        open_source(f"combined:{path}")
    assert str(caught.value).startswith(str(path))
