"""systemd: the unit that starts the daemon at boot, the script that installs it, and what the
running daemon tells: READY, STATUS, RELOADING, STOPPING, WATCHDOG; see sd_notify(3)."""

import os
import shlex
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tactile_rt.daemon.config import Config
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.health import Snapshot
from tactile_rt.daemon.items import Event, Item
from tactile_rt.stream import ConfigError

__all__ = [
    "Systemd",
    "hanging",
    "install_script",
    "status_of",
    "unit_text",
    "written_folders",
]

TICK_S = 1.0
SEND_S = 0.2  # a manager that does not read must not keep us
LEAST_S = 1.0  # a busy host may keep a thread from its turn for less
LONGEST = 400  # characters of a status
WATCHDOG_S = 15
# Kinds of device that a sensor may be: see /proc/devices.
DEVICES = ("char-ttyACM", "char-ttyUSB", "char-ttyS", "char-ttyAMA", "char-ttyTHS", "char-pts")

UNIT = """\
[Unit]
Description=tactile_rt: whisker arrays in, what they touch out
Documentation=man:systemd.exec(5)
After=network.target time-sync.target
StartLimitIntervalSec=0

[Service]
Type=notify
ExecStart={command}
ExecReload=/bin/kill -HUP $MAINPID
User={user}
Group={user}
SupplementaryGroups=dialout
# 2: the configuration is wrong, 3: it runs already. To start again changes neither.
Restart=always
RestartPreventExitStatus=2 3
RestartSec=1
WatchdogSec={watchdog}
TimeoutStartSec=30
TimeoutStopSec=10
KillMode=mixed
# Acquisition before all else that is not as urgent.
Nice=-5
OOMScoreAdjust=-500
LimitNOFILE=65536
MemoryMax=2G
TasksMax=256
UMask=0027
RuntimeDirectory=tactile-rt
StateDirectory=tactile-rt
WorkingDirectory=/var/lib/tactile-rt
{writes}
# It reads devices and files that are named, and talks over the network: nothing else.
NoNewPrivileges=yes
CapabilityBoundingSet=
AmbientCapabilities=
ProtectSystem=strict
ProtectHome={home}
PrivateTmp=yes
DevicePolicy=closed
{devices}
ProtectControlGroups=yes
ProtectHostname=yes
ProtectKernelLogs=yes
ProtectKernelModules=yes
ProtectKernelTunables=yes
ProtectProc=invisible
LockPersonality=yes
RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_CAN AF_NETLINK
RestrictNamespaces=yes
RestrictRealtime=yes
RestrictSUIDSGID=yes
RemoveIPC=yes
SystemCallArchitectures=native
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM

[Install]
WantedBy=multi-user.target
"""

SCRIPT = """\
#!/bin/sh
# Installs the service that stands beside this script. Run it as root: sudo sh install.sh
set -eu
here=$(cd "$(dirname "$0")" && pwd)
# Is the configuration right? It also leaves the bytecode, which the service may not write.
{check}
if ! id {user} >/dev/null 2>&1; then
    useradd --system --no-create-home --shell /usr/sbin/nologin --user-group {user}
fi
usermod --append --groups dialout {user}
{folders}install -m 0644 "$here/{unit}" /etc/systemd/system/{unit}
install -m 0644 "$here/99-tactile.rules" /etc/udev/rules.d/99-tactile.rules
udevadm control --reload && udevadm trigger
systemctl daemon-reload
systemctl enable --now {unit}
systemctl --no-pager status {unit}
"""


class Systemd(Consumer):
    """Sends to $NOTIFY_SOCKET; pings the watchdog while nothing is `hanging`.

    Args:
        name: of the part.
        options: none.
        environment: where the variables are.

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
        self._watchdog_s = _watchdog_s(environment)
        # systemd asks for a ping at half of the time; twice as often misses none.
        self.tick_s = min(TICK_S, self._watchdog_s / 4) if self._watchdog_s else TICK_S
        self._socket: socket.socket | None = None
        self._view: View | None = None
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
        assert self._view is not None
        for item in items:
            if isinstance(item, Event) and item.part == "daemon":
                self._daemon(item.state)
        if self._watchdog_s:
            # First: what asks more of the daemon may wait for the very thread that hangs.
            self._feed(self._view)
        snapshot = self._view.snapshot()
        if not self._ready and snapshot.state in ("running", "degraded"):
            self._daemon(snapshot.state)
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

    def _daemon(self, state: str) -> None:
        if state in ("running", "degraded", "reloaded", "refused"):
            # A device that is not plugged in is no reason not to have started.
            self._send("READY=1")
            self._ready = True
        elif state == "reloading":
            self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}")
        elif state == "stopping":
            self._send("STOPPING=1")

    def _feed(self, view: View) -> None:
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
    """Threads that the daemon cannot do without, and that have not turned for so long, s.

    A part that broke is tried again; but a thread in a call that does not return can only be
    ended with its process. That is worth it for the main loop, the watch and every source; and for
    models once none works. Consumers count for nothing here: the samples matter more than who
    looks at them.
    """
    late = [name for name, seconds in silent.items() if seconds > limit]
    models = [name for name in silent if name.startswith("model.")]
    if not all(name in late for name in models):
        late = [name for name in late if name not in models]
    return tuple(late)


def status_of(snapshot: Snapshot) -> str:
    """One line: the state, what does not work, and how much there is."""
    if snapshot.degraded:
        return f"{snapshot.state}: {'; '.join(snapshot.degraded)}"[:LONGEST]
    counts = (
        (len(snapshot.sources), "source"),
        (len(snapshot.models), "model"),
        (sum(c.part.name.startswith("publisher.") for c in snapshot.consumers), "publisher"),
    )
    said = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in counts)
    recording = any(c.kind == "recorder" for c in snapshot.consumers)
    return f"{snapshot.state}: {said}{', recorder' if recording else ''}"


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """How soon systemd takes us for dead, s; 0: it does not look."""
    text = environment.get("WATCHDOG_USEC", "")
    if not text or environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    if not text.isdigit() or int(text) == 0:
        raise ConfigError(f"systemd: WATCHDOG_USEC is {text!r}, not a number of microseconds")
    return int(text) / 1e6


def unit_text(
    command: Sequence[str], config: Config, user: str, watchdog_s: float = WATCHDOG_S
) -> str:
    """The unit file.

    Args:
        command: what to start, absolute paths.
        config: what it will run: files that it writes are made writable, nothing else is.
        user: whose name it runs under.
        watchdog_s: silent for so long, it is started anew, s.

    Raises:
        ConfigError: a path has a character that a unit file cannot hold.
    """
    folders = written_folders(config)
    for text in (*command, *map(str, folders)):
        if any(ord(c) < 32 for c in text):
            raise ConfigError(f"{text!r} cannot stand in a unit file")
    home = any(
        p.startswith(("/home/", "/root/", "/run/user/")) for p in (*command, *map(str, folders))
    )
    writes = "\n".join(f"ReadWritePaths={_path(str(f))}" for f in folders)
    return UNIT.format(
        command=" ".join(map(_quoted, command)), user=user, watchdog=f"{watchdog_s:g}",
        home="read-only" if home else "yes", writes=writes,
        devices="\n".join(f"DeviceAllow={d} rw" for d in DEVICES),
    )  # fmt: skip


def install_script(unit: str, check: Sequence[str], config: Config, user: str) -> str:
    """The script that installs the unit as root; it can be read before it is run.

    Args:
        unit: name of its file.
        check: command that says whether the configuration is right.
        config: folders that it writes into are made.
        user: whose name it runs under; made if there is none.
    """
    folders = "".join(
        f"install -d -o {user} -g {user} {shlex.quote(str(f))}\n" for f in written_folders(config)
    )
    return SCRIPT.format(unit=unit, check=shlex.join(check), user=user, folders=folders)


def written_folders(config: Config) -> list[Path]:
    """Folders that the daemon writes into, so configured."""
    found = {Path(config.recorder.folder)} if config.recorder is not None else set()
    if config.log.file:
        found.add(Path(config.log.file).parent)
    for publisher in config.publisher:
        file = publisher.options.get("file")
        if publisher.kind == "jsonl" and isinstance(file, str) and file:
            found.add(Path(file).parent)
    return sorted(found)


def _quoted(word: str) -> str:
    """A word of ExecStart: % and $ mean something there, see systemd.service(5)."""
    word = word.replace("%", "%%").replace("$", "$$")
    if word and all(c.isalnum() or c in "-_./=:@+,%$" for c in word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _path(path: str) -> str:
    text = path.replace("%", "%%")
    if " " in text or '"' in text or "\\" in text:
        return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return text
