"""The daemon as a process: signals, exit codes, one instance.

A process must obey signals from its first line on, but its imports take a good part of a second. So
`queue_signals` comes first, before anything heavy, and `run_daemon` looks at the noted signals
before it starts anything. That is why this module itself imports almost nothing.
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
TURN_S = 0.25  # longest time between passes of the main loop
READ_S = 2.0  # for a configuration to be read
LOADED_S = 0.5  # for a model to be loaded, or given up
SWITCH_S = 0.001  # how long a thread that computes may delay the threads that acquire

Calls = SimpleQueue[int]  # a queue that a signal handler may use

_noted: Calls = SimpleQueue()  # signals from before `run_daemon`


class ExitCode(IntEnum):
    """The exit code of the process.

    After `CONFIG` and `RUNNING` nothing has been started, and a restart changes nothing.
    """

    STOPPED = 0  # by a signal, or all streams have ended; everything is closed
    CONFIG = 2  # the configuration is wrong
    RUNNING = 3  # another process has the configuration, or a device
    ABANDONED = 4  # stopped, but a part did not end in time and may not have written everything


def queue_signals() -> None:
    """Queue signals from now on, so that `run_daemon` also obeys earlier ones.

    The handlers stay, so that no signal ends the process while Python shuts down."""
    for number in SIGNALS:
        signal.signal(number, lambda number, frame: _noted.put(number))
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)  # log rotators send it; see `Log`


def run_daemon(path: Path, sets: Sequence[str] = (), seconds: float | None = None) -> ExitCode:
    """Run the daemon until SIGTERM, SIGINT, the end of all streams, or `seconds`.

    SIGHUP reads the configuration again.

    Raises:
        ConfigError: The configuration is wrong.
        AlreadyRunning: Another process has the configuration, or a device.
    """
    calls: Calls = SimpleQueue()  # signals, and the end of all streams

    def note(number: int, frame: FrameType | None) -> None:
        calls.put(number)

    before = [signal.signal(number, note) for number in SIGNALS]
    switch = sys.getswitchinterval()
    try:
        if _must_end(_noted):
            return ExitCode.STOPPED
        # Imported late, as this takes time.
        from tactile_rt.core.locks import Locks
        from tactile_rt.daemon.checks import check_config
        from tactile_rt.daemon.daemon import Daemon
        from tactile_rt.daemon.loading import load_config

        loaded = load_config(path, sets)
        check_config(loaded)
        if _must_end(calls):
            return ExitCode.STOPPED
        sys.setswitchinterval(SWITCH_S)
        _raise_file_limit()
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


def _raise_file_limit() -> None:
    """Raise the limit of open files to its maximum. When a thousand clients connect at once, the
    process still finds descriptors for its own files until they are disconnected."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def _must_end(calls: Calls) -> bool:
    """Return whether a signal other than SIGHUP has come. A SIGHUP stays queued: the file may have
    been rewritten since it was read."""
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
        daemon.note_turn("main")
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
    """A thread that reads the configuration again and applies it.

    Signals are obeyed meanwhile, however long it takes; another reload may replace it."""

    def __init__(self, daemon: "Daemon", path: Path, sets: Sequence[str]) -> None:
        super().__init__(name="tactile-rt reload", daemon=True)
        self._for, self._path, self._sets = daemon, path, sets
        self._read_by = time.monotonic() + READ_S
        self._read = False
        self.wanted = True  # no other reload has replaced it
        self.late = False

    def hangs(self) -> bool:
        """Return True if reading takes too long, but only the first time."""
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
        except Exception as error:  # otherwise the failure would go unnoticed
            self._read = True
            if self.wanted:
                self._for.refuse(reason_of(error))


def leave(code: ExitCode) -> None:
    """End the process, even if threads hang. A thread that hangs would keep it running; a thread
    that is interrupted while it loads a model would abort it."""
    loading = [t for t in threading.enumerate() if t.name == ADMISSION]
    until = time.monotonic() + LOADED_S
    for thread in loading:
        thread.join(max(0.0, until - time.monotonic()))
    if code == ExitCode.ABANDONED or any(thread.is_alive() for thread in loading):
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
