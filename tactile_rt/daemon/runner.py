"""Run the daemon as the process's only work: signals, exit codes, one instance."""

import os
import signal
import sys
import time
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from queue import Empty, SimpleQueue
from types import FrameType

from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.daemon import Daemon
from tactile_rt.daemon.loading import load_config
from tactile_rt.daemon.lock import Locks
from tactile_rt.stream import TactileError

__all__ = ["ExitCode", "leave", "run_daemon"]

OVER = 0  # no signal has this number
TURN_S = 0.25  # how often the main loop tells that it goes on
SWITCH_S = 0.001  # how long a thread that computes may keep those waiting that acquire


class ExitCode(IntEnum):
    """What the process tells at its end.

    After `CONFIG` and `RUNNING` nothing has been started, and to start again changes nothing.
    """

    STOPPED = 0  # by a signal, or all streams were over; everything is closed
    CONFIG = 2  # the configuration is wrong
    RUNNING = 3  # another process has the configuration, or a device
    ABANDONED = 4  # stopped, but a part did not end in time and may not have written everything


def run_daemon(path: Path, sets: Sequence[str] = (), seconds: float | None = None) -> ExitCode:
    """Run until SIGTERM or SIGINT, until all streams are over, or for so many seconds.

    SIGHUP reads the configuration again.

    Raises:
        ConfigError: the configuration is wrong.
        AlreadyRunning: another process has it, or a device.
    """
    loaded = load_config(path, sets)
    check_config(loaded)
    # Signals, and the end of all streams: the one queue that a signal handler may put into.
    calls: SimpleQueue[int] = SimpleQueue()

    def note(number: int, frame: FrameType | None) -> None:
        calls.put(number)

    numbers = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    before = [signal.signal(number, note) for number in numbers]
    switch = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    daemon = Daemon(loaded, locks=Locks(), freeze=True, on_over=lambda: calls.put(OVER))
    try:
        try:
            daemon.start()
            _serve(daemon, path, sets, calls, seconds)
        finally:
            late = daemon.stop()
    finally:
        sys.setswitchinterval(switch)
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
    return ExitCode.ABANDONED if late else ExitCode.STOPPED


def _serve(
    daemon: Daemon,
    path: Path,
    sets: Sequence[str],
    calls: "SimpleQueue[int]",
    seconds: float | None,
) -> None:
    end = None if seconds is None else time.monotonic() + seconds
    while True:
        daemon.turned("main")
        left = TURN_S if end is None else min(TURN_S, end - time.monotonic())
        if left < 0:
            return
        try:
            number = calls.get(timeout=left)
        except Empty:
            continue
        if number != signal.SIGHUP:
            return
        daemon.report("daemon", "reloading", "")
        try:
            loaded = load_config(path, sets)
            check_config(loaded)
            daemon.reload(loaded)
        except TactileError as error:
            daemon.report("daemon", "refused", f"the old configuration goes on: {error}", "error")


def leave(code: ExitCode) -> None:
    """End the process; past threads that hang, which would otherwise keep it."""
    if code == ExitCode.ABANDONED:
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
