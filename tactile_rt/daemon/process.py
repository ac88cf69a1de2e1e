"""The daemon as a process's only work: signals, exit codes, one instance.

A process is a daemon from its first line on. Until it can obey a signal it has to import for a good
part of a second; so `note_signals` comes first, before anything heavy, and `run_daemon` looks at
what was noted before it starts anything. That is why this module imports next to nothing itself.
"""

import os
import resource
import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from queue import Empty, SimpleQueue
from types import FrameType
from typing import TYPE_CHECKING

from tactile_rt.daemon.config import ADMISSION

if TYPE_CHECKING:
    from tactile_rt.daemon.daemon import Daemon

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
OVER = 0  # no signal has this number
TURN_S = 0.25  # how often the main loop tells that it goes on
READ_S = 2.0  # for a configuration to be read
LOADED_S = 0.5  # for a model to be loaded, or given up
SWITCH_S = 0.001  # how long a thread that computes may keep those waiting that acquire

Calls = SimpleQueue[int]  # what a signal handler may put into

_noted: Calls = SimpleQueue()  # before anybody ran a daemon


class ExitCode(IntEnum):
    """What the process tells at its end.

    After `CONFIG` and `RUNNING` nothing has been started, and to start again changes nothing.
    """

    STOPPED = 0  # by a signal, or all streams were over; everything is closed
    CONFIG = 2  # the configuration is wrong
    RUNNING = 3  # another process has the configuration, or a device
    ABANDONED = 4  # stopped, but a part did not end in time and may not have written everything


def note_signals() -> None:
    """From now on let no signal end the process but through `run_daemon`, which obeys those that
    have come by then; for good, so that none ends it while Python winds down, either."""
    for number in SIGNALS:
        signal.signal(number, lambda number, frame: _noted.put(number))
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # log rotators send it; see `Log`


def run_daemon(path: Path, sets: Sequence[str] = (), seconds: float | None = None) -> ExitCode:
    """Run until SIGTERM or SIGINT, until all streams are over, or for so many seconds.

    SIGHUP reads the configuration again.

    Raises:
        ConfigError: The configuration is wrong.
        AlreadyRunning: Another process has it, or a device.
    """
    calls: Calls = SimpleQueue()  # signals, and the end of all streams

    def note(number: int, frame: FrameType | None) -> None:
        calls.put(number)

    before = [signal.signal(number, note) for number in SIGNALS]
    switch = sys.getswitchinterval()
    try:
        if _asked_to_end(_noted):
            return ExitCode.STOPPED
        # Late, as all this takes its time.
        from tactile_rt.core.locks import Locks
        from tactile_rt.daemon.checks import check_config
        from tactile_rt.daemon.daemon import Daemon
        from tactile_rt.daemon.loading import load_config

        loaded = load_config(path, sets)
        check_config(loaded)
        if _asked_to_end(calls):
            return ExitCode.STOPPED
        sys.setswitchinterval(SWITCH_S)
        _want_descriptors()
        daemon = Daemon(loaded, locks=Locks(), freeze=True, on_over=lambda: calls.put(OVER))
        try:
            daemon.start()
            _serve(daemon, path, sets, calls, seconds)
        finally:
            late = daemon.stop()
    finally:
        sys.setswitchinterval(switch)
        for number, handler in zip(SIGNALS, before, strict=True):
            signal.signal(number, handler)
    return ExitCode.ABANDONED if late else ExitCode.STOPPED


def _want_descriptors() -> None:
    """Let the process open as much as it may: when a thousand connect at once, what it opens
    itself finds a descriptor until they are shut down."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _asked_to_end(calls: Calls) -> bool:
    """Whether any signal but SIGHUP has come. One that has is left for later: between the file's
    last line and now it may have been written anew."""
    numbers = [calls.get_nowait() for _ in range(calls.qsize())]
    if any(number != signal.SIGHUP for number in numbers):
        return True
    for number in numbers[:1]:
        calls.put(number)
    return False


def _serve(
    daemon: "Daemon", path: Path, sets: Sequence[str], calls: Calls, seconds: float | None
) -> None:
    end = None if seconds is None else time.monotonic() + seconds
    reload: _Reload | None = None
    asked = False
    while True:
        daemon.turned("main")
        if reload is not None and reload.hangs():
            daemon.refuse(f"{path}: {READ_S:g} s do not do to read it: does its disk answer?")
        if asked and (reload is None or reload.late or not reload.is_alive()):
            asked = False
            daemon.report("daemon", "reloading", "")
            if reload is not None:
                reload.wanted = False
            reload = _Reload(daemon, path, sets)
            try:
                reload.start()
            except RuntimeError as error:
                reload = None
                daemon.refuse(f"{path}: {error}: raise the limit of threads (TasksMax)")
        left = TURN_S if end is None else min(TURN_S, end - time.monotonic())
        if left < 0:
            return
        try:
            number = calls.get(timeout=left)
        except Empty:
            continue
        if number != signal.SIGHUP:
            return
        asked = True


class _Reload(threading.Thread):
    """Reads the configuration again, in a thread of its own.

    Whatever it takes, signals are obeyed meanwhile; another one may take its place."""

    def __init__(self, daemon: "Daemon", path: Path, sets: Sequence[str]) -> None:
        super().__init__(name="tactile-rt reload", daemon=True)
        self._for, self._path, self._sets = daemon, path, sets
        self._read_by = time.monotonic() + READ_S
        self._read = False
        self.wanted = True  # none has taken its place
        self.late = False

    def hangs(self) -> bool:
        """Tell, once, that it takes too long to read."""
        before, self.late = self.late, not self._read and time.monotonic() > self._read_by
        return self.late and not before

    def run(self) -> None:
        from tactile_rt.daemon.checks import check_config
        from tactile_rt.daemon.loading import load_config
        from tactile_rt.daemon.part import reason_of

        try:
            loaded = load_config(self._path, self._sets)
            check_config(loaded)
            self._read = True
            if self.wanted:
                self._for.reload(loaded)
        except Exception as error:  # else nobody would know that it was not done
            self._read = True
            if self.wanted:
                self._for.refuse(reason_of(error))


def leave(code: ExitCode) -> None:
    """End the process; past threads that hang, which would otherwise keep it, or, being torn out
    of the loading of a model, abort it."""
    loading = [t for t in threading.enumerate() if t.name == ADMISSION]
    until = time.monotonic() + LOADED_S
    for thread in loading:
        thread.join(max(0.0, until - time.monotonic()))
    if code == ExitCode.ABANDONED or any(thread.is_alive() for thread in loading):
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
