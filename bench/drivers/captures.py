"""Other people's captures through `tactile-rt import`: samples in, intact, corrupt, missing.

python -m bench.drivers.captures [FOLDER]      (`make captures`)

`captures.toml` lists where each is, its SHA-256, its licence, and the options with which it is
imported. Nothing of it is kept in this repository: files go into FOLDER, or a temporary one. One
that is in FOLDER already, under its SHA-256, is not fetched again.
"""

import hashlib
import re
import shlex
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path
from urllib.parse import urlsplit

import msgspec

LIST = Path(__file__).with_name("captures.toml")
IMPORT = "from tactile_rt.cli import main; main()"
FETCH_S, IMPORT_S = 60, 60
MOST_BYTES = 256 << 20
_CAME = re.compile(r"(\d+) samples in, (\d+) intact, (\d+) corrupt, (\d+) missing")


class Capture(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A file that somebody has published.

    Attributes:
        name: Name of the capture, short.
        sensor: What was captured.
        url: Where the file is, of one commit for ever.
        sha256: SHA-256 of the file.
        licence: Licence that its publisher states.
        options: Options of `tactile-rt import`, as in a shell.
        suffix: Suffix of the file that tells its form, where only that does.
    """

    name: str
    sensor: str
    url: str
    sha256: str
    licence: str
    options: str
    suffix: str = ""


def captures() -> list[Capture]:
    """The list."""
    return msgspec.toml.decode(LIST.read_bytes(), type=dict[str, list[Capture]])["capture"]


def fetch(capture: Capture, folder: Path) -> Path:
    """The file in the folder; fetched if it is not there.

    Raises:
        OSError: it cannot be had.
        ValueError: what came is another file.
    """
    path = folder / f"{capture.sha256}{capture.suffix}"
    if not path.exists():
        with urllib.request.urlopen(capture.url, timeout=FETCH_S) as answer:
            data = answer.read(MOST_BYTES)
        if hashlib.sha256(data).hexdigest() != capture.sha256:
            raise ValueError(f"{capture.url} is another file than it was")
        path.write_bytes(data)
    return path


def row(capture: Capture, path: Path, output: Path) -> tuple[str, bool]:
    """What became of one, and whether it was imported."""
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", IMPORT, "import", str(path), str(output), "--force",
         *shlex.split(capture.options)],
        capture_output=True, text=True, timeout=IMPORT_S, check=False,
    )  # fmt: skip
    took = time.monotonic() - began
    found = _CAME.search(done.stdout)
    if done.returncode or found is None:
        why = (done.stderr.strip().splitlines() or ["?"])[-1]
        return f"{capture.name:<34} {why}", False
    numbers = "".join(f"{n:>10}" for n in found.groups())
    return f"{capture.name:<34}{numbers}{took:>7.1f}  {capture.sensor}", True


def main() -> int:
    """Print the table; 1: one was not imported, 2: there is no network."""
    say = sys.stdout.write
    wrong = 0
    with tempfile.TemporaryDirectory() as made:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(made)
        folder.mkdir(parents=True, exist_ok=True)
        for k, capture in enumerate(captures()):
            try:
                path = fetch(capture, folder)
            except urllib.error.HTTPError as error:
                say(f"{capture.name:<34} not there any more ({error.code})\n")
                wrong += 1
                continue
            except ValueError as error:
                say(f"{capture.name:<34} {error}\n")
                wrong += 1
                continue
            except OSError as error:
                host = urlsplit(capture.url).hostname
                say(f"no network: {host}, where the captures are, cannot be reached ({error})\n")
                return 2
            if k == 0:
                say(f"{'capture':<34}{'samples':>10}{'intact':>10}{'corrupt':>10}{'missing':>10}")
                say(f"{'s':>7}\n")
            text, good = row(capture, path, Path(made) / "out.mcap")
            say(f"{text}\n")
            sys.stdout.flush()
            wrong += not good
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main())
