"""One line per event, on stderr or in a file; a storm of the same line is counted instead."""

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
    """Writes events. Of those that say the same of the same part, the first is written at once,
    the others are counted and told together when `repeat_s` is over. A file that was moved or
    deleted is begun anew. Lines that nothing takes are dropped and counted, and that is told."""

    wants = frozenset({Event})
    tick_s = 1.0

    def __init__(self, name: str, config: LogConfig) -> None:
        self._config = config
        self._out: FileIO | None = None  # has no buffer, which at the end would be tried again
        self._seen: OrderedDict[tuple[str, str, str], _Seen] = OrderedDict()
        self._lines = self._repeated = self._dropped = 0
        self._why = ""  # why lines are dropped now
        self._unwritten: tuple[Event, int] | None = None  # the newest, and how many

    def open(self, view: View) -> None:
        file = self._config.file
        self._out = FileIO(file, "ab") if file else FileIO(2, "wb", closefd=False)

    def handle(self, items: list[Item]) -> None:
        self._follow_name()
        if self._unwritten is not None:
            last, count = self._unwritten
            why = f"{count} lines: {self._why}"
            told = Event("log", "dropped", why, "warning", last.t_ns, last.utc_offset_ns)
            if self._pass_on(self._form(told, 0)):
                self._unwritten, self._why = None, ""
        for item in items:
            if isinstance(item, Event) and _rank(item.level) >= _rank(self._config.level):
                self._note(item)
        now = time.monotonic()
        for key in [k for k, seen in self._seen.items() if seen.until <= now]:
            self._sum_up(key)

    def close(self) -> None:
        if self._out is not None:
            for key in list(self._seen):
                self._sum_up(key)
            self._out.close()
            self._out = None

    def details(self) -> dict[str, str | int | float]:
        return {
            "file": self._config.file, "lines": self._lines, "repeated": self._repeated,
            "dropped": self._dropped,
        }  # fmt: skip

    def diagnose(self) -> str:
        return self._why

    def _follow_name(self) -> None:
        """Open the file anew if it is no longer the one of that name."""
        file, out = self._config.file, self._out
        if not file:
            return
        if out is not None:
            with suppress(OSError):  # there is none of that name, or one may not look
                if os.path.samestat(os.fstat(out.fileno()), os.stat(file)):
                    return
            out.close()
        try:
            self._out = FileIO(file, "ab")
            self._why = self._why if self._unwritten else ""
        except OSError as error:
            self._out, self._why = None, f"{file}: {error.strerror or error}"

    def _note(self, event: Event) -> None:
        key = (event.part, event.state, event.reason)
        seen = self._seen.get(key)
        if seen is not None:
            seen.again += 1
            seen.event = event
            self._repeated += 1
            return
        while len(self._seen) >= REMEMBERED:
            self._sum_up(next(iter(self._seen)))
        self._seen[key] = _Seen(event, time.monotonic() + self._config.repeat_s)
        self._write(event, 0)

    def _sum_up(self, key: tuple[str, str, str]) -> None:
        seen = self._seen.pop(key)
        if seen.again:
            now_ns = round(1e9 * time.monotonic())  # lines are in the order of their times
            self._write(replace(seen.event, t_ns=now_ns), seen.again)

    def _write(self, event: Event, repeated: int) -> None:
        if self._unwritten is None and self._pass_on(self._form(event, repeated)):
            self._lines += 1
        else:
            self._dropped += 1
            self._unwritten = event, self._unwritten[1] + 1 if self._unwritten else 1

    def _pass_on(self, line: str) -> bool:
        """Write a line; whether it was taken whole."""
        data = (line.replace("\n", " ") + "\n").encode(errors="backslashreplace")
        try:
            if self._out is not None and self._out.write(data) == len(data):
                return True
            self._why = self._why or "it takes no more for now"
        except OSError as error:
            self._why = f"{self._config.file or 'stderr'}: {error.strerror or error}"
        return False

    def _form(self, event: Event, repeated: int) -> str:
        utc_ns = event.t_ns + event.utc_offset_ns
        when = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        when += f".{utc_ns // 1_000_000 % 1000:03d}Z"
        if self._config.format == "json":
            fields = {
                "time": when, "level": event.level, "part": event.part, "state": event.state,
                "reason": event.reason, "repeated": repeated, "t_ns": event.t_ns,
            }  # fmt: skip
            return msgspec.json.encode(fields).decode()
        said = f": {event.reason}" if event.reason else ""
        again = f" (repeated {repeated} times since)" if repeated else ""
        return f"{when} {event.level} {event.part} {event.state}{said}{again}"


class EventHandler(logging.Handler):
    """Makes an event of each warning of a Python logger, for `Daemon.report`."""

    def __init__(self, report: Callable[[str, str, str, str], None]) -> None:
        super().__init__(logging.WARNING)
        self._report = report

    def emit(self, record: logging.LogRecord) -> None:
        self._report("model", "warns", record.getMessage(), "warning")


def _rank(level: str) -> int:
    return LEVELS.index(level) if level in LEVELS else len(LEVELS)
