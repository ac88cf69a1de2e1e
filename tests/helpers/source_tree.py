"""The source of the package and of its rigs, parsed once: who imports whom, which names there are,
what the docstrings say.

Imports are taken from the syntax, wherever they stand: at a module's top, in a function, and as the
name given to `import_module`. What stands under `TYPE_CHECKING` is never run and is left out.
"""

import ast
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import tactile_rt

PACKAGE = Path(tactile_rt.__file__).parent
ROOT = PACKAGE.parent

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


@dataclass(frozen=True)
class Import:
    """One module named by another."""

    # full name of the imported module, or what stands for it where it is not one of ours
    module: str
    name: str  # name taken from it; empty where the module itself is imported
    line: int  # line of the import in the file
    by_name: bool = False  # whether it is imported by a string


@dataclass(frozen=True, eq=False)
class SourceModule:
    """A file of source."""

    name: str  # module's full name, such as `tactile_rt.core.stream`
    path: Path  # file that it was read from
    tree: ast.Module  # syntax tree of the whole file

    @property
    def room(self) -> str:
        """The module or folder directly under the package that holds it; empty for the face."""
        return self.name.partition(".")[2].partition(".")[0]

    @cached_property
    def nodes(self) -> list[tuple[ast.AST, ast.ClassDef | None]]:
        """Every node of the tree, with the class that it stands in."""
        found: list[tuple[ast.AST, ast.ClassDef | None]] = []
        waiting: list[tuple[ast.AST, ast.ClassDef | None]] = [(self.tree, None)]
        while waiting:
            node, owner = waiting.pop()
            found.append((node, owner))
            inside = node if isinstance(node, ast.ClassDef) else owner
            waiting += [(child, inside) for child in _children(node)]
        return found

    @cached_property
    def imports(self) -> list[Import]:
        """What it imports when it runs, wherever in the file."""
        found: list[Import] = []
        never_run = {
            id(inner)
            for node, _ in self.nodes
            if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
            for statement in node.body
            for inner in ast.walk(statement)
        }
        for node, _ in self.nodes:
            if id(node) in never_run:
                continue
            if isinstance(node, ast.Import):
                found += [Import(alias.name, "", node.lineno) for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = self._base(node)
                for alias in node.names:
                    inner = f"{base}.{alias.name}"
                    known = inner in modules()
                    found.append(
                        Import(*((inner, "") if known else (base, alias.name)), node.lineno)
                    )
            elif isinstance(node, ast.Call) and called(node) in ("import_module", "__import__"):
                found.append(Import(_text(node.args[0], self.name), "", node.lineno, by_name=True))
        return found

    def _base(self, node: ast.ImportFrom) -> str:
        if not node.level:
            return node.module or ""
        parts = self.name.split(".")
        up = node.level - (self.path.name == "__init__.py")
        return ".".join([*parts[: len(parts) - up], *([node.module] if node.module else [])])

    @cached_property
    def names(self) -> set[str]:
        """What the module's own scope holds: defined, assigned or imported, wherever in it."""
        found = set().union(*(_bound(node) for node in self.tree.body))
        for node, _ in self.nodes:
            if isinstance(node, ast.Import | ast.ImportFrom):
                found |= {(a.asname or a.name).partition(".")[0] for a in node.names}
        return found

    @cached_property
    def classes(self) -> dict[str, ast.ClassDef]:
        """The classes at the module's top."""
        return {n.name: n for n in self.tree.body if isinstance(n, ast.ClassDef)}

    @cached_property
    def documented(self) -> list[tuple[Documented, ast.ClassDef | None, str]]:
        """Everything with a docstring: (node, the class that it stands in, docstring)."""
        return [
            (node, owner, said)
            for node, owner in self.nodes
            if isinstance(node, Documented) and (said := ast.get_docstring(node))
        ]


@cache
def modules() -> dict[str, SourceModule]:
    """The modules of the package and of its rigs by their full names."""
    found = {}
    for top in (PACKAGE, ROOT / "bench"):
        for path in sorted(top.rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found[name] = SourceModule(name, path, ast.parse(path.read_text("utf-8")))
    return found


def product() -> list[SourceModule]:
    """The modules that are shipped."""
    return [m for m in modules().values() if m.name.partition(".")[0] == "tactile_rt"]


def called(node: ast.Call) -> str:
    """The last part of the name of what is called."""
    return ast.unparse(node.func).rpartition(".")[2]


def circles(arrows: dict[str, set[str]]) -> list[list[str]]:
    """The sets of nodes that reach each other, each sorted: none in a graph without circles."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    open_: list[str] = []
    found = []

    def visit(node: str) -> None:
        order[node] = lowest[node] = len(order)
        open_.append(node)
        for to in sorted(arrows.get(node, ())):
            if to not in order:
                visit(to)
                lowest[node] = min(lowest[node], lowest[to])
            elif to in open_:
                lowest[node] = min(lowest[node], order[to])
        if lowest[node] == order[node]:
            at = open_.index(node)
            part = sorted(open_[at:])
            del open_[at:]
            if len(part) > 1 or node in arrows.get(node, ()):
                found.append(part)

    for node in sorted(arrows):
        if node not in order:
            visit(node)
    return found


# names in back-ticks


def names_in_ticks(docstring: str) -> Iterator[str]:
    """What stands between single back-ticks; double ones hold text, not names."""
    for found in re.finditer(r"``.+?``|`([^`\n]+)`", docstring, re.DOTALL):
        if found[1]:
            yield found[1]


def _bound(node: ast.stmt) -> set[str]:
    """The names that a statement binds where it stands."""
    if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
        return {node.name}
    found: set[str] = set()
    for child in _without_functions(node):
        if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
            found.add(child.id)
    return found


def _without_functions(node: ast.AST) -> Iterator[ast.AST]:
    yield node
    for child in _children(node):
        if not isinstance(child, (*FUNCTIONS, ast.ClassDef, ast.Lambda)):
            yield from _without_functions(child)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    for field in node._fields:
        value = getattr(node, field, None)
        if isinstance(value, list):
            yield from (v for v in value if isinstance(v, ast.AST))
        elif isinstance(value, ast.AST) and not isinstance(value, ast.expr_context):
            yield value


def _text(node: ast.expr, module: str) -> str:
    """The text of a string; `*` stands for what is known only when it runs."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part, module) for part in node.values)
    if isinstance(node, ast.FormattedValue) and ast.unparse(node.value) == "__name__":
        return module
    return "*"


def collapsed(arrows: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """Arrows as a graph, those of a node to itself left out."""
    graph: dict[str, set[str]] = {}
    for tail, head in arrows:
        graph.setdefault(tail, set())
        if tail != head:
            graph[tail].add(head)
    return graph
