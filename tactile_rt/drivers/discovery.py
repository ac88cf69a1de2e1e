"""Which serial ports and CAN buses there are, and what is likely there."""

from dataclasses import dataclass
from pathlib import Path

__all__ = ["CanBus", "Port", "can_buses", "serial_ports"]

ARPHRD_CAN = 280  # type of a CAN network interface, linux/if_arp.h

# USB (vendor, product; None: any) -> what it is likely to be, and the URL's codec or scheme.
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


@dataclass(frozen=True)
class Port:
    """A serial port.

    Attributes:
        path: to open it by.
        stable: name in /dev/serial/by-id, the same after every reboot; empty if it has none.
        usb: (vendor, product) numbers; None if it is not on USB.
        serial_number: of the device.
        likely: what it is likely to be.
        url: to begin with; `codec=` is a guess.
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
        name: e.g. ``can0``.
        up: whether it is up.
        bitrate: bit/s; 0 where it is not known.
        url: to begin with.
    """

    name: str
    up: bool
    bitrate: int
    url: str


def serial_ports(by_id: Path = Path("/dev/serial/by-id")) -> list[Port]:
    """The serial ports of this machine; those that nothing is plugged into are left out."""
    from serial.tools import list_ports

    stable = {str(p.resolve()): str(p) for p in by_id.iterdir()} if by_id.is_dir() else {}
    found = []
    for port in sorted(list_ports.comports(), key=lambda p: p.device):
        if port.vid is None and port.hwid in ("n/a", "", None):
            continue  # ttyS0..31 that the kernel keeps ready
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


def can_buses(net: Path = Path("/sys/class/net")) -> list[CanBus]:
    """The CAN network interfaces of this machine (Linux)."""
    found = []
    for link in sorted(net.iterdir()) if net.is_dir() else ():
        if _number(link / "type") != ARPHRD_CAN:
            continue
        up = bool((_number(link / "flags") or 0) & 1)
        bitrate = _number(link / "can_bittiming" / "bitrate") or 0
        found.append(CanBus(link.name, up, bitrate, f"can:socketcan:{link.name}?codec="))
    return found


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text().strip(), 0)
    except (OSError, ValueError):
        return None
