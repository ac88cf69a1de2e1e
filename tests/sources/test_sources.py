from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import install_extra
from tactile_rt.core.stream import concatenate
from tactile_rt.sources.opening import open_source
from tactile_rt.sources.synthetic import SyntheticOptions, SyntheticSource
from tactile_rt.testing import ArraySource, small_spec
from tests.helpers.refusals import refusal


@dataclass(frozen=True)
class GloveOptions:
    gain: float = 1.0
    channels: int = 2
    raw: bool = False
    path: str = ""

    def __post_init__(self) -> None:
        if self.gain <= 0:
            raise ConfigError(f"gain must be positive, not {self.gain}")


class Glove(ArraySource):
    """A source of another package."""

    Options = GloveOptions

    def __init__(self, target: str, options: GloveOptions) -> None:
        super().__init__(small_spec(), [])
        self.target, self.options = target, options


@pytest.fixture
def glove(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package is installed that brings the scheme `glove`."""
    point = metadata.EntryPoint("glove", f"{__name__}:Glove", "tactile_rt.sources")
    monkeypatch.setattr(metadata.EntryPoint, "load", lambda self: Glove)
    points = metadata.EntryPoints([point, metadata.EntryPoint("glove", "x:y", "other.group")])
    monkeypatch.setattr(metadata, "entry_points", lambda **params: points.select(**params))


@pytest.mark.usefixtures("glove")
def test_another_package_s_source_is_opened_with_its_own_options() -> None:
    source = open_source("glove:/dev/ttyUSB0?gain=2.5&channels=6&raw=true")
    assert isinstance(source, Glove)
    assert source.target == "/dev/ttyUSB0"
    assert source.options == GloveOptions(2.5, 6, True)


@pytest.mark.usefixtures("glove")
@pytest.mark.parametrize(
    ("url", "target", "path"),
    [
        ("glove:", "", ""),
        ("glove:left", "left", ""),
        ("glove://host:5000/a", "host:5000/a", ""),
        ("glove:a%20b?path=c%20d%26e", "a b", "c d&e"),
        ("glove:?path=", "", ""),
        ("glove:part#2?path=mesh#7.obj", "part#2", "mesh#7.obj"),
        ("glove:?path=a=b", "", "a=b"),
    ],
)
def test_what_the_url_says_arrives(url: str, target: str, path: str) -> None:
    source = open_source(url)
    assert (source.target, source.options.path) == (target, path)


@pytest.mark.usefixtures("glove")
@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("glove:a?gian=2", "glove:a has no option 'gian'; did you mean gain?"),
        ("glove:a?zzz=2", "glove:a has no option 'zzz'; there are gain, channels, raw, path"),
        ("glove:a?channels=two", "glove:a: channels: expected a whole number, got 'two'"),
        ("glove:a?channels=2.5", "glove:a: channels: expected a whole number, got '2.5'"),
        ("glove:a?raw=perhaps", "glove:a: raw: expected true or false, got 'perhaps'"),
        ("glove:a?gain=", "glove:a: gain: expected a number, got ''"),
        ("glove:a?gain=1e999", "glove:a: gain: inf is not a finite number"),
        ("glove:a?gain=-1", "gain must be positive, not -1.0"),
        ("glove:a?gain=1&gain=2", "option 'gain' is given twice"),
    ],
)
def test_a_wrong_option_is_named_with_what_would_be_right(url: str, said: str) -> None:
    assert said in refusal(open_source, url)


@pytest.mark.usefixtures("glove")
def test_third_parties_are_among_the_known_schemes() -> None:
    assert refusal(open_source, "glvoe:left") == "'glvoe:left' is no source; did you mean glove:?"
    assert "glove:" in refusal(open_source, "xyz:left")


@pytest.mark.parametrize("url", ["", "mouse", "xyz:mouse", "/dev/ttyUSB0", "?seed=1"])
def test_an_unknown_source_is_told_what_there_is(url: str) -> None:
    said = refusal(open_source, url)
    assert said.startswith(f"{url!r} is no source; there are ")
    assert "sim:" in said


def test_a_url_that_cannot_be_taken_apart_is_a_config_error_too() -> None:
    assert "sim://[mouse" in refusal(open_source, "sim://[mouse")


def test_an_extra_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from tactile_rt.sources import opening as sources

    def without_mujoco(name: str) -> None:
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(sources, "import_module", without_mujoco)
    said = refusal(open_source, "sim:mouse")
    assert said == f"source sim: needs mujoco, which is not installed: {install_extra('sim')}"

    def broken(name: str) -> None:
        raise ModuleNotFoundError("no such module", name="tactile_rt.sim_backend.sauce")

    # Our own mistake must not be taken for the user's.
    monkeypatch.setattr(sources, "import_module", broken)
    with pytest.raises(ModuleNotFoundError):
        open_source("sim:mouse")


@pytest.mark.skipif(find_spec("mujoco") is None, reason="mujoco is not installed")
class TestSimulation:
    def test_its_options_arrive(self) -> None:
        with open_source("sim:mouse?objects=mug-3&pace=fast&seed=9") as source:
            assert not source.live
            assert source.spec.name == "mouse-right"

    @pytest.mark.parametrize(
        ("url", "said"),
        [
            ("sim:cat", "no simulated array 'cat'"),
            ("sim:mouse?pace=slow", "no pace 'slow': there are realtime, fast"),
            ("sim:mouse?sweeps=-1", "sweeps must be 0 or more"),
            ("sim:mouse?objects=mugg", "did you mean 'mug'?"),
        ],
    )
    def test_what_it_cannot_do_is_named(self, url: str, said: str) -> None:
        assert said in refusal(open_source, url)


def test_one_at_rest_only_has_noise() -> None:
    made = SyntheticSource("35x6", SyntheticOptions(seconds=6.0, pace="fast", touches=False))
    values = concatenate(list(made)).values
    touched = SyntheticSource("35x6", SyntheticOptions(seconds=6.0, pace="fast"))
    assert np.abs(values).max() < 0.05 * np.abs(concatenate(list(touched)).values).max()
    assert values.std(axis=0).min() > 0
