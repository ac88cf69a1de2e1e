"""The network as it is exported, step by step, against the window that was trained."""

from collections.abc import Iterator

import pytest
import torch

from tactile_rt.export import streaming as streaming_module
from tactile_rt.export.streaming import Pointwise, Taps, streaming
from tests.helpers.small_networks import GRAPH, TOLERANCE, build, frames, stream

STEPS = 22
# Every cell, encoder, attender and decoder at least once; `make check-export` takes all of them.
SAMPLE = [
    ("zhuang-timedecay", "none", "mlp"),
    ("zhuang-timedecay-ln", "mamba", "linear"),
    ("zhuang-vanilla", "gpt", "linear"),
    ("zhuang-vanilla-ln", "none", "linear"),
    ("zhuang-ugrnn", "none", "linear"),
    ("zhuang-ugrnn-ln", "gpt", "mlp-all"),
    ("zhuang-intersection", "mamba", "mlp"),
    ("zhuang-intersection-ln", "gpt", "linear"),
    ("zhuang-gru", "none", "mlp-all"),
    ("zhuang-gru-ln", "none", "linear"),
    ("zhuang-lstm", "none", "linear"),
    ("zhuang-lstm-ln", "mamba", "mlp-all"),
    ("resnet18", "gpt", "mlp"),
    ("s4", "gpt", "mlp-all"),
    ("mamba", "none", "mlp"),
    ("gru", "mamba", "linear"),
]


@pytest.fixture(scope="module", autouse=True)
def _inference() -> Iterator[None]:
    with torch.inference_mode():
        yield


@pytest.mark.parametrize(("encoder", "attender", "decoder"), SAMPLE)
def test_steps_give_the_window_s_logits(encoder: str, attender: str, decoder: str) -> None:
    ead = build(encoder, attender, "mean" if decoder == "mlp" else "last", decoder=decoder)
    x = frames()
    expected = ead(x)
    assert expected.std() > 1e-3, "logits that say nothing would agree in any network"
    for integer in (False, True):
        assert abs(stream(streaming(ead, integer), x) - expected).max() <= TOLERANCE


@pytest.fixture
def as_if_wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small networks take the forms of wide ones."""
    monkeypatch.setattr(streaming_module, "LARGE", 0)
    monkeypatch.setattr(streaming_module, "WIDE", 0)


@pytest.mark.usefixtures("as_if_wide")
@pytest.mark.parametrize(("encoder", "attender", "decoder"), SAMPLE)
def test_so_they_do_in_the_forms_of_wide_networks(
    encoder: str, attender: str, decoder: str
) -> None:
    ead = build(encoder, attender, "mean" if decoder == "mlp" else "last", decoder=decoder)
    deployed, x = streaming(ead), frames()
    convolves = any(isinstance(module, Pointwise) for module in deployed.modules())
    assert convolves == (encoder.startswith("zhuang") or attender == "gpt")
    assert abs(stream(deployed, x) - ead(x)).max() <= TOLERANCE


@pytest.mark.parametrize("encoder", ["zhuang-lstm-ln", "s4"])
def test_lanes_are_reset_one_by_one_at_any_step(encoder: str) -> None:
    """Lane i begins anew at step 3 i + 1: from then on it is a new episode."""
    ead = build(encoder, "gpt", "mean", decoder="mlp-all")
    deployed, x, lanes = streaming(ead), frames(batch=3), 3
    at = [3 * lane + 1 for lane in range(lanes)]
    state, zero = deployed.initial_state(lanes), deployed.initial_state(lanes)
    logits = []
    for t in range(STEPS):
        for lane in range(lanes):
            if t == at[lane]:
                for name in state:
                    state[name] = state[name].clone()
                    state[name][lane] = zero[name][lane]
        out, state = deployed.step(x[:, t], state)
        logits.append(out)
    for lane in range(lanes):
        found = torch.stack(logits[at[lane] :])[:, lane]
        assert abs(found - ead(x[lane : lane + 1, at[lane] :])[0]).max() <= TOLERANCE


def test_a_step_writes_its_own_rows_of_the_cache_and_no_others() -> None:
    """Each lane is at a step of its own; the last is past the end, where the last row is used."""
    deployed = streaming(build(attender="gpt"))
    at = torch.tensor([0, 4, STEPS - 1, STEPS + 3])
    state = deployed.initial_state(len(at))
    caches = [name for name in state if name.startswith("gpt_")]
    for name in caches:
        state[name] = torch.randn_like(state[name])
    (counter,) = [name for name in state if state[name].dtype == torch.int64]
    state[counter] = at
    _, new = deployed.step(frames(batch=len(at))[:, 0], state)
    for name in caches:
        changed = (new[name] != state[name]).all(-1).all(1)  # (lane, row), in every head
        assert torch.equal(changed, (new[name] != state[name]).any(-1).any(1))
        rows = [row.nonzero().flatten().tolist() for row in changed]
        last = 2 * (STEPS - 1)
        assert rows == [[0, 1], [8, 9], [last, last + 1], [last, last + 1]]


def test_a_graph_with_sums_and_gates_streams_as_it_was_trained() -> None:
    ead = build("graph", "none", graph=GRAPH, width=1.0)
    x = frames()
    assert abs(stream(streaming(ead), x) - ead(x)).max() <= TOLERANCE


@pytest.mark.usefixtures("as_if_wide")
def test_maps_of_one_row_have_no_site_below() -> None:
    ead = build("zhuang-intersection", "none", frame=(12, 1, 32))
    deployed, x = streaming(ead), torch.randn(2, STEPS, 12, 1, 32)
    assert {one.lower for one in deployed.modules() if isinstance(one, Taps)} == {None}
    assert abs(stream(deployed, x) - ead(x)).max() <= TOLERANCE
