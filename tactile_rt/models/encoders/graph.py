"""An encoder as data: a directed graph of the frame, nodes, and edges, which may form loops.

Time is unrolled as in biology: every edge has a delay of one step, so at step t a node reads
the outputs of its predecessors at step t-1 (zero at t = 0); only the frame is read at step t.

`parse_graph` reads a graph from TOML::

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

from dataclasses import dataclass, replace

import msgspec

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.settings import convert, parse_toml
from tactile_rt.models.ead_config import CELLS, added_cells

FUSIONS = ("concatenate", "sum", "gate")
KINDS = ("valid", "same", "dense")
DENSE_CELLS = ("none", "timedecay", "timedecay-ln")


@dataclass(frozen=True)
class Input:
    """The network's input at every step, a frame of channels on rows and columns."""

    name: str
    channels: int
    rows: int = 1
    columns: int = 1


@dataclass(frozen=True)
class Edge:
    """An edge of the graph: a source of a node, and its fusion with others.

    "concatenate": concatenated with the other sources on channels (the paper). "sum": projected to
    the concatenated maps' channels and added. "gate": as "sum", times a learned attention per site,
    0 to 1, computed from the concatenated maps and the added map. A vector is equal at all sites.
    """

    source: str
    fusion: str = "concatenate"


@dataclass(frozen=True)
class Node:
    """A node of the graph: sources -> convolution or dense layer -> cell -> ReLU.

    Attributes:
        reads: The edges that the node reads, in the order of their channels; the fusion of the
            first must be "concatenate".
        kind: "valid" or "same": a 2 x 2 convolution of maps with that padding; "dense": a linear
            layer on all sites.
        cell: The name of the recurrent cell, one of `CELLS` or a plugin's, or "none". A dense node
            may only have "none" or a time-decay cell.
    """

    name: str
    channels: int
    reads: tuple[Edge, ...]
    kind: str = "same"
    cell: str = "none"


@dataclass(frozen=True)
class Graph:
    """A network's graph: the frame, the nodes, and the output node's name."""

    frame: Input
    nodes: tuple[Node, ...]
    readout: str

    def __post_init__(self) -> None:
        parts: tuple[Input | Node, ...] = (self.frame, *self.nodes)
        names = [part.name for part in parts]
        for part in parts:
            if not part.name.isidentifier() or names.count(part.name) > 1:
                raise ConfigError(f"{part.name!r} must be a unique name of letters and digits")
            if part.channels < 1:
                raise ConfigError(f"{part.name}: channels must be at least 1, not {part.channels}")
        if self.frame.rows < 1 or self.frame.columns < 1:
            sites = f"{self.frame.rows} x {self.frame.columns}"
            raise ConfigError(f"{self.frame.name}: sites must be at least 1 x 1, not {sites}")
        for node in self.nodes:
            _check_node(node, names)
        if self.readout not in {node.name for node in self.nodes if node.kind == "dense"}:
            raise ConfigError(f"readout is {self.readout!r}, not a dense node")
        self.sizes  # noqa: B018  maps must fit each other
        idle = sorted(n.name for n in self.nodes if n.name not in self.remaining)
        if idle:
            raise ConfigError(f"{name_some(idle)} cannot reach the readout {self.readout}")
        if self.frame.name not in self.remaining:
            raise ConfigError(f"no path from {self.frame.name} to the readout {self.readout}")

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Rows and columns by name of frame and nodes; 1 x 1 for vectors."""
        sizes = {self.frame.name: (self.frame.rows, self.frame.columns)}
        sizes |= {node.name: (1, 1) for node in self.nodes if node.kind == "dense"}
        for _ in self.nodes:  # feedback may come from a node whose size is not known yet
            for node in self.nodes:
                maps = {sizes[e.source] for e in node.reads if e.source in sizes} - {(1, 1)}
                if node.name not in sizes and maps:
                    rows, columns = min(maps)
                    sizes[node.name] = _shrink(node, rows, columns)
        for node in self.nodes:
            if node.name not in sizes:
                raise ConfigError(
                    f"{node.name}: kind {node.kind!r} needs a map as input, but it reads only "
                    "vectors; use kind dense"
                )
        for node in self.nodes:
            maps = {sizes[e.source] for e in node.reads} - {(1, 1)}
            fits = node.kind == "dense" or {_shrink(node, *m) for m in maps} == {sizes[node.name]}
            if len(maps) > 1 or not fits:
                found = ", ".join(
                    f"{e.source} {sizes[e.source][0]}x{sizes[e.source][1]}" for e in node.reads
                )
                raise ConfigError(f"{node.name}: the maps that it reads differ in size ({found})")
            if min(sizes[node.name]) < 1:
                raise ConfigError(f"{node.name}: no site is left for a 'valid' convolution")
        return sizes

    @property
    def remaining(self) -> dict[str, int]:
        """Length of the shortest path from each part to the readout, without frame edges."""
        distance = {self.readout: 0}
        nodes = {node.name: node for node in self.nodes}
        queue = [self.readout]
        for name in queue:  # breadth first, against the edges
            for edge in nodes[name].reads:
                if edge.source == self.frame.name:
                    distance.setdefault(edge.source, distance[name])
                elif edge.source not in distance:
                    distance[edge.source] = distance[name] + 1
                    queue.append(edge.source)
        return distance

    @property
    def lag(self) -> int:
        """Delay in steps from the frame to the readout, on the shortest path."""
        return self.remaining[self.frame.name]

    @property
    def components(self) -> tuple[tuple[Node, ...], ...]:
        """Strongly connected components of nodes, in topological order."""
        reads = {n.name: {e.source for e in n.reads} for n in self.nodes}
        above = {name: set(sources) & set(reads) for name, sources in reads.items()}
        for _ in self.nodes:
            above = {n: a.union(*(above[s] for s in a)) for n, a in above.items()}
        groups: dict[frozenset[str], list[Node]] = {}
        for node in self.nodes:
            loop = {m for m in above[node.name] if node.name in above[m]} | {node.name}
            groups.setdefault(frozenset(loop), []).append(node)
        return tuple(
            tuple(group)
            for _, group in sorted(groups.items(), key=lambda g: len(above[g[1][0].name] | g[0]))
        )

    def scale_channels(self, width: float) -> "Graph":
        """Return the graph with every node's number of channels multiplied by `width`."""
        scale = [replace(n, channels=max(round(n.channels * width), 1)) for n in self.nodes]
        return replace(self, nodes=tuple(scale))


def _check_node(node: Node, names: list[str]) -> None:
    for what, value, known in (
        ("kind", node.kind, KINDS),
        ("cell", node.cell, _allowed_cells(node)),
        *(("reads", edge.source, tuple(names)) for edge in node.reads),
        *(("fusion", edge.fusion, FUSIONS) for edge in node.reads),
    ):
        if value not in known:
            raise ConfigError(f"{node.name}: {what} is {value!r}, not one of {name_some(known, 8)}")
    sources = [edge.source for edge in node.reads]
    if not sources or node.reads[0].fusion != "concatenate":
        raise ConfigError(f"{node.name}: its first edge must be 'concatenate'")
    if len(set(sources)) < len(sources):
        raise ConfigError(f"{node.name}: reads the same node twice")


def _allowed_cells(node: Node) -> tuple[str, ...]:
    if node.kind == "dense":
        return DENSE_CELLS
    ours = ("none", *CELLS)
    return ours if node.cell in ours else (*ours, *added_cells())


def _shrink(node: Node, rows: int, columns: int) -> tuple[int, int]:
    return (rows - 1, columns - 1) if node.kind == "valid" else (rows, columns)


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


def parse_graph(text: str, where: str = "graph") -> Graph:
    """Parse the text of a TOML file (see the module's docstring) into a graph."""
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
