"""Robotiq FT 150 and FT 300 on RS-485 (or its USB adapter), streaming.

The device is a Modbus RTU slave until its register 410 is set to 0x0200: then it ignores Modbus and
streams the frame of ``frames/ft300.toml``, which names the sources. A run of 50 bytes FF jams the
line and makes it a slave again.
"""

import struct
from dataclasses import dataclass
from typing import Final

from msgspec.structs import replace

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, shipped_frame
from tactile_rt.drivers.codecs.framing import seal_modbus

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE = REQUESTS = (3, 4, 6, 16)  # Modbus functions
ERROR, NO_SUCH_ADDRESS = 0x80, 2
OUTPUT, STREAM = 410, 0x0200  # the register that selects the output, and its value
LOADS, GRAVITY, SERIAL, YEAR = 180, 190, 510, 514  # its other registers
SERIAL_NUMBER: Final = "FTS-0001"  # of an emulated one
JAM: Final = 50  # bytes FF that end the stream
LONGEST: Final = 64  # bytes of a request, or of a jam


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
    """Codec of one six-axis sensor: forces (N) and moments (N m), 100 times a second.

    An FTDI adapter with its default latency of 16 ms delivers them in batches, 62.5 times a second;
    `tactile-rt doctor` shows how to set it to 1 ms.
    """

    Options = Ft300Options
    measures = True
    cannot_detect = (
        "frames that never came or came twice (no counter, no clock); overload of the sensor; of "
        "some thousand damaged frames one is miscounted"
    )

    def __init__(self, options: Ft300Options) -> None:
        self._slave = options.slave
        select = bytes((options.slave, WRITE)) + OUTPUT.to_bytes(2, "big") + b"\0\1"
        self._request = seal_modbus(select + b"\2" + STREAM.to_bytes(2, "big"))
        self._echo = seal_modbus(select)
        frame = shipped_frame("ft300")
        jam, request = frame.start  # a streaming device accepts no request
        request = replace(request, send=self._request.hex(), expect=self._echo.hex())
        super().__init__(
            replace(frame, start=(jam, request), between=(self._request.hex(),)), "ft300"
        )

    # the device's side

    def respond(self, packet: bytes) -> bytes:
        self._host_bytes += packet
        if (jam := self._host_bytes.rfind(b"\xff" * JAM)) >= 0:
            self.streaming, self._host_bytes = False, self._host_bytes[jam + JAM :]
        answer, at = b"", 0
        while not self.streaming and at < len(self._host_bytes):
            length = _find_request_length(self._host_bytes[at:], self._slave)
            request = self._host_bytes[at : at + length]
            if 0 < length <= len(request) and seal_modbus(request[:-2]) == request:
                answer += seal_modbus(request[:1] + self._execute(request[1:-2]))
                self._host_bytes, at = self._host_bytes[at + length :], 0
            elif length > len(request):
                break  # the rest is still to come
            else:
                at += 1
        self._host_bytes = self._host_bytes[-LONGEST:]
        return answer

    def _execute(self, request: bytes) -> bytes:
        """Execute a Modbus function; return the answer without address and checksum."""
        kind, first, n = request[0], *struct.unpack(">HH", request[1:5])
        if kind in (READ_HOLDING, READ_INPUT):
            registers = self._make_registers()
            if n < 1 or any(k not in registers for k in range(first, first + n)):
                return bytes((kind | ERROR, NO_SUCH_ADDRESS))
            values = [registers[k] for k in range(first, first + n)]
            return bytes((kind, 2 * n)) + struct.pack(f">{n}H", *values)
        if first != OUTPUT or (kind == WRITE and n != 1):
            return bytes((kind | ERROR, NO_SUCH_ADDRESS))
        output = n if kind == WRITE_ONE else int.from_bytes(request[6:8], "big")
        self.streaming = output == STREAM
        return request[:5]

    def _make_registers(self) -> dict[int, int]:
        loads = [0] * 6
        if self.newest is not None:
            frame = super().encode(self.newest)[0]
            loads = list(struct.unpack("<6H", frame[2:14]))
        words = dict(enumerate(loads, LOADS)) | dict.fromkeys(range(GRAVITY, GRAVITY + 3), 0)
        text = SERIAL_NUMBER.encode()
        serial = enumerate(struct.unpack(">4H", text), SERIAL)
        return words | dict(serial) | {OUTPUT: STREAM * self.streaming, YEAR: 2020}


def _find_request_length(received: bytes, slave: int) -> int:
    """Return a request's length, bytes; 0 if invalid, over `len(received)` while incomplete."""
    if received[0] != slave or (len(received) > 1 and received[1] not in REQUESTS):
        return 0
    if len(received) < 2 or (received[1] == WRITE and len(received) < 7):
        return len(received) + 1
    return 9 + received[6] if received[1] == WRITE else 8
