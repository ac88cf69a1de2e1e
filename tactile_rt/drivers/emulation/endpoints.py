"""Endpoints of emulated devices on a line: a pty, an slcan adapter on a pty, or a CAN bus.

No endpoint waits for a reader: a packet that does not fit is refused as a whole.
"""

import abc
import random
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, Generic

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.drivers.codec import CanFrame, Packet
from tactile_rt.drivers.emulation.pseudo_terminal import Pty, Wire, bytes_s, frames_s
from tactile_rt.drivers.links import CanLink
from tactile_rt.drivers.slcan import SlcanAdapter

UART_BYTES = 4096  # capacity of a device's queue for its line
FIFO_BYTES = 1 << 20  # a second of 1 kHz x 850 B: a busy host machine is no fault of the device
LOOK_S = 0.005  # interval at which an absent bus is checked
WAIT_S = 0.05  # longest time until a wait on a bus notices that the device is closed
SEND_S = 0.05  # longest time that a bus may take to accept a frame
BUS_ERROR = 0x80  # slcan's status flag


class Endpoint(abc.ABC, Generic[Packet]):
    """Device's end of a line, by which an emulated device sends and receives.

    Attributes:
        address: URL that a host opens, without options; known once plugged in.
    """

    wire: ClassVar[str]
    address: str = ""

    @property
    @abc.abstractmethod
    def heard(self) -> bool:
        """Whether a host has opened the line."""

    @abc.abstractmethod
    def plug(self) -> None:
        """Connect the device to its line."""

    @abc.abstractmethod
    def pull(self) -> None:
        """Disconnect the device; unread data is lost."""

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> Packet:
        """Return a packet from the host, empty after the timeout; for one thread only."""

    @abc.abstractmethod
    def send(self, packet: Packet, answer: bool = False) -> bool:
        """Send or queue a packet; return False if there is no host or no room.

        Args:
            answer: Whether the packet answers a command: answers always have room.
        """

    @abc.abstractmethod
    def disturb(self, amount: int, draw: random.Random) -> None:
        """Send random bytes, on CAN in frames with unknown identifiers."""

    def error(self, frames: int) -> None:
        """Send this many CAN error frames."""

    def gather(self, seconds: float) -> None:
        """Set the interval at which the adapter passes on data, s; 0 for no delay."""

    @property
    def backlog(self) -> int:
        """Number of bytes accepted and not yet sent."""
        return 0

    def wake(self) -> None:
        """Make a `receive` that waits in another thread return."""

    def close(self) -> None:
        """Disconnect the device for good; safe to call twice."""
        self.pull()


class _PtyEndpoint(Endpoint[Packet]):
    """Base of endpoints on a pty."""

    def __init__(
        self, link: str | Path | None, fifo_bytes: int, wire: Wire | None = None, baud: int = 0
    ) -> None:
        self.pty = Pty(link, fifo_bytes if wire is None else UART_BYTES, wire, baud)

    @property
    def heard(self) -> bool:
        return self.pty.heard

    @property
    def backlog(self) -> int:
        return self.pty.queued

    def gather(self, seconds: float) -> None:
        self.pty.gather(seconds)

    def pull(self) -> None:
        self.pty.pull()

    def wake(self) -> None:
        self.pty.wake()

    def close(self) -> None:
        self.pty.close()


class SerialEndpoint(_PtyEndpoint[bytes]):
    """Endpoint on a serial port, which is a pty.

    Args:
        link: Another name of the port, in addition to /dev/pts/N.
        fifo_bytes: Number of bytes that the port queues for a host that does not read.
        baud: Speed of the line, bit/s, which delays the data; a host with another speed receives
            nonsense. 0 for a line without a speed, such as USB.
    """

    wire = "serial"

    def __init__(
        self,
        link: str | Path | None = None,
        fifo_bytes: int = FIFO_BYTES,
        baud: int = 0,
        parity: str = "N",
    ) -> None:
        super().__init__(link, fifo_bytes, Wire() if baud else None, baud)
        self._byte_s = bytes_s(1, baud, parity) if baud else 0.0

    def plug(self) -> None:
        self.pty.plug()
        self.address = f"serial://{self.pty.name}"

    def receive(self, timeout_s: float) -> bytes:
        return self.pty.read(timeout_s)

    def send(self, packet: bytes, answer: bool = False) -> bool:
        return self.pty.write(packet, answer, len(packet) * self._byte_s)

    def disturb(self, amount: int, draw: random.Random) -> None:
        self.send(draw.randbytes(amount))


class SlcanEndpoint(_PtyEndpoint[Sequence[CanFrame]]):
    """Endpoint on a CAN bus behind an slcan adapter on a pty.

    Args:
        bitrate: Speed of the bus, bit/s; a host that chooses another speed receives nothing. None
            accepts any.
        paced: Whether frames take as long as on a bus of the host's bit rate.
    """

    wire = "can"

    def __init__(
        self,
        link: str | Path | None = None,
        bitrate: int | None = None,
        fifo_bytes: int = FIFO_BYTES,
        paced: bool = False,
    ) -> None:
        super().__init__(link, fifo_bytes, Wire() if paced else None)
        self._bitrate = bitrate
        self.adapter = SlcanAdapter(bitrate)

    @property
    def heard(self) -> bool:
        return self.pty.heard and self.adapter.hears

    def plug(self) -> None:
        self.adapter = SlcanAdapter(self._bitrate)  # a new one, since the port powers it
        self.pty.plug()
        self.address = f"can:slcan:{self.pty.name}"

    def receive(self, timeout_s: float) -> Sequence[CanFrame]:
        data = self.pty.read(timeout_s)
        if not data:
            return []
        with self.pty.lock:  # no data may come between a command and its answer
            answer, frames = self.adapter.respond(data)
            self.pty.write(answer, answer=True)
        return frames

    def send(self, packet: Sequence[CanFrame], answer: bool = False) -> bool:
        with self.pty.lock:
            data = self.adapter.encode(packet, time.monotonic_ns())
            takes_s = frames_s(packet, self.adapter.bitrate, self.adapter.data_bitrate)
            return bool(data) and self.pty.write(data, answer, takes_s)

    def disturb(self, amount: int, draw: random.Random) -> None:
        # with an end of line, so that the next frame is a line of its own
        if self.adapter.hears:
            self.pty.write(draw.randbytes(amount) + b"\r")

    def error(self, frames: int) -> None:
        self.adapter.flags |= BUS_ERROR


class BusEndpoint(Endpoint[Sequence[CanFrame]]):
    """Endpoint on a bus of python-can."""

    wire = "can"

    def __init__(self, name: str, fd: bool = False, bitrate: int = 1_000_000) -> None:
        self._interface, _, self._channel = name.partition(":")
        if not self._channel:
            raise ConfigError(f"bus {name!r} is not INTERFACE:CHANNEL, e.g. virtual:test")
        self.address = f"can:{name}"
        self._fd, self._bitrate = fd, bitrate
        self._link: CanLink | None = None

    @property
    def heard(self) -> bool:
        # a virtual bus knows its participants; on others a host is assumed
        link = self._link
        return link is not None and (self._interface != "virtual" or len(link.bus.channel) > 1)

    def plug(self) -> None:
        if self._link is None:
            try:
                self._link = CanLink(
                    self._interface, self._channel, self._bitrate, self._fd, patience_s=SEND_S
                )
            except SourceError as error:
                raise ConfigError(str(error)) from None

    def pull(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def receive(self, timeout_s: float) -> Sequence[CanFrame]:
        link = self._link
        if link is None:
            time.sleep(min(timeout_s, LOOK_S))
            return []
        try:
            found = link.receive(min(timeout_s, WAIT_S))
        except SourceError:
            time.sleep(LOOK_S)  # pulled out by now, or the bus is off
            return []
        return found[0] if found else []

    def send(self, packet: Sequence[CanFrame], answer: bool = False) -> bool:
        link = self._link
        if link is None or not self.heard:
            return False
        with suppress(SourceError):
            link.send(packet)
            return True
        return False

    def disturb(self, amount: int, draw: random.Random) -> None:
        for _ in range(-(-amount // 8)):  # 29 bits: no codec here has such identifiers
            self.send([CanFrame(1 << 28 | draw.getrandbits(28), draw.randbytes(8), extended=True)])

    def error(self, frames: int) -> None:
        import can

        if self._link is not None and self.heard:
            with suppress(can.CanError, OSError, ValueError):
                for _ in range(frames):
                    self._link.bus.send(can.Message(is_error_frame=True), timeout=SEND_S)
