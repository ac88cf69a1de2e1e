"""Do the wheels that a robot needs exist for aarch64 (Raspberry Pi, Jetson), Python 3.11 to 3.13?

Asks pip to resolve the dependencies in pyproject.toml for each Python and each generation of
Linux, wheels only, without installing or keeping anything.
"""

import json
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PYTHONS = ("3.11", "3.12", "3.13")
# Each takes wheels for an older glibc too; what is older than the first lacks onnxruntime.
PLATFORMS = {
    "glibc 2.28 (Debian 10)": (
        "manylinux_2_28_aarch64", "manylinux_2_27_aarch64", "manylinux2014_aarch64",
        "manylinux_2_17_aarch64",
    ),
    "glibc 2.31 (JetPack 5, Debian 11)": ("manylinux_2_31_aarch64",),
    "glibc 2.35 (JetPack 6, Ubuntu 22.04)": ("manylinux_2_35_aarch64", "manylinux_2_34_aarch64"),
}  # fmt: skip


def main() -> int:
    with (ROOT / "pyproject.toml").open("rb") as file:
        wanted = tomllib.load(file)["project"]["dependencies"]
    failed = 0
    older: tuple[str, ...] = ()
    for machine, platforms in PLATFORMS.items():
        older = (*platforms, *older)
        for python in PYTHONS:
            found, why = resolve(wanted, python, older)
            failed += found is None
            line = ", ".join(found) if found is not None else f"NO: {why}"
            sys.stdout.write(f"{machine}, Python {python}: {line}\n")
            sys.stdout.flush()
    return 1 if failed else 0


def resolve(
    wanted: list[str], python: str, platforms: tuple[str, ...]
) -> tuple[list[str] | None, str]:
    """Names with versions of all wheels, or None and pip's reason."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        tags = [part for p in (*platforms, "linux_aarch64") for part in ("--platform", p)]
        command = [
            *(sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", "--ignore-installed"),
            *("--disable-pip-version-check", "--only-binary", ":all:", "--target", folder),
            *("--python-version", python, "--implementation", "cp", "--report", str(report)),
            *(*tags, *wanted),
        ]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return None, (done.stderr.strip().splitlines() or ["pip said nothing"])[-1]
        items = json.loads(report.read_text())["install"]
        return sorted(f"{i['metadata']['name']} {i['metadata']['version']}" for i in items), ""


if __name__ == "__main__":
    sys.exit(main())
