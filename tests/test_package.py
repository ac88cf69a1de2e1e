"""What an installed tactile_rt looks like from outside."""

import importlib
import pkgutil
import subprocess
import tomllib
from importlib.metadata import distributions
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

import tactile_rt
from tests.helpers.processes import run_program

ROOT = Path(__file__).parent.parent
PACKAGE = Path(tactile_rt.__file__).parent
LINKS = ("drivers", "export", "models", "sim_backend")
# What a robot has none of.
HEAVY = ("torch", "mujoco", "trimesh", "scipy", "onnx", "onnxscript", "sklearn", "matplotlib")
ONBOARD = (
    "calibration", "classifier.classifier", "classifier.contact_point", "classifier.session",
    "cli", "daemon.daemon", "drivers.opening", "recording", "core.settings", "sources.combined",
    "sources.opening", "core.stream", "sets.objects", "testing",
)  # fmt: skip

MODULES = sorted(m.name for m in pkgutil.walk_packages([str(PACKAGE)], "tactile_rt."))


def order(name: str) -> tuple[int, str]:
    """CONSTANTS, then Classes, then functions: how the linter sorts `__all__`."""
    return (0 if name.isupper() else 1 if name[0].isupper() else 2), name


@pytest.mark.parametrize("name", MODULES)
def test_what_a_module_exports_is_there_and_sorted(name: str) -> None:
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in HEAVY:
            pytest.skip(f"{error.name} is not installed")
        raise
    exported = getattr(module, "__all__", [])
    assert [n for n in exported if not hasattr(module, n)] == []
    assert list(exported) == sorted(set(exported), key=order)
    assert not any(n.startswith("_") for n in exported)
    assert module.__doc__ or not exported, "a module that exports says what it is"


def test_every_folder_of_modules_is_a_package() -> None:
    """Tools that find packages by `__init__.py` would leave the others out of a wheel."""
    folders = {p.parent for p in PACKAGE.rglob("*.py")}
    assert [f for f in folders if not (f / "__init__.py").exists()] == []


@pytest.mark.skipif((ROOT / "PKG-INFO").exists(), reason="a source archive, which has no links")
@pytest.mark.parametrize("name", LINKS)
def test_the_names_at_the_top_are_links_that_point_inward(name: str) -> None:
    link = ROOT / name
    assert link.is_symlink()
    target = link.readlink()
    assert not target.is_absolute(), "it would point elsewhere on another machine"
    assert target == Path("tactile_rt") / name
    assert link.resolve() == (ROOT / "tactile_rt" / name).resolve()
    assert (link / "__init__.py").is_file()


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no clone")
def test_a_source_archive_is_the_whole_tree() -> None:
    """But for the links, what runs the tests where this is developed, and what is no file of it."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("git does not list this tree")
    there = {name.partition("/")[0] for name in listed.stdout.splitlines()}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    archived = project["tool"]["hatch"]["build"]["targets"]["sdist"]["only-include"]
    assert set(archived) == there - {*LINKS, ".ci", ".gitignore"}


def test_it_is_typed() -> None:
    assert (PACKAGE / "py.typed").is_file()


def test_the_version_is_the_project_s() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert tactile_rt.__version__ == project["version"]


def modules_after(code: str) -> set[str]:
    """The top-level modules that a fresh interpreter has loaded after running some code."""
    code += "\nimport sys; print('\\n'.join({m.partition('.')[0] for m in sys.modules}))"
    done = run_program(program=code)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.split("\n"))


@pytest.mark.skipif(find_spec("torch") is None, reason="proves nothing where torch is missing")
@pytest.mark.parametrize("name", ONBOARD)
def test_what_runs_on_a_robot_needs_nothing_heavy(name: str) -> None:
    loaded = modules_after(f"import tactile_rt.{name}")
    assert "tactile_rt" in loaded
    assert not loaded & set(HEAVY)


def test_neither_does_running_a_model() -> None:
    code = """
import numpy as np
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.testing import cut_chunks
spec = load_model(shipped_model())[1].array
for chunk in cut_chunks(np.zeros((100, *spec.shape)), spec.rate_hz):
    Classifier(shipped_model(), spec).push(chunk)
"""
    assert not modules_after(code) & set(HEAVY)


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["run", "--help"], ["codecs"]])
def test_neither_does_asking_the_command_for_help(arguments: list[str]) -> None:
    code = f"""
import sys
from tactile_rt.cli import main
sys.argv = ["tactile-rt", *{arguments!r}]
try:
    main()
except SystemExit as leaving:
    assert not leaving.code
"""
    loaded = modules_after(code)
    assert not loaded & set(HEAVY)
    assert not loaded & {"numpy", "onnxruntime", "can", "serial"}, "help is instant"


def test_shipped_helpers_need_no_test_framework() -> None:
    loaded = modules_after("import tactile_rt.testing")
    assert not loaded & {"pytest", "_pytest", "hypothesis"}


def test_what_is_pinned_installs_with_the_oldest_python() -> None:
    """Such as Debian 12's, which is older than what these tests mostly run with."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    oldest = project["requires-python"].removeprefix(">=") + ".0"
    pins = (ROOT / "requirements" / "constraints.txt").read_text().splitlines()
    pinned = {line.partition("==")[0] for line in pins if not line.startswith("#")}
    needs = {
        one.name: SpecifierSet(one.metadata["Requires-Python"])
        for one in distributions()
        if one.name in pinned and "Requires-Python" in one.metadata
    }
    assert len(needs) > 100
    assert [name for name, versions in needs.items() if oldest not in versions] == []
