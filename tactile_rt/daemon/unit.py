"""What makes the daemon start at boot: a systemd unit, and a script that installs it."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from tactile_rt.daemon.config import Config
from tactile_rt.stream import ConfigError

__all__ = ["install_script", "unit_text", "written_folders"]

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
LimitNOFILE=4096
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
