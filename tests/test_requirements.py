"""The exact releases in `requirements/` are those asked for, and those that are installed."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "requirements"
PYTHONS = ("3.11", "3.12", "3.13")
HASH = re.compile(r"--hash=sha256:[0-9a-f]{64}")


def asked_for(*extras: str) -> list[Requirement]:
    """What the project needs with some extras; none: with all but `onboard`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    tables = project["optional-dependencies"]
    chosen = extras or [name for name in tables if name != "onboard"]
    lines = [*project["dependencies"], *(line for name in chosen for line in tables[name])]
    found = [Requirement(line) for line in lines]
    inside = {extra for r in found if r.name == project["name"] for extra in r.extras}
    found = [r for r in found if r.name != project["name"]]
    return [*found, *asked_for(*inside)] if inside else found


def pins(name: str) -> list[Requirement]:
    """The releases of a file; a line that goes on is one line."""
    text = (FOLDER / name).read_text("utf-8").replace("\\\n", "")
    lines = [line for line in text.splitlines() if line and line[0] not in " #"]
    return [Requirement(line.partition(" --hash")[0]) for line in lines]


def pinned(found: list[Requirement], name: str, python: str) -> Version:
    """The one release of a package for a Python on Linux."""
    here = {
        "python_version": python, "python_full_version": f"{python}.0", "sys_platform": "linux",
        "implementation_name": "cpython", "platform_python_implementation": "CPython",
    }  # fmt: skip
    name = canonicalize_name(name)
    (pin,) = [
        r for r in found
        if canonicalize_name(r.name) == name and (r.marker is None or r.marker.evaluate(here))
    ]  # fmt: skip
    (only,) = pin.specifier
    assert only.operator == "=="
    return Version(only.version)


def check(wanted: list[Requirement], found: list[Requirement], python: str) -> None:
    for one in wanted:
        if one.marker is None or one.marker.evaluate({"python_version": python}):
            assert pinned(found, one.name, python) in one.specifier, one


def test_every_dependency_and_extra_has_its_release() -> None:
    check(asked_for(), pins("constraints.txt"), "3.11")


@pytest.mark.parametrize("python", PYTHONS)
def test_every_package_of_a_robot_has_its_release(python: str) -> None:
    check(asked_for("onboard"), pins("onboard.txt"), python)


def test_what_is_installed_is_what_is_written() -> None:
    """An environment of another time: `make test` brings it up to date."""
    wrong = {}
    for pin in pins("constraints.txt"):
        if (pin.marker is not None and not pin.marker.evaluate()) or not is_installed(pin.name):
            continue  # of an extra that the tests do without
        if version(pin.name) not in pin.specifier:
            wrong[str(pin)] = version(pin.name)
    assert wrong == {}
    extras = ("sim", "gym", "train", "publish", "ros2", "lerobot", "test", "dev")
    assert [r.name for r in asked_for(*extras) if not is_installed(r.name)] == []


def is_installed(name: str) -> bool:
    try:
        version(name)
    except PackageNotFoundError:
        return False
    return True


def test_every_release_of_a_robot_is_told_by_its_hashes_wherever_it_comes_from() -> None:
    text = (FOLDER / "onboard.txt").read_text("utf-8")
    entries = re.split(r"\n(?=[a-z])", text)[1:]
    assert len(entries) >= 20
    assert all(HASH.search(entry) for entry in entries)
    for name in ("onboard.txt", "constraints.txt"):
        assert not re.search(r"://|index-url|find-links| @ ", (FOLDER / name).read_text("utf-8"))
