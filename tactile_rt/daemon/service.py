"""The daemon as a service of systemd: the unit, and the script that installs it.

The installer runs as root, so the service must not be able to do harm: it writes into folders that
systemd makes for it, and nowhere else.
"""

import os
import pwd
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from tactile_rt.core.errors import ConfigError
from tactile_rt.daemon.config import Config
from tactile_rt.daemon.loading import Loaded

# The folders that systemd makes for the service.
MADE = {
    "StateDirectory": Path("/var/lib/tactile-rt"),
    "LogsDirectory": Path("/var/log/tactile-rt"),
    "RuntimeDirectory": Path("/run/tactile-rt"),
}
WATCHDOG_S = 15
# Kinds of devices that sensors use: see /proc/devices.
DEVICES = ("char-ttyACM", "char-ttyUSB", "char-ttyS", "char-ttyAMA", "char-ttyTHS", "char-pts")

UNIT = """\
[Unit]
Description=tactile_rt: tactile sensors in, what they touch out
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
# Where memory runs out, the trial of a model goes first; the daemon goes on.
OOMPolicy=continue
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
install -m 0644 -- "$here/{unit}" /etc/systemd/system/{unit}
install -m 0644 -- "$here/99-tactile.rules" /etc/udev/rules.d/99-tactile.rules
udevadm control --reload && udevadm trigger
systemctl daemon-reload
systemctl enable {unit}
systemctl restart {unit}
systemctl --no-pager status {unit}
"""


def unit_text(command: Sequence[str], config: Config, user: str) -> str:
    """Return the unit file of a service that runs a command.

    Args:
        command: The program with absolute paths, and its arguments.
        config: The configuration that it will run; see `check_folders`.

    Raises:
        ConfigError: The command has a character that a unit file cannot hold.
    """
    for text in command:
        if any(ord(c) < 32 for c in text):
            raise ConfigError(f"{text!r} cannot be written in a unit file")
    home = any(p.startswith(("/home/", "/root/", "/run/user/")) for p in command)
    folders = [folder for _, folder in _list_outputs(config)]
    made = [
        f"{key}={base.name}"
        for key, base in MADE.items()
        if key == "StateDirectory" or any(f.is_relative_to(base) for f in folders)
    ]
    return UNIT.format(
        command=" ".join(map(_quote, command)), user=user, watchdog=f"{WATCHDOG_S:g}",
        home="read-only" if home else "yes", made="\n".join(made),
        devices="\n".join(f"DeviceAllow={d} rw" for d in DEVICES),
    )  # fmt: skip


def install_script(unit: str, again: Sequence[str], user: str) -> str:
    """Return the shell script that installs the unit as root.

    Args:
        again: The command that writes the unit once more, into the folder added as ``--out``.
        user: The name of the service's user, which is created if missing.
    """
    return SCRIPT.format(unit=unit, again=shlex.join(again), user=user)


def check_folders(loaded: Loaded, user: str) -> None:
    """Check that all outputs are in folders that systemd makes for the user.

    Args:
        user: The name of the service's user, who need not exist yet.

    Raises:
        ConfigError: An output is elsewhere, an input is in such a folder, or another user owns it.
    """
    names = " or ".join(map(str, MADE.values()))
    read = _list_inputs(loaded)
    for key, folder in _list_outputs(loaded.config):
        if not any(Path(os.path.realpath(folder)).is_relative_to(b) for b in MADE.values()):
            loaded.refuse(key, f"folder {folder}: a service writes into {names} alone")
    for base in MADE.values():
        inside = next((file for file in read if file.is_relative_to(base)), None)
        if inside is not None:
            raise ConfigError(
                f"the service would own {inside}, which it only reads: move it out of {base}"
            )
        if os.path.lexists(base) and base.lstat().st_uid != _find_uid(user):
            raise ConfigError(f"folder {base}: user {user} must own it: give it to {user}")


def _list_outputs(config: Config) -> Iterator[tuple[list[str | int], Path]]:
    """Yield each key whose value names an output, with the output's folder."""
    if config.recorder is not None:
        yield ["recorder", "folder"], Path(config.recorder.folder)
    if config.log.file:
        yield ["log", "file"], Path(config.log.file).parent
    for i, publisher in enumerate(config.publisher):
        file = publisher.options.get("file")
        if publisher.kind == "jsonl" and isinstance(file, str) and file:
            yield ["publisher", i, "options", "file"], Path(file).parent


def _list_inputs(loaded: Loaded) -> list[Path]:
    """List the files and folders that the service reads, and must not write."""
    config = loaded.config
    names = [
        *(node.file for _, node in loaded.nodes.walk()),
        *(m.file for m in config.model),
        *(file for s in config.source for file in (s.array, s.calibration)),
        str(loaded.path), sys.prefix, sys.executable, __file__,
    ]  # fmt: skip
    return [Path(os.path.realpath(n)) for n in dict.fromkeys(names) if os.path.isabs(n)]


def _find_uid(user: str) -> int | None:
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        return None


def _quote(word: str) -> str:
    """Quote a word for ExecStart, where % and $ are special, see systemd.service(5)."""
    word = word.replace("%", "%%").replace("$", "$$")
    if word and all(c.isalnum() or c in "-_./=:@+,%$" for c in word):
        return word
    return '"' + word.replace("\\", "\\\\").replace('"', '\\"') + '"'
