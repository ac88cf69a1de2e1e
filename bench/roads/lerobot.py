"""LeRobot's own command line and our plug-in: without touch, with it, and with a dead one."""

from pathlib import Path

from bench.roads.walking import ROOT, Road

RELEASES = {"3.11": "0.4.4", "3.12": "0.6.1", "3.13": "0.6.1"}
SCRIPTS = ("lerobot-record", "lerobot-train", "lerobot-teleoperate", "lerobot-replay")
LOOK = """\
import sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
seen = LeRobotDataset("me/touch", root=sys.argv[1])
names = seen.features["observation.state"]["names"]
states = np.array([seen[k]["observation.state"].numpy() for k in range(len(seen))])
at = {name: states[:, k] for k, name in enumerate(names)}
assert len(seen) >= 60, len(seen)
assert np.isfinite(states).all()
assert sum(np.ptp(x) > 0 for n, x in at.items() if n.startswith("finger.") and n[-2:] == "fx") > 5
assert (at["finger.valid"] == 1).all() and at["finger.age_ms"].max() < 1000
print(len(seen), "rows of", len(names), "numbers, newest at most",
      round(float(at["finger.age_ms"].max())), "ms old")
"""


def walk_lerobot(road: Road, wheel: Path) -> None:
    """Walk it.

    Raises:
        Failed: a step does not do what it should.
    """
    release = RELEASES[".".join(_version(road))]
    # Since 0.6 what records and trains is not in the base install.
    further = "" if release == "0.4.4" else "[core-scripts,training]"
    road.install(f"lerobot{further}=={release}")
    for name in ("plugins/lerobot_robot_tactile", "bench/roads/made_up_arm"):
        road.install(str(wheel), str(ROOT / name))
    for script in SCRIPTS:
        road.step(f"{script} --help", script, "--help", says=["usage: "])
    road.step("without touch", *_record("data-arm", 2, "--robot.type=made_up_arm"))
    touch = [
        "--robot.type=tactile",
        "--robot.robot={type: made_up_arm}",
        "--robot.sensors={finger: 'replay:demo?loop=true'}",
        "--robot.record=full",
    ]
    says = ["the arm is released"]
    road.step("with touch", *_record("data-touch", 4, *touch), says=says)
    road.tell(road.step("look at it", "python", "-c", LOOK, "data-touch").strip())
    device = "tactile-rt emulate native --source 'replay:demo?loop=true' --link whiskers"
    dead = [*touch[:2], "--robot.sensors={finger: 'serial://whiskers?codec=native'}"]
    record = " ".join(
        f'"{word}"' for word in _record("data-dead", 60, *dead, "--robot.record=dead")
    )
    script = (
        f"{device} > device.log & device=$!; until test -e whiskers; do sleep 0.1; done; "
        "(until test -e dead/finger-*.mcap; do sleep 0.1; done; sleep 3; kill -STOP $device) & "
        f"{record}; said=$?; kill -KILL $device; exit $said"
    )
    said = ["finger has given no valid sample for", "the arm is released"]
    road.step("with a sensor that dies", "sh", "-c", script, code=1, says=said)


def _record(root: str, seconds: int, *robot: str) -> list[str]:
    return [
        "lerobot-record", *robot, "--teleop.type=made_up_hand", f"--dataset.root={root}",
        "--dataset.repo_id=me/touch", "--dataset.single_task=touch it", "--dataset.fps=30",
        f"--dataset.episode_time_s={seconds}", "--dataset.reset_time_s=0",
        "--dataset.num_episodes=1", "--dataset.video=false", "--dataset.push_to_hub=false",
        "--play_sounds=false",
    ]  # fmt: skip


def _version(road: Road) -> tuple[str, str]:
    (folder,) = (road.environment / "lib").glob("python*")
    major, minor = folder.name.removeprefix("python").split(".")
    return major, minor
