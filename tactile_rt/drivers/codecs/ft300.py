"""Robotiq FT 150 and FT 300 on RS-485 (or its USB adapter), streaming.

The device is a Modbus RTU slave until its register 410 is set to 0x0200: then it sends, unasked and
deaf to Modbus, 20 4E, six i16 (N / 100, N m / 1000) and CRC-16/MODBUS, all little-endian, 100 times
a second. A run of 50 bytes FF jams the line and makes it a slave again.

Sources: Robotiq, FT 300 Instruction Manual, section 4 (control); facts of the maker's driver
robotiq_ft_sensor (rq_sensor_com.cpp).
"""

from dataclasses import dataclass
from typing import Final

from msgspec.structs import replace

from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, shipped_frame
from tactile_rt.drivers.codecs.framing import crc16_modbus
from tactile_rt.stream import ConfigError

__all__ = ["Ft300", "Ft300Options"]

WRITE: Final = 16  # Modbus function: write registers
OUTPUT, STREAM = 410, 0x0200  # the register that selects the output, and its value
JAM: Final = 50  # bytes FF that end the stream


@dataclass(frozen=True)
class Ft300Options:
    """Options of the Robotiq FT 300.

    Attributes:
        slave: Modbus address of the sensor, 1 to 247.
    """

    slave: int = 9

    def __post_init__(self) -> None:
        if not 1 <= self.slave <= 247:
            raise ConfigError(f"slave must be a Modbus address, 1 to 247, not {self.slave}")


class Ft300(DescribedFrame):
    """One six-axis sensor: forces and moments, N and N m, 100 times a second.

    An FTDI adapter left at its latency of 16 ms hands them over in bunches, 62.5 times a second;
    `tactile-rt doctor` shows how to set it to 1 ms.
    """

    Options = Ft300Options
    cannot_detect = (
        "It sends neither a counter nor a time: frames that never came, repeated frames and the "
        "device's overload cannot be seen."
        " Damaged frames are told from noise by how they begin, wrongly once in some thousand."
    )

    def __init__(self, options: Ft300Options) -> None:
        select = bytes((options.slave, WRITE)) + OUTPUT.to_bytes(2, "big") + b"\0\1"
        self._request = _checked(select + b"\2" + STREAM.to_bytes(2, "big"))
        self._echo = _checked(select)
        frame = shipped_frame("ft300")
        jam, request = frame.start  # it may be streaming, and then takes no request
        request = replace(request, send=self._request.hex(), expect=self._echo.hex())
        super().__init__(
            replace(frame, start=(jam, request), between=(self._request.hex(),)), "ft300"
        )

    def respond(self, packet: bytes) -> bytes:
        answer = b""
        for k in range(len(packet)):
            self._heard += packet[k : k + 1]
            if self._heard.endswith(b"\xff" * JAM):
                self.streaming, self._heard = False, b""
            elif not self.streaming and self._heard.endswith(self._request):
                self.streaming, self._heard = True, b""
                answer += self._echo
            self._heard = self._heard[-JAM:]
        return answer


def _checked(message: bytes) -> bytes:
    return message + crc16_modbus(message).to_bytes(2, "little")
