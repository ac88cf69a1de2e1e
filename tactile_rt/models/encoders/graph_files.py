"""Graphs in TOML files.

readout = "fc"
[inputs.frame]
channels = 30
rows = 5
columns = 7
[nodes.conv1]
kind = "valid"
channels = 96
reads = ["frame"]
cell = "gru-ln"
[nodes.fc]
kind = "dense"
channels = 512
reads = ["conv1"]
"""

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import convert, parse_toml
from tactile_rt.models.encoders.graph import Edge, Graph, Input, Node
from tactile_rt.models.encoders.graph_encoder import GraphEncoder

__all__ = ["build_encoder", "parse_graph"]


class _Input(msgspec.Struct):
    channels: int
    rows: int = Input.rows
    columns: int = Input.columns


class _Node(msgspec.Struct):
    channels: int
    reads: tuple[str | Edge, ...]
    kind: str = Node.kind
    cell: str = Node.cell


class _File(msgspec.Struct):
    inputs: dict[str, _Input] = {}
    nodes: dict[str, _Node] = {}
    readout: str = ""


def build_encoder(text: str, width: float, frame: tuple[int, int, int]) -> GraphEncoder:
    """Build the encoder of a graph in TOML.

    Args:
        width: what its channel counts are multiplied by.
        frame: channels, rows and columns of the array's frames.

    Raises:
        ConfigError: the text is no graph, or one of other frames.
    """
    graph = parse_graph(text)
    read = graph.frame
    if (found := (read.channels, read.rows, read.columns)) != frame:
        sizes = (" x ".join(map(str, size)) for size in (found, frame))
        raise ConfigError(
            "the graph's {} has {} channels, rows and columns, the array's frames "
            "{}: change the graph".format(read.name, *sizes)
        )
    return GraphEncoder(graph.scaled(width))


def parse_graph(text: str, where: str = "graph") -> Graph:
    """Read a graph from TOML, as in the module's docstring.

    Raises:
        ConfigError: naming `where`, the line, the key and what is wrong.
    """
    tree = parse_toml(text, where)
    file: _File = convert(tree, _File)
    for table in ("inputs", "nodes"):
        if not getattr(file, table):
            raise ConfigError(f"{tree.where}: {table} must be tables, [{table}.NAME]")
    if len(file.inputs) > 1:
        raise ConfigError(
            f"{tree.where}: a graph has one input, the frame, not {', '.join(file.inputs)}"
        )
    (frame,) = (Input(name, **msgspec.structs.asdict(i)) for name, i in file.inputs.items())
    nodes = []
    for name, node in file.nodes.items():
        reads = tuple(Edge(edge) if isinstance(edge, str) else edge for edge in node.reads)
        nodes.append(Node(name, node.channels, reads, node.kind, node.cell))
    try:
        return Graph(frame, tuple(nodes), file.readout)
    except ConfigError as error:  # how its parts fit together
        raise ConfigError(f"{tree.where}: {error}") from None
