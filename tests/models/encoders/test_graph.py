"""Networks from data: paths, loops, fusion, and what is refused."""

import re

import pytest
import torch

from tactile_rt.models.encoders.graph import Edge, Graph, Input, Node, parse_graph
from tactile_rt.models.encoders.graph_encoder import GraphEncoder
from tactile_rt.models.encoders.zhuang import zhuang_graph
from tests.helpers.refusals import refusal
from tests.helpers.small_networks import GRAPH, frames, stir


def test_zhuangs_graph():
    graph = zhuang_graph()
    assert graph.lag == 3
    assert graph.sizes["conv6"] == (4, 6)
    assert [{n.name for n in group} for group in graph.components] == [
        {"conv1"}, {f"conv{n}" for n in range(2, 7)}, {"fc7"}, {"fc8"}]  # fmt: skip
    assert [graph.remaining[f"conv{n}"] for n in range(1, 7)] == [3, 2, 3, 2, 3, 2]


def test_a_graph_from_toml():
    graph = parse_graph(GRAPH)
    assert graph.lag == 2  # first -> up -> fc
    assert graph.frame == Input("frame", 30, 5, 7)
    assert graph.nodes[1].reads[3] == Edge("up", "sum")
    assert [[n.name for n in group] for group in graph.components] == [
        ["first", "up", "down", "fc"]]  # fmt: skip


def test_a_frame_is_heard_two_steps_late():
    torch.manual_seed(0)
    encoder = GraphEncoder(parse_graph(GRAPH))
    stir(encoder)
    x = frames(1, 6).requires_grad_()
    (gradient,) = torch.autograd.grad(encoder(x)[:, -1].square().sum(), x)
    heard = gradient.flatten(2).abs().amax(dim=(0, 2)) > 0
    assert int(heard.nonzero().max()) == 3


def test_fusion():
    """sum and gate, against their definitions, in a node that only adds up."""
    torch.manual_seed(0)
    for fusion in ("sum", "gate"):
        reads = (Edge("frame"), Edge("fc", fusion))
        nodes = Node("map", 8, reads, "same"), Node("fc", 4, (Edge("map"),), "dense")
        graph = Graph(Input("frame", 30, 5, 7), nodes, "fc")
        encoder = GraphEncoder(graph)
        stir(encoder)
        without = Graph(graph.frame, (Node("map", 8, reads[:1], "same"), nodes[1]), "fc")
        plain = GraphEncoder(without)
        kept = {k: v for k, v in encoder.state_dict().items() if not k.startswith("fusions")}
        plain.load_state_dict(kept)
        x, fused = frames(2, 4), encoder.fusions["map"]
        before, state, expected = torch.zeros(2, 4), plain.initial_state(2), []
        for t in range(4):
            added = (before @ fused.projections[0].weight.T)[:, :, None, None].expand_as(x[:, t])
            if fusion == "gate":
                gate = fused.gates[0]
                both = torch.cat([x[:, t], added], 1)
                score = torch.einsum("bcij,c->bij", both, gate.weight[0]) + gate.bias
                assert score.std() > 0.01
                added = added * torch.sigmoid(score)[:, None]
            before, state = plain.step(x[:, t] + added, torch.zeros(2), state)
            expected.append(before)
        torch.testing.assert_close(encoder(x), torch.stack(expected, 1), atol=1e-5, rtol=1e-5)
        assert (encoder(x) - plain(x)).abs().max() > 1e-3


def test_width_scales_every_node_but_not_the_frame():
    half = parse_graph(GRAPH).scale_channels(0.5)
    assert [n.channels for n in half.nodes] == [16, 32, 16, 32]
    assert half.frame.channels == 30


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('readout = "fc"', 'readout = "up"', "readout is 'up', not a dense node"),
        ('readout = "fc"', "", "readout is ''"),
        ('"lstm-ln"', '"lstn"', "up: cell is 'lstn', not one of none, timedecay"),
        ('"timedecay"', '"gru"', "fc: cell is 'gru'"),
        ('"down", "fc"', '"down", "fd"', "up: reads is 'fd'"),
        ('"up", "down"', '"up", "up"', "down: reads the same node twice"),
        ('["up", "down"]', "[]", "down: its first edge"),
        ('["up", "down"]', "[3]", r"nodes\.down\.reads\[0\]: expected text or a table, got 3"),
        ('["up", "down"]', '["down"]', "down: kind .* needs a map as input"),
        ('["up", "down"]', '["up", "frame"]', "down: .* differ in size .*frame 5x7"),
        ("rows = 5", "rows = 0", "frame: sites must be"),
        ("rows = 5", "rows = 1", "first: .* no site|needs a map|no site is left"),
        ("channels = 64", "channels = 0", "up: channels must be at least 1"),
        (
            "channels = 64",
            "chanels = 64",
            r"nodes\.up has no key 'chanels'; did you mean channels\?",
        ),
        ("[nodes.first]", "[nodes.frame]", "'frame' must be a unique name"),
        ("[nodes.first]", '[nodes."a-b"]', "'a-b' must be a unique name"),
        ('["up", { source = "down"', '["first", { source = "first"', "reads the same node twice"),
        ('"first", "down", "fc"', '"frame", "down", "fc"', "first cannot reach the readout fc"),
        ("[nodes.fc]", "[node.fc]", "the file has no key 'node'; did you mean nodes"),
        ("rows = 5", "rows = ", "Invalid value"),
        (
            "[nodes.first]",
            "[inputs.angle]\nchannels = 4\n[nodes.first]",
            "one input, the frame, not frame, angle",
        ),
    ],
)
def test_a_mistake_is_named_in_one_line(old, new, match):
    assert old in GRAPH
    said = refusal(parse_graph, GRAPH.replace(old, new, 1), "my graph")
    assert said.startswith("my graph") and re.search(match, said)
