"""Discovery of serial ports and CAN buses, the devices likely on them, and their problems.

`serial_ports` and `list_can_buses` list them, each with a URL to start from; `diagnose` checks
permissions, latency timers and the state of buses, and suggests remedies; `udev_rules` makes part
of these permanent.
"""

import getpass
import grp
import json
import os
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ARPHRD_CAN = 280  # type of a CAN network interface, linux/if_arp.h

# USB (vendor, product; None: any) -> the likely device, and the URL's codec or scheme.
# Numbers from the vendors' own udev rules and the Linux USB ID repository.
KNOWN = {
    (0x0403, 0x6001): ("FTDI adapter: Bota or Robotiq RS-485, ATI", "serial"),
    (0x0403, 0x6014): ("FTDI adapter: Bota, ATI", "serial"),
    (0x0403, None): ("FTDI adapter", "serial"),
    (0x04B4, 0xF232): ("Robotiq TSF-85 fingertip", "tsf85"),
    (0x239A, None): ("Adafruit board: AnySkin, MLX90393 whisker", "anyskin"),
    (0x2341, None): ("Arduino: HX711 whiskers, lines of text", "ascii_line"),
    (0x16C0, 0x0483): ("Teensy: native firmware, lines of text", "native"),
    (0x2E8A, None): ("RP2040 board: MLX90393 whisker, native firmware", "native"),
    (0x16D0, 0x117E): ("CANable with slcan firmware", "slcan"),
    (0xAD50, 0x60C4): ("CANable with slcan firmware", "slcan"),
    (0x0483, 0x5740): ("STM32 board: OptoForce, native firmware, or an slcan adapter", "serial"),
    (0x10C4, 0xEA60): ("CP210x adapter", "serial"),
    (0x1A86, 0x7523): ("CH340 adapter: lines of text", "serial"),
}
FAST_MS = 1  # latency timer of an FTDI adapter; its default of 16 ms makes bursts
QUIET_ERRORS = 96  # an error counter beyond it warns (ISO 11898-1)


@dataclass(frozen=True)
class Port:
    """A serial port.

    Attributes:
        path: Path by which the port is opened, such as ``/dev/ttyUSB0``.
        stable: Path in /dev/serial/by-id, the same after every reboot; empty if it has none.
        usb: Vendor and product numbers on USB; None for a port that is not on USB.
        serial_number: Serial number that the USB device reports; empty if none.
        url: URL to start from; its codec is guessed, or left for the user to fill in.
    """

    path: str
    stable: str
    usb: tuple[int, int] | None
    serial_number: str
    likely: str
    url: str


@dataclass(frozen=True)
class CanBus:
    """A CAN network interface.

    Attributes:
        bitrate: Speed of the bus, bit/s; 0 if the kernel does not know it.
        url: URL to start from; the user fills in the codec.
    """

    name: str
    up: bool
    bitrate: int
    url: str


@dataclass(frozen=True)
class Finding:
    """Result of one check: its subject, whether it passed, a message, and a remedy."""

    what: str
    good: bool
    says: str
    do: str = ""


def serial_ports(by_id: Path = Path("/dev/serial/by-id")) -> list[Port]:
    """Return the serial ports of this machine that have a device."""
    from serial.tools import list_ports

    stable = {str(p.resolve()): str(p) for p in by_id.iterdir()} if by_id.is_dir() else {}
    found = []
    for port in sorted(list_ports.comports(), key=lambda p: p.device):
        if port.vid is None and port.hwid in ("n/a", "", None):
            continue  # one of ttyS0..31, which the kernel lists without a device
        usb = None if port.vid is None else (port.vid, port.pid)
        likely, guess = "", "serial"
        if usb is not None:
            likely, guess = KNOWN.get(usb) or KNOWN.get((usb[0], None), ("", "serial"))
        name = stable.get(port.device, port.device)
        if guess == "slcan":
            url = f"can:slcan:{name}?codec="
        else:
            url = f"serial://{name}?codec={'' if guess == 'serial' else guess}"
        found.append(
            Port(
                port.device, stable.get(port.device, ""), usb, port.serial_number or "",
                likely or port.description or "", url,
            )
        )  # fmt: skip
    return found


def list_can_buses(net: Path = Path("/sys/class/net")) -> list[CanBus]:
    """Return the CAN network interfaces of this machine (Linux)."""
    found = []
    for link in sorted(net.iterdir()) if net.is_dir() else ():
        if _read_number(link / "type") != ARPHRD_CAN:
            continue
        up = bool((_read_number(link / "flags") or 0) & 1)
        bitrate = _read_number(link / "can_bittiming" / "bitrate") or 0
        found.append(CanBus(link.name, up, bitrate, f"can:socketcan:{link.name}?codec="))
    return found


def diagnose(
    ports: list[Port],
    buses: list[CanBus],
    sys: Path = Path("/sys"),
    run: Callable[[list[str]], str] | None = None,
) -> list[Finding]:
    """Return findings on permissions, latency timers, CAN bus states and ModemManager.

    Args:
        sys: Where sysfs is mounted.
        run: Runs a command and returns its output ("" if it fails).
    """
    ask = run or _run_command
    found = [f for port in ports for f in _check_port(port, sys)]
    found += [_check_bus(bus, ask) for bus in buses]
    if not ports and not buses:
        found.append(
            Finding(
                "devices", False, "no serial port and no CAN bus",
                "plug one in; without any, `tactile-rt emulate` makes one",
            )
        )  # fmt: skip
    if ports and "active" in ask(["systemctl", "is-active", "ModemManager"]).split():
        found.append(
            Finding(
                "ModemManager", False, "running: it talks to every new serial port for seconds",
                "sudo systemctl disable --now ModemManager, or the udev rules below",
            )
        )  # fmt: skip
    return found


def udev_rules(ports: list[Port]) -> str:
    """Return udev rules for these ports: access for group dialout, low latency, fixed names."""
    lines = [
        "# tactile_rt: access, low latency and stable names for tactile sensors.",
        "# Install: sudo cp THIS /etc/udev/rules.d/99-tactile.rules",
        "#          sudo udevadm control --reload && sudo udevadm trigger",
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVERS=="ftdi_sio", '
        f'ATTR{{latency_timer}}="{FAST_MS}"',
    ]
    for port in ports:
        if port.usb is None:
            continue
        match = f'ATTRS{{idVendor}}=="{port.usb[0]:04x}", ATTRS{{idProduct}}=="{port.usb[1]:04x}"'
        if port.serial_number:
            match += f', ATTRS{{serial}}=="{port.serial_number}"'
        name = f"tactile-{port.serial_number or f'{port.usb[0]:04x}-{port.usb[1]:04x}'}"
        lines.append(
            f'SUBSYSTEM=="tty", {match}, GROUP="dialout", MODE="0660", '
            f'ENV{{ID_MM_DEVICE_IGNORE}}="1", SYMLINK+="{name}"'
        )
    return "\n".join(lines) + "\n"


def _check_port(port: Port, sys: Path) -> Iterator[Finding]:
    if os.access(port.path, os.R_OK | os.W_OK):
        yield Finding(port.path, True, "may be read and written")
    else:
        try:
            group = grp.getgrgid(os.stat(port.path).st_gid).gr_name
        except (OSError, KeyError):
            group = "dialout"
        yield Finding(
            port.path, False, f"no permission (it belongs to group {group})",
            f"sudo usermod -aG {group} {getpass.getuser()}, then log in again",
        )  # fmt: skip
    timer = sys / "bus/usb-serial/devices" / Path(port.path).name / "latency_timer"
    try:
        ms = int(timer.read_text())
    except (OSError, ValueError):
        return  # not an FTDI adapter
    says = f"latency timer {ms} ms"
    if ms <= FAST_MS:
        yield Finding(port.path, True, says)
    else:
        yield Finding(
            port.path, False, f"{says}: samples come in bursts, 62 reads/s at 16 ms",
            f"echo {FAST_MS} | sudo tee {timer}; for good: the udev rules below",
        )  # fmt: skip


def _check_bus(bus: CanBus, ask: Callable[[list[str]], str]) -> Finding:
    up = f"sudo ip link set {bus.name} up type can bitrate {bus.bitrate or 1_000_000}"
    if not bus.up:
        return Finding(bus.name, False, "down", up)
    try:
        (link,) = json.loads(
            ask(["ip", "-details", "-statistics", "-json", "link", "show", bus.name])
        )
        data: dict[str, Any] = link["linkinfo"]["info_data"]
    except (ValueError, KeyError, TypeError):
        return Finding(bus.name, True, "up; its state cannot be read (`ip` of iproute2 is missing)")
    state = str(data.get("state", "unknown"))
    rate = data.get("bittiming", {}).get("bitrate", bus.bitrate)
    errors = data.get("berr_counter", {})
    says = (
        f"{state}, {rate} bit/s, error counters tx {errors.get('tx', 0)} rx {errors.get('rx', 0)}"
    )
    if state == "BUS-OFF":
        return Finding(
            bus.name, False, says,
            "the controller gave up: check bit rate, termination (60 ohm between CAN_H and CAN_L) "
            f"and wiring, then sudo ip link set {bus.name} down && {up} restart-ms 100",
        )  # fmt: skip
    if max(errors.get("tx", 0), errors.get("rx", 0)) >= QUIET_ERRORS:
        return Finding(
            bus.name, False, says,
            "errors on the bus: is the bit rate that of the sensor, and the bus terminated?",
        )  # fmt: skip
    return Finding(bus.name, True, says)


def _run_command(command: list[str]) -> str:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5).stdout
    except (OSError, subprocess.TimeoutExpired):
        return ""


def _read_number(path: Path) -> int | None:
    try:
        return int(path.read_text().strip(), 0)
    except (OSError, ValueError):
        return None
