"""Zhuang's recurrent convolutional network on the array's grid, as a graph (Zhuang et al. 2017)."""

from tactile_rt.models.ead_config import MOUSE_FRAME
from tactile_rt.models.encoders.graph import Edge, Graph, Input, Node
from tactile_rt.models.encoders.graph_encoder import GraphEncoder

# Node: (channels, nodes that it reads, in the order of their channels: alphabetical).
EDGES = {
    "conv1": (96, ("frame",)),
    "conv2": (128, ("conv1", "conv3", "conv4")),
    "conv3": (256, ("conv2", "conv4", "conv5")),
    "conv4": (384, ("conv3", "conv5", "conv6")),
    "conv5": (384, ("conv4", "conv6")),
    "conv6": (256, ("conv5",)),
    "fc7": (1024, ("conv2", "conv4", "conv6")),
    "fc8": (512, ("fc7",)),
}


def zhuang_graph(cell: str = "intersection-ln", frame: tuple[int, int, int] = MOUSE_FRAME) -> Graph:
    """Return the paper's graph with a given cell in all convolutional nodes.

    The time-decay cell of the original is in the dense nodes fc7 and fc8 as well; no other cell is.
    """
    dense_cell = "timedecay" if cell.startswith("timedecay") else "none"
    nodes = []
    for name, (channels, sources) in EDGES.items():
        reads = tuple(Edge(source) for source in sources)
        if name.startswith("fc"):
            nodes.append(Node(name, channels, reads, "dense", dense_cell))
        else:  # conv1 reduces the mouse's 5 x 7 grid to 4 x 6; single rows and 2 x 2 stay as is
            less = name == "conv1" and min(frame[1:]) > 1 and max(frame[1:]) > 2
            nodes.append(Node(name, channels, reads, "valid" if less else "same", cell))
    return Graph(Input("frame", *frame), tuple(nodes), readout="fc8")


class ZhuangEncoder(GraphEncoder):
    """Encoder by `zhuang_graph`, from frames to 512 * width features per step."""

    def __init__(
        self,
        width: float = 1.0,
        cell: str = "intersection-ln",
        frame: tuple[int, int, int] = MOUSE_FRAME,
    ) -> None:
        super().__init__(zhuang_graph(cell, frame).scale_channels(width))
