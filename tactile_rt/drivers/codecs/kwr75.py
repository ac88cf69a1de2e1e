"""Kunwei KWR75 (and its kin) on RS-422 or RS-485.

A frame is 48 AA (49 AA if it was asked for), six float32 (kgf and kgf m), little-endian, and 0D 0A.
The host's commands are four bytes: 43 stops, 48 streams, 49 asks for one frame, each with AA 0D 0A.

Sources: KWR75-RS422 datasheet as told by public drivers of the KWR75B and KWR75D (the command and
frame table, 460,800 baud, 1 kHz) and ian-chuang/kwr75_force_sensor_ros2 (the single reading).
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step, six_axis
from tactile_rt.drivers.codecs.framing import FrameFinder
from tactile_rt.stream import Chunk, ConfigError

__all__ = ["Kwr75", "Kwr75Options"]

TAIL: Final = b"\r\n"
STOP, STREAM, ONCE = (bytes((c, 0xAA)) + TAIL for c in (0x43, 0x48, 0x49))
COMMAND: Final = re.compile(rb"[\x43\x48\x49]\xaa\r\n")
FRAME: Final = np.dtype([("sync", "S2"), ("load", "<f4", 6), ("tail", "S2")])
G: Final = 9.80665  # N per kgf, exactly
SETTLE_S: Final = 0.05  # until a frame that was on its way has passed
NOTHING: Final = re.compile(rb"(?!)")  # the device sends nothing but frames


@dataclass(frozen=True)
class Kwr75Options:
    """Options of the Kunwei KWR75.

    Attributes:
        poll: Whether to ask for each frame, as on an RS-485 bus, instead of streaming.
        rate_hz: Rate at which the device sends, or is asked (at most), Hz.
        newton: Newtons in a unit that the device sends; some of its kin count in tens of N.
    """

    poll: bool = False
    rate_hz: float = 1000.0
    newton: float = G

    def __post_init__(self) -> None:
        for what in ("rate_hz", "newton"):
            if not 0 < getattr(self, what) < 1e6:
                raise ConfigError(f"{what} must be positive, not {getattr(self, what)}")


class Kwr75(SerialCodec):
    """One six-axis sensor: forces and moments, N and N m, 1,000 times a second."""

    Options = Kwr75Options
    baud = 460_800
    cannot_detect = (
        "It sends no checksum, counter, time or status: a damaged value between an intact "
        "beginning and end is taken for a measurement, and frames that never came or came twice "
        "cannot be seen."
    )

    def __init__(self, options: Kwr75Options) -> None:
        super().__init__(six_axis("kwr75", options.rate_hz))
        self._newton = options.newton
        self._sync = (ONCE if options.poll else STREAM)[:2]
        self._finder = FrameFinder(self._sync, FRAME.itemsize, _whole, NOTHING, self.stats)
        self.polls = options.poll
        self.streaming = False
        self._heard = b""

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        found, damaged = self._finder.find(packet)
        if not found:
            return None
        n = len(found)
        with np.errstate(over="ignore", invalid="ignore"):  # a damaged value may be any
            loads = np.frombuffer(b"".join(found), FRAME)["load"] * np.float32(self._newton)
        return Samples(
            loads[:, None],
            np.asarray(np.isfinite(loads).all(axis=1))[:, None],
            np.full(n, t_ns, np.int64),
            np.array(damaged, np.int64),
        )

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        stop = Step(STOP, pause_s=SETTLE_S)
        if command == Command.START:
            return (stop,) if self.polls else (stop, Step(STREAM))
        if command == Command.POLL:
            return (Step(ONCE),) if self.polls else ()
        return (stop,)

    def forget(self) -> None:
        self._finder.forget()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        most = np.finfo(np.float32).max
        loads = np.nan_to_num(chunk.values[:, 0].astype(np.float64) / self._newton)
        wire = np.clip(loads, -most, most).astype("<f4")
        return [self._sync + load.tobytes() + TAIL for load in wire]

    def respond(self, packet: bytes) -> bytes:
        heard, done = self._heard + packet, 0
        for found in COMMAND.finditer(heard):
            if found[0] == ONCE:
                self.polled += 1
            else:
                self.streaming = found[0] == STREAM
            done = found.end()
        self._heard = heard[done:][-3:]
        return b""


def _whole(frame: bytes) -> bool:
    return frame.endswith(TAIL)
