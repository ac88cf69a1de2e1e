"""What a recording says of itself, in metadata that carries a checksum."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import msgspec

from tactile_rt.calibration import Calibration
from tactile_rt.stream import ArraySpec, ConfigError, RecordingError

__all__ = ["METADATA", "RECOVERED", "SESSION", "SUMMARY", "Description", "seal", "unseal"]

LAYOUT_VERSION = 1
METADATA, SESSION, SUMMARY, RECOVERED = "tactile_rt", "session", "summary", "recovered"


@dataclass(frozen=True)
class Description:
    """What a recording is of.

    Attributes:
        spec: the array of the samples.
        utc_offset_ns: UTC less the host's monotonic time, when the recording began.
        source: where it came from: a URL, or a device's name.
        wire: ``serial`` or ``can``; empty: no device, so no packets.
        codec: what the device spoke.
        codec_options: as in a URL; paths are absolute.
        clock: ``host`` or ``device``: whose time the samples have.
        calibration: of the samples, not of the packets; None: the samples are the codec's.
        session: what the user notes.
        recovered: whether the file was made whole after an interruption, and may have gaps.
    """

    spec: ArraySpec
    utc_offset_ns: int
    source: str = ""
    wire: str = ""
    codec: str = ""
    codec_options: Mapping[str, str] = field(default_factory=dict)
    clock: str = "host"
    calibration: Calibration | None = None
    session: Mapping[str, str] = field(default_factory=dict)
    recovered: bool = False

    def to_metadata(self) -> dict[str, str]:
        """For the record ``tactile_rt``, sealed; the session's notes have one of their own."""
        return seal(
            {
                "version": str(LAYOUT_VERSION),
                "spec": self.spec.to_json(),
                "utc_offset_ns": str(self.utc_offset_ns),
                "source": self.source,
                "wire": self.wire,
                "codec": self.codec,
                "codec_options": msgspec.json.encode(dict(self.codec_options)).decode(),
                "clock": self.clock,
                "calibration": msgspec.json.encode(self.calibration).decode(),
            }
        )

    @classmethod
    def from_metadata(
        cls, what: str, fields: Mapping[str, str], session: Mapping[str, str], recovered: bool
    ) -> "Description":
        """Read what `to_metadata` wrote.

        Raises:
            RecordingError: it is damaged, or of another version.
        """
        version = fields.get("version")
        if version != str(LAYOUT_VERSION):
            raise RecordingError(
                f"{what} is a recording of version {version!r}; this release reads {LAYOUT_VERSION}"
            )
        plain = unseal(what, fields)
        try:
            return cls(
                spec=ArraySpec.from_json(plain["spec"]),
                utc_offset_ns=int(plain["utc_offset_ns"]),
                source=plain["source"],
                wire=plain["wire"],
                codec=plain["codec"],
                codec_options=msgspec.json.decode(plain["codec_options"], type=dict[str, str]),
                clock=plain["clock"],
                calibration=msgspec.json.decode(plain["calibration"], type=Calibration | None),
                session=unseal(what, session) if session else {},
                recovered=recovered,
            )
        except (KeyError, ValueError, msgspec.MsgspecError, ConfigError) as error:
            raise RecordingError(
                f"{what} is damaged: its metadata cannot be read ({error})"
            ) from None


def seal(fields: Mapping[str, str]) -> dict[str, str]:
    """Add a checksum: MCAP guards chunks with one, but not metadata."""
    return {**fields, "crc32": _crc(fields)}


def unseal(what: str, fields: Mapping[str, str]) -> dict[str, str]:
    """The fields without their checksum.

    Raises:
        RecordingError: it is not theirs.
    """
    plain = {k: v for k, v in fields.items() if k != "crc32"}
    if fields.get("crc32") != _crc(plain):
        raise RecordingError(f"{what} is damaged: the checksum of its metadata is wrong")
    return plain


def _crc(fields: Mapping[str, str]) -> str:
    return f"{zlib.crc32(msgspec.json.encode(sorted(fields.items()))):08x}"
