"""Networks for arrays of any size: what holds for the mouse's holds for a robot's."""

from dataclasses import replace

import pytest
import torch

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Timing
from tactile_rt.core.stream.sensor_spec import channel_limits
from tactile_rt.models.ead import EAD, TactileClassifier
from tactile_rt.models.ead_config import ENCODERS, EADConfig
from tests.helpers.small_networks import GRAPH, TOLERANCE, build, stream
from tests.helpers.tiny_sweeps import plate

GRIDS = [(6, 1, 1), (30, 2, 2), (30, 2, 4), (12, 1, 32), (15, 3, 3), (9, 10, 14), (4, 8, 1)]


@pytest.mark.parametrize("frame", GRIDS)
@pytest.mark.parametrize("encoder", [name for name in ENCODERS if name != "graph"])
def test_a_window_and_its_steps_give_the_same_logits(
    encoder: str, frame: tuple[int, int, int]
) -> None:
    ead = build(encoder, "none", "mean", frame=frame)
    x = torch.randn(2, 9, *frame, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        whole, steps = ead(x), stream(ead, x)
    assert whole.shape == (2, 9, 7)
    torch.testing.assert_close(whole, steps, rtol=0, atol=5 * TOLERANCE)
    # every number of a frame has its say, from the lag on
    loud = x.clone()
    loud[:, 0] += torch.randn(frame, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        assert (ead(loud)[:, ead.lag] != whole[:, ead.lag]).any()


def test_a_network_of_another_array_is_refused_in_one_line() -> None:
    with pytest.raises(ConfigError, match=r"30 x 5 x 7 .* does not fit an array of 6 channels on"):
        spec = plate(2, 4)
        TactileClassifier(spec, EADConfig(3, "gru", "none", width=1 / 32), channel_limits(spec))


def test_a_classifier_knows_how_its_windows_are_cut() -> None:
    config = EADConfig(3, "gru", "none", width=1 / 32, frame=(12, 2, 4), max_steps=10)
    spec = plate(2, 4, "fx fy fz")
    model = TactileClassifier(spec, config, channel_limits(spec))
    assert model.timing == Timing(steps=10, substeps=4)
    samples = torch.zeros(2, 10, 4, 8, 3)
    rest = torch.zeros(2, 8, 3)
    assert model.eval()(samples, rest, rest + 1e-6).shape == (2, 10, 3)


@pytest.mark.parametrize(
    ("period_ms", "substeps"), [(9, 5), (10, 4), (12.5, 4), (1, 45), (100, 1), (5, 9)]
)
def test_steps_are_about_45_ms_at_every_rate(period_ms: float, substeps: int) -> None:
    assert Timing.of(round(period_ms * 1e6)) == Timing(22, substeps)


def test_a_graph_for_another_array_is_refused_in_one_line() -> None:
    config = EADConfig(3, "graph", "none", graph=GRAPH)
    assert EAD(config)
    with pytest.raises(ConfigError, match=r"frame has 30 x 5 x 7 .* array's frames 6 x 1 x 1"):
        EAD(replace(config, frame=(6, 1, 1)))
