"""The page of all measured figures, docs/reference/benchmarks.md.

    python -m bench.pages.benchmarks measure align           # `tactile-rt bench align`, and keep it
    python -m bench.pages.benchmarks measure drivers --quick
    python -m bench.pages.benchmarks                         # write the page of all that is kept

What is kept of an area, in docs/reference/benchmarks, is what its command printed, with the
machine, the day and the command. The page is made of nothing else.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from tactile_rt.cli.bench import AREAS
from tactile_rt.core.packages import VERSION
from tactile_rt.models.evaluation.records import Record

__all__ = ["FOLDER", "PAGE", "Measurement", "measure", "read", "written"]

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "benchmarks.md"
FOLDER = PAGE.with_suffix("")
COMMAND = [sys.executable, "-c", "from tactile_rt.cli import main; main()"]
HEAD = """# Every bar

<!-- written by `python -m bench.pages.benchmarks`; do not edit -->

What `tactile-rt bench` measured, area by area, beside what is asked of it (the bar) and what that
comes from (the anchor). *Of its bar* is the figure over the bar's: what must be small is good below
1, what must be large above. A figure is of the machine and the day that stand above its table; run
the command on yours. What is not met reads **MISSED**.

Real things, by every method, have [a page of their own](realtouch.md), and so have
[networks that are tuned alike](../explain/results.md).
"""


@dataclass(frozen=True)
class Measurement:
    """What one command printed.

    Attributes:
        command: The command, as a user types it.
        version: The release of this package.
        day: The day of the measurement, UTC, YYYY-MM-DD.
        machine: The processor, its cores, the system, and the load before it began.
        records: The figures in the order in which they were printed.
    """

    command: str
    version: str
    day: str
    machine: str
    records: tuple[Record, ...]


def measure(area: str, quick: bool) -> Measurement:
    """Run the command of an area.

    Raises:
        CalledProcessError: It failed; its words are on stderr.
    """
    words = ["bench", area, *(["--quick"] if quick else [])]
    machine = described()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "records.json"
        subprocess.run([*COMMAND, *words, "--json", str(out)], cwd=ROOT, check=True)
        found = json.loads(out.read_text("utf-8"))
    records = tuple(Record(**{k: v for k, v in one.items() if k != "met"}) for one in found)
    day = datetime.now(UTC).date().isoformat()
    return Measurement(" ".join(["tactile-rt", *words]), VERSION, day, machine, records)


def described() -> str:
    """This machine in words."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text("utf-8").splitlines()
        name = next((x.partition(": ")[2] for x in lines if x.startswith("model name")), name)
    return (
        f"{name}, {os.cpu_count()} cores, {platform.system()} {platform.machine()}, "
        f"Python {platform.python_version()}, load {os.getloadavg()[0]:.1f} before it began"
    )


def read(area: str) -> Measurement | None:
    """What is kept of an area; None: nothing yet."""
    path = FOLDER / f"{area}.json"
    if not path.exists():
        return None
    kept = json.loads(path.read_text("utf-8"))
    return Measurement(**{**kept, "records": tuple(Record(**one) for one in kept["records"])})


def written() -> str:
    """The page of all that is kept."""
    return "\n".join([HEAD, *(section(area, read(area)) for area in AREAS)])


def section(area: str, measured: Measurement | None) -> str:
    """One area's part of the page."""
    if measured is None:
        return (
            f"## {area}\n\nNot measured yet for this page: `tactile-rt bench {area}` does, from a "
            "checkout.\n"
        )
    bars = [one for one in measured.records if one.bar]
    missed = sum(not one.met for one in bars)
    quick = " It is a quick look, not a figure to quote." if "--quick" in measured.command else ""
    lines = [
        f"## {area}",
        "",
        f"`{measured.command}`, release {measured.version}, {measured.day}. {measured.machine}. "
        f"{len(bars) - missed} of {len(bars)} bars met.{quick}",
        "",
        "| figure | value | bar | of its bar | | anchor; how |",
        "|---|---:|---:|---:|---|---|",
        *map(row, measured.records),
        "",
    ]
    return "\n".join(lines)


def row(one: Record) -> str:
    """One figure as a line of the table."""
    limit = float(one.bar.partition(" ")[2]) if one.bar else 0.0
    share = f"{one.value / limit:.2f}" if limit else ""
    met = {True: "met", False: "**MISSED**", None: ""}[one.met]
    how = "; ".join(part for part in (one.anchor, one.how) if part).replace("|", "/")
    return f"| `{one.name}` | {one.value:.4g} {one.unit} | {one.bar} | {share} | {met} | {how} |"


def main() -> None:
    parser = argparse.ArgumentParser(description="The page of all measured figures.")
    parser.add_argument("what", nargs="?", choices=["measure"])
    parser.add_argument("areas", nargs="*", metavar="AREA", help=", ".join(AREAS))
    parser.add_argument("--quick", action="store_true", help="a look, marked as such")
    asked = parser.parse_args()
    for area in asked.areas:
        if area not in AREAS:
            parser.error(f"no area {area!r}: there are {', '.join(AREAS)}")
        FOLDER.mkdir(exist_ok=True)
        kept = json.dumps(asdict(measure(area, asked.quick)), indent=1)
        (FOLDER / f"{area}.json").write_text(kept + "\n", "utf-8")
    PAGE.write_text(written(), "utf-8")


if __name__ == "__main__":
    main()
