"""What is said of a package that is not there can be typed as it stands."""

import shlex
import sys

import pytest

from tactile_rt.core import packages


@pytest.fixture
def environment(tmp_path, monkeypatch):
    """An environment with a Python that runs, and a pip of its own."""
    folder = tmp_path / "an env" / "bin"
    folder.mkdir(parents=True)
    for name in ("python", "pip"):
        (folder / name).write_text("#!/bin/sh\n")
        (folder / name).chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(folder / "python"))
    monkeypatch.setenv("PATH", "/usr/bin")
    return folder


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """As from a wheel: beside the package lies no project."""
    monkeypatch.setattr(packages, "ROOT", tmp_path / "site-packages")


def test_from_a_checkout_it_is_the_checkout_that_is_installed(environment, tmp_path, monkeypatch):
    folder = tmp_path / "my tree"
    folder.mkdir()
    (folder / "pyproject.toml").touch()
    monkeypatch.setattr(packages, "ROOT", folder)
    words = shlex.split(packages.install_extra("sim,view"))
    assert words[1:] == ["-m", "pip", "install", "--editable", f"{folder}[sim,view]"]
    assert words[0] == str(environment / "python")


def test_where_there_is_no_pip_uv_installs(environment, installed, monkeypatch):
    monkeypatch.setattr(packages, "find_spec", lambda name: None)
    words = shlex.split(packages.install_extra("sim,view"))
    python = str(environment / "python")
    assert words == ["uv", "pip", "install", "--python", python, "tactile-rt[sim,view]"]


def test_in_an_activated_environment_pip_is_enough(environment, installed, monkeypatch):
    monkeypatch.setenv("PATH", f"{environment}:/usr/bin")
    assert packages.install_extra("sim") == "pip install 'tactile-rt[sim]'"
    assert packages.install_line("tensorboard") == "pip install tensorboard"


def test_pip_of_another_environment_is_not_taken(environment, installed, tmp_path, monkeypatch):
    other = tmp_path / "other"
    other.mkdir()
    (environment / "pip").rename(other / "pip")
    monkeypatch.setenv("PATH", str(other))
    assert shlex.split(packages.install_line("tensorboard"))[:3] == [sys.executable, "-m", "pip"]


def test_it_names_the_package_that_is_missing(environment, installed, monkeypatch):
    monkeypatch.setenv("PATH", str(environment))
    error = ModuleNotFoundError("No module named 'av.video'", name="av.video")
    said = str(packages.lacking("films need", "view", error))
    assert said == "films need av, which is not installed: pip install 'tactile-rt[view]'"


def test_what_no_extra_brings_is_no_lack_of_an_extra():
    error = ModuleNotFoundError("No module named 'tactile_rt.gone'", name="tactile_rt.gone")
    with pytest.raises(ModuleNotFoundError) as raised:
        packages.lacking("this needs", "sim", error)
    assert raised.value is error
