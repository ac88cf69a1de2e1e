"""What the native protocol says on every line: see docs/reference/native-protocol.md."""

from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec

__all__ = [
    "FORMATS",
    "HARMLESS",
    "IMPOSSIBLE",
    "RANGE_N",
    "RANGE_NM",
    "RANGE_SI",
    "STATUS",
    "UNKNOWN",
    "DeviceDescription",
    "MessageType",
    "check_numbers",
    "pack_valid",
    "quantise",
    "unpack_valid",
]

# What an ACK says went wrong: a type or length that the device does not know; a thing it cannot do.
UNKNOWN: Final = 1
IMPOSSIBLE: Final = 2

FORMATS: Final = {"float32": 0, "int16": 1}
# What int16's largest value stands for, by SI unit, unless the device describes another scale.
RANGE_N: Final = 0.1
RANGE_NM: Final = 1e-3
RANGE_RAD: Final = float(np.pi)
RANGE_SI: Final = 1.0
LARGEST: Final = 1e30  # scale: any count times it is a float32
# Bits of the status; 4 to 7 are ours to give a meaning later, 8 to 15 the device's own (serial).
STATUS: Final = {
    0: "a channel is at the end of its range",
    1: "a sensor fails",
    2: "the device lost samples before this one",
    3: "the whisking drive fails",
}
HARMLESS: Final = frozenset((0, 2))  # no faults: a firm touch, and what the counter shows


class MessageType:
    """Types of frames."""

    SAMPLE = 0
    DESCRIBE = 1  # host: what are you?
    DESCRIPTION = 2  # device: JSON, see `DeviceDescription`
    START = 3
    STOP = 4
    WHISK = 5  # host: move the whiskers like this
    ACK = 6  # device: payload is the type acknowledged and 0, UNKNOWN or IMPOSSIBLE

    FROM_DEVICE = (SAMPLE, DESCRIPTION, ACK)


@dataclass(frozen=True)
class DeviceDescription:
    """What a native device says of itself.

    Attributes:
        scale: SI units per count of int16, by channel.
        serial_number: Tells it from all others of its kind; empty for none.
    """

    spec: ArraySpec
    scale: tuple[float, ...]
    serial_number: str = ""

    @classmethod
    def of(
        cls,
        spec: ArraySpec,
        range_n: float = RANGE_N,
        range_nm: float = RANGE_NM,
        range_si: float = RANGE_SI,
        serial_number: str = "",
    ) -> "DeviceDescription":
        """A description with scales for these largest readings, and +-pi rad.

        Args:
            range_n: Largest force that an int16 can tell, N.
            range_nm: Largest moment that an int16 can tell, N m.
            range_si: Largest reading in any other unit that an int16 can tell.
        """
        full = {"N": range_n, "N m": range_nm, "rad": RANGE_RAD}
        scale = tuple(full.get(unit, range_si) / 32767 for unit in spec.units)
        return cls(spec, scale, serial_number)

    def to_json(self) -> bytes:
        """The payload of a DESCRIPTION."""
        spec = msgspec.Raw(self.spec.to_json().encode())
        further = {"serial": self.serial_number} if self.serial_number else {}
        return msgspec.json.encode({"spec": spec, "scale": self.scale, **further})

    @classmethod
    def from_json(cls, text: bytes) -> "DeviceDescription | None":
        """Read a payload; None if it is not one."""
        try:
            fields = msgspec.json.decode(text, type=dict[str, msgspec.Raw])
            spec = ArraySpec.from_json(bytes(fields["spec"]).decode())
            scale = msgspec.json.decode(fields["scale"], type=tuple[float, ...])
            serial_number = msgspec.json.decode(fields.get("serial", b'""'), type=str)
        except (msgspec.MsgspecError, ConfigError, KeyError, UnicodeDecodeError):
            return None
        good = len(scale) == len(spec.channels) and all(0 < s <= LARGEST for s in scale)
        return cls(spec, scale, serial_number) if good else None


def pack_valid(valid: NDArray[np.bool_]) -> bytes:
    """(element,) bool as bits, the first element lowest."""
    return np.packbits(valid, bitorder="little").tobytes()


def unpack_valid(bits: bytes, elements: int) -> NDArray[np.bool_]:
    """What `pack_valid` packed."""
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=elements, bitorder="little").view(
        np.bool_
    )


def quantise(values: NDArray[np.float32], scale: tuple[float, ...]) -> NDArray[np.int16]:
    """Values as counts, rounded to the nearest and saturated."""
    counts = np.rint(np.nan_to_num(values.astype(np.float64) / scale))
    return np.clip(counts, -32767, 32767).astype(np.int16)


def check_numbers(form: str, *ranges: float) -> None:
    """Raise a `ConfigError` if there is no such format, or one cannot be a range."""
    if not all(0 < r <= LARGEST for r in ranges):
        raise ConfigError("range_n, range_nm and range_si must be above 0")
    if form not in FORMATS:
        raise ConfigError(f"format must be one of {', '.join(FORMATS)}, not {form!r}")
