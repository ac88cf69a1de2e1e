"""Description of a recording: its metadata, sealed by a checksum."""

import time
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec

from tactile_rt.calibration import CalibratedSource, Calibration
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import ArraySpec, Source
from tactile_rt.drivers.device_source import device_of

LAYOUT_VERSION = "3"
METADATA, SESSION, SUMMARY, RECOVERED = "tactile_rt", "session", "summary", "recovered"


@dataclass(frozen=True)
class Description:
    """Origin of a recording: array, device, clock and calibration.

    Attributes:
        utc_offset_ns: UTC less the host's monotonic time when the recording began, ns.
        source: The URL of the source that was recorded, or the device's name.
        wire: ``serial`` or ``can``; empty if the source is no device, so no packets are recorded.
        codec: The name of the codec that the device spoke; empty without a device.
        codec_options: The options of the codec, as in a URL; paths are absolute.
        calibration: The calibration that was applied to the samples, not to the packets; None if
            the samples are as the codec decoded them.
        recovered: Whether the file was recovered after an interruption, and may have gaps.
    """

    spec: ArraySpec
    utc_offset_ns: int
    source: str = ""
    wire: str = ""
    codec: str = ""
    codec_options: Mapping[str, str] = field(default_factory=dict)
    clock: str = "host"  # "device": the device's own clock; "log": times of an imported log
    calibration: Calibration | None = None
    session: Mapping[str, str] = field(default_factory=dict)
    recovered: bool = False

    def to_metadata(self) -> dict[str, str]:
        """Return the sealed fields of the metadata record ``tactile_rt``, without session notes."""
        return seal(
            {
                "version": LAYOUT_VERSION,
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
        """Make a description from the fields that `to_metadata` returned.

        Raises:
            RecordingError: the metadata is damaged, or of another version.
        """
        version = fields.get("version")
        if version != LAYOUT_VERSION:
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
    """Return metadata fields with a checksum, which MCAP has only for chunks."""
    return {**fields, "crc32": _make_crc(fields)}


def unseal(what: str, fields: Mapping[str, str]) -> dict[str, str]:
    """Check the checksum of sealed fields; return the fields without it.

    Raises:
        RecordingError: the checksum does not fit the fields.
    """
    plain = {k: v for k, v in fields.items() if k != "crc32"}
    if fields.get("crc32") != _make_crc(plain):
        raise RecordingError(f"{what} is damaged: the checksum of its metadata is wrong")
    return plain


def _make_crc(fields: Mapping[str, str]) -> str:
    return f"{zlib.crc32(msgspec.json.encode(sorted(fields.items()))):08x}"


def utc_offset_ns() -> int:
    """Return the present UTC less the host's monotonic time, ns."""
    before = time.monotonic_ns()
    utc = time.time_ns()
    return utc - (before + time.monotonic_ns()) // 2


def describe(
    source: Source, url: str = "", session: Mapping[str, str] | None = None
) -> Description:
    """Return the description of a recording of a source that begins now."""
    notes = {**getattr(source, "notes", {}), **(session or {})}
    about = Description(source.spec, utc_offset_ns(), url, session=notes)
    device = device_of(source)
    if device is None:
        return about
    options = {
        # Paths become absolute: a recording is read from other folders than it was made in.
        name: str(Path(value).resolve()) if _is_file(value) else value
        for name, value in device.codec_options.items()
    }
    return replace(
        about, source=url or device.name, wire=device.codec.wire, codec=device.options.codec,
        codec_options=options, clock=device.options.clock,
        calibration=source.calibration if isinstance(source, CalibratedSource) else None,
    )  # fmt: skip


def _is_file(value: str) -> bool:
    try:
        return bool(value) and Path(value).is_file()
    except OSError:  # the name is too long: it is an array's JSON
        return False
