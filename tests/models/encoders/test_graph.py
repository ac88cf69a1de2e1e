"""Networks from data: paths, loops, fusion, a second modality, and what is refused."""

import pytest
import torch

from tactile_rt.models.ead import EAD, EADConfig
from tactile_rt.models.encoders.graph import Edge, Graph, Input, Node
from tactile_rt.models.encoders.graph_encoder import GraphEncoder
from tactile_rt.models.encoders.graph_files import parse_graph, read_graph
from tactile_rt.models.encoders.zhuang import GRAPH
from tactile_rt.stream import ConfigError
from tests.helpers.small_networks import TOLERANCE, frames, stir, stream

TEXT = """
readout = "fc"
[inputs.frame]
channels = 30
rows = 5
columns = 7
[inputs.whisker_angle]
channels = 4
[inputs.depth]
channels = 3
rows = 4
columns = 6
[nodes.first]
kind = "valid"
channels = 32
reads = ["frame", { source = "whisker_angle", fusion = "gate" }]
cell = "gru-ln"
[nodes.up]
channels = 64
reads = ["first", "down", "fc", { source = "depth", fusion = "sum" }]
cell = "lstm-ln"
[nodes.down]
channels = 32
reads = ["up", "down"]
[nodes.fc]
kind = "dense"
channels = 64
cell = "timedecay"
reads = ["up", { source = "whisker_angle", fusion = "gate" }]
"""


def test_zhuangs_graph():
    assert GRAPH.lag == 3
    assert GRAPH.sizes["conv6"] == (4, 6)
    assert [{n.name for n in group} for group in GRAPH.components] == [
        {"conv1"}, {f"conv{n}" for n in range(2, 7)}, {"fc7"}, {"fc8"}]  # fmt: skip
    assert [GRAPH.remaining[f"conv{n}"] for n in range(1, 7)] == [3, 2, 3, 2, 3, 2]


def test_a_graph_from_toml():
    graph = parse_graph(TEXT)
    assert graph.lag == 2  # first -> up -> fc
    assert graph.inputs[1] == Input("whisker_angle", 4)
    assert graph.nodes[1].reads[3] == Edge("depth", "sum")
    assert [[n.name for n in group] for group in graph.components] == [
        ["first"], ["up", "down", "fc"]]  # fmt: skip


@pytest.mark.parametrize("steps", [1, 2, 3, 9])
def test_stream_equals_window(steps):
    torch.manual_seed(0)
    ead = EAD(EADConfig(7, "graph", "none", readout="mean", graph=TEXT)).eval()
    stir(ead)
    others = torch.randn(2, steps, 4), torch.randn(2, steps, 3, 4, 6)
    x = frames(2, steps)
    with torch.no_grad():
        assert (ead(x, *others) - stream(ead, x, *others)).abs().max() <= TOLERANCE


def test_what_can_be_heard_when():
    """The frame two steps late, whisker angles at once, at the node that the data name."""
    torch.manual_seed(0)
    encoder = GraphEncoder(parse_graph(TEXT))
    stir(encoder)
    inputs = [frames(1, 6), torch.randn(1, 6, 4), torch.randn(1, 6, 3, 4, 6)]
    wanted = [x.requires_grad_() for x in inputs]
    gradients = torch.autograd.grad(encoder(*inputs)[:, -1].square().sum(), wanted)
    heard = [g.flatten(2).abs().amax(dim=(0, 2)) > 0 for g in gradients]
    assert [int(h.nonzero().max()) for h in heard] == [3, 5, 4]


def test_fusion():
    """sum and gate, against their definitions, in a node that only adds up."""
    torch.manual_seed(0)
    for fusion in ("sum", "gate"):
        reads = (Edge("frame"), Edge("angle", fusion))
        graph = Graph(
            (Input("frame", 30, 5, 7), Input("angle", 4)),
            (Node("map", 8, reads, "same"), Node("fc", 8, (Edge("map"),), "dense")),
            "fc",
        )
        encoder = GraphEncoder(graph)
        stir(encoder)
        x, angle = frames(2, 3), torch.randn(2, 3, 4)
        fused = encoder.fusions["map"]
        added = (angle @ fused.projections[0].weight.T)[:, :, :, None, None].expand_as(x)
        if fusion == "gate":
            gate = fused.gates[0]
            both = torch.cat([x, added], 2)
            score = torch.einsum("btcij,c->btij", both, gate.weight[0]) + gate.bias
            assert score.std() > 0.01
            added = added * torch.sigmoid(score)[:, :, None]
        plain = GraphEncoder(
            Graph(graph.inputs[:1], (Node("map", 8, reads[:1], "same"), graph.nodes[1]), "fc")
        )
        kept = {k: v for k, v in encoder.state_dict().items() if not k.startswith("fusions")}
        plain.load_state_dict(kept)
        torch.testing.assert_close(encoder(x, angle), plain(x + added), atol=1e-5, rtol=1e-5)
        assert (encoder(x, angle) - plain(x)).abs().max() > 1e-3


def test_width_scales_every_node_but_no_input():
    half = parse_graph(TEXT).scaled(0.5)
    assert [n.channels for n in half.nodes] == [16, 32, 16, 32]
    assert [i.channels for i in half.inputs] == [30, 4, 3]


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('readout = "fc"', 'readout = "up"', "readout is 'up', not a dense node"),
        ('readout = "fc"', "", "readout is ''"),
        ('"lstm-ln"', '"lstn"', "up: cell is 'lstn', not one of none, timedecay"),
        ('"timedecay"', '"gru"', "fc: cell is 'gru'"),
        ('"valid"', '"full"', "first: kind is 'full'"),
        ('"sum"', '"add"', "up: fusion is 'add'"),
        ('"sum"', "1", r"nodes\.up\.reads\[3\]\.fusion: expected text, got 1"),
        ('"down", "fc"', '"down", "fd"', "up: reads is 'fd'"),
        ('"up", "down"', '"up", "up"', "down: reads the same node twice"),
        ('["up", "down"]', "[]", "down: the first edge"),
        ('["up", "down"]', '"up"', r"nodes\.down\.reads: expected a list, got 'up'"),
        ('["up", "down"]', "[3]", r"nodes\.down\.reads\[0\]: expected text or a table, got 3"),
        ('["up", "down"]', '["down"]', "down: reads no map"),
        ('["up", "down"]', '["up", "frame"]', "down: .* differ in size .*frame 5x7"),
        ("rows = 5", "rows = 0", "frame: 0 x 7 sites"),
        ("rows = 5", "rows = 1", "first: .* no site|reads no map|no site is left"),
        ("channels = 64", "channels = 0", "up: channels is 0"),
        (
            "channels = 64",
            "chanels = 64",
            r"nodes\.up has no key 'chanels'; did you mean channels\?",
        ),
        ("[nodes.first]", "[nodes.frame]", "'frame' must be a name of its own"),
        ("[nodes.first]", '[nodes."a-b"]', "'a-b' must be a name"),
        ('["first", "down", "fc"', '["down", "fc"', "first cannot reach the readout fc"),
        ("[nodes.fc]", "[node.fc]", "the file has no key 'node'; did you mean nodes"),
        ("rows = 5", "rows = ", "Invalid value"),
    ],
)
def test_a_mistake_is_named_in_one_line(tmp_path, old, new, match):
    path = tmp_path / "graph.toml"
    assert old in TEXT
    path.write_text(TEXT.replace(old, new, 1))
    with pytest.raises(ConfigError, match=match) as error:
        read_graph(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml: no such file"):
        read_graph(tmp_path / "none.toml")
