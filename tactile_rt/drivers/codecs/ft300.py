"""Robotiq FT 150 and FT 300 on RS-485 (or its USB adapter), streaming.

The device is a Modbus RTU slave until its register 410 is set to 0x0200: then it sends, unasked and
deaf to Modbus, 20 4E, six i16 (N / 100, N m / 1000) and CRC-16/MODBUS, all little-endian, 100 times
a second. A run of 50 bytes FF jams the line and makes it a slave again.

Sources: Robotiq, FT 300 Instruction Manual, section 4 (control); facts of the maker's driver
robotiq_ft_sensor (rq_sensor_com.cpp).
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step, six_axis
from tactile_rt.drivers.codecs.framing import FrameFinder, crc16_modbus
from tactile_rt.stream import Chunk, ConfigError

__all__ = ["Ft300", "Ft300Options"]

SYNC: Final = b"\x20\x4e"
FRAME: Final = np.dtype([("sync", "S2"), ("load", "<i2", 6), ("check", "<u2")])
PER_UNIT: Final = np.array([100.0, 100.0, 100.0, 1000.0, 1000.0, 1000.0])  # counts, N and N m
WRITE: Final = 16  # Modbus function: write registers
OUTPUT, STREAM = 410, 0x0200  # the register that selects the output, and its value
JAM: Final = 50  # bytes FF that end the stream
SILENCE_S: Final = 0.1  # until the device is a Modbus slave again


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


class Ft300(SerialCodec):
    """One six-axis sensor: forces and moments, N and N m, 100 times a second.

    An FTDI adapter left at its latency of 16 ms hands them over in bunches, 62.5 times a second;
    `tactile-rt doctor` shows how to set it to 1 ms.
    """

    Options = Ft300Options
    baud = 19_200
    cannot_detect = (
        "It sends neither a counter nor a time: frames that never came, repeated frames and the "
        "device's overload cannot be seen."
        " Damaged frames are told from noise by how they begin, wrongly once in some thousand."
    )

    def __init__(self, options: Ft300Options) -> None:
        super().__init__(six_axis("ft300", 100.0))
        select = bytes((options.slave, WRITE)) + OUTPUT.to_bytes(2, "big") + b"\0\1"
        self._request = _checked(select + b"\2" + STREAM.to_bytes(2, "big"))
        self._echo = _checked(select)
        # an adapter that hears itself returns the host's own bytes, too
        text = re.compile(re.escape(self._echo) + b"|" + re.escape(self._request))
        self._finder = FrameFinder(SYNC, FRAME.itemsize, _intact, text, self.stats)
        self.streaming = False
        self._heard = b""

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        found, damaged = self._finder.find(packet)
        if not found:
            return None
        loads = np.frombuffer(b"".join(found), FRAME)["load"] / PER_UNIT
        n = len(found)
        return Samples(
            loads.astype(np.float32)[:, None],
            np.ones((n, 1), np.bool_),
            np.full(n, t_ns, np.int64),
            np.array(damaged, np.int64),
        )

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        jam = Step(b"\xff" * JAM, pause_s=SILENCE_S)
        if command == Command.START:  # it may be streaming, and then takes no request
            return (jam, Step(self._request, self._echo, what="the request to stream"))
        return (jam,) if command == Command.STOP else ()

    def forget(self) -> None:
        self._finder.forget()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        counts = np.nan_to_num(np.rint(chunk.values[:, 0].astype(np.float64) * PER_UNIT))
        loads = np.clip(counts, -32768, 32767).astype("<i2")
        return [_checked(SYNC + load.tobytes()) for load in loads]

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


def _intact(frame: bytes) -> bool:
    return crc16_modbus(frame[:-2]) == int.from_bytes(frame[-2:], "little")
