"""What a road is walked with: a wheel, an empty environment, steps that must say what they do."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
STEP_S = 900.0


class Failed(Exception):
    """A step did not do what it should; the message says which, and what it printed."""


def build_wheel(folder: Path) -> Path:
    """Build the wheel of this checkout into a folder; returns its path."""
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def find_python(version: str) -> str:
    """Return the path of a Python such as ``3.12``; empty if there is none here."""
    if sys.version_info[:2] == tuple(map(int, version.split("."))):
        return str(Path(sys.base_prefix) / "bin" / f"python{version}")
    for folder in os.environ["PATH"].split(":"):
        found = Path(folder) / f"python{version}"
        # A launcher may be there without the Python that it launches.
        if (
            found.is_file()
            and not subprocess.run([found, "-c", ""], capture_output=True).returncode
        ):
            return str(found)
    return ""


@dataclass(frozen=True)
class Road:
    """An environment and an empty folder to walk in.

    Attributes:
        name: The name of the road, for what is printed.
        environment: The environment's folder.
        folder: The folder in which commands run.
        installer: ``pip`` or ``uv``.
    """

    name: str
    environment: Path
    folder: Path
    installer: str

    @property
    def python(self) -> str:
        """The path of the environment's Python."""
        return str(self.environment / "bin" / "python")

    @property
    def settings(self) -> dict[str, str]:
        """The environment variables of a shell in which the environment is activated."""
        gone = ("PYTHONPATH", "PYTHONHOME", "PIP_CONSTRAINT")
        kept = {key: value for key, value in os.environ.items() if key not in gone}
        return kept | {
            "PATH": f"{self.environment / 'bin'}:{os.environ['PATH']}",
            "VIRTUAL_ENV": str(self.environment),
            "XDG_STATE_HOME": str(self.folder / "state"),
            "NUMBA_CACHE_DIR": str(self.environment / "numba"),
        }

    def install(self, *what: str) -> None:
        """Install packages."""
        if self.installer == "uv":
            command = ["uv", "pip", "install", "--quiet", "--python", self.python, *what]
        else:
            command = [self.python, "-m", "pip", "install", "--quiet", *what]
        self.step(f"install {' '.join(Path(one).name for one in what)}", *command)

    def step(
        self,
        what: str,
        *command: str,
        says: Sequence[str] = (),
        code: int = 0,
        stdin: str = "",
        seconds: float = STEP_S,
    ) -> str:
        """Run a command as a user would; returns what it printed on both outputs.

        Args:
            what: The step, for what is printed.
            command: The command and its arguments.
            says: What must be among what it prints.
            code: The exit code that it must have.
            stdin: What is typed.
            seconds: The longest time that it may take.

        Raises:
            Failed: it has another exit code, does not say it, or takes longer.
        """
        began = time.monotonic()
        try:
            done = subprocess.run(
                command, cwd=self.folder, env=self.settings, input=stdin, text=True,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=seconds, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise Failed(f"{what}: not over in {seconds:g} s: {error.output!r:.400}") from None
        missing = [words for words in says if words not in done.stdout]
        if done.returncode != code or missing:
            why = f"exit code {done.returncode}" if done.returncode != code else f"no {missing}"
            raise Failed(f"{what}: {why}\n  {' '.join(command)}\n{done.stdout[-1500:]}")
        self.tell(f"{what} ({time.monotonic() - began:.1f} s)")
        return done.stdout

    def tell(self, what: str) -> None:
        """Print a line of the road."""
        sys.stdout.write(f"{self.name}: {what}\n")
        sys.stdout.flush()

    def size_mb(self) -> float:
        """Return what is installed, in MB, without the installer and without bytecode."""
        (packages,) = (self.environment / "lib").glob("python*/site-packages")
        tools = ("pip", "setuptools", "pkg_resources", "_distutils_hack", "distutils-precedence")
        sizes = [
            path.stat().st_size
            for path in packages.rglob("*")
            if path.is_file()
            and path.suffix != ".pyc"
            and not path.relative_to(packages).parts[0].startswith(tools)
        ]
        return sum(sizes) / 1e6


@contextmanager
def new_road(name: str, python: str, installer: str) -> Iterator[Road]:
    """Make an empty environment of a Python, and an empty folder; both are gone afterwards."""
    with tempfile.TemporaryDirectory() as place:
        environment, folder = Path(place) / "env", Path(place) / "work"
        folder.mkdir()
        road = Road(name, environment, folder, installer)
        if installer == "uv":
            made = ["uv", "venv", "--quiet", "--python", python, str(environment)]
        else:
            made = [python, "-m", "venv", str(environment)]
        road.step("make an environment", *made)
        yield road
