"""Part of the native protocol common to serial and CAN: docs/reference/native-protocol.md."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk

# Errors in an ACK: a type or length unknown to the device; a command that it cannot execute.
UNKNOWN: Final = 1
IMPOSSIBLE: Final = 2

FORMATS: Final = {"float32": 0, "int16": 1}
LARGEST: Final = 1e30  # scale: any count times it is a float32
# Bits of the status; 4 to 7 are reserved for this protocol, 8 to 15 for the device (serial).
STATUS: Final = {
    0: "a channel is at the end of its range",
    1: "a sensor fails",
    2: "the device lost samples before this one",
    3: "the whisking drive fails",
}
HARMLESS: Final = frozenset((0, 2))  # no faults: a firm touch; losses that the counter shows


class MessageType:
    """Types of the native protocol's frames."""

    SAMPLE = 0
    DESCRIBE = 1  # host: request for a description
    DESCRIPTION = 2  # device: JSON, see `DeviceDescription`
    START = 3
    STOP = 4
    WHISK = 5  # host: frequency, amplitude and offset of the whiskers' motion
    ACK = 6  # device: payload is the type acknowledged and 0, UNKNOWN or IMPOSSIBLE

    FROM_DEVICE = (SAMPLE, DESCRIPTION, ACK)


@dataclass(frozen=True)
class NativeOptions:
    """Options of the native protocol.

    Attributes:
        format: Number format of an emulated device, ``float32`` or ``int16``; a host accepts both.
        range_n, range_nm: Full scale of an emulated device's int16 forces (N) and moments (N m).
        range_si: Full scale of its channels of other units, SI; that of rad is pi.
        serial_number: Serial number that an emulated device reports; empty for none.
    """

    format: str = "float32"
    range_n: float = 0.1
    range_nm: float = 1e-3
    range_si: float = 1.0
    serial_number: str = ""

    def __post_init__(self) -> None:
        if not all(0 < r <= LARGEST for r in (self.range_n, self.range_nm, self.range_si)):
            raise ConfigError("range_n, range_nm and range_si must be above 0")
        if self.format not in FORMATS:
            raise ConfigError(f"format must be one of {', '.join(FORMATS)}, not {self.format!r}")


@dataclass(frozen=True)
class DeviceDescription:
    """Self-description of a native device.

    Attributes:
        scale: SI units per count of int16, by channel.
        serial_number: Serial number, unique among devices of this kind; empty for none.
    """

    spec: ArraySpec
    scale: tuple[float, ...]
    serial_number: str = ""

    @classmethod
    def of(
        cls, spec: ArraySpec, options: NativeOptions | None = None, serial_number: str = ""
    ) -> "DeviceDescription":
        """Return a description whose scales fit the full scales of a device's options."""
        options = options or NativeOptions()
        full = {"N": options.range_n, "N m": options.range_nm, "rad": float(np.pi)}
        scale = tuple(full.get(unit, options.range_si) / 32767 for unit in spec.units)
        return cls(spec, scale, serial_number)

    def to_json(self) -> bytes:
        """Return the description as JSON, the payload of a DESCRIPTION frame."""
        spec = msgspec.Raw(self.spec.to_json().encode())
        further = {"serial": self.serial_number} if self.serial_number else {}
        return msgspec.json.encode({"spec": spec, "scale": self.scale, **further})

    @classmethod
    def from_json(cls, text: bytes) -> "DeviceDescription | None":
        """Parse the payload of a DESCRIPTION frame; return None if it is invalid."""
        try:
            fields = msgspec.json.decode(text, type=dict[str, msgspec.Raw])
            spec = ArraySpec.from_json(bytes(fields["spec"]).decode())
            scale = msgspec.json.decode(fields["scale"], type=tuple[float, ...])
            serial_number = msgspec.json.decode(fields.get("serial", b'""'), type=str)
        except (msgspec.MsgspecError, ConfigError, KeyError, UnicodeDecodeError):
            return None
        good = len(scale) == len(spec.channels) and all(0 < s <= LARGEST for s in scale)
        return cls(spec, scale, serial_number) if good else None


def encode_samples(
    chunk: Chunk, described: DeviceDescription, form: str
) -> Iterator[tuple[int, int, bytes]]:
    """Yield (number, time in us, payload) of each sample; payload: validity bits, values."""
    rows = zip(chunk.seq.tolist(), chunk.t_ns.tolist(), chunk.values, chunk.valid, strict=True)
    for seq, t_ns, values, valid in rows:
        if form == "float32":
            body = values.astype("<f4").tobytes()
        else:
            counts = np.rint(np.nan_to_num(values.astype(np.float64) / described.scale))
            body = np.clip(counts, -32767, 32767).astype("<i2").tobytes()
            valid = valid & np.isfinite(values).all(axis=1)  # a count cannot be NaN
        yield seq, t_ns // 1000, np.packbits(valid, bitorder="little").tobytes() + body
