"""A supervised thread: it starts, works, breaks, waits and starts again, and always says why.

What no further try can mend, an array that is another than the one that was asked for, is not tried
again: the part has failed, until what it failed of has changed.
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

STEADY_S = 10.0  # whoever has worked so long begins with the shortest pause again


class Report(Protocol):
    """Puts an event into the log and to all consumers."""

    def __call__(self, part: str, state: str, reason: str, level: str = "info") -> None: ...


class Part(abc.ABC):
    """Something that works in a thread of its own and is restarted when it breaks."""

    def __init__(self, name: str, report: Report, limits: LimitsConfig) -> None:
        self.name, self.limits = name, limits
        self._report = report
        self._stop = threading.Event()
        self._state, self._reason, self._since_ns = "starting", "", time.monotonic_ns()
        self._starts = self._failures = 0
        self._busy_ns = 0  # since when it is in a turn that may not end; 0: it waits for work
        self._stalled = False
        self._pause_s = limits.retry_first_s
        self._thread = threading.Thread(target=self._run, name=f"tactile-rt {name}", daemon=True)

    def start(self) -> None:
        """Begin, in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """Ask it to end; from any thread, safe to call twice."""
        self._stop.set()

    def join(self, until: float) -> bool:
        """Wait for its end until so much CLOCK_MONOTONIC, s; whether it came."""
        if self._thread.ident is not None:
            self._thread.join(max(0.0, until - time.monotonic()))
        return not self._thread.is_alive()

    @property
    def state(self) -> PartState:
        """Now; from any thread."""
        state, reason, since = self._state, self._reason, self._since_ns
        silent = self.silent_s
        if state in ("starting", "running") and silent > self.limits.stall_s:
            state, since = "stalled", time.monotonic_ns() - round(1e9 * silent)
            reason = f"in a call that has not returned for {silent:.0f} s"
        return PartState(self.name, state, reason, since, self._starts, self._failures)

    @property
    def silent_s(self) -> float:
        """How long one turn of its work has taken by now, s; 0: it has nothing to do."""
        busy = self._busy_ns
        return (time.monotonic_ns() - busy) / 1e9 if busy else 0.0

    def watch(self) -> None:
        """Tell when it stalls, and when it goes on; called now and then by the daemon."""
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
        """Work until `_stop` is set; what it raises is the reason of a restart. To return before
        that says that there is nothing left to do."""

    def _release(self) -> None:  # noqa: B027
        """Let go of everything; after every `_work`."""

    def _mended(self) -> bool:
        """Whether what it failed of has changed, so that it is worth another try."""
        return False

    def _up(self, where: str = "") -> None:
        """Report that it works, and where it can be reached."""
        self._turn("running", where)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._starts += 1
            began = time.monotonic()
            self._set("starting", self._reason)
            why, state = "", "waiting"
            try:
                self._work()
            except Exception as error:
                why = reason_of(error)
                if isinstance(error, SpecMismatch):
                    state = "failed"
                error.__traceback__ = None  # it holds everything that was at hand
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
                self._turn(state, why)
                self._stop.wait(self._pause_s)
                while state == "failed" and not (self._stop.is_set() or self._mended()):
                    self._stop.wait(self.limits.retry_last_s)
                self._pause_s = min(2 * self._pause_s, self.limits.retry_last_s)
        self._turn("stopped" if self._stop.is_set() else "ended", "")

    def _turn(self, state: str, reason: str) -> None:
        self._set(state, reason)
        level = {"waiting": "warning", "failed": "error"}.get(state, "info")
        self._report(self.name, state, reason, level)

    def _set(self, state: str, reason: str) -> None:
        if state != self._state:
            self._since_ns = time.monotonic_ns()
        self._state, self._reason = state, reason


def reason_of(error: BaseException) -> str:
    """An error in one line; one that nobody foresaw with the place where it came from."""
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
