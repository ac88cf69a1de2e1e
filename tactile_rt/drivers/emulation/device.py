"""A device that is not there, with its line: plug it in, open its URL, pull it out.

with EmulatedSerial(source, "native") as device, open_source(device.url) as driver:
    chunk = driver.read(timeout=1.0)
    device.unplug()
"""

from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self
from urllib.parse import quote, urlencode

from tactile_rt.drivers.codec import Codec
from tactile_rt.drivers.emulation.emulator import Emulator
from tactile_rt.drivers.emulation.endpoints import (
    BusEndpoint,
    Endpoint,
    SerialEndpoint,
    SlcanEndpoint,
)
from tactile_rt.drivers.emulation.faults import FaultSchedule
from tactile_rt.drivers.opening import make_codec
from tactile_rt.stream import Source

__all__ = ["EmulatedCan", "EmulatedDevice", "EmulatedSerial"]


class EmulatedDevice:
    """An emulated device on a line that exists; a context manager, plugged in while entered.

    Attributes:
        codec: The codec that the device speaks; it also remembers what hosts have commanded.
        emulator: The emulator behind the line; its `log` tells what it did with each sample.

    Raises:
        ConfigError: The codec or one of its options is unknown.
    """

    wire: ClassVar[str]

    def __init__(
        self,
        source: Source,
        codec: str,
        endpoint: Endpoint[Any],
        *,
        options: dict[str, str] | None = None,
        faults: FaultSchedule | None = None,
        pace: str = "realtime",
        **emulator: Any,
    ) -> None:
        self._name, self._options = codec, dict(options or {})
        self.codec: Codec[Any] = make_codec(self.wire, codec, self._options)
        self.emulator = Emulator(self.codec, source, endpoint, faults, pace=pace, **emulator)

    @property
    def port(self) -> str:
        """What a program opens: a serial port's path, or INTERFACE:CHANNEL."""
        return self.emulator.address.partition(":")[2].removeprefix("//")

    @property
    def url(self) -> str:
        """What `open_source` opens: the line, the codec and its options."""
        # a + is a + in our URLs, not the space that web forms make of it
        query = urlencode({"codec": self._name, **self._options}, quote_via=quote)
        return f"{quote(self.emulator.address, safe=':/')}?{query}"

    def unplug(self) -> None:
        """Pull it out."""
        self.emulator.unplug()

    def replug(self, restart: bool = False) -> None:
        """Plug it in again; see `Emulator.replug`."""
        self.emulator.replug(restart)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until all is sent; whether it is."""
        return self.emulator.wait(timeout)

    def close(self) -> None:
        """Leave nothing behind; safe to call twice."""
        self.emulator.close()

    def __enter__(self) -> Self:
        self.emulator.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class EmulatedSerial(EmulatedDevice):
    """A device on a serial port: a pty, which any program can open. Unix only.

    Args:
        source: What the device measures.
        codec: Name of the codec that it speaks.
        link: A symbolic link to the port, so that the port has the same name when it is plugged
            in again; None: /dev/pts/N.
        options: Options of the codec, as in a URL.
        faults: What goes wrong on the line.
        pace: ``realtime``, or ``fast``: every sample is sent as soon as it is read.
        emulator: Further options of `Emulator`.
    """

    wire = "serial"

    def __init__(
        self,
        source: Source,
        codec: str = "native",
        *,
        link: str | Path | None = None,
        **further: Any,
    ) -> None:
        super().__init__(source, codec, SerialEndpoint(link), **further)


class EmulatedCan(EmulatedDevice):
    """A device on a CAN bus: behind an slcan adapter on a pty, or on a bus of python-can.

    Args:
        bus: ``INTERFACE:CHANNEL``, e.g. ``virtual:test``; None: slcan.
        fd: Whether to open that bus for CAN FD; None: if the codec's own option says so.

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
        **further: Any,
    ) -> None:
        if fd is None:
            fd = (options or {}).get("fd", "").lower() in ("1", "true")
        endpoint = SlcanEndpoint(link) if bus is None else BusEndpoint(bus, fd)
        super().__init__(source, codec, endpoint, options=options, **further)
