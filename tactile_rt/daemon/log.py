"""The log: one line per event, on stderr or in a file; repeated lines are counted instead."""

import logging
import os
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import FileIO

import msgspec

from tactile_rt.daemon.config import LogConfig
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import Event, Item

LEVELS = ("info", "warning", "error")
REMEMBERED = 256  # different lines


@dataclass
class _Seen:
    event: Event
    until: float  # CLOCK_MONOTONIC, s
    again: int = 0


class Log(Consumer):
    """A consumer that logs events. The first of equal events of a part is written at once; the
    others are counted and reported together after `repeat_s`. A file that was moved or deleted is
    created again. Lines that cannot be written are dropped, counted and reported."""

    wants = frozenset({Event})
    tick_s = 1.0

    def __init__(self, name: str, config: LogConfig) -> None:
        self._config = config
        self._out: FileIO | None = None  # unbuffered: closing would write a buffer again
        self._seen: OrderedDict[tuple[str, str, str], _Seen] = OrderedDict()
        self._lines = self._repeated = self._dropped = 0
        self._why = ""  # why lines are dropped now
        self._unwritten: tuple[Event, int] | None = None  # the newest, and their number

    def open(self, view: View) -> None:
        file = self._config.file
        self._out = FileIO(file, "ab") if file else FileIO(2, "wb", closefd=False)

    def handle(self, items: list[Item]) -> None:
        self._reopen_if_moved()
        if self._unwritten is not None:
            last, count = self._unwritten
            why = f"{count} lines: {self._why}"
            notice = Event("log", "dropped", why, "warning", last.t_ns, last.utc_offset_ns)
            if self._write_line(self._format_line(notice, 0)):
                self._unwritten, self._why = None, ""
        for item in items:
            if isinstance(item, Event) and _rank(item.level) >= _rank(self._config.level):
                self._log_event(item)
        now = time.monotonic()
        for key in [k for k, seen in self._seen.items() if seen.until <= now]:
            self._write_repeats(key)

    def close(self) -> None:
        if self._out is not None:
            for key in list(self._seen):
                self._write_repeats(key)
            self._out.close()
            self._out = None

    def details(self) -> dict[str, str | int | float]:
        return {
            "file": self._config.file, "lines": self._lines, "repeated": self._repeated,
            "dropped": self._dropped,
        }  # fmt: skip

    def diagnose(self) -> str:
        return self._why

    def _reopen_if_moved(self) -> None:
        """Open the log file again if it was moved or deleted."""
        file, out = self._config.file, self._out
        if not file:
            return
        if out is not None:
            with suppress(OSError):  # no such file, or no permission
                if os.path.samestat(os.fstat(out.fileno()), os.stat(file)):
                    return
            out.close()
        try:
            self._out = FileIO(file, "ab")
            self._why = self._why if self._unwritten else ""
        except OSError as error:
            self._out, self._why = None, f"{file}: {error.strerror or error}"

    def _log_event(self, event: Event) -> None:
        key = (event.part, event.state, event.reason)
        seen = self._seen.get(key)
        if seen is not None:
            seen.again += 1
            seen.event = event
            self._repeated += 1
            return
        while len(self._seen) >= REMEMBERED:
            self._write_repeats(next(iter(self._seen)))
        self._seen[key] = _Seen(event, time.monotonic() + self._config.repeat_s)
        self._write(event, 0)

    def _write_repeats(self, key: tuple[str, str, str]) -> None:
        seen = self._seen.pop(key)
        if seen.again:
            now_ns = round(1e9 * time.monotonic())  # so that lines stay in the order of time
            self._write(replace(seen.event, t_ns=now_ns), seen.again)

    def _write(self, event: Event, repeated: int) -> None:
        if self._unwritten is None and self._write_line(self._format_line(event, repeated)):
            self._lines += 1
        else:
            self._dropped += 1
            self._unwritten = event, self._unwritten[1] + 1 if self._unwritten else 1

    def _write_line(self, line: str) -> bool:
        """Write a line; return whether all of it was written."""
        data = (line.replace("\n", " ") + "\n").encode(errors="backslashreplace")
        try:
            if self._out is not None and self._out.write(data) == len(data):
                return True
            self._why = self._why or "it takes no more for now"
        except OSError as error:
            self._why = f"{self._config.file or 'stderr'}: {error.strerror or error}"
        return False

    def _format_line(self, event: Event, repeated: int) -> str:
        utc_ns = event.t_ns + event.utc_offset_ns
        when = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        when += f".{utc_ns // 1_000_000 % 1000:03d}Z"
        if self._config.format == "json":
            fields = {
                "time": when, "level": event.level, "part": event.part, "state": event.state,
                "reason": event.reason, "repeated": repeated, "t_ns": event.t_ns,
            }  # fmt: skip
            return msgspec.json.encode(fields).decode()
        reason = f": {event.reason}" if event.reason else ""
        again = f" (repeated {repeated} times since)" if repeated else ""
        return f"{when} {event.level} {event.part} {event.state}{reason}{again}"


class EventHandler(logging.Handler):
    """A logging handler that reports each warning as an event of the daemon."""

    def __init__(self, report: Callable[[str, str, str, str], None]) -> None:
        super().__init__(logging.WARNING)
        self._report = report

    def emit(self, record: logging.LogRecord) -> None:
        self._report("model", "warns", record.getMessage(), "warning")


def _rank(level: str) -> int:
    return LEVELS.index(level) if level in LEVELS else len(LEVELS)
