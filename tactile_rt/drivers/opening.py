"""Opening of devices from `serial:` and `can:` URLs.

serial:///dev/ttyUSB0?codec=bota            can:socketcan:can0?codec=xela
serial:socket://10.0.0.7:4000?codec=native  can:slcan:/dev/ttyACM0?codec=native&bitrate=1000000
serial:COM3?codec=ascii_line&baud=9600      can:virtual:test?codec=can-dbc&mapping=glove.toml
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from tactile_rt.calibration import (
    CalibratedSource,
    Calibration,
    declare,
    declare_calibration,
    load_calibration,
)
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import no_such, split_url, take_options
from tactile_rt.core.stream import ArraySpec, Source
from tactile_rt.drivers.codec import CanCodec, Codec, SerialCodec, codec_class
from tactile_rt.drivers.device_source import DeviceOptions, DeviceSource
from tactile_rt.drivers.links import CanLink, Link, SerialLink, SlcanLink


@dataclass(frozen=True)
class Prepared:
    """A source that can be opened, with its array if known in advance.

    Attributes:
        spec: The array that the samples will be of; None if the device must describe it.
        told: Whether the user declared the array of a device that would otherwise describe it;
            the samples are then of that array before any calibration.
    """

    spec: ArraySpec | None
    open: Callable[[], Source]
    told: bool = False

    def with_calibration(self, calibration: Calibration) -> "Prepared":
        """Return a copy whose samples are corrected by a calibration.

        Raises:
            SpecMismatch: the calibration is of another device.
        """
        spec = self.spec and calibration.output_spec(self.spec)
        opened = self._open_then(lambda source: CalibratedSource(source, calibration))
        return Prepared(spec, opened, self.told)

    def with_array(self, array: ArraySpec) -> "Prepared":
        """Return a copy whose samples are declared to be of this array; see `declare`."""
        if self.told:
            return self
        known = self.spec
        spec = declare_calibration(known, array).output_spec(known) if known else array
        return Prepared(spec, self._open_then(lambda source: declare(source, array)))

    def _open_then(self, change: Callable[[Source], Source]) -> Callable[[], Source]:
        def open_changed() -> Source:
            source = self.open()
            try:
                return change(source)
            except BaseException:
                source.close()
                raise

        return open_changed


@dataclass(frozen=True)
class SerialOptions(DeviceOptions):
    """Options of ``serial:`` in addition to those of the codec.

    Attributes:
        baud: Speed of the line, bit/s; 0 for the codec's default.
        parity: Parity of the line, ``N``, ``E`` or ``O``; empty for the codec's default.
        dtr: Whether to assert DTR; many boards reset when it rises.
    """

    baud: int = 0
    parity: str = ""
    dtr: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.parity not in ("", "N", "E", "O"):
            raise ConfigError(f"parity must be N, E or O, not {self.parity!r}")
        if self.baud < 0:
            raise ConfigError(f"baud must be 0 or more, not {self.baud}")


@dataclass(frozen=True)
class CanOptions(DeviceOptions):
    """Options of ``can:`` in addition to those of the codec.

    Attributes:
        bitrate: Speed of the bus, bit/s; 0 for the codec's default.
        fd: Whether to open the bus for CAN FD.
        data_bitrate: Speed of the data phase of CAN FD, bit/s; 0 for the codec's default.
    """

    bitrate: int = 0
    fd: bool = False
    data_bitrate: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("bitrate", "data_bitrate"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")


def make_codec(wire: str, name: str, fields: dict[str, str]) -> Codec[Any]:
    """Return a codec with options as written in a URL."""
    kind = codec_class(wire, name)
    (options,) = take_options(f"codec {name}", fields, kind.Options)
    made: Codec[Any] = kind(options)
    return made


def prepare_serial(target: str, fields: dict[str, str], array: ArraySpec | None = None) -> Prepared:
    """Prepare the device on a serial port for opening.

    Args:
        array: Array to assume for a device that would otherwise describe itself; None asks it.

    Raises:
        ConfigError: wrong options. Opening the result raises `SourceError` if the port cannot be
            opened or the device does not send.
        SpecMismatch: the calibration is of another device.
    """
    if not target:
        raise ConfigError("serial: needs a port, e.g. serial:///dev/ttyUSB0?codec=bota")
    kind = _find_codec_class("serial", target, fields)
    assert issubclass(kind, SerialCodec)
    options, own = take_options(f"serial:{target}", fields, SerialOptions, kind.Options)
    codec = kind(own)
    baud, parity = options.baud or codec.baud, options.parity or codec.parity
    connect = partial(SerialLink, target, baud, parity, options.dtr)
    return _prepare(connect, codec, options, target, fields, array)


def prepare_can(target: str, fields: dict[str, str], array: ArraySpec | None = None) -> Prepared:
    """Prepare the device on a CAN bus for opening.

    Args:
        target: interface and channel, such as ``socketcan:can0``.

    Raises:
        ConfigError: wrong options. Opening the result raises `SourceError` if the bus cannot be
            opened or the device does not send.
    """
    from can import VALID_INTERFACES

    interface, _, channel = target.partition(":")
    if not channel:
        raise ConfigError(
            f"can:{target} needs an interface and a channel, e.g. can:socketcan:can0?codec=xela"
        )
    kind = _find_codec_class("can", target, fields)
    assert issubclass(kind, CanCodec)
    if interface not in VALID_INTERFACES:
        raise ConfigError(
            f"can:{target}: {no_such('interface', interface, sorted(VALID_INTERFACES))}"
        )
    # `fd` may be set by an option of the bus or of the codec
    options, own = take_options(f"can:{target}", fields, CanOptions, kind.Options)
    fd = options.fd or bool(getattr(own, "fd", False))
    speeds = kind.bitrate, kind.data_bitrate
    connect = partial(_open_bus, interface, channel, options, fd, speeds)
    return _prepare(connect, kind(own), options, target, fields, array)


def _open_bus(
    interface: str, channel: str, options: CanOptions, fd: bool, speeds: tuple[int, int | None]
) -> Link[Any]:
    bitrate = options.bitrate or speeds[0]
    if interface == "slcan":
        return SlcanLink(channel, bitrate)
    return CanLink(interface, channel, bitrate, fd, options.data_bitrate or speeds[1])


def open_line(url: str) -> Link[Any]:
    """Open the line of a ``serial:`` or ``can:`` URL, to receive raw packets.

    Args:
        url: URL of a source; only the options of the line have an effect.

    Raises:
        ConfigError: another scheme, or a wrong option.
    """
    scheme, target, fields = split_url(url)
    fields = {"codec": "", **fields}
    if scheme == "serial":
        (serial,) = take_options(f"serial:{target}", fields, SerialOptions)
        return SerialLink(target, serial.baud or SerialCodec.baud, serial.parity or "N", serial.dtr)
    interface, _, channel = target.partition(":")
    if scheme != "can" or not channel:
        raise ConfigError(
            f"{url!r} is not a line: use serial:PORT?baud=... or can:INTERFACE:CHANNEL"
        )
    (can,) = take_options(f"can:{target}", fields, CanOptions)
    speeds = CanCodec.bitrate, CanCodec.data_bitrate
    return _open_bus(interface, channel, can, can.fd, speeds)


def _find_codec_class(wire: str, target: str, fields: dict[str, str]) -> type[Codec[Any]]:
    if "codec" not in fields:
        raise ConfigError(
            f"{wire}:{target} needs codec=...: what the device speaks, see `tactile-rt codecs`"
        )
    return codec_class(wire, fields["codec"])


def _prepare(
    connect: Callable[[], Link[Any]],
    codec: Codec[Any],
    options: DeviceOptions,
    name: str,
    fields: dict[str, str],
    array: ArraySpec | None,
) -> Prepared:
    """Prepare a source, and read its calibration file; opening the result opens the line."""
    written = {k: v for k, v in fields.items() if k in codec.Options.__dataclass_fields__}
    declared_array = array if codec.spec is None else None
    if declared_array is not None:
        codec.spec = declared_array
        written["array"] = declared_array.to_json()  # needed to decode a recording's packets
    opened = partial(DeviceSource, connect, codec, options, name, written)
    prepared = Prepared(codec.spec, opened, declared_array is not None)
    if not options.calibration:
        return prepared
    return prepared.with_calibration(load_calibration(options.calibration))
