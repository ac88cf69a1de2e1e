"""AnySkin and ReSkin: magnetometers under a magnetised elastomer.

A frame (``frames/anyskin.toml``) has no sync, counter or checksum, and its line end also occurs
inside the floats, so the frames' place is inferred from several frames at once (`endings`).
"""

import struct
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codecs.ascii_mapping import Element
from tactile_rt.drivers.codecs.binary_frame import DescribedFrame, shipped_frame
from tactile_rt.drivers.codecs.frame_mapping import UNHEARD

CHIPS: Final = 5  # of the board whose chip positions are known
BYTES: Final = 16  # of a chip
ABSENT: Final = -998.1  # C, a chip that does not answer: raw temperature 0


@dataclass(frozen=True)
class AnySkinOptions:
    """Options of AnySkin.

    Attributes:
        magnetometers: Number of magnetometers on the board: 5 on the 5X board, 1 on a single one.
        temperature: Whether to deliver each chip's temperature (K) as a fourth channel.
        rate_hz: Rate at which the board sends, Hz, which the speed of its I2C bus limits.
    """

    magnetometers: int = 5
    temperature: bool = True
    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        if not 1 <= self.magnetometers <= 64:
            raise ConfigError(f"magnetometers must be 1 to 64, not {self.magnetometers}")
        if not 0 < self.rate_hz < np.inf:
            raise ConfigError(f"rate_hz must be positive, not {self.rate_hz}")


class AnySkin(DescribedFrame):
    """Codec of the n MLX90393 magnetometers of an AnySkin or ReSkin board, also under eFlesh."""

    Options = AnySkinOptions
    cannot_detect = (
        "lost and repeated frames (no counter); changed values, but for a missing line end and "
        "impossible values (no checksum)"
    )

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [{"magnetometers": str(n)} for n in range(1, 17) if n != CHIPS]

    def __init__(self, options: AnySkinOptions) -> None:
        frame, n = shipped_frame("anyskin"), options.magnetometers
        names = tuple(f"M{i}" for i in range(n))
        field, temperature = (replace(v, elements=names) for v in frame.values)
        if not options.temperature:
            temperature = replace(temperature, channels=(UNHEARD,))
        chips = {name: Element(grid=(0, i)) for i, name in enumerate(names)}
        super().__init__(
            replace(
                frame, length=BYTES * n + len(b"\r\n"), values=(field, temperature),
                elements=frame.elements if n == CHIPS else chips,
            ),
            "anyskin",
            options.rate_hz,
        )  # fmt: skip

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        good = chunk.valid & np.isfinite(chunk.values).all(axis=2)
        values = np.where(good[..., None], chunk.values, 0.0).astype(np.float32)
        packets = super().encode(Chunk(chunk.seq, chunk.t_ns, values, np.ones_like(good)))
        return [self._blank(p, np.flatnonzero(~g)) for p, g in zip(packets, good, strict=True)]

    def _blank(self, packet: bytes, absent: NDArray[np.intp]) -> bytes:
        """Return the packet with the absent chips' temperatures set to the raw value 0."""
        frame = bytearray(packet)
        for chip in absent.tolist():
            struct.pack_into("<f", frame, BYTES * chip, ABSENT)
        return bytes(frame)
