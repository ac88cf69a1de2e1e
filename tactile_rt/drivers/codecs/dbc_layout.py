"""Where in a device's CAN frames its samples are."""

import math
import struct
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import CanFrame
from tactile_rt.stream import ArraySpec

__all__ = ["DbcMapping", "FramePart", "Signal"]

FLOATS: Final = {16: ">e", 32: ">f", 64: ">d"}


@dataclass(frozen=True)
class Signal:
    """Where a number is in a frame's data.

    Attributes:
        message: Name of the message that the signal is part of.
        name: Name of the signal in the DBC file.
        start: The signal's lowest bit, counted from the lowest bit of byte 0; if `big`, the highest
            bit, counted from the highest of byte 0.
        length: Width of the signal, in bits.
        big: Whether the signal's bytes are big-endian.
        signed: Whether the number is in two's complement.
        real: Whether the number is an IEEE 754 floating-point number.
    """

    message: str
    name: str
    start: int
    length: int
    big: bool
    signed: bool
    real: bool

    def read(self, data: bytes) -> float:
        """The number as it is in the data, before the DBC file's factor and offset."""
        if self.big:
            raw = int.from_bytes(data, "big") >> (8 * len(data) - self.start - self.length)
        else:
            raw = int.from_bytes(data, "little") >> self.start
        raw &= (1 << self.length) - 1
        if self.real:
            number: float = struct.unpack(FLOATS[self.length], raw.to_bytes(self.length // 8))[0]
            return number
        if self.signed and raw >> (self.length - 1):
            raw -= 1 << self.length
        return raw

    def nearest(self, value: float) -> float:
        """What it can hold that is nearest to this value; NaN is 0."""
        if not math.isfinite(value):
            value = 0.0
        if self.real:
            return value
        low, high = (0, 1 << self.length) if not self.signed else (-1 << self.length - 1, 0)
        high = high or 1 << self.length - 1
        return min(max(round(value), low), high - 1)


@dataclass(frozen=True)
class FramePart:
    """A frame that every sample has: a message, with these values of its multiplexers.

    Attributes:
        id: CAN identifier of the message.
        extended: Whether the identifier has 29 bits.
        length: Length of the message's data, bytes.
        when: The multiplexers in the message, and the values of each that make a frame this part.
        message: The message as cantools read it, which encodes the data of an emulated device.
    """

    id: int
    extended: bool
    length: int
    when: tuple[tuple[Signal, frozenset[int]], ...]
    message: Any

    def matches(self, data: bytes) -> bool:
        """Whether the multiplexers in the data have these values."""
        return all(signal.read(data) in values for signal, values in self.when)


@dataclass(frozen=True)
class DbcMapping:
    """How a sample is put together.

    Attributes:
        spec: What the samples are.
        parts: The frames of a sample, in the order in which the device sends them.
        cells: The signal of each of (element * channel) values, and the parts that each is in.
        gain: Scale of each value, (element, channel), SI units per raw count.
        bias: Value of a raw 0, (element, channel), SI.
        counter: The signal that counts samples, and the parts that have it; None if there is none.
            The same holds for `time` and `status`.
        tick_ns: Length of a tick of `time`, ns; None if the device sends no time.
        invalid: Bits of the status that make a sample invalid.
        commands: What the host sends and when: (command, frame, identifier of the answer).
    """

    spec: ArraySpec
    parts: tuple[FramePart, ...]
    cells: tuple[tuple[Signal, tuple[int, ...]], ...]
    gain: NDArray[np.float64]
    bias: NDArray[np.float64]
    counter: tuple[Signal, tuple[int, ...]] | None
    time: tuple[Signal, tuple[int, ...]] | None
    status: tuple[Signal, tuple[int, ...]] | None
    tick_ns: float | None
    invalid: int
    commands: tuple[tuple[str, CanFrame, int | None], ...]
