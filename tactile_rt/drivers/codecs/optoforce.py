"""OptoForce OMD and HEX sensors, over USB (serial) or a CAN bus.

A message is two bytes of kind, one of number, one of length, a payload and the sum of all bytes
before it as u16; everything big-endian. Samples: AA 07 08, length 0A (one 3D sensor), 1C (four of
them) or 10 (one 6D), u16 counter, u16 status and i16 counts. Configuration: AA 00 32 03, speed,
filter, zero; the device answers AA 00 50 01 and a status. A CAN bus carries the same bytes in
frames of 8, each message beginning with a frame.

Sources: OptoForce, General DAQ User Guide 2.2, sections 3 to 5 (as quoted by the public drivers
github.com/alknemeyer/optoforce, github.com/shadow-robot/optoforce and
github.com/RCPRG-ros-pkg/optoforce_can).
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import (
    SIX_AXES,
    CanCodec,
    CanFrame,
    Command,
    Samples,
    SerialCodec,
    Step,
    WireStats,
)
from tactile_rt.drivers.codecs.framing import FrameFinder

SAMPLE: Final = b"\xaa\x07\x08"
CONFIGURE: Final = b"\xaa\x00\x32\x03"
ANSWER: Final = b"\xaa\x00\x50\x01"
ANSWERS: Final = re.compile(re.escape(ANSWER) + b"[\x00-\xff]{3}", re.DOTALL)
SETTINGS: Final = re.compile(re.escape(CONFIGURE) + b"[\x00-\xff]{5}", re.DOTALL)
SHAPES: Final = {"3d": (1, 3), "4x3d": (4, 3), "6d": (1, 6)}
SPEEDS: Final = {1000: 1, 333: 3, 100: 10, 30: 33, 10: 100}  # Hz: code, ms between samples
FILTERS: Final = {0.0: 0, 500.0: 1, 150.0: 2, 50.0: 3, 15.0: 4, 5.0: 5, 1.5: 6}  # Hz: code
ZERO: Final = 255

FAILURE, SEVERAL = 11, 3  # bits of the status
FAULTS: Final = 0xFFF0  # errors and overloads; the lower bits are the number of the faulty sensor


@dataclass(frozen=True)
class OptoForceOptions:
    """Options of the OptoForce protocol.

    Attributes:
        model: Connected model: ``3d``, ``4x3d`` (four sensors on one board) or ``6d``.
        rate_hz: Sample rate to set: 1000, 333, 100, 30 or 10 Hz.
        filter_hz: Cut-off of the device's low-pass filter: 500, 150, 50, 15, 5 or 1.5 Hz; 0 for
            none.
        zero: Whether the device takes its load at the start as zero.
        counts: The counts per N (and per N m) of the sensor's sensitivity report, by channel and
            separated by commas, for all sensors or for each in turn. If empty, values are counts.
    """

    model: str = "3d"
    rate_hz: int = 100
    filter_hz: float = 15.0
    zero: bool = False
    counts: str = ""

    def __post_init__(self) -> None:
        for name, known in (("model", SHAPES), ("rate_hz", SPEEDS), ("filter_hz", FILTERS)):
            if getattr(self, name) not in known:
                each = ", ".join(f"{k:g}" if isinstance(k, float) else f"{k}" for k in known)
                raise ConfigError(f"{name} must be one of {each}, not {getattr(self, name)}")
        self.scale()

    def scale(self) -> NDArray[np.float64]:
        """Return (element, channel) SI units per count, or ones without `counts`."""
        shape = SHAPES[self.model]
        if not self.counts:
            return np.ones(shape)
        try:
            counts = np.array([float(part) for part in self.counts.split(",")])
        except ValueError:
            raise ConfigError(f"counts must be numbers, not {self.counts!r}") from None
        if counts.size not in (shape[1], shape[0] * shape[1]):
            raise ConfigError(f"counts must be {shape[1]} numbers for a {self.model}, by channel")
        if not ((counts >= 1e-6) & (counts <= 1e9)).all():  # zero, negative or implausible
            raise ConfigError(f"counts must be positive numbers, not {self.counts!r}")
        return np.broadcast_to(1 / counts.reshape(-1, shape[1]), shape)


class _Messages:
    """Encoder and decoder of the device's messages, common to USB and CAN."""

    def __init__(self, options: OptoForceOptions, stats: WireStats, parts: bool) -> None:
        elements, channels = SHAPES[options.model]
        axes = list(SIX_AXES)[:channels]
        units = {axis: SIX_AXES[axis] if options.counts else "1" for axis in axes}
        sensors = {f"S{i + 1}": (0, i) for i in range(elements)}  # the user mounts them
        rate_hz = float(options.rate_hz)
        self.spec = ArraySpec.at_origin("optoforce", rate_hz, units, elements=sensors)
        self._scale = options.scale()
        self._head = SAMPLE + bytes((4 + 2 * elements * channels,))
        self._layout = np.dtype(
            [
                ("head", "u1", 4),
                ("count", ">u2"),
                ("status", ">u2"),
                ("load", ">i2", (elements, channels)),
                ("sum", ">u2"),
            ]
        )
        size = self._layout.itemsize
        self.finder = FrameFinder(self._head, size, _is_intact, ANSWERS, stats, parts)
        self._host_bytes = b""

    def decode(self, found: list[bytes], damaged: list[int], t_ns: int) -> Samples | None:
        """Convert intact messages to samples; return None without messages."""
        if not found:
            return None
        messages = np.frombuffer(b"".join(found), self._layout)
        status = messages["status"].astype(np.int64)
        return Samples(
            (messages["load"] * self._scale).astype(np.float32),
            _find_valid(status, len(self._scale)),
            np.full(len(found), t_ns, np.int64),
            np.array(damaged, np.int64),
            count=messages["count"].astype(np.int64),
            status=status,
        )

    def encode(self, chunk: Chunk) -> list[bytes]:
        messages = np.zeros(len(chunk), self._layout)
        valid = chunk.valid & np.isfinite(chunk.values).all(axis=2)
        counts = np.nan_to_num(np.rint(chunk.values.astype(np.float64) / self._scale))
        messages["head"] = np.frombuffer(self._head, np.uint8)
        messages["count"] = chunk.seq & 0xFFFF
        messages["load"] = np.clip(counts, -32768, 32767)
        bad = (~valid).sum(axis=1)
        first = np.argmin(valid, axis=1) + 1
        messages["status"] = np.where(bad > 0, 1 << FAILURE | first, 0) | (bad > 1) << SEVERAL
        return [_seal(message.tobytes()[:-2]) for message in messages]

    def respond(self, packet: bytes) -> tuple[bytes, int | None]:
        """Return (answer to a host, new rate in Hz: 0 if stopped, None if unchanged)."""
        self._host_bytes += packet
        answer, rate, done = b"", None, 0
        for settings in SETTINGS.finditer(self._host_bytes):
            done = settings.end()
            speed, filter_, _ = settings[0][4:7]
            good = _is_intact(settings[0]) and speed in (0, *SPEEDS.values()) and filter_ <= 6
            if good:
                rate = next((hz for hz, code in SPEEDS.items() if code == speed), 0)
            answer += _seal(ANSWER + bytes((not good,)))
        self._host_bytes = self._host_bytes[max(done, len(self._host_bytes) - 8) :]
        return answer, rate


class OptoForceSerial(SerialCodec):
    """Codec of an OptoForce DAQ on USB."""

    Options = OptoForceOptions
    usb = True
    baud = 1_000_000
    count_bits = 16
    status_bits: ClassVar[dict[int, str]] = {
        15: "error of a reserved kind",
        14: "the board cannot be talked to",
        13: "error of the board",
        12: "temperature error of a sensor",
        FAILURE: "a sensor has failed",
        10: "a sensor is not connected",
        9: "fx overloaded",
        8: "fy overloaded",
        7: "fz overloaded",
        6: "mx overloaded",
        5: "my overloaded",
        4: "mz overloaded",
        SEVERAL: "several sensors are at fault",
    }
    harmless_bits = frozenset(range(4, 10))
    cannot_detect = (
        "changes that cancel each other, or bytes that change places (a sum of bytes); 65,536 "
        "samples lost in succession"
    )

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [{"model": model} for model in SHAPES if model != OptoForceOptions.model]

    def __init__(self, options: OptoForceOptions) -> None:
        super().__init__(None)
        self._options = options
        self._messages = _Messages(options, self.stats, parts=False)
        self.spec = self._messages.spec

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        return self._messages.decode(*self._messages.finder.find(packet), t_ns)

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        if command == Command.START:
            return (Step(_configure(self._options), _seal(ANSWER + b"\0"), what="its settings"),)
        return (Step(_configure(self._options, stop=True)),) if command == Command.STOP else ()

    def forget(self) -> None:
        self._messages.finder.forget()

    def encode(self, chunk: Chunk) -> list[bytes]:
        return self._messages.encode(chunk)

    def respond(self, packet: bytes) -> bytes:
        answer, rate = self._messages.respond(packet)
        if rate is not None:
            self.streaming, self.commanded_hz = rate > 0, rate or None
        return answer


@dataclass(frozen=True)
class OptoForceCanOptions(OptoForceOptions):
    """Options of the OptoForce protocol on a CAN bus, in addition to the serial ones.

    Attributes:
        device_id: CAN identifier of the frames that the device sends.
        host_id: CAN identifier of the frames that the device accepts.
    """

    device_id: int = 0x100
    host_id: int = 0x101

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("device_id", "host_id"):
            if not 0 <= (value := getattr(self, name)) <= 0x7FF:
                raise ConfigError(f"{name} must be from 0 to 0x7ff, not {value:#x}")


class OptoForceCan(CanCodec):
    """Codec of an OptoForce DAQ on a CAN bus."""

    Options = OptoForceCanOptions
    count_bits = 16
    status_bits = OptoForceSerial.status_bits
    harmless_bits = OptoForceSerial.harmless_bits
    cannot_detect = OptoForceSerial.cannot_detect

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        usual = OptoForceOptions.model, OptoForceCanOptions.device_id
        return [
            {"model": model, "device_id": f"{device:#x}"}
            for model in SHAPES
            for device in sorted(identifiers)
            if (model, device) != usual
        ]

    def __init__(self, options: OptoForceCanOptions) -> None:
        super().__init__(None)
        self._options = options
        self._messages = _Messages(options, self.stats, parts=True)
        self.spec = self._messages.spec
        self._id, self._host_id = options.device_id, options.host_id

    def feed(self, packet: Sequence[CanFrame], t_ns: int) -> Samples | None:
        mine = [f.data for f in packet if f.id == self._id and not (f.extended or f.remote)]
        self.stats.skipped += len(packet) - len(mine)
        return self._messages.decode(*self._messages.finder.find(b"".join(mine)), t_ns)

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        if command == Command.START:
            settings = self._split(self._host_id, _configure(self._options), fill=True)
            return (Step(settings, self._id, what="its settings"),)
        if command == Command.STOP:
            settings = self._split(self._host_id, _configure(self._options, stop=True), fill=True)
            return (Step(settings),)
        return ()

    def forget(self) -> None:
        self._messages.finder.forget()

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        return [self._split(self._id, message) for message in self._messages.encode(chunk)]

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        received = b"".join(f.data for f in packet if f.id == self._host_id and not f.extended)
        answer, rate = self._messages.respond(received)
        if rate is not None:
            self.streaming, self.commanded_hz = rate > 0, rate or None
        return self._split(self._id, answer)

    @staticmethod
    def _split(id: int, message: bytes, fill: bool = False) -> list[CanFrame]:
        if fill:  # the board requires whole frames
            message += bytes(-len(message) % 8)
        return [CanFrame(id, message[at : at + 8]) for at in range(0, len(message), 8)]


def _seal(message: bytes) -> bytes:
    return message + (sum(message) & 0xFFFF).to_bytes(2, "big")


def _is_intact(message: bytes) -> bool:
    return sum(message[:-2]) == int.from_bytes(message[-2:], "big")


def _configure(options: OptoForceOptions, stop: bool = False) -> bytes:
    """Return the message that configures the device and starts it, or stops it."""
    speed = 0 if stop else SPEEDS[options.rate_hz]
    zero = ZERO if options.zero and not stop else 0
    return _seal(CONFIGURE + bytes((speed, FILTERS[options.filter_hz], zero)))


def _find_valid(status: NDArray[np.int64], elements: int) -> NDArray[np.bool_]:
    """Return validity, (n, element): False for the sensors that the status marks as faulty."""
    sensor, several = status & 7, status >> SEVERAL & 1
    one = (several == 0) & (sensor >= 1) & (sensor <= elements)
    at_fault = ~one[:, None] | (np.arange(1, elements + 1) == sensor[:, None])
    bad: NDArray[np.bool_] = (status & FAULTS != 0)[:, None] & at_fault
    return ~bad
