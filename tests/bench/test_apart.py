"""Rigs use the product as its users do: with its emulated devices, not with its fakes for tests."""

import ast
from pathlib import Path

import bench

RIGS = Path(bench.__file__).parent


def test_no_rig_needs_the_fakes():
    rigs = {p: ast.parse(p.read_text(encoding="utf-8")) for p in RIGS.rglob("*.py")}
    assert len(rigs) > 30
    imported = {
        (path.name, node.module)
        for path, tree in rigs.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module
    }
    assert ("emulated.py", "tactile_rt.drivers.emulation.device") in imported
    assert [i for i in imported if i[1].startswith("tactile_rt.testing")] == []
