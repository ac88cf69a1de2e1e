"""Responses computed elsewhere: which arrays of a file are layers."""

import numpy as np
import pytest

from tactile_rt.alignment.loading import responses_layers
from tactile_rt.core.errors import ConfigError

RNG = np.random.default_rng(0)


def test_a_layer_is_of_the_encoder_unless_its_name_says_so(tmp_path):
    arrays = {"stem": RNG.normal(size=(6, 4)), "decoder.fc1": RNG.normal(size=(6, 22, 3))}
    np.savez(tmp_path / "a.npz", **arrays)
    traces = responses_layers(tmp_path / "a.npz").traces
    assert {name: trace.shape for name, trace in traces.items()} == {
        "encoder.stem": (6, 1, 4),
        "decoder.fc1": (6, 22, 3),
    }


@pytest.mark.parametrize("names", [("stem", "encoder.stem"), ("encoder.stem", "stem")])
def test_no_layer_takes_the_place_of_another(tmp_path, names):
    np.savez(tmp_path / "a.npz", **{name: RNG.normal(size=(6, 4)) for name in names})
    with pytest.raises(ConfigError, match=r"arrays stem and encoder\.stem are one layer"):
        responses_layers(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"x": np.full((6, 4), 1e300)}, r"array x .* is no layer: finite"),
        ({"a": np.zeros((5, 3))}, "array a .* is no layer"),
        ({"a": np.full((6, 3), np.nan)}, "array a .* is no layer"),
        ({"a": np.array([None] * 6)}, "no archive of arrays"),
        ({}, "has no array"),
    ],
)
def test_what_is_no_layer_is_refused(tmp_path, arrays, said):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ConfigError, match=said):
        responses_layers(tmp_path / "a.npz")


def test_what_is_no_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nonsense")
    with pytest.raises(ConfigError, match="no archive of arrays"):
        responses_layers(tmp_path / "a.npz")
    with pytest.raises(ConfigError, match="cannot be read"):
        responses_layers(tmp_path / "none.npz")
