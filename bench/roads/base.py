"""The base install: a right decision, a recording and back, a table, a log, a lesson."""

import json
import shlex
from pathlib import Path

from bench.roads.walking import Failed, Road

LARGEST_MB = 180.0
PASSED = ["other", "other", "table", "bottle", "other", "other"]  # in the recording that ships
TABLE = "time,left,right\n" + "".join(f"{k / 100},{k % 7},{k % 5}\n" for k in range(300))
# Two samples of an Aidin AFT200: forces and torques in two frames each.
LOG = "".join(
    f"({k / 100:.6f}) can0 {name}#{'7530' * 3}\n" for k in range(100) for name in ("001", "002")
)


def walk_base(road: Road, wheel: Path) -> None:
    """Walk it.

    Raises:
        Failed: a step does not do what it should.
    """
    road.install(str(wheel))
    size = road.size_mb()
    if size > LARGEST_MB:
        raise Failed(f"{size:.0f} MB are installed, more than {LARGEST_MB:g}")
    road.tell(f"{size:.0f} MB are installed, without bytecode")
    road.step("the version", "tactile-rt", "--version", says=["tactile-rt "])
    road.step("the demo", "tactile-rt", "demo", "--sweeps", "2", says=["2 of 2 right"])
    run = ["tactile-rt", "run", "--source", "replay:demo?speed=0", "--final-only"]
    decided = [
        json.loads(line)["label"]
        for line in road.step("decisions", *run).splitlines()
        if line.startswith("{")
    ]
    right = sum(said == was for said, was in zip(decided, PASSED, strict=False))
    if right < 5:
        raise Failed(f"decisions: {decided}, where {PASSED} passed")
    road.step("record", "tactile-rt", "record", "replay:demo", "run.mcap", "--seconds", "3")
    road.step("replay", "tactile-rt", "replay", "run.mcap", says=['"label":"other"'])
    for name in ("run.npz", "run.csv"):
        road.step(f"convert to {name}", "tactile-rt", "convert", "run.mcap", name)
        road.step(f"{name} and back", "tactile-rt", "convert", name, f"{name}.mcap")
    (road.folder / "table.csv").write_text(TABLE)
    columns = "time:s,left.fz:N,right.fz:N"
    road.step(
        "import a table", "tactile-rt", "import", "table.csv", "--columns", columns,
        says=["table.mcap: 300 samples in, 300 intact, 0 corrupt"],
    )  # fmt: skip
    (road.folder / "can.log").write_text(LOG)
    road.step("look at a log", "tactile-rt", "sniff", "can.log", says=["aft200"])
    road.step(
        "import a log", "tactile-rt", "import", "can.log", "--as", "codec=aft200",
        says=["can.mcap: ", "0 corrupt"],
    )  # fmt: skip
    touches = "replay:demo?loop=true&speed=0"
    classes = ["--classes", "one,other", "--touches", "3"]
    road.step(
        "teach", "tactile-rt", "teach", touches, "lesson", *classes, says=["knows one, other"]
    )
    model = ["--source", "replay:demo?speed=0", "--model", "lesson/model.onnx", "--final-only"]
    road.step("decide by the lesson", "tactile-rt", "run", *model, says=['"label":"'])
    said = road.step(
        "a source that needs an extra", "tactile-rt", "run", "--source", "sim:mouse", code=2,
        says=["not installed: "],
    )  # fmt: skip
    command = said.strip().partition("not installed: ")[2].replace("[sim]", "[dbc]")
    road.step("do as it says", *shlex.split(command))
    road.step("it is there", "python", "-c", "import cantools")
