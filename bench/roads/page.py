"""`config example` to decisions on the page."""

import json
import socket
import subprocess
import time
import urllib.request
from pathlib import Path

from bench.roads.walking import Failed, Road

WAIT_S = 60.0
RIGHT = {"other", "table", "bottle"}


def walk_page(road: Road, wheel: Path) -> None:
    """Walk it: the page's own stream of lines tells what was touched.

    Raises:
        Failed: a step does not do what it should, or the page tells no right decision.
    """
    road.install(str(wheel))
    road.step("config example", "tactile-rt", "config", "example", "robot.toml")
    road.step("config check", "tactile-rt", "config", "check", "robot.toml", says=["all right"])
    port = _free_port()
    command = ["tactile-rt", "run", "robot.toml", "--set", f"page.port={port}"]
    with subprocess.Popen(
        command, cwd=road.folder, env=road.settings, stdout=subprocess.DEVNULL
    ) as daemon:
        try:
            found = _decided(f"http://127.0.0.1:{port}", 3)
        finally:
            daemon.terminate()
    if len(set(found) & RIGHT) < 2:
        raise Failed(f"the page tells {found}")
    road.tell(f"the page tells {', '.join(found)}")
    made_up = ["--set", "source.whiskers.url=synthetic:mouse"]
    road.step(
        "what is made up says so", "tactile-rt", "config", "check", "robot.toml", *made_up,
        says=["decisions on it mean nothing"],
    )  # fmt: skip


def _decided(url: str, count: int) -> list[str]:
    """The labels of so many touches, as the page is told them."""
    until = time.monotonic() + WAIT_S
    found: list[str] = []
    while time.monotonic() < until and len(found) < count:
        try:
            with urllib.request.urlopen(url, timeout=5) as page:
                assert b"What it touches" in page.read()
            with urllib.request.urlopen(f"{url}/live", timeout=WAIT_S) as lines:
                for line in lines:
                    told = json.loads(line)
                    if told.get("type") == "decision" and told["final"]:
                        found.append(told["label"])
                    if len(found) == count or time.monotonic() > until:
                        break
        except OSError:  # not up yet
            time.sleep(0.2)
    return found


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
