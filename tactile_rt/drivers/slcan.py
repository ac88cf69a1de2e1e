"""The slcan protocol of most USB adapters: CAN frames as text over a serial line.

After the LAWICEL CANUSB and CAN232 manuals (t, T, r, R, commands, answers, time stamps) and the
CANable 2 firmware (d, D, b, B: CAN FD). The format has no checksum and no counter: a damaged line
is not always detected, a lost line never. USB has a checksum of its own.
"""

from collections.abc import Iterable
from typing import Final

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import CanFrame

CR, BELL = b"\r", b"\a"
# S7 is 800 kbit/s to LAWICEL and 750 kbit/s to CANable.
BITRATES: Final = {
    10_000: b"S0", 20_000: b"S1", 50_000: b"S2", 100_000: b"S3", 125_000: b"S4", 250_000: b"S5",
    500_000: b"S6", 750_000: b"S7", 800_000: b"S7", 1_000_000: b"S8", 83_300: b"S9",
}  # fmt: skip
DATA_BITRATES: Final = {2_000_000: b"Y2", 5_000_000: b"Y5"}

_CLASSIC: Final = {ord(f"{n}"): n for n in range(9)}
_FD_LENGTHS: Final = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_FD: Final = {ord(c): _FD_LENGTHS[int(c, 16)] for c in "0123456789ABCDEFabcdef"}
# first letter: (where the identifier ends, its largest value, lengths, extended, FD, remote)
_KINDS: Final = {
    ord(letter): (9 if extended else 4, 0x1FFFFFFF if extended else 0x7FF, _FD if fd else _CLASSIC,
                  extended, fd, remote)
    for letter, extended, fd, remote in (
        ("t", False, False, False), ("T", True, False, False),
        ("r", False, False, True), ("R", True, False, True),
        ("d", False, True, False), ("D", True, True, False),
        ("b", False, True, False), ("B", True, True, False),
    )
}  # fmt: skip
_LONGEST: Final = 1 + 8 + 1 + 2 * 64 + 8


class SlcanDecoder:
    """Decoder of an adapter's bytes to CAN frames. It never raises, and buffers at most one line.

    Answers to commands and anything else that is no frame are skipped. Time stamps, 4 or 8
    hexadecimal digits after a frame's data, are allowed but not used: they are the adapter's, not
    the device's. The first line shows their length; a new length is accepted only when two
    successive lines have it, so that a damaged length is noticed.
    """

    def __init__(self) -> None:
        self._rest = b""
        self._stamp: int | None = None  # digits of a time stamp
        self._other: int | None = None  # those of the previous line, if they differed

    def feed(self, data: bytes) -> list[CanFrame]:
        """Return the CAN frames that these bytes complete; the bytes may be cut anywhere."""
        data = self._rest + data
        if BELL in data:
            data = data.replace(BELL, BELL + CR)
        if b"\n" in data:  # some adapters end their lines with CR LF
            data = data.replace(b"\n", b"")
        *lines, rest = data.split(CR)
        self._rest = rest[: _LONGEST + 1]  # a line that is longer is corrupt
        frames = []
        for line in lines:
            kind = _KINDS.get(line[0]) if line else None
            if kind is None:
                continue
            end, highest, lengths, extended, fd, remote = kind
            # int() and fromhex() would allow spaces, signs and underscores
            if len(line) <= end or not line.isalnum() or (size := lengths.get(line[end])) is None:
                continue
            stop = end + 1 if remote else end + 1 + 2 * size
            stamp = len(line) - stop
            if stamp == self._stamp:
                self._other = None
            elif not self._accept_stamp(stamp):
                continue
            try:
                ident = int(line[1:end], 16)
                body = bytes.fromhex(line[end + 1 : stop].decode())
                if stamp:
                    int(line[stop:], 16)
            except ValueError:
                continue
            if ident <= highest:
                frames.append(CanFrame(ident, body, extended, fd, remote))
        return frames

    def _accept_stamp(self, digits: int) -> bool:
        """Return whether a time stamp of this many digits may follow a line's data."""
        if digits not in (0, 4, 8):
            return False
        if self._stamp is not None and self._other != digits:
            self._other = digits
            return False
        self._stamp, self._other = digits, None
        return True


def encode(frames: Iterable[CanFrame], stamp_ms: int | None = None) -> bytes:
    """Return CAN frames as lines of slcan; FD frames have bit-rate switching.

    Args:
        frames: Frames to write; FD data is padded with zeros to the next length that CAN FD has.
        stamp_ms: Time to append to each frame, ms, modulo a minute; None for no time stamps.
    """
    end = b"\r" if stamp_ms is None else b"%04X\r" % (stamp_ms % 60_000)
    lines = []
    for ident, data, extended, fd, remote in frames:
        address = b"%08X" % ident if extended else b"%03X" % ident
        if remote:
            lines.append(b"%c%b%X" % (b"R" if extended else b"r", address, len(data)))
        elif not fd:
            letter = b"T" if extended else b"t"
            lines.append(b"%b%b%X%b" % (letter, address, len(data), data.hex().upper().encode()))
        else:
            code = next(k for k, n in enumerate(_FD_LENGTHS) if n >= len(data))
            body = data.ljust(_FD_LENGTHS[code], b"\0").hex().upper().encode()
            lines.append(b"%b%b%X%b" % (b"B" if extended else b"b", address, code, body))
    lines.append(b"")
    return end.join(lines)


def opening(bitrate: int) -> tuple[bytes, ...]:
    """Return the commands by which a host opens the channel, in order; each is answered.

    The first ends an unfinished line in the adapter, the second closes the channel: an error in
    answer to either means nothing.

    Raises:
        ConfigError: slcan has no such bit rate.
    """
    if bitrate not in BITRATES:
        rates = ", ".join(str(r) for r in sorted(BITRATES))
        raise ConfigError(f"slcan has no bitrate {bitrate}: there are {rates}")
    return (CR * 3, b"C\r", BITRATES[bitrate] + CR, b"O\r")


def closing() -> bytes:
    """Return the command by which a host closes the channel."""
    return b"C\r"


class SlcanAdapter:
    """Emulated slcan adapter, which answers a host's commands.

    Args:
        bitrate: Speed of the bus that the adapter is on, bit/s. If the host opens the channel at
            another speed, the adapter passes no frames and reports bus errors. None accepts any
            speed that the host chooses.

    Attributes:
        hears: Whether frames pass: the channel is open, and at the bus's bit rate.
        flags: Status that F reports and clears: bit 3 is a data overrun, bit 7 a bus error.
        data_bitrate: Speed of CAN FD's data phase, bit/s, once the host has set it.
    """

    VERSION = b"V1013"
    SERIAL = b"NA123"

    def __init__(self, bitrate: int | None = None) -> None:
        self.open = False
        self.flags = 0
        self._bus_rate = None if bitrate is None else BITRATES[bitrate]
        self._rate = self._bus_rate
        self._stamps = False
        self._silent = False
        self._rest = b""
        self.data_bitrate: int | None = None

    @property
    def bitrate(self) -> int:
        """Speed of the bus, bit/s; 1 Mbit/s if neither side has set it."""
        return next((rate for rate, code in BITRATES.items() if code == self._rate), 1_000_000)

    @property
    def hears(self) -> bool:
        return self.open and self._rate == (self._bus_rate or self._rate)

    def respond(self, data: bytes) -> tuple[bytes, list[CanFrame]]:
        """Process data from the host; return (the answer, the frames for the bus)."""
        *lines, rest = (self._rest + data).split(CR)
        self._rest = rest[: _LONGEST + 1]
        answers, frames = [], []
        for line in lines:
            line = line.strip(b"\n")
            if line[:1] and line[:1] in b"tTrRdDbB":
                found = SlcanDecoder().feed(line + CR) if self.open and not self._silent else []
                frames += found if self.hears else []
                answers.append((b"Z\r" if line[:1].isupper() else b"z\r") if found else BELL)
            else:
                answers.append(self._run_command(line))
        return b"".join(answers), frames

    def encode(self, frames: Iterable[CanFrame], time_ns: int = 0) -> bytes:
        """Return frames from the bus as lines for the host; empty unless `hears`."""
        if not self.hears:
            return b""
        return encode(frames, time_ns // 1_000_000 if self._stamps else None)

    def _run_command(self, line: bytes) -> bytes:
        name, value = line[:1], line[1:]
        if name in (b"O", b"L", b"S", b"s", b"Y", b"Z", b"M", b"m", b"W") and self.open:
            return BELL  # these are allowed only while the channel is closed
        match name:
            case b"":
                return CR
            case b"V":
                return self.VERSION + CR
            case b"N":
                return self.SERIAL + CR
            case b"F":
                flags, self.flags = self.flags | (0x80 if self.open and not self.hears else 0), 0
                return b"F%02X\r" % flags if self.open else BELL
            case b"O" | b"L":
                self.open, self._silent = True, name == b"L"
            case b"C":
                if not self.open:
                    return BELL
                self.open = False
            case b"S":
                if line not in BITRATES.values():
                    return BELL
                self._rate = line
            case b"Z":
                if value not in (b"0", b"1"):
                    return BELL
                self._stamps = value == b"1"
            case b"Y" if line in DATA_BITRATES.values():
                self.data_bitrate = next(r for r, code in DATA_BITRATES.items() if code == line)
            case b"s" | b"Y" | b"X" | b"M" | b"m" | b"W" | b"Q":
                pass  # accepted without effect
            case _:
                return BELL
        return CR
