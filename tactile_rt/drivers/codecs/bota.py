"""Bota Systems SensONE and Rokubi, generation 2, over RS-422 or USB.

37 bytes a frame: AA, a payload of 34 bytes, CRC-16/X-25 of the payload, all little-endian. The
payload: u16 status, 6 float32 (N and N m), u32 time in us, float32 temperature in degrees Celsius.
Commands are ASCII without an end; the device reads 64 bytes of them at once and answers
``r,0,COMMAND,ERROR``.

Sources: Bota Systems, Rokubi serial interface (frame, commands); facts of the public drivers
bota_driver/rokubimini_serial and of the maker's Python and Arduino examples.
"""

import re
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.framing import FrameFinder, crc16_x25
from tactile_rt.stream import ArraySpec, Chunk, ConfigError

__all__ = ["Bota", "BotaOptions"]

SYNC: Final = b"\xaa"
USUAL: Final = SYNC + bytes(2)  # a good status; most of its bits are never set
FRAME: Final = np.dtype(
    [
        ("sync", "u1"),
        ("status", "<u2"),
        ("load", "<f4", 6),
        ("time", "<u4"),
        ("temperature", "<f4"),
        ("check", "<u2"),
    ]
)
BAUDS: Final = {9600: 0, 57_600: 1, 115_200: 2, 230_400: 3, 460_800: 4}
SINC_S: Final = 19.53125e-6  # of time between samples, for each unit of the sinc filter's length
LEAST_SINC, LARGEST_SINC = 51, 512
OVERRANGE, INVALID, RAW = 1, 2, 3  # bits of the status
UNUSABLE: Final = 1 << OVERRANGE | 1 << INVALID | 1 << RAW  # a slow one is late, yet right
ZERO_C: Final = 273.15  # K
ROOM: Final = 298.15  # K, of an emulated device that does not measure it
TEXT: Final = re.compile(rb"App Init|r,\d,[\w#],\d")
COMMAND: Final = re.compile(rb"c(?:,\d){4}|f,\d{2,3}(?:,\d){3}|[CIR#s]")
INPUT: Final = 64  # bytes that the device can hold of commands


@dataclass(frozen=True)
class BotaOptions:
    """Options of the Bota protocol.

    Attributes:
        sinc: Length of the sinc filter, 51 to 512; a sample takes 19.53125 us for each unit of
            length: 512 gives 100 Hz, 64 gives 800 Hz.
        chop: Whether the device chops its inputs, against offset drift.
        fast: Whether the device's filters settle fast.
        skip_fir: Whether the FIR filter is left out, which is faster and noisier.
        temperature_compensation: Whether the device's own temperature compensation is on; the maker
            leaves it off.
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


class Bota(SerialCodec):
    """One six-axis sensor: forces and moments at its reference point, N and N m."""

    Options = BotaOptions
    baud = 460_800
    tick_ns = 1000.0
    status_bits: ClassVar[dict[int, str]] = {
        0: "skips measurements: the sinc filter is too short for its other settings",
        OVERRANGE: "measuring range exceeded",
        INVALID: "measurements invalid: the sensor may be damaged",
        RAW: "sends raw gauge readings: its calibration matrix is off",
    }
    cannot_detect = (
        "It has no sample counter: frames that never came, or came twice, show only in the steps "
        "of its clock."
        " Damaged frames are told from noise by how they begin, wrongly once in some thousand."
    )

    def __init__(self, options: BotaOptions) -> None:
        channels: tuple[str, ...] = ("fx", "fy", "fz", "mx", "my", "mz")
        units: tuple[str, ...] = ("N",) * 3 + ("N m",) * 3
        if options.temperature:
            channels, units = (*channels, "temperature"), (*units, "K")
        super().__init__(
            ArraySpec(
                name="bota",
                elements=("sensor",),
                grid=((0, 0),),
                positions=((0.0, 0.0, 0.0),),  # loads are told at the frame's origin
                orientations=((1.0, 0.0, 0.0, 0.0),),
                channels=channels,
                units=units,
                rate_hz=1 / (SINC_S * options.sinc),
                frame="sensor",
            )
        )
        self._options = options
        self._finder = FrameFinder(SYNC, FRAME.itemsize, _intact, TEXT, self.stats, head=USUAL)
        self._commands = bytearray()
        self._configuring = False

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        found, damaged = self._finder.find(packet)
        if not found:
            return None
        frames = np.frombuffer(b"".join(found), FRAME)
        values: NDArray[np.float32] = frames["load"]
        if self._options.temperature:
            with np.errstate(all="ignore"):  # it may be any bits, though the CRC is right
                kelvin = frames["temperature"] + np.float32(ZERO_C)
            values = np.column_stack([values, kelvin])
        usable = (frames["status"] & UNUSABLE == 0) & np.isfinite(values).all(axis=1)
        return Samples(
            np.ascontiguousarray(values, np.float32)[:, None],
            usable[:, None],
            np.full(len(found), t_ns, np.int64),
            np.array(damaged, np.int64),
            ticks=frames["time"].astype(np.int64),
            status=frames["status"].astype(np.int64),
        )

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        o = self._options
        configure = Step(b"C", b"r,0,C,0", what="the command to configure it")
        if command == Command.STOP:
            return (configure,)
        if command != Command.START:
            return ()
        line = f"c,{o.temperature_compensation:d},1,0,{BAUDS[o.baud]}"  # calibrated, binary
        filters = f"f,{o.sinc},{o.chop:d},{o.fast:d},{o.skip_fir:d}"
        return (
            configure,
            Step(line.encode(), b"r,0,c,0", what="the set-up of its line"),
            Step(filters.encode(), b"r,0,f,0", what="the set-up of its filters"),
            Step(b"R", b"r,0,R,0", what="the command to run"),
        )

    def forget(self) -> None:
        self._finder.forget()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        frames = np.zeros(len(chunk), FRAME)
        values = chunk.values[:, 0].astype(np.float64)
        known = chunk.valid[:, 0] & np.isfinite(values).all(axis=1)
        limit = np.finfo(np.float32).max
        values = np.clip(np.nan_to_num(values), -limit, limit)
        frames["sync"] = SYNC[0]
        frames["status"] = np.where(known, 0, 1 << INVALID)
        frames["load"] = values[:, :6]
        frames["time"] = chunk.t_ns // 1000 & 0xFFFFFFFF
        frames["temperature"] = (values[:, 6] if self._options.temperature else ROOM) - ZERO_C
        whole = (frame.tobytes() for frame in frames)
        return [w[:-2] + crc16_x25(w[1:-2]).to_bytes(2, "little") for w in whole]

    def respond(self, packet: bytes) -> bytes:
        self._commands += packet
        answer, done = b"", 0
        for command in COMMAND.finditer(bytes(self._commands)):
            answer += self._obey(command[0])
            done = command.end()
        del self._commands[:done]
        del self._commands[:-INPUT]
        return answer

    def _obey(self, command: bytes) -> bytes:
        kind, error = command[:1], 0
        if kind == b"#":
            self.streaming, self._configuring = True, False
            return b"App Init\r\n"
        if kind in b"CI":
            self.streaming, self._configuring = False, kind == b"C"
        elif kind == b"R":
            self.streaming, self._configuring = True, False
        elif not self._configuring:
            error = 1
        return b"r,0,%s,%d\r\n" % (kind, error)


def _intact(frame: bytes) -> bool:
    return crc16_x25(frame[1:-2]) == int.from_bytes(frame[-2:], "little")
