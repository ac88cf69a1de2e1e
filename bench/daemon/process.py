"""The daemon in a process of its own: started, asked, measured from outside, ended."""

import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

PATIENCE_S = 60.0
MAIN = "from tactile_rt.cli import main; main()"
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")


class Usage:
    """What a process uses, read from /proc.

    Attributes:
        at: (n,) time of each `look`, CLOCK_MONOTONIC in s.
        resident: (n,) resident memory at each `look`, bytes.
        cores: Processor time by core in s, each thread's on the core that it was last seen on.
    """

    def __init__(self, pid: int) -> None:
        self._proc = Path(f"/proc/{pid}")
        self.at: list[float] = []
        self.resident: list[int] = []
        self.cores: dict[int, float] = defaultdict(float)
        self._threads: dict[str, float] = {}
        self._first: float | None = None
        self._newest = 0.0

    def look(self) -> None:
        """Read once more."""
        try:
            self._newest = _ticks(self._proc / "stat")[0]
            resident = int((self._proc / "statm").read_text().split()[1]) * PAGE
            for task in (self._proc / "task").iterdir():
                used, core = _ticks(task / "stat")
                before = self._threads.get(task.name)
                self._threads[task.name] = used
                if before is not None:
                    self.cores[core] += used - before
        except (FileNotFoundError, ProcessLookupError):
            return  # a thread, or all of it, has just ended
        self.at.append(time.monotonic())
        self.resident.append(resident)
        if self._first is None:
            self._first = self._newest

    @property
    def share(self) -> float:
        """Processor time from the first look to the last, of one core."""
        if self._first is None or len(self.at) < 2:
            return 0.0
        return (self._newest - self._first) / (self.at[-1] - self.at[0])


class DaemonProcess:
    """`tactile-rt run` on a configuration; a context manager.

    Args:
        folder: where its files are.
        configuration: TOML; it must have ``[metrics]``.
        port: of its metrics.
        stdout: descriptor.
        environment: beside that of this process.
        before: called in the new process before it becomes the daemon.
        main: what Python runs in it.
    """

    def __init__(
        self,
        folder: Path,
        configuration: str,
        port: int,
        stdout: int = subprocess.DEVNULL,
        environment: Mapping[str, str] | None = None,
        before: Callable[[], None] | None = None,
        main: str = MAIN,
    ) -> None:
        self.path, self.log_path = folder / "robot.toml", folder / "daemon.log"
        self.path.write_text(configuration)
        self._port = port
        paths = os.pathsep.join(p for p in sys.path if p)
        with self.log_path.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", main, "run", str(self.path)],
                stdout=stdout, stderr=log, preexec_fn=before,
                env={**os.environ, "PYTHONPATH": paths, **(environment or {})},
            )  # fmt: skip
        self.usage = Usage(self.process.pid)

    def state(self) -> dict[str, Any]:
        """Its snapshot.

        Raises:
            OSError: it does not answer.
        """
        line = http.client.HTTPConnection("127.0.0.1", self._port, timeout=10)
        try:
            line.request("GET", "/state")
            found: dict[str, Any] = json.loads(line.getresponse().read())["snapshot"]
        finally:
            line.close()
        return found

    def await_state(
        self, wanted: Callable[[dict[str, Any]], bool], seconds: float = PATIENCE_S,
        every_s: float = 0.05,
    ) -> dict[str, Any]:  # fmt: skip
        """Its snapshot as soon as it is as wanted.

        Raises:
            TimeoutError: it never was.
            EOFError: it has ended.
        """
        end = time.monotonic() + seconds
        while True:
            if self.process.poll() is not None:
                raise EOFError(f"the daemon has ended: {self.log()[-600:]}")
            try:
                found = self.state()
            except (OSError, http.client.HTTPException):
                found = None
            if found is not None and wanted(found):
                return found
            if time.monotonic() > end:
                raise TimeoutError(f"the daemon is not as wanted after {seconds:g} s: {found}")
            time.sleep(every_s)

    def log(self) -> str:
        """What it has told."""
        return self.log_path.read_text(errors="replace")

    def reload(self) -> None:
        """Have it read its configuration again."""
        self.process.send_signal(signal.SIGHUP)

    def stop(self) -> tuple[int, float]:
        """(exit code, seconds that closing took)."""
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        code = self.process.wait(PATIENCE_S)
        return code, time.monotonic() - began

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


def messages_of(file: Path, kind: str) -> list[dict[str, Any]]:
    """The messages of one type in a file that publisher `jsonl` may be writing just now.

    Its last line counts once it has its end.
    """
    *lines, _ = file.read_text().split("\n") if file.exists() else [""]
    return [m for m in map(json.loads, lines) if m["type"] == kind]


def free_port() -> int:
    """A TCP port that nobody listens on just now."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


def until(true: Callable[[], bool], seconds: float = PATIENCE_S, every_s: float = 0.01) -> bool:
    """Wait for something; whether it came."""
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            return False
        time.sleep(every_s)
    return True


def _ticks(stat: Path) -> tuple[float, int]:
    """(processor time in s, core that it was on)."""
    fields = stat.read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) * TICK_S, int(fields[36])
