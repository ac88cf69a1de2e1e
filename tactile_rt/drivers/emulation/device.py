"""Emulated devices with their lines: plug one in, open its URL, pull it out.

with EmulatedSerial(source, "native") as device, open_source(device.url) as driver:
    chunk = driver.read(timeout=1.0)
    device.unplug()
"""

from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import quote, urlencode

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Source
from tactile_rt.drivers.codec import Codec, SerialCodec, codec_class
from tactile_rt.drivers.emulation.emulator import Emulator
from tactile_rt.drivers.emulation.endpoints import (
    BusEndpoint,
    Endpoint,
    SerialEndpoint,
    SlcanEndpoint,
)
from tactile_rt.drivers.emulation.faults import FaultSchedule
from tactile_rt.drivers.opening import make_codec

SPEEDS = ("baud", "bitrate")  # options for a line's speed; 0 for no limit


class EmulatedDevice(Emulator):
    """Emulated device on a real line; as a context manager, plugged in inside the block."""

    wire: ClassVar[str]
    paced: ClassVar[bool] = True  # whether its line has a speed in real time

    def __init__(
        self,
        source: Source,
        name: str,
        codec: Codec[Any],
        endpoint: Endpoint[Any],
        *,
        options: dict[str, str],
        faults: FaultSchedule | None = None,
        **emulator: Any,
    ) -> None:
        self._name, self._options = name, options
        like = getattr(source, "like", None)  # a synthetic source takes on the device's array
        if like is not None and codec.spec is not None:
            source = like(codec.spec)
        super().__init__(codec, source, endpoint, faults, **emulator)

    @property
    def port(self) -> str:
        """Name by which a program opens the line: a port's path, or INTERFACE:CHANNEL."""
        return self.address.partition(":")[2].removeprefix("//")

    @property
    def url(self) -> str:
        """URL for `open_source`: the line, the codec and its options."""
        # a + stays a + in our URLs, other than in web forms, where it is a space
        options = {k: v for k, v in self._options.items() if k not in SPEEDS or v != "0"}
        query = urlencode({"codec": self._name, **options}, quote_via=quote)
        return f"{quote(self.address, safe=':/')}?{query}"


def _make_codec_and_speed(
    wire: str, name: str, options: dict[str, str], speed: str
) -> tuple[Codec[Any], int | None]:
    """Return (codec, line speed in bit/s or None if not given) from a URL's options."""
    fields = dict(options)
    rate = None
    if speed in fields and speed not in codec_class(wire, name).Options.__dataclass_fields__:
        text = fields.pop(speed)
        if not text.isdecimal():
            raise ConfigError(f"{speed} must be a whole number, bit/s, not {text!r}")
        rate = int(text)
    return make_codec(wire, name, fields), rate


class EmulatedSerial(EmulatedDevice):
    """Emulated device on a serial port: a pty, which any program can open. Unix only.

    In real time, sending takes as long as at the line's speed, a packet that does not fit is not
    sent, and a host with another baud rate receives nonsense. A device on USB has no such speed,
    unless an option ``baud`` sets one; ``baud=0`` removes it.

    Args:
        link: A symbolic link to the port, so that the port has the same name when it is plugged
            in again; None for only /dev/pts/N.
        pace: ``realtime``, or ``fast``: every sample is sent as soon as it is read, over a line
            without a speed.
    """

    wire = "serial"

    def __init__(
        self,
        source: Source,
        codec: str = "native",
        *,
        link: str | Path | None = None,
        options: dict[str, str] | None = None,
        pace: str = "realtime",
        **further: Any,
    ) -> None:
        fields = dict(options or {})
        spoken, baud = _make_codec_and_speed("serial", codec, fields, "baud")
        assert isinstance(spoken, SerialCodec)
        if baud is None:
            baud = spoken.baud if self.paced and pace == "realtime" and not spoken.usb else 0
        endpoint = SerialEndpoint(link, baud=baud, parity=spoken.parity)
        super().__init__(source, codec, spoken, endpoint, options=fields, pace=pace, **further)


class EmulatedCan(EmulatedDevice):
    """Emulated device behind an slcan adapter on a pty, or on a bus of python-can.

    In real time, frames behind an slcan adapter take as long as on a bus of the bit rate that the
    host chose; with an option ``bitrate=0`` they take no time.

    Args:
        bus: ``INTERFACE:CHANNEL``, e.g. ``virtual:test``; None for an slcan adapter.
        fd: Whether to open that bus for CAN FD; None to follow the codec's option.

    The other arguments are those of `EmulatedSerial`.
    """

    wire = "can"

    def __init__(
        self,
        source: Source,
        codec: str = "native",
        *,
        bus: str | None = None,
        fd: bool | None = None,
        link: str | Path | None = None,
        options: dict[str, str] | None = None,
        pace: str = "realtime",
        **further: Any,
    ) -> None:
        fields = dict(options or {})
        spoken, bitrate = _make_codec_and_speed("can", codec, fields, "bitrate")
        if fd is None:
            fd = fields.get("fd", "").lower() in ("1", "true")
        if bitrate is None:
            paced = self.paced and pace == "realtime"
        else:
            paced = bitrate > 0
        endpoint: Endpoint[Any] = SlcanEndpoint(link, bitrate or None, paced=paced)
        if bus is not None:
            endpoint = BusEndpoint(bus, fd)
        super().__init__(source, codec, spoken, endpoint, options=fields, pace=pace, **further)
