"""What is said of a package that is not there: its name, and the command that installs it here.

An extra is added by the same road by which tactile_rt came, into the same environment: from a
checkout by its folder; otherwise to what is installed, which pip then need not find anywhere.
"""

import shlex
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

from tactile_rt.core.errors import ConfigError

__all__ = ["install_extra", "install_line", "lacking"]

ROOT = Path(__file__).parents[2]  # of a checkout or an unpacked source archive


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
