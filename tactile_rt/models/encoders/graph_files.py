"""Graphs in TOML files.

readout = "fc"
[inputs.frame]
channels = 30
rows = 5
columns = 7
[inputs.whisker_angle]          # a vector: no rows and columns
channels = 30
[nodes.conv1]
kind = "valid"
channels = 96
reads = ["frame"]
cell = "gru-ln"
[nodes.fc]
kind = "dense"
channels = 512
reads = ["conv1", { source = "whisker_angle", fusion = "gate" }]
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.models.encoders.graph import Edge, Graph, Input, Node
from tactile_rt.stream import ConfigError

__all__ = ["parse_graph", "read_graph"]


def parse_graph(text: str, where: str = "graph") -> Graph:
    """A graph from TOML, as in the module's docstring.

    Raises:
        ConfigError: naming `where`, the field and what is wrong.
    """
    try:
        raw = tomllib.loads(text)
        _known(raw, {"inputs", "nodes", "readout"}, "")
        inputs = [{"name": k, **_table(v, Input, k)} for k, v in _named(raw, "inputs")]
        nodes = [{"name": k, **_table(v, Node, k)} for k, v in _named(raw, "nodes")]
        for node in nodes:
            reads = node.get("reads")
            if isinstance(reads, list):
                node["reads"] = [
                    {"source": edge} if isinstance(edge, str) else _table(edge, Edge, node["name"])
                    for edge in reads
                ]
        # The graph itself is built afterwards: msgspec would wrap the constructor's own errors.
        return Graph(
            msgspec.convert(inputs, tuple[Input, ...]),
            msgspec.convert(nodes, tuple[Node, ...]),
            msgspec.convert(raw.get("readout", ""), str),
        )
    except (tomllib.TOMLDecodeError, msgspec.ValidationError, ConfigError) as error:
        raise ConfigError(f"{where}: {error}") from None


def read_graph(path: Path) -> Graph:
    """A graph from a TOML file.

    Raises:
        ConfigError: as `parse_graph`; or the file cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as text ({error})") from None
    return parse_graph(text, str(path))


def _named(raw: Mapping[str, Any], key: str) -> list[tuple[str, Any]]:
    table = raw.get(key)
    if not isinstance(table, dict) or not table:
        raise ConfigError(f"{key} must be tables, [{key}.NAME]")
    return list(table.items())


def _table(value: Any, kind: type[Any], name: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{name}: expected a table, not {value!r}")
    _known(value, {field.name for field in fields(kind)} - {"name"}, f"{name}: ")
    return dict(value)


def _known(table: Mapping[str, Any], known: set[str], where: str) -> None:
    for key in table:
        if key not in known:
            raise ConfigError(f"{where}unknown field {key!r}; there are {', '.join(sorted(known))}")
