"""The house is in order: nobody imports in a circle, every name is given once, every word leads
somewhere.

The linter of imports sees neither a circle through functions nor an import by a string, so both are
followed here. Tables of plug-ins, of which each entry is imported when it is asked for, are meant
to point upward and do not count.
"""

import ast
import builtins
import re
import tomllib
from collections import defaultdict
from functools import cache
from importlib import import_module
from importlib.util import find_spec

import pytest

from bench.checks.house import LIMITS, measure
from tests.helpers.source_tree import (
    FUNCTIONS,
    ROOT,
    circles,
    collapsed,
    modules,
    names_in_ticks,
    product,
)

# What is loaded by its name when it is asked for: sources, codecs, publishers, encoders, metrics,
# datasets, commands, rigs, and what `from tactile_rt import ...` gives.
TABLES = {
    "tactile_rt",
    "tactile_rt.cli",
    "tactile_rt.cli.bench",
    "tactile_rt.daemon.publishers",
    "tactile_rt.drivers.codec",
    "tactile_rt.models",
    "tactile_rt.alignment.datasets",
    "tactile_rt.alignment.metrics",
    "tactile_rt.alignment.other_models",
    "tactile_rt.models.ead",
    "tactile_rt.sources.opening",
}
ROOMS = sorted({m.room for m in product()} - {""})
# Names that are not ours: of ONNX operators, and what the usage of commands calls their arguments.
OPERATORS = {"Gemm", "MatMulInteger", "MatMulNBits", "Scan", "ScatterND"}
FILES = re.compile(r"[\w-]+\.(csv|json|md|onnx|pt|toml|zip)")


@cache
def arrows() -> list[tuple[str, str]]:
    """Who imports whom among the shipped modules."""
    ours = {m.name for m in product()}
    return [
        (module.name, imported.module)
        for module in product()
        for imported in module.imports
        if imported.module in ours and not (imported.by_name and module.name in TABLES)
    ]


def test_what_is_imported_by_name_is_known() -> None:
    """Else no circle through it would be seen."""
    unknown = {
        f"{module.name}:{imported.line}"
        for module in product()
        for imported in module.imports
        if imported.by_name and "*" in imported.module and module.name not in TABLES
        if imported.module.startswith(("tactile_rt", "*"))
    }
    assert unknown == set()
    assert set(modules()) >= TABLES, "a table that is none any more"


def test_no_modules_import_each_other() -> None:
    assert circles(collapsed(arrows())) == []


def test_no_rooms_import_each_other() -> None:
    rooms = ((modules()[a].room, modules()[b].room) for a, b in arrows())
    assert circles(collapsed((a, b) for a, b in rooms if a and b)) == []


@pytest.mark.parametrize("room", ROOMS)
def test_no_parts_of_a_room_import_each_other(room: str) -> None:
    """At every level: the modules and folders that lie in one folder."""
    for folder in product():
        if folder.room != room or folder.path.name != "__init__.py":
            continue
        inside = f"{folder.name}."
        parts = (
            (a.removeprefix(inside).partition(".")[0], b.removeprefix(inside).partition(".")[0])
            for a, b in arrows()
            if a.startswith(inside) and b.startswith(inside)
        )
        assert circles(collapsed(parts)) == []


def test_circles_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}) == [["a", "b", "c"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []
    assert circles({"a": {"a"}}) == [["a"]]


@pytest.mark.parametrize("room", ROOMS)
def test_what_is_shipped_needs_neither_face_nor_fakes_nor_rigs(room: str) -> None:
    wrong = [
        f"{module.name}:{imported.line} imports {imported.name or imported.module}"
        for module in product()
        if module.room == room and room != "testing"
        for imported in module.imports
        if not (imported.by_name and module.name in TABLES)
        if imported.module == "tactile_rt"
        or imported.module.startswith("tactile_rt.testing")
        or imported.module.partition(".")[0] in ("tests", "bench")
    ]
    assert wrong == []


def test_no_two_public_classes_share_a_name() -> None:
    where = defaultdict(list)
    for module in modules().values():
        for name in module.classes:
            if not name.startswith("_"):
                where[name].append(module.name)
    assert {name: places for name, places in where.items() if len(places) > 1} == {}


@cache
def known_words() -> set[str]:
    """Every name that the package defines or takes anywhere."""
    words = set(dir(builtins)) | OPERATORS | {"self"}
    for module in product():
        words |= module.names | set(module.name.split("."))
        for node, _ in module.nodes:
            if isinstance(node, ast.Name):
                words.add(node.id)
            elif isinstance(node, ast.Attribute):
                words.add(node.attr)
            elif isinstance(node, ast.arg):
                words.add(node.arg)
            elif isinstance(node, (*FUNCTIONS, ast.ClassDef)):
                words.add(node.name)
    return words


def resolves(name: str) -> bool:
    """True if each part of a dotted name is defined somewhere, here or in the module it names."""
    if FILES.fullmatch(name) or any(m.path.name == name for m in modules().values()):
        return True
    if all(part in known_words() for part in name.split(".")):
        return True
    place, _, last = name.rpartition(".")
    there = bool(place) and find_spec(name.partition(".")[0]) is not None
    return there and hasattr(import_module(place), last)


@pytest.mark.parametrize("room", ROOMS)
def test_names_in_back_ticks_lead_somewhere(room: str) -> None:
    wrong = [
        f"{module.name}: `{name}` in the docstring of {getattr(node, 'name', 'the module')}"
        for module in product()
        if module.room == room
        for node, _, said in module.documented
        for name in names_in_ticks(said)
        if re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", name) and not resolves(name)
    ]
    assert not wrong, "\n".join(wrong)


def test_a_name_that_leads_nowhere_is_found() -> None:
    assert all(map(resolves, ("Chunk", "ArraySpec.elements", "stream.Chunk", "numpy.load", "list")))
    assert not any(map(resolves, ("Chnk", "ArraySpec.lements", "strem.Chunk", "numpy.lod")))


def test_every_test_lies_where_its_subject_does() -> None:
    folders = {m.path.parent.relative_to(ROOT) for m in modules().values()}
    mirrored = {f.relative_to("tactile_rt") if f.parts[0] == "tactile_rt" else f for f in folders}
    mirrored.add((ROOT / "plugins").relative_to(ROOT))  # packages of their own
    tests = ROOT / "tests"
    astray = {
        str(path.relative_to(tests))
        for path in tests.rglob("test_*.py")
        if path.parent.relative_to(tests) not in mirrored
    }
    assert astray == set()


def test_the_package_is_within_its_limits() -> None:
    limits = tomllib.loads(LIMITS.read_text("utf-8"))
    assert {name: n for name, n in measure().items() if n > limits[name]} == {}
