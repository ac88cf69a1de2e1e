"""The input of the six stimuli, held against what a model takes."""

import msgspec
import onnx
import pytest
import torch

from tactile_rt.alignment.activations import checkpoint_layers, untrained_card_layers
from tactile_rt.alignment.onnx_activations import onnx_layers
from tactile_rt.alignment.stimuli_input import read_stimuli
from tactile_rt.classifier.model_file import METADATA_KEY, read_model, shipped_model
from tactile_rt.core.errors import ConfigError
from tests.helpers.source_tree import ROOT

FELT = read_stimuli()
MS = 1_000_000


def test_a_model_of_another_sample_period_is_refused(tmp_path):
    """Of 10 ms, a step has five samples as well."""
    card = msgspec.structs.replace(read_model(shipped_model())[0], period_ns=10 * MS)
    model = onnx.load(shipped_model())
    onnx.helper.set_model_props(model, {METADATA_KEY: msgspec.json.encode(card).decode()})
    onnx.save(model, tmp_path / "slow.onnx")
    said = r"a sample every 10 ms, but the stimuli have one every 9 ms"
    with pytest.raises(ConfigError, match=rf"slow\.onnx takes {said}"):
        onnx_layers(tmp_path / "slow.onnx", FELT)
    with pytest.raises(ConfigError, match=said):
        untrained_card_layers(card, FELT)


@pytest.mark.parametrize("period_ms, taken", [(9, True), (10, False)])
def test_so_is_a_checkpoint_that_says_its_period(tmp_path, period_ms, taken):
    saved = torch.load(ROOT / "bench" / "shipped" / "mouse13.pt", weights_only=True)
    torch.save({**saved, "period_ns": period_ms * MS}, tmp_path / "a.pt")
    if taken:
        assert checkpoint_layers(tmp_path / "a.pt", FELT)[0].traces
        return
    with pytest.raises(ConfigError, match=r"a\.pt takes a sample every 10 ms"):
        checkpoint_layers(tmp_path / "a.pt", FELT)
