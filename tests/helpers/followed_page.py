"""A page of docs/, followed as a reader does: every block of code in order, in an empty folder.

    ```python title="pyproject.toml"      a block with a title is a file, written as it stands
    ```python                             run, all of a page in one namespace
    ```sh                                 run, command by command; each must end well
    ```sh title="another terminal"        begun, and stopped when the page ends
    ```text                               what the block before prints; "..." stands for anything

`pip install .` does here what matters of it: the names that the folder's pyproject.toml adds are
found, and its modules can be imported. `git clone` copies this tree. All other languages are shown
and not run.
"""

import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.helpers.processes import PROGRAM
from tests.helpers.source_tree import ROOT

FENCE = re.compile(r"^```(\w+)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.M | re.S)
TERMINAL = "another terminal"
OF_A_SHELL = re.compile(r"[|&;<>$*]")


@dataclass(frozen=True)
class Block:
    """One fenced block."""

    language: str  # word after the fence
    title: str  # name of the file that it is, or that of a terminal; empty for neither
    text: str  # lines of the block
    line: int  # line of the page that the fence is in


def blocks(page: str) -> list[Block]:
    """All fenced blocks of a page, in order."""
    return [
        Block(m[1], m[2] or "", m[3], page.count("\n", 0, m.start()) + 1)
        for m in FENCE.finditer(page)
    ]


def follow(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Do all that a page says; what fails is told with the page's line."""
    reader = Reader(folder, monkeypatch)
    with reader.at_work():
        for block in blocks(page.read_text("utf-8")):
            try:
                reader.take(block)
            except Exception as error:
                where = f"{page.relative_to(ROOT)}:{block.line}"
                raise AssertionError(f"{where}: {type(error).__name__}: {error}") from error


class Reader:
    """Somebody at a computer with the page before them.

    Args:
        folder: An empty folder, where they begin.
        monkeypatch: Takes back what they change of this process.
    """

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.printed = ""
        self._patch = monkeypatch
        self._names: dict[str, object] = {"__name__": "__page__"}
        self._terminals: list[subprocess.Popen[bytes]] = []

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """In the folder, with the commands of this tree first on the path."""
        tools = self.folder.parent / f"{self.folder.name}-bin"
        tools.mkdir()
        for name, words in (("tactile-rt", ["-c", PROGRAM]), ("python", [])):
            call = shlex.join([sys.executable, *words])
            (tools / name).write_text(f'#!/bin/sh\nexec {call} "$@"\n')
            (tools / name).chmod(0o755)
        modules = set(sys.modules)
        self._patch.chdir(self.folder)
        self._patch.setenv("PATH", f"{tools}{os.pathsep}{os.environ['PATH']}")
        self._patch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), *self._path()]))
        self._patch.setenv("XDG_CONFIG_HOME", str(tools / "config"))
        self._patch.setenv("COLUMNS", "120")
        self._patch.syspath_prepend(str(self.folder))
        try:
            yield
        finally:
            for terminal in self._terminals:
                terminal.terminate()
                terminal.wait()
            for name in set(sys.modules) - modules:  # another page may call its modules the same
                if str(self.folder) in str(getattr(sys.modules[name], "__file__", "")):
                    del sys.modules[name]

    def take(self, block: Block) -> None:
        """Do what one block says."""
        if block.title == TERMINAL:
            self._begin(block.text)
        elif block.title:
            path = Path(block.title)  # from where the reader is
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(block.text, "utf-8")
        elif block.language == "python":
            self._print(lambda: exec(compile(block.text, "<page>", "exec"), self._names))
        elif block.language == "sh":
            self.printed = ""
            for command in commands(block.text):
                self._run(command)
        elif block.language == "text":
            check_printed(self.printed, block.text)

    def _run(self, command: str) -> None:
        words = shlex.split(command, comments=True)
        if words[:2] == ["pip", "install"]:
            self._install(Path(words[-1]).resolve())
        elif words[0] == "cd" and len(words) == 2:
            self._patch.chdir(words[1])
        elif words[:2] == ["git", "clone"]:
            kept = ("tactile_rt", "tests", "bench", "pyproject.toml")
            for name in kept:
                into = self.folder / Path(words[2]).name / name
                _copy(ROOT / name, into)
        elif words[0] == "tactile-rt" and words[1] != "run" and not OF_A_SHELL.search(command):
            self._call(words)  # what runs as a daemon minds the signals of its process
        else:
            done = subprocess.run(
                ["bash", "-c", command], capture_output=True, text=True, timeout=60, check=False
            )
            assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
            self.printed += done.stdout

    def _call(self, words: list[str]) -> None:
        """`tactile-rt` in this process, which spares its start."""
        from tactile_rt.cli import main

        with self._patch.context() as patch:
            patch.setattr(sys, "argv", words)
            with pytest.raises(SystemExit) as left:
                self._print(main, add=True)
        assert not left.value.code, f"{shlex.join(words)}: exit code {left.value.code}"

    def _begin(self, text: str) -> None:
        for command in commands(text):
            call = ["bash", "-c", f"exec {command}"]
            self._terminals.append(subprocess.Popen(call, stdout=subprocess.DEVNULL))

    def _install(self, package: Path) -> None:
        project = tomllib.loads((package / "pyproject.toml").read_text("utf-8"))["project"]
        place = self.folder.parent / f"{self.folder.name}-installed"
        info = place / f"{project['name']}-{project['version']}.dist-info"
        info.mkdir(parents=True)
        head = f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
        (info / "METADATA").write_text(head)
        lines = []
        for group, names in project.get("entry-points", {}).items():
            lines += [f"[{group}]", *(f"{name} = {value}" for name, value in names.items())]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        for path in (place, package):
            self._patch.syspath_prepend(str(path))
            self._patch.setenv("PYTHONPATH", f"{os.environ['PYTHONPATH']}{os.pathsep}{path}")

    def _print(self, what: Callable[[], object], add: bool = False) -> None:
        out = io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True)
        try:
            with redirect_stdout(out):
                what()
        finally:
            said = out.buffer.getvalue().decode()  # type: ignore[attr-defined]
            self.printed = (self.printed if add else "") + said

    @staticmethod
    def _path() -> list[str]:
        return [part for part in os.environ.get("PYTHONPATH", "").split(os.pathsep) if part]


def _copy(there: Path, here: Path) -> None:
    here.parent.mkdir(exist_ok=True)
    if there.is_file():
        shutil.copy(there, here)
    else:
        shutil.copytree(there, here, ignore=shutil.ignore_patterns("__pycache__", "data", "*.pt"))


def commands(text: str) -> list[str]:
    """The commands of a block, lines that are continued joined, comments left out."""
    lines = text.replace("\\\n", " ").splitlines()
    return [line for line in lines if line.strip() and not line.lstrip().startswith("#")]


def check_printed(printed: str, shown: str) -> None:
    """That what was printed is what the page shows, where spaces do not count.

    Raises:
        AssertionError: It is not.
    """
    said, wanted = (" ".join(text.split()) for text in (printed, shown))
    pattern = ".*".join(re.escape(part.strip()) for part in wanted.split("..."))
    pattern = pattern.replace(".*", r"\s?.*?\s?")
    assert re.fullmatch(pattern, said), f"the page shows\n{shown}\nbut this is printed\n{printed}"
