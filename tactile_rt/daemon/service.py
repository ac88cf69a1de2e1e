"""The daemon as a service of systemd: the unit, and the script that installs it."""

import shlex
from collections.abc import Sequence

from tactile_rt.daemon.config import Config
from tactile_rt.daemon.service_folders import MADE, made_by_systemd, written_folders
from tactile_rt.errors import ConfigError

__all__ = ["install_script", "unit_text"]

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
{made}
WorkingDirectory=/var/lib/tactile-rt
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
# It may be run again. Until all that can be wrong has been looked at, it changes nothing.
set -eu
refuse() {{
    echo "install.sh: $1; nothing has been changed" >&2
    exit 1
}}
[ "$(id -u)" = 0 ] || refuse "run it as root"
for tool in useradd usermod udevadm systemctl; do
    command -v "$tool" >/dev/null || refuse "there is no $tool here"
done
for folder in /etc/systemd/system /etc/udev/rules.d; do
    [ -d "$folder" ] || refuse "there is no folder $folder here"
done
getent group dialout >/dev/null || refuse "there is no group dialout, which may open serial ports"
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
# Written once more: the configuration must still be right, its folders still free to be written
# into, and the unit still the one that was read.
again=$(mktemp -d)
trap 'rm -rf -- "$again"' EXIT
PYTHONDONTWRITEBYTECODE=1 {again} --out "$again/service" >/dev/null ||
    refuse "the configuration cannot be installed"
cmp -s -- "$again/service/{unit}" "$here/{unit}" ||
    refuse "the configuration now gives another {unit}: write it anew"

# From here on things change.
if ! id {user} >/dev/null 2>&1; then
    useradd --system --no-create-home --shell /usr/sbin/nologin --user-group {user}
fi
usermod --append --groups dialout {user}
{folders}install -m 0644 -- "$here/{unit}" /etc/systemd/system/{unit}
install -m 0644 -- "$here/99-tactile.rules" /etc/udev/rules.d/99-tactile.rules
udevadm control --reload && udevadm trigger
systemctl daemon-reload
systemctl enable {unit}
systemctl restart {unit}
systemctl --no-pager status {unit}
"""
# A folder of the service's own, never one that is there; `chown USER:` adds the user's group.
NEW_FOLDER = """\
[ -d {folder} ] || {{ mkdir -m 0750 -- {folder} && chown -- {user}: {folder}; }}
"""


def unit_text(
    command: Sequence[str], config: Config, user: str, watchdog_s: float = WATCHDOG_S
) -> str:
    """The unit file.

    Args:
        command: what to start, absolute paths.
        config: what it will run: folders that it writes into are made writable, nothing else is.
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
    made = [
        f"{key}={base.name}"
        for key, base in MADE.items()
        if key == "StateDirectory" or any(f.is_relative_to(base) for f in folders)
    ]
    writes = [f"ReadWritePaths={_path(str(f))}" for f in folders if not made_by_systemd(f)]
    return UNIT.format(
        command=" ".join(map(_quoted, command)), user=user, watchdog=f"{watchdog_s:g}",
        home="read-only" if home else "yes", made="\n".join([*made, *writes]),
        devices="\n".join(f"DeviceAllow={d} rw" for d in DEVICES),
    )  # fmt: skip


def install_script(unit: str, again: Sequence[str], config: Config, user: str) -> str:
    """The script that installs the unit as root; it can be read before it is run.

    Args:
        unit: name of its file.
        again: command that writes the unit once more, into the folder that is added as ``--out``.
        config: folders that it writes into, and that are not there, are made.
        user: whose name it runs under; made if there is none.
    """
    folders = "".join(
        NEW_FOLDER.format(user=user, folder=shlex.quote(str(f)))
        for f in written_folders(config)
        if not made_by_systemd(f)
    )
    return SCRIPT.format(unit=unit, again=shlex.join(again), user=user, folders=folders)


def _quoted(word: str) -> str:
    """A word of ExecStart: % and $ mean something there, see systemd.service(5)."""
    word = word.replace("%", "%%").replace("$", "$$")
    if word and all(c.isalnum() or c in "-_./=:@+,%$" for c in word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _path(path: str) -> str:
    text = path.replace("%", "%%")
    if any(c in text for c in " '\"\\"):
        return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return text
