"""Measure how large the package is, against the limits in house.toml.

    python -m bench.checks.house [--single]

A room is a folder of the package. An arrow leads from a room to another that it imports from when
it runs, inside functions too; there each module and each sub-package of `core` is a room, since all
others stand on them. The robot's part is the rooms that the linter of imports keeps from torch and
MuJoCo, without `sets`, and the commands that need no other room.
"""

import argparse
import sys
import tomllib
from functools import cache
from pathlib import Path

import grimp

from bench.pictures.house import HEAVY, PACKAGE, ROOT, contracts, room_of

LIMITS = Path(__file__).with_suffix(".toml")
DESK = {"sets"}  # kept from torch as well, but for those who train


@cache
def import_graph() -> grimp.ImportGraph:
    """Who imports whom in the package, except for types alone."""
    return grimp.build_graph(PACKAGE, exclude_type_checking_imports=True, cache_dir=None)


def arrows() -> set[tuple[str, str]]:
    """The pairs of rooms of which the first imports from the second."""
    graph = import_graph()
    pairs = (
        (_fine_room(module), _fine_room(imported))
        for module in graph.modules
        for imported in graph.find_modules_directly_imported_by(module)
    )
    return {(a, b) for a, b in pairs if a and b and a != b}


def _fine_room(module: str) -> str:
    room = room_of(module)
    return ".".join(module.split(".")[1:3]) if room == "core" else room


def single_importers() -> dict[str, str]:
    """The modules that one other module alone imports, and that module."""
    graph = import_graph()
    found = {m: graph.find_modules_that_directly_import(m) for m in sorted(graph.modules)}
    return {module: next(iter(by)) for module, by in found.items() if len(by) == 1}


def robot_modules() -> list[str]:
    """The modules that a robot runs."""
    graph = import_graph()
    contract = next(c for c in contracts() if c["name"].startswith(HEAVY))
    kept = {room_of(name) for name in contract["source_modules"]} - DESK

    def needs(module: str) -> set[str]:
        return {room_of(m) for m in graph.find_modules_directly_imported_by(module)} - {""}

    commands = [m for m in graph.modules if room_of(m) == "cli" and needs(m) <= {*kept, "cli"}]
    return sorted([*(m for m in graph.modules if room_of(m) in kept), *commands])


def measure() -> dict[str, int]:
    """Every figure that house.toml limits, by its name there."""
    graph, robot = import_graph(), robot_modules()
    rooms = {room_of(module) for module in graph.modules} - {""}
    return {
        "rooms": len(rooms),
        "arrows": len(arrows()),
        "modules": len(graph.modules),
        "lines": sum(map(_lines, graph.modules)),
        "robot_modules": len(robot),
        "robot_lines": sum(map(_lines, robot)),
        "tests_lines": _lines_below("tests"),
        "bench_lines": _lines_below("bench"),
    }


def _lines(module: str) -> int:
    path = ROOT.joinpath(*module.split("."))
    file = path.with_suffix(".py")
    return (file if file.exists() else path / "__init__.py").read_text("utf-8").count("\n")


def _lines_below(folder: str) -> int:
    return sum(f.read_text("utf-8").count("\n") for f in (ROOT / folder).rglob("*.py"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--single", action="store_true", help="list the modules that one other alone imports"
    )
    if parser.parse_args().single:
        for module, importer in single_importers().items():
            sys.stdout.write(f"{_lines(module):4} {module} <- {importer} ({_lines(importer)})\n")
        return
    limits, found = tomllib.loads(LIMITS.read_text("utf-8")), measure()
    for name, value in found.items():
        missed = "  MISSED" if value > limits[name] else ""
        sys.stdout.write(f"{name:14}{value:8,} <= {limits[name]:,}{missed}\n")
    sys.stdout.write(f"modules that one other alone imports: {len(single_importers())}\n")
    sys.exit(any(found[name] > limits[name] for name in found))


if __name__ == "__main__":
    main()
