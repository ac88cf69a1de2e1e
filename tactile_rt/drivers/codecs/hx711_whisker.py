"""Strain-gauge whiskers on HX711 converters, two bridges each, read by an Arduino.

Frames (``frames/hx711_whisker.toml``) end with six bytes that no possible reading contains.
"""

import math
import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from msgspec.structs import replace

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codecs.ascii_mapping import Element
from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, shipped_frame
from tactile_rt.drivers.codecs.frame_mapping import Message

MOST: Final = 9  # whiskers that fit the board's pins
BYTES: Final = 8  # of a whisker
_COMMAND: Final = re.compile(rb"N=([1-9])[\r\n]|[SE]")


@dataclass(frozen=True)
class Hx711WhiskerOptions:
    """Options of the strain-gauge whiskers.

    Attributes:
        whiskers: Number of connected whiskers, 1 to 9.
        reset: Whether opening the port resets the board, as Arduinos do: the board then waits for
            the number of whiskers. A board that is not reset (a bridge, ``dtr=false``) may be
            running already.
        indicator: Whether to raise the board's recording pin while connected.
        rate_hz: Sample rate of the converters, 80 or 10 Hz, which their RATE pin selects.
    """

    whiskers: int = 9
    reset: bool = True
    indicator: bool = False
    rate_hz: float = 80.0

    def __post_init__(self) -> None:
        if not 1 <= self.whiskers <= MOST:
            raise ConfigError(f"whiskers must be 1 to {MOST}, not {self.whiskers}")
        if not 0 < self.rate_hz < math.inf:
            raise ConfigError(f"rate_hz must be positive, not {self.rate_hz}")


class Hx711Whisker(DescribedFrame):
    """Codec of up to nine whiskers: voltages of two bridges each; loads need a calibration.

    Source: github.com/biao-geng-me/whisker_sensor, hx711_array/hx711_array.ino (frame, handshake,
    scale), hx711_array/arduino_reader.py (reset on opening). That a converter at its limit is
    saturated is from the HX711 datasheet (output 800000 to 7FFFFF).

    Attributes:
        recording: Whether the recording pin is up; the state of an emulated device.
    """

    Options = Hx711WhiskerOptions
    cannot_detect = (
        "lost and repeated frames (no counter); changed values, but for a damaged ending and "
        "voltages out of range (no checksum)"
    )

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [{"whiskers": str(n)} for n in range(1, 10) if n != Hx711WhiskerOptions.whiskers]

    def __init__(self, options: Hx711WhiskerOptions) -> None:
        frame, n = shipped_frame("hx711_whisker"), options.whiskers
        wait, number = frame.start
        number = replace(number, send=f"text:N={n}\n")
        start = (wait, number) if options.reset else (Message(send=number.send),)
        if options.indicator:
            start = (*start, Message(send="text:S"))
        # the positions of the whiskers and the directions of the bridges depend on the array
        elements = {f"W{i}": Element(grid=(0, i)) for i in range(n)}
        values = (replace(frame.values[0], elements=tuple(elements)),)
        super().__init__(
            replace(
                frame, length=frame.length - BYTES * (MOST - n), elements=elements, values=values,
                start=start, stop=(Message(send="text:E"),) if options.indicator else (),
            ),
            "hx711_whisker",
            options.rate_hz,
        )  # fmt: skip
        self.recording = False

    def respond(self, packet: bytes) -> bytes:
        commands, answer = self._host_bytes + packet, b""
        last = 0
        for found in _COMMAND.finditer(commands):
            last = found.end()
            if found[1] is None:
                self.recording = found[0] == b"S"
            else:  # a real board accepts this once per reset; an emulated one sees no resets
                self.streaming, answer = True, answer + b"OK\r\n"
        self._host_bytes = commands[last:][-3:]
        return answer
