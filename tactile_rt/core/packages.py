"""Packages: the version of this one, what others add to it, and how to install a missing one.

A package says in its pyproject.toml what it adds, by the entry points of a group:

    [project.entry-points."tactile_rt.sources"]
    weather = "tactile_weather:WeatherSource"

Once it is installed, ``weather:`` is a source everywhere. Ours are looked up first, so a package
adds names and replaces none; what it names is imported when it is asked for.

An extra is added by the same road by which tactile_rt came, into the same environment: from a
checkout by its folder; otherwise to what is installed, which pip then need not find anywhere.
"""

import shlex
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tactile_rt.core.errors import ConfigError

VERSION = "0.2.0"  # which recordings, sweep sets and model files carry
ROOT = Path(__file__).parents[2]  # of a checkout or an unpacked source archive
ARRAYS = "tactile_rt.arrays"  # paths of .csv or .toml files
CELLS = "tactile_rt.cells"  # classes, of `encoders.cells.Cell`
CODECS = "tactile_rt.codecs"  # classes, of `drivers.codec.Codec`, as serial.NAME or can.NAME
OBJECTS = "tactile_rt.objects"  # functions of a random generator, to convex pieces
PUBLISHERS = "tactile_rt.publishers"  # classes, of `daemon.consumer.Consumer`
# Classes of the target and their `Options`, or functions of the target and the options as written,
# which return the source.
SOURCES = "tactile_rt.sources"


def added_names(group: str) -> tuple[str, ...]:
    """The names that other packages add to a group, in alphabetical order; nothing is imported."""
    return tuple(sorted(metadata.entry_points(group=group).names))


def added(group: str, name: str) -> Any:
    """What another package adds by this name; None if none does.

    Raises:
        ConfigError: It cannot be imported; the message names the package.
    """
    for point in metadata.entry_points(group=group).select(name=name):
        try:
            return point.load()
        except Exception as error:  # another package's code
            package = f" of the package {point.dist.name}" if point.dist else ""
            kind = group.removeprefix("tactile_rt.").replace("_", " ").removesuffix("s")
            raise ConfigError(f"{kind} {name}{package} cannot be loaded: {error}") from None
    return None


def install_extra(extra: str) -> str:
    """The command that adds an extra to this very tactile_rt, such as ``sim`` or ``sim,view``."""
    if (ROOT / "pyproject.toml").is_file():
        return install_line(f"{ROOT}[{extra}]", "--editable ")
    return install_line(f"tactile-rt[{extra}]")


def install_line(requirement: str, option: str = "") -> str:
    """The command that installs a package for the Python that is running.

    In an environment that uv made there is no pip: there it is uv that installs.
    """
    python = Path(sys.executable)
    if find_spec("pip") is None:
        return (
            f"uv pip install --python {shlex.quote(str(python))} {option}{shlex.quote(requirement)}"
        )
    # Where the environment is not activated, `pip` is another's.
    ours = shutil.which("pip") == str(python.with_name("pip"))
    pip = "pip" if ours else f"{shlex.quote(str(python))} -m pip"
    return f"{pip} install {option}{shlex.quote(requirement)}"


@contextmanager
def require_extra(what: str, extra: str) -> Iterator[None]:
    """Raise `lacking` if an import in the block fails."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise lacking(what, extra, error) from None


def lacking(what: str, extra: str, error: ModuleNotFoundError) -> ConfigError:
    """The error to raise when an import fails: what needs which package, and how it is installed.

    Args:
        what: The words before the package's name, such as "recordings need".

    Raises:
        ModuleNotFoundError: What is missing is a module of ours, which no extra brings.
    """
    missing = (error.name or extra).partition(".")[0]
    if missing == "tactile_rt":
        raise error
    return ConfigError(f"{what} {missing}, which is not installed: {install_extra(extra)}")
