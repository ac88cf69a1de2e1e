"""Do the tests notice when a line is wrong? Small faults are put into modules, one at a time.

python -m bench.checks.mutants [--module NAME ...] [--count 60] [--seed 0] [--resume FILE]

A mutant is a module with one change: a comparison, an arithmetic operator, a number or a boolean is
another, a condition is negated, a call whose result nobody uses is gone. It is killed if one of the
module's tests fails or hangs. `mutants.toml` says which tests those are, and which mutants nobody
can tell from the module, with the reason. Mutants are drawn at random from all that there are, and
run in a copy of the tree.
"""

import argparse
import ast
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_rt.models.evaluation.records import Record, show, write

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_suffix(".toml")
BAR = 85.0  # %
PATIENCE, LEAST_S = 4.0, 15.0  # as long as the tests take beside the original, at least so long
LEFT_OUT = (".git", ".venv", "__pycache__", ".pytest_cache", ".mypy_cache", ".ruff_cache", "dist")
# In the process that forks, so that no mutant waits for them.
HEAVY = ("numpy", "pytest", "msgspec", "onnxruntime", "mcap.reader", "rich.table")
SERVER = f"""
import contextlib, importlib, os, sys
for name in {HEAVY!r}:
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        os.setsid()
        nothing = os.open(os.devnull, os.O_RDWR)
        for number in (0, 1, 2):
            os.dup2(nothing, number)
        import pytest
        code = pytest.main(["-x", "-q", "-p", "no:cacheprovider", *line.split()])
        os._exit(int(code))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.LShift: ast.RShift,
    ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitAnd,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """A module with one change.

    Attributes:
        line: The number of the line of the change.
        name: The line as it was and what was changed in it; unlike its number, this stays.
        source: The whole source of the mutant.
    """

    line: int
    name: str
    source: bytes


def mutants_of(source: bytes) -> list[Mutant]:
    """All mutants of a module, in the order of its lines."""
    lines = source.splitlines(keepends=True)
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line))
    found, seen = [], dict[str, int]()
    for node, text in _changes(ast.parse(source)):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        was = " ".join(lines[node.lineno - 1].decode().split())
        old = " ".join(source[begin:end].decode().split())
        name = f"{was} | {old} -> {text}"
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > 1:
            name += f" ({seen[name]})"
        found.append(Mutant(node.lineno, name, source[:begin] + text.encode() + source[end:]))
    return found


def _changes(tree: ast.AST) -> Iterator[tuple[Any, str]]:
    """Expressions and statements, and what takes their place."""
    for node in _walk(tree):
        if isinstance(node, ast.Compare):
            for n, operator in enumerate(node.ops):
                yield node, _with(node.ops, n, COMPARED[type(operator)](), node)
        elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in COMPUTED:
            was, node.op = node.op, COMPUTED[type(node.op)]()
            text = ast.unparse(node)
            node.op = was
            yield node, text if isinstance(node, ast.AugAssign) else f"({text})"
        elif isinstance(node, ast.BoolOp):
            was_bool = node.op
            node.op = ast.Or() if isinstance(was_bool, ast.And) else ast.And()
            text = ast.unparse(node)
            node.op = was_bool
            yield node, f"({text})"
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            yield node, f"({ast.unparse(node.operand)})"
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
            yield node, repr(_another(node.value))
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield node, "pass"
        if isinstance(node, ast.If | ast.While | ast.IfExp):
            yield node.test, f"(not ({ast.unparse(node.test)}))"


def _another(value: bool | int | float) -> bool | int | float:
    """Another constant: so far off that it matters, if anything does."""
    if isinstance(value, bool):
        return not value
    return value + 1 if isinstance(value, int) and abs(value) < 100 else 2 * value or 1.0


def _with(items: list[Any], n: int, other: Any, whole: ast.AST) -> str:
    was, items[n] = items[n], other
    text = f"({ast.unparse(whole)})"
    items[n] = was
    return text


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes whose change is one of the behaviour: no annotations, texts, or lists of names."""
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_params", "bases"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not isinstance(child, ast.JoinedStr):
                yield from _walk(child)


class _Bench:
    """Runs tests in a copy of the tree, again and again; a context manager."""

    def __enter__(self) -> "_Bench":
        self._folder = tempfile.TemporaryDirectory(prefix="tactile-mutants-")
        self.tree = Path(self._folder.name) / "tree"
        ignored = shutil.ignore_patterns(*LEFT_OUT)
        shutil.copytree(ROOT, self.tree, symlinks=True, ignore=ignored)
        self._stamp = int(time.time())
        self._server = subprocess.Popen(
            [sys.executable, "-c", SERVER], cwd=self.tree, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(self.tree)},
        )  # fmt: skip
        return self

    def __exit__(self, *_: object) -> None:
        self._server.kill()
        self._server.wait()
        self._folder.cleanup()

    def put(self, path: str, source: bytes) -> None:
        """What the module is from now on; its time stamp is one that no compiled file has."""
        self._stamp += 2
        (self.tree / path).write_bytes(source)
        os.utime(self.tree / path, (self._stamp, self._stamp))

    def passes(self, tests: list[str], most_s: float) -> bool:
        """Whether all of them pass within so many seconds."""
        assert self._server.stdin is not None and self._server.stdout is not None
        print(" ".join(tests), file=self._server.stdin, flush=True)
        child = int(self._server.stdout.readline())
        watch = subprocess.Popen(
            [sys.executable, "-S", "-c", f"import os,time; time.sleep({most_s}); "
             f"os.killpg({child}, {int(signal.SIGKILL)})"], stderr=subprocess.DEVNULL,
        )  # fmt: skip
        code = int(self._server.stdout.readline())
        watch.kill()
        watch.wait()
        try:
            os.killpg(child, signal.SIGKILL)  # what it left behind
        except ProcessLookupError:
            pass
        return code == 0


def judge(
    module: str,
    about: dict[str, Any],
    count: int,
    seed: int,
    known: dict[str, str],
    keep: Callable[[], None],
) -> Record:
    """Draw mutants of a module and try each; `known` is what has been found, and is added to."""
    path = about["path"]
    source = (ROOT / path).read_bytes()
    found = mutants_of(source)
    drawn = random.Random(f"{module} {seed}").sample(found, min(count, len(found)))
    equal = {e["mutant"] for e in about.get("equivalent", ())}
    stamp = hashlib.sha256(source).hexdigest()[:16]
    if known.get("module") != stamp:
        known.clear()
        known["module"] = stamp
    tests = hashlib.sha256(
        b"".join((ROOT / t.partition("::")[0]).read_bytes() for t in about["tests"])
    )
    if known.get("tests") != tests.hexdigest()[:16]:  # what survived may be killed by now
        for name in [n for n, outcome in known.items() if outcome == "survived"]:
            del known[name]
        known["tests"] = tests.hexdigest()[:16]
    open_ones = [m for m in drawn if m.name not in known and m.name not in equal]
    if open_ones:
        with _Bench() as bench:
            began = time.monotonic()
            if not bench.passes(about["tests"], 600.0):
                raise SystemExit(f"{module}: its tests fail without any change")
            most_s = max(LEAST_S, PATIENCE * (time.monotonic() - began))
            for mutant in open_ones:
                bench.put(path, mutant.source)
                survived = bench.passes(about["tests"], most_s)
                known[mutant.name] = "survived" if survived else "killed"
                keep()
    alive = [m for m in drawn if known.get(m.name) == "survived" and m.name not in equal]
    same = sum(m.name in equal for m in drawn)
    judged = len(drawn) - same
    notes = [f"{judged - len(alive)} of {judged} killed", f"{same} cannot be told apart"]
    notes += [f"survived: {path}:{m.line}: {m.name}" for m in alive]
    score = 100.0 * (judged - len(alive)) / judged
    bar = f">= {BAR:g}"
    drawn_from = f"{len(drawn)} of {len(found)} drawn"
    return Record(f"mutants.{module}", score, "%", bar, drawn_from, "; ".join(notes))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    table = tomllib.loads(TABLE.read_text())
    parser.add_argument("--module", nargs="*", default=list(table), choices=list(table))
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    known: dict[str, dict[str, str]] = {}
    if given.resume and given.resume.exists():
        known = json.loads(given.resume.read_text())

    def keep() -> None:
        if given.resume:
            given.resume.write_text(json.dumps(known, indent=1))

    records, console = [], Console()
    for module in given.module:
        mine = known.setdefault(module, {})
        records.append(judge(module, table[module], given.count, given.seed, mine, keep))
        console.print(records[-1].name, f"{records[-1].value:.0f} %", highlight=False)
    show(records, console)
    if given.json:
        write(records, given.json)


if __name__ == "__main__":
    main()
