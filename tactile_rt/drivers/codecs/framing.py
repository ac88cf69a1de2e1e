"""Checksums of the wire formats, and the buffer that frames are looked for in."""

import binascii
from typing import Final

__all__ = ["ByteBuffer", "crc16_modbus", "crc16_x25", "crc16_xmodem"]

_REVERSED: Final = bytes(int(f"{b:08b}"[::-1], 2) for b in range(256))


def _modbus_table() -> tuple[int, ...]:
    table = []
    for b in range(256):
        for _ in range(8):
            b = b >> 1 ^ (0xA001 if b & 1 else 0)
        table.append(b)
    return tuple(table)


_MODBUS: Final = _modbus_table()


def crc16_xmodem(data: bytes | bytearray | memoryview) -> int:
    """CRC-16/XMODEM: polynomial 0x1021, initial value 0 ("123456789" gives 0x31C3)."""
    return binascii.crc_hqx(data, 0)


def crc16_x25(data: bytes | bytearray) -> int:
    """CRC-16/X-25: polynomial 0x1021 reflected ("123456789" gives 0x906E)."""
    # Python has only the CRC that takes bits from the other end: turn each byte, then the result.
    crc = binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return (_REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]) ^ 0xFFFF


def crc16_modbus(data: bytes | bytearray | memoryview) -> int:
    """CRC-16/MODBUS: polynomial 0x8005 reflected, initial value 0xFFFF ("123456789": 0x4B37)."""
    crc = 0xFFFF
    for b in data:
        crc = crc >> 8 ^ _MODBUS[(crc ^ b) & 0xFF]
    return crc


class ByteBuffer:
    """Bytes that have come and are not yet taken.

    Attributes:
        data: the bytes.
    """

    def __init__(self) -> None:
        self.data = bytearray()

    def skip_to(self, sync: bytes, keep: int = 0) -> int:
        """Drop all before the first `sync` (or what may become one); return how many bytes.

        Args:
            sync: how a frame begins.
            keep: do not look at so many bytes at the beginning.
        """
        at = self.data.find(sync, keep)
        if at < 0:
            at = len(self.data)
            for n in range(min(len(sync) - 1, len(self.data) - keep), 0, -1):
                if self.data.endswith(sync[:n]):
                    at -= n
                    break
        del self.data[:at]
        return at

    def take(self, n: int) -> bytes:
        """Take the first n bytes."""
        taken = bytes(self.data[:n])
        del self.data[:n]
        return taken
