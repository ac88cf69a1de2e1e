"""Capacitive skin of the iCub on CAN: triangles of twelve taxels, sixteen per board."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import CanFrame, Command, SampleBatch, Step
from tactile_rt.drivers.codecs.framing import CodecOfParts

TAXELS: Final = 12  # of a triangle
TRIANGLES: Final = 16  # of a board, at most
HEAD, TAIL = 0x40, 0xC0  # first byte of a triangle's two frames, which differ in bit 7
IN_HEAD: Final = 7  # taxels
CLASS: Final = {"new": 0x400, "old": 0x300}  # of identifiers, by firmware
CONFIGURE_ID: Final = 0x200  # | board
SET_BOARD, SET_TRIANGLES, SET_TX_MODE, OLD_SETUP, OLD_SETUP_2 = 0x4D, 0x50, 0x07, 0x4C, 0x4E
OFFSET: Final = 0x2200  # of the converters: the maker's default
NOT_READ: Final = 0x0003  # error bits of a whole triangle; the upper twelve are of its taxels


@dataclass(frozen=True)
class IcubSkinOptions:
    """Options of one skin board; several boards are several sources, to be combined.

    Attributes:
        board: Address of the board, from 0 to 15.
        triangles: The connected triangles, as a list of numbers and ranges, e.g. ``0-6,9``.
        firmware: Generation of the board's firmware: ``new`` (configured by messages 4D and 50,
            sends after a command) or ``old`` (4C and 4E, sends at once).
        period_ms: Time between samples, 1 to 255 ms.
    """

    board: int = 1
    triangles: str = "0-15"
    firmware: str = "new"
    period_ms: int = 20

    def __post_init__(self) -> None:
        if not 0 <= self.board <= 15:
            raise ConfigError(f"board must be from 0 to 15, not {self.board}")
        if self.firmware not in CLASS:
            raise ConfigError(f"firmware must be new or old, not {self.firmware!r}")
        if not 1 <= self.period_ms <= 255:
            raise ConfigError(f"period_ms must be from 1 to 255, not {self.period_ms}")
        self.numbers()

    def numbers(self) -> tuple[int, ...]:
        """Return the numbers of the connected triangles, ascending."""
        found: set[int] = set()
        for item in self.triangles.split(","):
            first, dash, last = item.strip().partition("-")
            if not (first.isdecimal() and (last.isdecimal() or not dash)):
                raise ConfigError(
                    f"triangles must be numbers and ranges like 0-6,9, not {self.triangles!r}"
                )
            found |= set(range(int(first), min(int(last or first), 255) + 1))
        if not found or max(found) >= TRIANGLES:
            raise ConfigError(f"triangles must be from 0 to 15, not {self.triangles!r}")
        return tuple(sorted(found))


class IcubSkin(CodecOfParts):
    """Codec of a skin board, with two frames per triangle.

    The first has seven taxels, the second the other five and the errors. Values are the board's
    counts from 0 to 255, which fall as a taxel is pressed; newtons need a calibration. A taxel is
    invalid if its frame did not come, the board reports it stuck, or could not read its triangle.

    Source: github.com/robotology/icub-main (class CanBusSkin and SkinDiagnostics.h) and the skin
    board's firmware, which sends the triangles in ascending order.
    """

    Options = IcubSkinOptions
    status_bits: ClassVar[dict[int, str]] = {
        0: "a triangle could not be read",
        1: "a triangle did not take its configuration",
        **{4 + i: f"taxel {i} of a triangle is stuck" for i in range(TAXELS)},
    }
    cannot_detect = "a lost sample (no counter)"

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [
            {"board": str(board), "triangles": ",".join(map(str, there)), "firmware": firmware}
            for firmware, first in CLASS.items()
            for board in range(16)
            if (there := [n for n in range(TRIANGLES) if (first | board << 4 | n) in identifiers])
            if (firmware, board, len(there)) != ("new", IcubSkinOptions.board, TRIANGLES)
        ]

    def __init__(self, options: IcubSkinOptions) -> None:
        self._options = options
        self._first = CLASS[options.firmware] | options.board << 4
        self._numbers = options.numbers()
        self._parts = {n: 2 * i for i, n in enumerate(self._numbers)}
        cells = {f"t{n}.{k}": (n, k) for n in self._numbers for k in range(TAXELS)}
        # the taxels' positions depend on the robot's part that holds the board: they are zero
        name, rate_hz = f"icub-skin-{options.board}", 1e3 / options.period_ms
        spec = ArraySpec.at_origin(name, rate_hz, {"c": "1"}, "board", cells)
        super().__init__(spec, parts=2 * len(self._numbers))
        self.streaming = options.firmware == "old"

    def _identify_part(self, identifier: int, data: bytes) -> tuple[int, int] | None:
        part = self._parts.get(identifier - self._first)
        tail = bool(data and data[0] & 0x80)
        return None if part is None else (part + tail, 6 if tail else 8)

    def _add_sample(self, batch: SampleBatch, parts: list[bytes | None]) -> None:
        counts = bytearray()
        valid: list[bool] = []
        status = 0
        for head, tail in zip(parts[::2], parts[1::2], strict=True):
            # boards without diagnostics send a tail of six bytes
            error = int.from_bytes(tail[6:8], "big") if tail and len(tail) >= 8 else 0
            status |= error
            counts += head[1 : 1 + IN_HEAD] if head else bytes(IN_HEAD)
            counts += tail[1 : 1 + TAXELS - IN_HEAD] if tail else bytes(TAXELS - IN_HEAD)
            for k in range(TAXELS):
                came = head if k < IN_HEAD else tail
                valid.append(came is not None and not error & (NOT_READ | 1 << 4 + k))
        batch.values.append(np.frombuffer(bytes(counts), np.uint8))
        batch.valid.append(valid)
        batch.status.append(status)

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        options = self._options
        if options.firmware == "old":
            if command != Command.START:
                return ()
            mask = sum(1 << n for n in self._numbers)
            # the maker's defaults except for the mask of triangles
            return (
                self._configure(OLD_SETUP, 1, 1, 1, 0, 0x20, 0, 0),
                self._configure(OLD_SETUP_2, 2, 0x22, 0xF0, 0, *mask.to_bytes(2, "little"), 0x0A),
            )
        if command == Command.STOP:
            return (self._configure(SET_TX_MODE, 1),)
        if command == Command.START:
            offset = OFFSET.to_bytes(2, "little")
            return (
                # skin type 0: triangles with temperature compensation; counts at rest: 245
                self._configure(SET_BOARD, 0, options.period_ms, 245),
                self._configure(SET_TRIANGLES, 0, TRIANGLES - 1, 2, 0, *offset),
                *(self._configure(SET_TRIANGLES, n, n, 2, 1, *offset) for n in self._numbers),
                self._configure(SET_TX_MODE, 0),
            )
        return ()

    def _configure(self, *data: int) -> Step[Sequence[CanFrame]]:
        return Step((CanFrame(CONFIGURE_ID | self._options.board, bytes(data)),), pause_s=0.01)

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        counts = np.clip(np.rint(np.nan_to_num(chunk.values[..., 0])), 0, 255).astype(np.uint8)
        shape = (-1, len(self._numbers), TAXELS)
        stuck = ~(chunk.valid & np.isfinite(chunk.values[..., 0]))
        errors = (stuck.reshape(shape) << np.arange(4, 4 + TAXELS)).sum(axis=2)
        packets: list[Sequence[CanFrame]] = []
        for sample, error in zip(counts.reshape(shape), errors.tolist(), strict=True):
            packet = []
            for n, taxels, word in zip(self._numbers, sample, error, strict=True):
                raw = taxels.tobytes()
                tail = raw[IN_HEAD:] + word.to_bytes(2, "big")
                packet.append(CanFrame(self._first | n, bytes((HEAD,)) + raw[:IN_HEAD]))
                packet.append(CanFrame(self._first | n, bytes((TAIL,)) + tail))
            packets.append(packet)
        return packets

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        for frame in packet:
            mine = frame.id == CONFIGURE_ID | self._options.board and not frame.extended
            if mine and len(frame.data) == 2 and frame.data[0] == SET_TX_MODE:
                self.streaming = frame.data[1] == 0
        return []
