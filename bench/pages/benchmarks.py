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
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from tactile_rt.cli.bench import AREAS
from tactile_rt.core.packages import VERSION
from tactile_rt.models.evaluation.records import Record

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "benchmarks.md"
FOLDER = PAGE.with_suffix("")
COMMAND = [sys.executable, "-c", "from tactile_rt.cli import main; main()"]
HEAD = """# Benchmarks

<!-- written by `python -m bench.pages.benchmarks`; do not edit -->

What `tactile-rt bench` measured, area by area. A *bar* is the value that a figure must reach. Each
table has the headline figures of its area, a fixed list (`bench/pages/headlines.toml`), and after
them every other figure that misses its bar, marked **MISSED**. All figures, with what each is
compared with and how it was measured, are in the JSON file of the area. Timings are those of the
machine named above the table: run the command on yours.

More results: [shapes of real things](realtouch-2.md), [names of them](realtouch.md),
[networks compared](../explain/results.md), [the physics](../explain/physics.md).
"""
HEADLINES = tomllib.loads(Path(__file__).with_name("headlines.toml").read_text("utf-8"))


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
    quick = " A quick look, not a figure to quote." if "--quick" in measured.command else ""
    met = f"{len(bars) - missed} of {len(bars)} bars met" if bars else "no bars"
    lines = [
        f"## {area}",
        "",
        f"`{measured.command}`, release {measured.version}, {measured.day}. {measured.machine}. "
        f"{met}; [all {len(measured.records)} figures](benchmarks/{area}.json).{quick}",
        "",
        *bar_table(measured.records, HEADLINES[area]),
        "",
    ]
    return "\n".join(lines)


def bar_table(records: Sequence[Record], headlines: dict[str, str]) -> list[str]:
    """Tabulate the headlines, in their order, and then every other figure that misses its bar."""
    shown = [one for name in headlines for one in records if one.name == name]
    shown += [one for one in records if one.met is False and one.name not in headlines]
    words = HEADLINES["missed"] | headlines
    rows = (row(one, words.get(one.name, f"`{one.name}`")) for one in shown)
    return ["| figure | value | bar |", "|---|---:|---:|", *rows]


def row(one: Record, words: str) -> str:
    """One figure as a line of the table."""
    limit = float(one.bar.partition(" ")[2]) if one.bar else None
    value = f"{one.value:,.0f}" if abs(one.value) >= 1000 else f"{one.value:.3g}"
    if one.value != limit == float(value.replace(",", "")):
        value = f"{one.value:.6g}"  # on which side of its bar
    met = {True: " met", False: " **MISSED**", None: ""}[one.met]
    called = words.format(anchor=one.anchor.partition(";")[0])
    return f"| {called} | {f'{value} {one.unit}'.strip()} | {one.bar}{met} |"


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
