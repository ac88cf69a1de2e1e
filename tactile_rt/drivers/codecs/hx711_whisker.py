"""Strain-gauge whiskers on HX711 converters, two bridges each, read by an Arduino.

A frame is two float32 per whisker, little-endian, in millivolts, then 0D 0A and the float32 2024:
six bytes that end no possible reading, and by which frames are told apart.
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.drivers.codec import Command, SampleBatch, Samples, SerialCodec, Step
from tactile_rt.stream import ArraySpec, Chunk, ConfigError

__all__ = ["Hx711Whisker", "Hx711WhiskerOptions"]

END: Final = bytes.fromhex("0d0a0000fd44")
BRIDGES: Final = 2
MOST: Final = 9  # whiskers that the board has pins for
BOOT_S: Final = 1.5  # how long the board takes after opening its port has reset it
FULL_SCALE: Final = 4.3e3 / 128 / 2  # mV: the firmware's supply of 4.3 V, gain 128, both signs
SATURATED: Final = FULL_SCALE * (1 - 2.0**-22)  # mV; the converter stays there beyond its range
VOLT: Final = 1e-3
GAP: Final = 16  # frames without an ending, then what comes is not this device's

_COUNT: Final = re.compile(rb"N=([1-9])[\r\n]|[SE]")


@dataclass(frozen=True)
class Hx711WhiskerOptions:
    """Options of the strain-gauge whiskers.

    Attributes:
        whiskers: Number of whiskers that are connected, 1 to 9.
        reset: Whether opening the port resets the board, as Arduinos do: the board then waits to be
            told the number of whiskers. A board that is not reset (a bridge, ``dtr=false``) may be
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
        if not 0 < self.rate_hz < np.inf:
            raise ConfigError(f"rate_hz must be positive, not {self.rate_hz}")


class Hx711Whisker(SerialCodec):
    """Up to nine whiskers, the voltages of their two bridges; loads are a matter of calibration.

    Source: github.com/biao-geng-me/whisker_sensor, hx711_array/hx711_array.ino (frame, handshake,
    scale), hx711_array/arduino_reader.py (reset on opening). That a converter at its limit is
    saturated is from the HX711 datasheet (output 800000 to 7FFFFF).

    Attributes:
        recording: Whether the recording pin is up; the state of an emulated device.
    """

    Options = Hx711WhiskerOptions
    baud = 2_000_000
    cannot_detect = (
        "there is no counter and no checksum: lost and repeated frames leave no trace, and of "
        "changed bytes only a damaged ending and voltages out of range are seen"
    )

    def __init__(self, options: Hx711WhiskerOptions) -> None:
        n = options.whiskers
        # where the whiskers stand and which way a bridge bends is up to who builds the array
        super().__init__(
            ArraySpec(
                name="hx711_whisker",
                elements=tuple(f"W{i}" for i in range(n)),
                grid=tuple((0, i) for i in range(n)),
                positions=((0.0, 0.0, 0.0),) * n,
                orientations=((1.0, 0.0, 0.0, 0.0),) * n,
                channels=("bridge0", "bridge1"),
                units=("V", "V"),
                rate_hz=options.rate_hz,
                frame="mount",
            )
        )
        self._options, self._shape = options, (n, BRIDGES)
        self._body = n * BRIDGES * 4
        self._data, self._heard = bytearray(), b""
        self._most = GAP * (self._body + len(END))
        self._dropped = 0  # bytes since the last ending, of those that are not kept
        self._joined = False
        self._damaged = 0
        self.streaming = False
        self.recording = False

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        self._data += packet
        batch = SampleBatch()
        at = 0
        while (end := self._data.find(END, at)) >= 0:
            self._between(self._data[at:end], batch)
            at = end + len(END)
        del self._data[:at]
        keep = len(END) - 1
        if len(self._data) > self._most + keep:
            self._dropped += len(self._data) - keep
            self.stats.skipped += len(self._data) - keep
            del self._data[:-keep]
        return batch.take(self._shape, t_ns)

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        tell = f"N={self._options.whiskers}\n".encode()
        if command == Command.START:
            begin: tuple[Step[bytes], ...] = (Step(tell),)
            if self._options.reset:
                begin = (
                    Step(b"", pause_s=BOOT_S, what="its reset"),
                    Step(tell, b"OK", timeout_s=2.0, what="the number of whiskers"),
                )
            return (*begin, Step(b"S")) if self._options.indicator else begin
        return (Step(b"E"),) if command == Command.STOP and self._options.indicator else ()

    def forget(self) -> None:
        self._data.clear()
        self._dropped = self._damaged = 0
        self._joined = False

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        values = np.where(chunk.valid[..., None], chunk.values, np.nan).astype(np.float64)
        wire = np.clip(values / VOLT, -FULL_SCALE, FULL_SCALE).astype("<f4")
        return [sample.tobytes() + END for sample in wire]

    def respond(self, packet: bytes) -> bytes:
        heard, answer = self._heard + packet, b""
        last = 0
        for found in _COUNT.finditer(heard):
            last = found.end()
            if found[1] is None:
                self.recording = found[0] == b"S"
            else:  # a real board listens once after a reset; an emulated one cannot see those
                self.streaming, answer = True, answer + b"OK\r\n"
        self._heard = heard[last:][-3:]
        return answer

    def _between(self, segment: bytearray, batch: SampleBatch) -> None:
        """Take what came between two endings: one frame, if nothing is damaged."""
        size = self._body + len(END)
        length = self._dropped + len(segment)
        joined, self._joined, self._dropped = self._joined, True, 0
        # longer by whole frames: the endings between them are damaged, the last frame is whole;
        # before the first ending anything may come, "OK" for one
        whole = (length + len(END)) % size == 0 if joined else length >= self._body
        whole = whole and length <= self._most
        if joined:
            lost = -(-(length + len(END)) // size) - whole
            self.stats.corrupt += lost
            self._damaged += lost
        if not whole:
            self.stats.skipped += len(segment) + len(END)
            return
        self.stats.skipped += len(segment) - self._body
        self.stats.intact += 1
        wire = np.frombuffer(bytes(segment[-self._body :]), "<f4").reshape(self._shape)
        with np.errstate(invalid="ignore"):  # a signalling NaN is only a NaN
            batch.valid.append((np.abs(wire) < SATURATED).all(axis=1))
            batch.values.append(wire * np.float32(VOLT))
        batch.damaged.append(self._damaged)
        self._damaged = 0
