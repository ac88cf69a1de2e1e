"""An end whenever it is asked for: how long it takes.

python -m bench.daemon.stopping [--quick]
"""

import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from rich.console import Console

from bench.daemon.disturbed import CONFIGURATION
from bench.daemon.models import finger_array, whisker_array, write_wide_model
from bench.daemon.overload import HOG, HOGS_PER_CORE, STEP_MS, slow_down
from bench.daemon.process import DaemonProcess, free_port
from bench.emulated import ArrayScript, play
from bench.processes import Helper
from tactile_rt.models.evaluation.records import Record, show

TIMES, QUICK = 25, 2  # of each way
STATED_S = 2.0
STREAM_S = 3600.0


def stopping(quick: bool) -> list[Record]:
    """End daemons at the start, under way, in a reload and under overload."""
    return _ends(QUICK if quick else TIMES)


class _Rig:
    """Two arrays that outlive each daemon; a context manager."""

    def __init__(self) -> None:
        self._stack = ExitStack()
        self.draw = random.Random(0)

    def __enter__(self) -> "_Rig":
        self.folder = Path(
            self._stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-stopping-"))
        )
        self.model = self.folder / "wide.onnx"
        write_wide_model(self.model, whisker_array())
        self.good = self.model.read_bytes()
        slow_down(self.model, STEP_MS)
        self.slow = self.model.read_bytes()
        specs = {"whiskers": whisker_array(), "finger": finger_array()}
        self._urls = {}
        for name, spec in specs.items():
            wire = "serial" if name == "whiskers" else "slcan"
            script = ArrayScript(
                wire, spec, round(STREAM_S * spec.rate_hz), str(self.folder / name)
            )
            self._urls[name] = self._stack.enter_context(Helper(play, script)).hear()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def put(self, data: bytes) -> None:
        """A file takes the place of the model, whole."""
        new = self.model.with_suffix(".new")
        new.write_bytes(data)
        new.replace(self.model)

    def daemon(self) -> DaemonProcess:
        ports = {name: free_port() for name in ("zmq", "page", "metrics")}
        text = CONFIGURATION.format(**self._urls, **ports)
        return DaemonProcess(self.folder, text, ports["metrics"])


def _at_the_start(rig: _Rig, daemon: DaemonProcess) -> None:
    time.sleep(rig.draw.uniform(0.0, 2.0))


def _under_way(rig: _Rig, daemon: DaemonProcess) -> None:
    daemon.await_state(lambda s: s["state"] == "running")
    time.sleep(rig.draw.uniform(0.0, 1.0))


def _in_a_reload(rig: _Rig, daemon: DaemonProcess) -> None:
    _under_way(rig, daemon)
    rig.put(rig.good)
    daemon.reload()
    time.sleep(rig.draw.uniform(0.0, 0.6))


def _under_overload(rig: _Rig, daemon: DaemonProcess) -> None:
    daemon.await_state(lambda s: all(x["samples"] > 2000 for x in s["sources"][:1]))
    time.sleep(rig.draw.uniform(0.0, 1.0))


WAYS: dict[str, Callable[[_Rig, DaemonProcess], None]] = {
    "start": _at_the_start,
    "under_way": _under_way,
    "reload": _in_a_reload,
    "overload": _under_overload,
}


def _ends(times: int) -> list[Record]:
    records = []
    with _Rig() as rig:
        for name, way in WAYS.items():
            rig.put(rig.slow if name == "overload" else rig.good)
            took, wrong = [], 0
            for _ in range(times):
                with ExitStack() as stack:
                    daemon = stack.enter_context(rig.daemon())
                    if name == "overload":
                        for _ in range(2 * HOGS_PER_CORE):
                            hog = subprocess.Popen([sys.executable, "-c", HOG])
                            stack.callback(hog.wait)
                            stack.callback(hog.kill)
                    way(rig, daemon)
                    code, seconds = daemon.stop()
                took.append(seconds)
                # Python itself is still starting: a signal ends it as it does any program
                wrong += code not in ((0, -15) if name == "start" else (0,))
            right = sum(t <= STATED_S for t in took) - wrong
            records.append(
                Record(
                    f"daemon.sigterm.{name}", right, f"of {times}", f"== {times}",
                    f"median {np.median(took):.2f}, worst {max(took):.2f} s; "
                    f"{wrong} wrong exit codes", f"within {STATED_S:g} s",
                )
            )  # fmt: skip
    return records


def main() -> None:
    """Print the table."""
    show(stopping("--quick" in sys.argv), Console())


if __name__ == "__main__":
    main()
