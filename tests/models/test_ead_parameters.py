"""Every network of the paper has the published number of parameters."""

import csv
from pathlib import Path

import pytest
import torch

from tactile_rt.models.attenders import GPT, MambaStack
from tactile_rt.models.ead import EAD, EADConfig, count_parameters
from tactile_rt.models.encoders.gru import GRUEncoder
from tactile_rt.models.encoders.mamba import MambaEncoder
from tactile_rt.models.encoders.zhuang import ZhuangEncoder

# Copied from the paper's tables; the first line says so.
LINES = (Path(__file__).parent / "data" / "ead_reference.csv").read_text().splitlines()[1:]
ROWS = list(csv.DictReader(LINES))
DECODERS = {
    "MLP 512-1024-512-117 (last step)": "mlp",
    "MLP 22*512-1024-512-117 (all steps)": "mlp-all",
    "linear (last step)": "linear",
    "linear-probe (last step)": "linear",
}
PUBLISHED = sorted(
    {(r["encoder"], r["attender"], r["decoder"], int(r["total_parameters"])) for r in ROWS}
)


def test_the_table_is_whole():
    assert len(ROWS) == 46
    assert {r["loss"] for r in ROWS} >= {"supervised", "simclr", "simsiam", "autoencoder"}


@pytest.mark.parametrize(("encoder", "attender", "decoder", "total"), PUBLISHED)
def test_published_totals(encoder, attender, decoder, total):
    with torch.device("meta"):
        network = EAD(EADConfig(117, encoder, attender, DECODERS[decoder]))
    assert count_parameters(network) == total


@pytest.mark.parametrize(("attender", "parameters"), [("gpt", 25_778_688), ("mamba", 6_784_000)])
def test_s4_totals(attender, parameters):
    """S4 (3,434,496), attender and linear decoder (60,021)."""
    ead = EAD(EADConfig(117, "s4", attender))  # its initial values cannot be made on "meta"
    assert count_parameters(ead) == 3_434_496 + parameters + 60_021


@pytest.mark.parametrize(
    ("cell", "norms"),
    [("timedecay", 1), ("vanilla", 1), ("ugrnn", 2), ("gru", 3), ("lstm", 5), ("intersection", 4)],
)
def test_layer_norm_adds_a_scale_and_a_shift_per_channel(cell, norms):
    with torch.device("meta"):
        plain, normal = (count_parameters(ZhuangEncoder(cell=cell + ln)) for ln in ("", "-ln"))
    assert normal - plain == norms * 2 * (96 + 128 + 256 + 384 + 384 + 256)


def test_published_attenders():
    with torch.device("meta"):
        assert count_parameters(GPT(512, 0.1, 22)) == 25_778_688
        assert count_parameters(GPT(256, 0.1, 22, inputs=512)) == 6_532_608
        assert count_parameters(MambaStack(512)) == 6_784_000
        assert count_parameters(MambaEncoder()) == 6_784_000 + 1051 * 512
        assert count_parameters(GRUEncoder()) == 3_978_240
