"""Bota Systems SensONE and Rokubi, generation 2, over RS-422 or USB.

``frames/bota.toml`` describes its frame and sources; the float32 after the time is the temperature
in degrees Celsius. Commands are ASCII without an ending; the device reads 64 bytes at once and
answers ``r,0,COMMAND,ERROR``.
"""

import re
import struct
from dataclasses import dataclass
from typing import Final

from msgspec.structs import replace

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, shipped_frame
from tactile_rt.drivers.codecs.frame_mapping import Values

BAUDS: Final = {9600: 0, 57_600: 1, 115_200: 2, 230_400: 3, 460_800: 4}
SINC_S: Final = 19.53125e-6  # of time between samples, for each unit of the sinc filter's length
LEAST_SINC, LARGEST_SINC = 51, 512
TEMPERATURE: Final = 31  # offset in a frame
ROOM: Final = 25.0  # C, sent by an emulated device that does not measure the temperature
COMMAND: Final = re.compile(rb"c(?:,\d){4}|f,\d{2,3}(?:,\d){3}|[CIR#s]")
INPUT: Final = 64  # bytes of commands that the device can hold


@dataclass(frozen=True)
class BotaOptions:
    """Options of the Bota protocol.

    Attributes:
        sinc: Length of the sinc filter, 51 to 512; a sample takes 19.53125 us for each unit of
            length: 512 gives 100 Hz, 64 gives 800 Hz.
        chop: Whether the device chops its inputs, against offset drift.
        fast: Whether the device's filters settle fast.
        skip_fir: Whether to skip the FIR filter, which is faster and noisier.
        temperature_compensation: Whether the device's own temperature compensation is on; the
            maker's default is off.
        temperature: Whether to add the device's temperature (K) as a seventh channel.
        baud: Speed of the line, bit/s: 9600, 57600, 115200, 230400 or 460800.
    """

    sinc: int = 512
    chop: bool = False
    fast: bool = False
    skip_fir: bool = False
    temperature_compensation: bool = False
    temperature: bool = False
    baud: int = 460_800

    def __post_init__(self) -> None:
        if not LEAST_SINC <= self.sinc <= LARGEST_SINC:
            raise ConfigError(f"sinc must be {LEAST_SINC} to {LARGEST_SINC}, not {self.sinc}")
        if self.baud not in BAUDS:
            known = ", ".join(map(str, BAUDS))
            raise ConfigError(f"baud must be one of {known} for a Bota sensor, not {self.baud}")


class Bota(DescribedFrame):
    """Codec of one six-axis sensor: forces (N) and moments (N m) at its reference point."""

    Options = BotaOptions
    greeting = b"App Init\r\n"
    cannot_detect = (
        "frames that never came or came twice, but for steps of its clock (no counter); of some "
        "thousand damaged frames one is miscounted"
    )

    def __init__(self, options: BotaOptions) -> None:
        o, frame = options, shipped_frame("bota")
        line = f"c,{o.temperature_compensation:d},1,0,{BAUDS[o.baud]}"  # calibrated, binary
        filters = f"f,{o.sinc},{o.chop:d},{o.fast:d},{o.skip_fir:d}"
        configure, set_line, set_filters, run = frame.start
        start = (
            configure, replace(set_line, send=f"text:{line}"),
            replace(set_filters, send=f"text:{filters}"), run,
        )  # fmt: skip
        values = frame.values
        if o.temperature:
            place = Values(at=TEMPERATURE, type="float32", channels=("temperature",), unit="degC")
            values = (*values, place)
        frame = replace(frame, start=start, values=values, baud=o.baud)
        super().__init__(frame, "bota", rate_hz=1 / (SINC_S * o.sinc))
        self._measures_temperature = o.temperature
        self.streaming = True  # from power-on
        self._commands = bytearray()
        self._configuring = False

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        packets = super().encode(chunk)
        return packets if self._measures_temperature else [self._set_ambient(p) for p in packets]

    def _set_ambient(self, packet: bytes) -> bytes:
        frame = bytearray(packet)
        struct.pack_into("<f", frame, TEMPERATURE, ROOM)
        return self.frame.seal(frame)

    def respond(self, packet: bytes) -> bytes:
        self._commands += packet
        answer, done = b"", 0
        for command in COMMAND.finditer(bytes(self._commands)):
            answer += self._execute(command[0])
            done = command.end()
        del self._commands[:done]
        del self._commands[:-INPUT]
        return answer

    def _execute(self, command: bytes) -> bytes:
        kind, error = command[:1], 0
        if kind == b"#":
            self.streaming, self._configuring = True, False
            return self.greeting
        if kind in b"CI":
            self.streaming, self._configuring = False, kind == b"C"
        elif kind == b"R":
            self.streaming, self._configuring = True, False
        elif not self._configuring:
            error = 1
        elif kind == b"f":
            self.commanded_hz = 1 / (SINC_S * int(command.split(b",")[1]))
        return b"r,0,%s,%d\r\n" % (kind, error)
