"""Notifications to systemd: READY, STATUS, RELOADING, STOPPING, WATCHDOG; see sd_notify(3)."""

import os
import socket
import time
from collections.abc import Mapping
from typing import Any

from tactile_rt.core.errors import ConfigError
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import Event, Item
from tactile_rt.daemon.states import Snapshot

TICK_S = 1.0
SEND_S = 0.2  # a manager that does not read must not block the daemon
LEAST_S = 1.0  # on a busy host, a thread may get no processor for less
LONGEST = 400  # characters of a status


class Systemd(Consumer):
    """The consumer that notifies systemd; it pings the watchdog while no thread is `hanging`.

    Raises:
        ConfigError: $NOTIFY_SOCKET or $WATCHDOG_USEC is not what systemd sets.
    """

    wants = frozenset({Event})

    def __init__(
        self, name: str, options: Any = None, environment: Mapping[str, str] = os.environ
    ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        if path[:1] not in ("/", "@"):
            raise ConfigError(f"systemd: NOTIFY_SOCKET is {path!r}, not a path or @name")
        self._address = "\0" + path[1:] if path[0] == "@" else path
        self._watchdog_s = _read_watchdog_s(environment)
        # systemd asks for a ping at half of the time; twice as often misses none.
        self.tick_s = min(TICK_S, self._watchdog_s / 4) if self._watchdog_s else TICK_S
        self._socket: socket.socket | None = None
        self._status = ""
        self._ready = False
        self._pings = self._withheld = 0
        self._hanging: tuple[str, ...] = ()

    def open(self, view: View) -> None:
        self._view = view
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.settimeout(SEND_S)
        self._socket.connect(self._address)

    def handle(self, items: list[Item]) -> None:
        for item in items:
            if isinstance(item, Event) and item.part == "daemon":
                self._notify_state(item.state)
        if self._watchdog_s:
            # Before the snapshot, which may wait for the very thread that hangs.
            self._ping_watchdog(self._view)
        snapshot = self._view.snapshot()
        if not self._ready and snapshot.state in ("running", "degraded"):
            self._notify_state(snapshot.state)
        status = status_of(snapshot)
        if status != self._status:
            self._send(f"STATUS={status}")
            self._status = status

    def close(self) -> None:
        opened, self._socket = self._socket, None
        self._status = ""
        if opened is not None:
            opened.close()

    def details(self) -> dict[str, str | int | float]:
        return {
            "watchdog_s": self._watchdog_s,
            "pings": self._pings,
            "withheld": self._withheld,
        }

    def _notify_state(self, state: str) -> None:
        if state in ("running", "degraded", "reloaded", "refused"):
            # The daemon counts as ready even if a device is not plugged in.
            self._send("READY=1")
            self._ready = True
        elif state == "reloading":
            self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
        elif state == "stopping":
            self._send("STOPPING=1")

    def _ping_watchdog(self, view: View) -> None:
        limit = max(LEAST_S, self._watchdog_s / 2)
        found = hanging(view.silent(), limit)
        if found:
            self._withheld += 1
            if not self._hanging:
                why = f"{', '.join(found)}: not a turn for {limit:g} s: systemd will start it anew"
                view.report("systemd", "withheld", why, "error")
        else:
            self._send("WATCHDOG=1")
            self._pings += 1
            if self._hanging:
                view.report("systemd", "fed", "all threads turn again")
        self._hanging = found

    def _send(self, text: str) -> None:
        assert self._socket is not None
        self._socket.send(text.encode())


def hanging(silent: Mapping[str, float], limit: float) -> tuple[str, ...]:
    """Return the names of critical threads whose current loop pass exceeds a limit, s.

    A part that broke is restarted; but a thread in a call that does not return can only be ended
    with its process. That is worthwhile for the main loop, the watch and every source; and for
    models once all hang. Consumers do not count here: the samples matter more than their use.
    """
    late = [name for name, seconds in silent.items() if seconds > limit]
    models = [name for name in silent if name.startswith("model.")]
    if not all(name in late for name in models):
        late = [name for name in late if name not in models]
    return tuple(late)


def status_of(snapshot: Snapshot) -> str:
    """Return the state in one line, with the diagnostics or the number of parts."""
    if snapshot.degraded:
        return f"{snapshot.state}: {'; '.join(snapshot.degraded)}"[:LONGEST]
    counts = (
        (len(snapshot.sources), "source"),
        (len(snapshot.models), "model"),
        (sum(c.part.name.startswith("publisher.") for c in snapshot.consumers), "publisher"),
    )
    parts = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in counts)
    recording = any(c.kind == "recorder" for c in snapshot.consumers)
    return f"{snapshot.state}: {parts}{', recorder' if recording else ''}"


def _read_watchdog_s(environment: Mapping[str, str]) -> float:
    """Return the watchdog's time limit, s, or 0 if systemd expects no pings."""
    text = environment.get("WATCHDOG_USEC", "")
    if not text or environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    if not text.isdigit() or int(text) == 0:
        raise ConfigError(f"systemd: WATCHDOG_USEC is {text!r}, not a number of microseconds")
    return int(text) / 1e6
