"""A supervised thread: it starts, works, breaks, waits and starts again, and always reports why.

A failure that no retry can mend, such as another array than configured, is not retried: the part
has failed until the cause of the failure changes.
"""

import abc
import threading
import time
import traceback
from pathlib import Path
from typing import Protocol

from tactile_rt.core.errors import SpecMismatch, TactileError
from tactile_rt.daemon.config import LimitsConfig
from tactile_rt.daemon.states import PartState

STEADY_S = 10.0  # a part that has worked so long restarts after the shortest pause again


class Report(Protocol):
    """A function that posts an event to the log and all other consumers."""

    def __call__(self, part: str, state: str, reason: str, level: str = "info") -> None: ...


class Part(abc.ABC):
    """A supervised part of the daemon: a thread whose work is restarted after an error."""

    def __init__(self, name: str, report: Report, limits: LimitsConfig) -> None:
        self.name, self.limits = name, limits
        self._report = report
        self._stop = threading.Event()
        self._state, self._reason, self._since_ns = "starting", "", time.monotonic_ns()
        self._starts = self._failures = 0
        self._busy_ns = 0  # start of its current work, which may hang; 0: it waits for work
        self._stalled = False
        self._pause_s = limits.retry_first_s
        self._thread = threading.Thread(target=self._run, name=f"tactile-rt {name}", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Request the part to end; from any thread, safe to call twice."""
        self._stop.set()

    def join(self, until: float) -> bool:
        """Wait for the part to end until a CLOCK_MONOTONIC time, s; return whether it did."""
        if self._thread.ident is not None:
            self._thread.join(max(0.0, until - time.monotonic()))
        return not self._thread.is_alive()

    @property
    def state(self) -> PartState:
        """Present state of the part; safe from any thread."""
        state, reason, since = self._state, self._reason, self._since_ns
        silent = self.silent_s
        if state in ("starting", "running") and silent > self.limits.stall_s:
            state, since = "stalled", time.monotonic_ns() - round(1e9 * silent)
            reason = f"in a call that has not returned for {silent:.0f} s"
        return PartState(self.name, state, reason, since, self._starts, self._failures)

    @property
    def silent_s(self) -> float:
        """Time since the part began its current work, s; 0 while it waits for work."""
        busy = self._busy_ns
        return (time.monotonic_ns() - busy) / 1e9 if busy else 0.0

    def watch(self) -> None:
        """Report when the part stalls and when it goes on; the daemon calls this regularly."""
        stalled = self.state.state == "stalled"
        if stalled == self._stalled:
            return
        self._stalled = stalled
        if stalled:
            why = f"in a call that has not returned for {self.limits.stall_s:g} s"
            self._report(self.name, "stalled", why, "warning")
        elif self._state == "running":
            self._report(self.name, "running", "the call has returned")

    # for the thread of the part

    @abc.abstractmethod
    def _work(self) -> None:
        """Do the part's work until `_stop` is set. An error leads to a restart; an earlier return
        means that no work is left."""

    def _release(self) -> None:  # noqa: B027
        """Release all resources; called after every `_work`."""

    def _may_retry(self) -> bool:
        """Return whether the cause of the failure has changed, so a retry is worthwhile."""
        return False

    def _report_running(self, where: str = "") -> None:
        """Set and report the state ``running``, with the address if the part has one."""
        self._change_state("running", where)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._starts += 1
            began = time.monotonic()
            self._set_state("starting", self._reason)
            why, state = "", "waiting"
            try:
                self._work()
            except Exception as error:
                why = reason_of(error)
                if isinstance(error, SpecMismatch):
                    state = "failed"
                error.__traceback__ = None  # it would keep all local variables
            self._busy_ns = time.monotonic_ns()
            try:
                self._release()
            except Exception as error:
                why = why or reason_of(error)
            self._busy_ns = 0
            if not why:
                break
            self._failures += 1
            if time.monotonic() - began > STEADY_S:
                self._pause_s = self.limits.retry_first_s
            if not self._stop.is_set():
                self._change_state(state, why)
                self._stop.wait(self._pause_s)
                while state == "failed" and not (self._stop.is_set() or self._may_retry()):
                    self._stop.wait(self.limits.retry_last_s)
                self._pause_s = min(2 * self._pause_s, self.limits.retry_last_s)
        self._change_state("stopped" if self._stop.is_set() else "ended", "")

    def _change_state(self, state: str, reason: str) -> None:
        self._set_state(state, reason)
        level = {"waiting": "warning", "failed": "error"}.get(state, "info")
        self._report(self.name, state, reason, level)

    def _set_state(self, state: str, reason: str) -> None:
        if state != self._state:
            self._since_ns = time.monotonic_ns()
        self._state, self._reason = state, reason


def reason_of(error: BaseException) -> str:
    """Describe an error in one line, with its source location if it is unexpected."""
    text = " ".join(str(error).split())
    if isinstance(error, TactileError):
        return text
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    where = ""
    frames = traceback.extract_tb(error.__traceback__)
    if frames:
        where = f" ({Path(frames[-1].filename).name}:{frames[-1].lineno})"
    return f"{type(error).__name__}: {text}{where}" if text else f"{type(error).__name__}{where}"
