"""XELA uSkin patches on CAN: 4 x 4 three-axis taxels, a frame per taxel."""

import struct
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import CanFrame, Command, SampleBatch, Step
from tactile_rt.drivers.codecs.framing import CodecOfParts

SIDE: Final = 4
TAXELS: Final = SIDE * SIDE
CONTROL_ID: Final = 0x200  # | board
START: Final = b"\x07\x00"
XYZ: Final = struct.Struct(">3H")


@dataclass(frozen=True)
class XelaOptions:
    """Options of a uSkin patch.

    Attributes:
        board: Number of the controller board, 0 to 255; its commands have CAN id 0x200 + board.
        first_id: CAN identifier of the first taxel; the others follow in order.
        rate_hz: Rate at which the patch sends samples, Hz.
    """

    board: int = 1
    first_id: int = 0x710
    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        if not 0 <= self.board <= 0xFF:
            raise ConfigError(f"board must be from 0 to 255, not {self.board}")
        if not 0 <= self.first_id <= 0x800 - TAXELS:
            raise ConfigError(
                f"first_id must be from 0 to {0x800 - TAXELS:#x}, not {self.first_id:#x}"
            )


class Xela(CodecOfParts):
    """Codec of uSkin uSPa44: one frame per taxel, with x, y, z as big-endian u16.

    Byte 0 of a frame has an unknown meaning. Values are the device's counts: the newtons per count
    differ from patch to patch and belong in a calibration. Taxels without a frame are invalid. The
    frames of a sample come in the order of their identifiers, which is also that of arbitration.

    Source: the public driver of the O2AS team (github.com/o2as/ur-o2as, o2as_xela_sensor), which
    reads one board.
    """

    Options = XelaOptions
    cannot_detect = (
        "a lost sample (no counter); two neighbouring samples that lost complementary taxels come "
        "out as one"
    )

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [
            {"first_id": f"{first:#x}"}
            for first in identifiers
            if first != XelaOptions.first_id
            and all(first + k in identifiers for k in range(TAXELS))
        ]

    def __init__(self, options: XelaOptions) -> None:
        self._first, self._board = options.first_id, options.board
        # the public driver does not give the distance of the taxels: positions are zero
        super().__init__(
            ArraySpec.at_origin(
                "uSPa44", options.rate_hz, dict.fromkeys("xyz", "1"), "patch",
                {f"T{i}": divmod(i, SIDE) for i in range(TAXELS)},
            ),
            TAXELS,
        )  # fmt: skip
        self.streaming = False

    def _identify_part(self, identifier: int, data: bytes) -> tuple[int, int] | None:
        taxel = identifier - self._first
        return (taxel, 1 + XYZ.size) if 0 <= taxel < TAXELS else None

    def _add_sample(self, batch: SampleBatch, parts: list[bytes | None]) -> None:
        raw = b"".join([p[1 : 1 + XYZ.size] if p else bytes(XYZ.size) for p in parts])
        batch.values.append(np.frombuffer(raw, ">u2"))
        batch.valid.append([p is not None for p in parts])

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        if command == Command.START:  # the stop command is not public: it stops without power
            return (Step((CanFrame(CONTROL_ID | self._board, START),)),)
        return ()

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        counts = np.clip(np.rint(np.nan_to_num(chunk.values)), 0, 0xFFFF).astype(">u2")
        valid = chunk.valid & np.isfinite(chunk.values).all(axis=2)
        return [
            [
                CanFrame(self._first + i, b"\0" + sample[i].tobytes())
                for i in range(TAXELS)
                if good[i]
            ]
            for sample, good in zip(counts, valid, strict=True)
        ]

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        for frame in packet:
            if frame.id == CONTROL_ID | self._board and frame.data == START:
                self.streaming = True
        return []
