"""One line per event, on stderr or in a file; a storm of the same line is counted instead."""

import sys
import time
from collections import OrderedDict
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TextIO

import msgspec

from tactile_rt.daemon.config import LogConfig
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import Event, Item

__all__ = ["Log"]

LEVELS = ("info", "warning", "error")
REMEMBERED = 256  # different lines


@dataclass
class _Seen:
    event: Event
    until: float  # CLOCK_MONOTONIC, s
    again: int = 0


class Log(Consumer):
    """Writes events. Of those that say the same of the same part, the first is written at once,
    the others are counted and told together when `repeat_s` is over."""

    wants = frozenset({Event})
    tick_s = 1.0

    def __init__(self, name: str, config: LogConfig) -> None:
        self._config = config
        self._out: TextIO | None = None
        self._seen: OrderedDict[tuple[str, str, str], _Seen] = OrderedDict()
        self._lines = self._repeated = 0

    def open(self, view: View) -> None:
        self._out = Path(self._config.file).open("a") if self._config.file else sys.stderr

    def handle(self, items: list[Item]) -> None:
        for item in items:
            if isinstance(item, Event) and _rank(item.level) >= _rank(self._config.level):
                self._note(item)
        now = time.monotonic()
        for key in [k for k, seen in self._seen.items() if seen.until <= now]:
            self._sum_up(key)
        if self._out is not None:
            self._out.flush()

    def close(self) -> None:
        out, self._out = self._out, None
        if out is None:
            return
        try:
            self._out = out
            for key in list(self._seen):
                self._sum_up(key)
            out.flush()
        finally:
            self._out = None
            if out is not sys.stderr:
                out.close()

    def details(self) -> dict[str, str | int | float]:
        return {"lines": self._lines, "repeated": self._repeated}

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
            self._write(seen.event, seen.again)

    def _write(self, event: Event, repeated: int) -> None:
        utc_ns = event.t_ns + event.utc_offset_ns
        when = datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%S")
        when += f".{utc_ns // 1_000_000 % 1000:03d}Z"
        if self._config.format == "json":
            fields = {
                "time": when, "level": event.level, "part": event.part, "state": event.state,
                "reason": event.reason, "repeated": repeated, "t_ns": event.t_ns,
            }  # fmt: skip
            line = msgspec.json.encode(fields).decode()
        else:
            said = f": {event.reason}" if event.reason else ""
            again = f" (repeated {repeated} times)" if repeated else ""
            line = f"{when} {event.level} {event.part} {event.state}{said}{again}"
        if self._out is not None:
            self._out.write(line.replace("\n", " ") + "\n")
        self._lines += 1


def _rank(level: str) -> int:
    return LEVELS.index(level) if level in LEVELS else len(LEVELS)
