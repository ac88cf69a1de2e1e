"""A whisker on a magnet above a MLX90393, read by a RP2040 that prints hexadecimal digits.

A line is ``SSXXXXYYYYZZZZ - HZ``: the chip's status byte, the raw field components, big-endian,
and the board's estimate of its line rate.
"""

import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import SampleBatch, Samples, SerialCodec

# uT per count at RES = 0 by GAIN_SEL, of x and y and of z; each step of RES doubles them
# (datasheet MLX90393, table of sensitivities, by HALLCONF).
SENSITIVITY: Final = {
    0xC: (
        (0.751, 1.210), (0.601, 0.968), (0.451, 0.726), (0.376, 0.605),
        (0.300, 0.484), (0.250, 0.403), (0.200, 0.323), (0.150, 0.242),
    ),
    0x0: (
        (0.787, 1.267), (0.629, 1.014), (0.472, 0.760), (0.393, 0.634),
        (0.315, 0.507), (0.262, 0.422), (0.210, 0.338), (0.157, 0.253),
    ),
}  # fmt: skip
# (counts on the wire for no field, least and most), by RES; two's complement up to RES = 1
ZERO: Final = {0: 0, 1: 0, 2: 0x8000, 3: 0x4000}
TESLA: Final = 1e-6
BURST: Final = 0x82  # status without error: burst mode, six bytes follow
ERROR: Final = 0x10

LONGEST: Final = 64
_LINE: Final = re.compile(rb"([0-9A-Fa-f]{2})([0-9A-Fa-f]{12}) - \d{1,9}")
_BOOT: Final = re.compile(rb"[0-9A-Fa-f]{2}|")  # status after exit, reset and start


@dataclass(frozen=True)
class MlxHexOptions:
    """Options of the MLX90393 whisker: settings of its chip, which the board does not report.

    Attributes:
        gain: The chip's setting GAIN_SEL, 0 to 7.
        resolution: The chip's setting RES, 0 to 3, the same for all axes.
        hallconf: The chip's setting HALLCONF: 12, the chip's default, or 0.
        rate_hz: Rate at which the board prints lines, Hz.
    """

    gain: int = 7
    resolution: int = 0
    hallconf: int = 0xC
    rate_hz: float = 850.0

    def __post_init__(self) -> None:
        if not 0 <= self.gain <= 7:
            raise ConfigError(f"gain must be 0 to 7, not {self.gain}")
        if self.resolution not in ZERO:
            raise ConfigError(f"resolution must be 0 to 3, not {self.resolution}")
        if self.hallconf not in SENSITIVITY:
            raise ConfigError(f"hallconf must be 12 or 0, not {self.hallconf}")


class MlxHex(SerialCodec):
    """Codec of one magnet whisker: three components of the field at its chip.

    Source: github.com/JakeSwin/rp_whisker_sensor, src/main.rs (what is printed; the chip is reset
    and left at its defaults); MLX90393 datasheet (status byte, sensitivities, zero by RES).
    """

    Options = MlxHexOptions
    usb = True
    baud = 115200  # nominal: the board is on USB
    status_bits = {  # noqa: RUF012
        2: "the chip was reset",
        3: "a bit of the chip's memory was corrected",
        4: "the chip refused a command",
    }
    harmless_bits = frozenset((2, 3))
    cannot_detect = "lost and repeated lines (no counter); changed digits (no checksum)"

    def __init__(self, options: MlxHexOptions) -> None:
        field = dict.fromkeys(("bx", "by", "bz"), "T")
        super().__init__(
            ArraySpec.at_origin("mlx_hex", options.rate_hz, field, "chip", {"W0": (0, 0)})
        )
        xy, z = SENSITIVITY[options.hallconf][options.gain]
        self._scale = np.array([xy, xy, z]) * 2**options.resolution * TESLA
        self._zero = ZERO[options.resolution]
        self._tail = f" - {options.rate_hz:.0f}\n"
        self._data = bytearray()
        self._joined = self._overlong = False
        self._gap = 0  # bytes of damaged lines since the last intact one

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        self._data += packet
        *lines, self._data = self._data.split(b"\n")
        batch, digits = SampleBatch(), bytearray()
        for line in lines:
            self._read_line(line.removesuffix(b"\r"), batch, digits)
        if len(self._data) > LONGEST:
            self._gap += len(self._data)
            self.stats.skipped += len(self._data)
            self._data.clear()
            self._overlong = True
        if not digits:
            return None
        raw = np.frombuffer(bytes.fromhex(digits.decode()), ">i2" if self._zero == 0 else ">u2")
        values = (raw.reshape(-1, 1, 3).astype(np.float64) - self._zero) * self._scale
        batch.values = list(values)
        return batch.take((1, 3), t_ns)

    def forget(self) -> None:
        self._data.clear()
        self._joined = self._overlong = False
        self._gap = 0

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        good = chunk.valid[:, 0] & np.isfinite(chunk.values).all(axis=(1, 2))
        field = np.nan_to_num(chunk.values[:, 0].astype(np.float64))
        counts = np.rint(field / self._scale) + self._zero
        low, high = (0, 2 * self._zero - 1) if self._zero else (-0x8000, 0x7FFF)
        raw = np.clip(counts, low, high).astype(np.int64).astype(">u2")
        return [
            f"{BURST if ok else BURST | ERROR:02x}{row.tobytes().hex()}{self._tail}".encode()
            for row, ok in zip(raw, good.tolist(), strict=True)
        ]

    def _read_line(self, line: bytearray, batch: SampleBatch, digits: bytearray) -> None:
        overlong, self._overlong = self._overlong, False
        found = None if overlong or len(line) > LONGEST else _LINE.fullmatch(line)
        if found is None:
            self.stats.skipped += len(line)
            if not _BOOT.fullmatch(line) or overlong:
                self._gap += len(line) + 1
            return
        # a line in two pieces is one lost line, two joined without a line end are two
        lost = -(-self._gap // (len(line) + 1)) if self._joined else 0
        self._gap, self._joined = 0, True
        self.stats.corrupt += lost
        self.stats.intact += 1
        status = int(found[1], 16)
        batch.damaged.append(lost)
        batch.status.append(status)
        batch.valid.append([not status & ERROR])
        digits += found[2]
