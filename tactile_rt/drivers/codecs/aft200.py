"""Aidin Robotics AFT200-D80 force/torque sensor on CAN."""

import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import CanFrame, Command, SampleBatch, Step, six_axis
from tactile_rt.drivers.codecs.framing import CodecOfParts

COMMAND_ID: Final = 0x102
BIAS, TRANSMIT, PERIOD = 2, 3, 5  # second byte of a command
XYZ: Final = struct.Struct(">3H")
# SI units per count, and value at count 0: force in N, torque in N m
SCALE: Final = np.array([0.01] * 3 + [0.002] * 3)
ZERO: Final = np.array([-300.0] * 3 + [-50.0] * 3)
BIAS_S: Final = 1.0  # the sensor is silent while it takes its bias


@dataclass(frozen=True)
class Aft200Options:
    """Options of an AFT200.

    Attributes:
        sensor: Number of the sensor, the first byte of each command.
        force_id: CAN identifier of the force frames; that of the torque frames follows it.
        rate_hz: Sample rate to set, 15.3 to 1000 Hz.
        bias: Whether the sensor takes its load at the start as zero.
    """

    sensor: int = 1
    force_id: int = 1
    rate_hz: float = 1000.0
    bias: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.sensor <= 0xFF:
            raise ConfigError(f"sensor must be from 0 to 255, not {self.sensor}")
        if not 0 <= self.force_id <= 0x7FE:
            raise ConfigError(f"force_id must be from 0 to 0x7fe, not {self.force_id:#x}")
        if not 1e6 / 0xFFFF <= self.rate_hz <= 1000:
            raise ConfigError(f"rate_hz must be from 15.3 to 1000, not {self.rate_hz:g}")


class Aft200(CodecOfParts):
    """Codec of the AFT200: a frame of forces, then one of torques, in big-endian u16.

    A sample without its torques, or without its forces, is invalid.

    Source: the public driver rise_aft_can (class AFT200D80).
    """

    Options = Aft200Options
    full_scale = (300.0,) * 3 + (50.0,) * 3
    cannot_detect = "a lost sample (no counter); forces and torques pair by order only"

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [
            {"force_id": f"{first:#x}"}
            for first in identifiers
            if first != Aft200Options.force_id and first + 1 in identifiers
            if not {first - 1, first + 2} & set(identifiers)  # a longer row is of another device
        ]

    def __init__(self, options: Aft200Options) -> None:
        self._options, self._first = options, options.force_id
        self._period_us = round(1e6 / options.rate_hz)  # it takes whole microseconds
        super().__init__(six_axis("AFT200-D80", 1e6 / self._period_us), parts=2)
        self.streaming = False

    def _identify_part(self, identifier: int, data: bytes) -> tuple[int, int] | None:
        part = identifier - self._first
        return (part, XYZ.size) if 0 <= part <= 1 else None

    def _add_sample(self, batch: SampleBatch, parts: list[bytes | None]) -> None:
        raw = b"".join([p[: XYZ.size] if p else bytes(XYZ.size) for p in parts])
        batch.values.append(np.frombuffer(raw, ">u2") * SCALE + ZERO)
        batch.valid.append((None not in parts,))

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        if command != Command.START:  # the stop command is not public
            return ()
        steps = [self._make_command(PERIOD, *self._period_us.to_bytes(2, "big"))]
        if self._options.bias:
            steps.append(self._make_command(BIAS, 1, pause_s=BIAS_S))
        return (*steps, self._make_command(TRANSMIT, 1))

    def _make_command(self, *data: int, pause_s: float = 0.0) -> Step[Sequence[CanFrame]]:
        whole = bytes((self._options.sensor, *data)).ljust(8, b"\0")
        return Step((CanFrame(COMMAND_ID, whole),), pause_s=pause_s)

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        counts = np.rint((np.nan_to_num(chunk.values[:, 0].astype(np.float64)) - ZERO) / SCALE)
        words = np.clip(counts, 0, 0xFFFF).astype(">u2")
        return [
            [
                CanFrame(self._first + part, w[3 * part : 3 * part + 3].tobytes())
                for part in range(2)
            ]
            for w in words
        ]

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        for frame in packet:
            mine = frame.id == COMMAND_ID and len(frame.data) >= 3 and not frame.extended
            if mine and frame.data[:2] == bytes((self._options.sensor, TRANSMIT)):
                self.streaming = frame.data[2] == 1
        return []
