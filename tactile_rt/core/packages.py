"""Packages: the version of this package, plugins of others, and installation of missing ones.

A plugin declares what it adds in its pyproject.toml, by the entry points of a group:

    [project.entry-points."tactile_rt.sources"]
    weather = "tactile_weather:WeatherSource"

Once it is installed, ``weather:`` is a source everywhere. Built-in names are looked up first, so a
plugin adds names and replaces none; its object is imported when it is requested.

An extra is installed as tactile_rt itself was, into the same environment: from a checkout by its
folder; otherwise by adding to the installed package, which pip need not find again.
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

VERSION = "0.2.0"  # stored in recordings, sweep sets and model files
ROOT = Path(__file__).parents[2]  # of a checkout or an unpacked source archive
# Groups of entry points, and what their names stand for.
ARRAYS = "tactile_rt.arrays"  # paths of .csv or .toml files
CELLS = "tactile_rt.cells"  # subclasses of `encoders.cells.Cell`
CODECS = "tactile_rt.codecs"  # subclasses of `drivers.codec.Codec`, as serial.NAME or can.NAME
OBJECTS = "tactile_rt.objects"  # functions from a random generator to convex pieces
PUBLISHERS = "tactile_rt.publishers"  # subclasses of `daemon.consumer.Consumer`
# Source classes, made of target and `Options`; or functions of target and options as text.
SOURCES = "tactile_rt.sources"


def added_names(group: str) -> tuple[str, ...]:
    """List the names that other packages add to an entry-point group; import nothing."""
    return tuple(sorted(metadata.entry_points(group=group).names))


def import_addition(group: str, name: str) -> Any:
    """Import the object that another package adds by this name; return None if none does.

    Raises:
        ConfigError: The import fails; the message names the package.
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
    """Return the shell command that installs extras, such as ``sim,view``."""
    if (ROOT / "pyproject.toml").is_file():
        return install_line(f"{ROOT}[{extra}]", "--editable ")
    return install_line(f"tactile-rt[{extra}]")


def install_line(requirement: str, option: str = "") -> str:
    """Return the shell command that installs a package for the running Python.

    The command uses uv if the environment has no pip, as environments made by uv.
    """
    python = Path(sys.executable)
    if find_spec("pip") is None:
        return (
            f"uv pip install --python {shlex.quote(str(python))} {option}{shlex.quote(requirement)}"
        )
    # If the environment is not activated, `pip` belongs to another one.
    ours = shutil.which("pip") == str(python.with_name("pip"))
    pip = "pip" if ours else f"{shlex.quote(str(python))} -m pip"
    return f"{pip} install {option}{shlex.quote(requirement)}"


@contextmanager
def require_extra(what: str, extra: str) -> Iterator[None]:
    """Turn a failed import in the block into an error that names the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise lacking(what, extra, error) from None


def lacking(what: str, extra: str, error: ModuleNotFoundError) -> ConfigError:
    """Make a `ConfigError` that names a missing package and the command that installs it.

    Args:
        what: The words before the package's name, such as "recordings need".

    Raises:
        ModuleNotFoundError: The missing module is one of tactile_rt, which no extra contains.
    """
    missing = (error.name or extra).partition(".")[0]
    if missing == "tactile_rt":
        raise error
    return ConfigError(f"{what} {missing}, which is not installed: {install_extra(extra)}")
