"""Lines to devices: a serial port, a CAN bus. Bytes or frames out and in, nothing else."""

import abc
import errno
import math
import os
import select
import time
from collections.abc import Sequence
from typing import Any, Generic

from tactile_rt.core.errors import ConfigError, SourceError, describe_error
from tactile_rt.drivers.codec import CanFrame, Packet
from tactile_rt.drivers.slcan import SlcanDecoder, closing, encode, opening

READ_BYTES = 65_536
TERMINAL_BYTES = 4095  # that Linux's terminals give at most at a time
STALLED_S = 0.15  # for so long nobody looked: what has come meanwhile is one packet
MOST_FRAMES = 512  # taken from a bus at a time
WAIT_S = 0.05  # how soon a line without a descriptor looks for the end of the wait


class Link(abc.ABC, Generic[Packet]):
    """A line to a device; opened when made."""

    name: str
    can_errors = 0
    usb_number = ""  # serial number of the USB device that the line ends in; empty: unknown

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> tuple[Packet, int] | None:
        """What has arrived and when (host time, ns), or None when nothing came in time.

        Raises:
            SourceError: the line is gone.
        """

    @abc.abstractmethod
    def send(self, packet: Packet) -> None:
        """Send; waits a moment where the line is full.

        Raises:
            SourceError: the line is gone, or full for too long.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Release the line; safe to call twice."""

    def fileno(self) -> int:
        """The descriptor that is readable when something has arrived; -1: there is none."""
        return -1


class SerialLink(Link[bytes]):
    """Any port that pyserial opens: a device, a pty, ``socket://``, ``rfc2217://``.

    Args:
        baud: Speed of the line, bit/s.
        dtr: Whether to assert DTR; boards that reset when DTR rises are left alone with False.
    """

    def __init__(self, port: str, baud: int, parity: str = "N", dtr: bool = True) -> None:
        import serial

        self.name = port
        # a pty forgets parity and then refuses to be opened with it again
        self._pty = os.path.realpath(port).startswith("/dev/pts/")
        if self._pty:
            parity = "N"
        try:
            self._port: Any = serial.serial_for_url(
                port, baudrate=baud, parity=parity, timeout=WAIT_S, do_not_open=True,
                **({} if "://" in port else {"exclusive": True, "write_timeout": 1.0}),
            )  # fmt: skip
            if not dtr:
                self._port.dtr = False
            self._port.open()
        except (OSError, ValueError, AttributeError) as error:
            raise SourceError(f"{port}: {_why(port, error)}") from None
        self.usb_number = _usb_number(os.path.realpath(port))
        self._looked_s = math.inf
        try:
            self._fd: int | None = self._port.fileno()
            self._terminal, self._blocks = os.isatty(self._fd), os.get_blocking(self._fd)
            self._poll = select.poll()
            self._poll.register(self._fd, select.POLLIN)
        except Exception:  # each pyserial handler without one says so in its own way
            self._fd = None

    def receive(self, timeout_s: float) -> tuple[bytes, int] | None:
        stalled = time.monotonic() - self._looked_s > STALLED_S
        try:
            if self._fd is None:
                return self._receive_slowly(timeout_s)
            if timeout_s > 0 or self._blocks:
                if not self._poll.poll(1e3 * max(timeout_s, 0.0)):
                    return None
            data = self._read(self._fd, stalled)
            if not data and timeout_s <= 0 and self._terminal and not self._hung_up():
                return None  # a terminal that has nothing gives nothing; it may have by now
        except BlockingIOError:
            return None
        except (OSError, ValueError, TypeError) as error:  # closed meanwhile, or unplugged
            raise SourceError(f"{self.name}: the line is gone ({_reason(error)})") from None
        finally:
            self._looked_s = time.monotonic()
        if not data:
            raise SourceError(f"{self.name}: the line is gone (unplugged, or hung up)")
        return data, time.monotonic_ns()

    def _read(self, fd: int, whole: bool) -> bytes:
        """Read what has come, or a part of it.

        The parts of a backlog, after nobody looked, would be dated as if they came one by one.
        """
        data = newest = os.read(fd, READ_BYTES)
        while whole and len(newest) >= TERMINAL_BYTES and len(data) < READ_BYTES:
            try:
                if not self._poll.poll(0):
                    break
                newest = os.read(fd, READ_BYTES)
            except OSError:
                break  # the next call meets it, too
            data += newest
        return data

    def _hung_up(self) -> bool:
        return any(events & ~select.POLLIN for _, events in self._poll.poll(0))

    def _receive_slowly(self, timeout_s: float) -> tuple[bytes, int] | None:
        end = time.monotonic() + timeout_s
        while True:
            data = self._port.read(max(1, self._port.in_waiting))
            if data:
                return bytes(data), time.monotonic_ns()
            if time.monotonic() >= end:
                return None

    def retune(self, baud: int, parity: str = "N") -> None:
        """Go on at another speed, with what had come at the last one thrown away.

        Raises:
            SourceError: the port cannot have it, or is gone.
        """
        try:
            self._port.baudrate = baud
            if not self._pty:
                self._port.parity = parity
            self._port.reset_input_buffer()
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise SourceError(f"{self.name}: not at {baud} bit/s ({_reason(error)})") from None

    def send(self, packet: bytes) -> None:
        try:
            self._port.write(packet)
        except (OSError, ValueError, TypeError) as error:
            raise SourceError(f"{self.name}: cannot be written to ({_reason(error)})") from None

    def close(self) -> None:
        self._fd = None
        try:
            self._port.close()
        except (OSError, TypeError):
            pass  # it is gone, which is what we want

    def fileno(self) -> int:
        return -1 if self._fd is None else self._fd


def convert_message(message: Any) -> CanFrame:
    """Convert a message of python-can."""
    return CanFrame(
        message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_fd,
        message.is_remote_frame,
    )  # fmt: skip


class CanLink(Link[Sequence[CanFrame]]):
    """Any interface of python-can: socketcan, pcan, kvaser, virtual, ...

    Args:
        interface: Name that python-can has for the interface, such as ``socketcan``.
        channel: Which bus of that interface, such as ``can0``.
        bitrate: Speed of the bus, bit/s.
        data_bitrate: Speed of the data phase of CAN FD, bit/s.
        patience_s: Longest time that the bus may take to take a frame, s.
    """

    def __init__(
        self, interface: str, channel: str, bitrate: int, fd: bool, data_bitrate: int | None = None,
        patience_s: float = 1.0,
    ) -> None:  # fmt: skip
        import can

        self.name, self._patience_s = f"{interface}:{channel}", patience_s
        wanted: dict[str, Any] = {"fd": True, "data_bitrate": data_bitrate} if fd else {}
        if interface == "virtual":
            wanted = {"protocol": can.CanProtocol.CAN_FD} if fd else {}
        try:
            self.bus: Any = can.Bus(channel, interface, bitrate=bitrate, **wanted)
        except can.CanInterfaceNotImplementedError as error:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise ConfigError(
                f"can:{self.name}: {_reason(error)}; python-can knows {known}"
            ) from None
        except (can.CanError, OSError, ValueError, ImportError, NotImplementedError) as error:
            raise SourceError(f"can:{self.name}: {_why_bus(channel, error)}") from None

    def receive(self, timeout_s: float) -> tuple[Sequence[CanFrame], int] | None:
        import can

        frames: list[CanFrame] = []
        try:
            message = self.bus.recv(timeout_s)
            while message is not None:
                if message.is_error_frame:
                    self.can_errors += 1
                else:
                    frames.append(convert_message(message))
                message = self.bus.recv(0) if len(frames) < MOST_FRAMES else None
        except (can.CanError, OSError, ValueError) as error:
            if self._off():
                raise SourceError(
                    f"can:{self.name}: the controller is bus-off after too many errors: check "
                    "bit rate, termination and wiring"
                ) from None
            raise SourceError(f"can:{self.name}: the bus is gone ({_reason(error)})") from None
        return (frames, time.monotonic_ns()) if frames else None

    def send(self, packet: Sequence[CanFrame]) -> None:
        import can

        try:
            for f in packet:
                self.bus.send(
                    can.Message(
                        arbitration_id=f.id, data=f.data, is_extended_id=f.extended, is_fd=f.fd,
                        bitrate_switch=f.fd, is_remote_frame=f.remote,
                    ),
                    timeout=self._patience_s,
                )  # fmt: skip
        except (can.CanError, OSError, ValueError) as error:
            raise SourceError(f"can:{self.name}: cannot send ({_reason(error)})") from None

    def close(self) -> None:
        import can

        try:
            self.bus.shutdown()
        except (can.CanError, OSError):
            pass  # it is gone, which is what we want

    def _off(self) -> bool:
        import can

        try:
            return bool(self.bus.state == can.BusState.ERROR)
        except (NotImplementedError, can.CanError, OSError):
            return False


class SlcanLink(Link[Sequence[CanFrame]]):
    """A CAN adapter that speaks slcan (LAWICEL) over a serial port.

    python-can speaks it too, byte by byte: 5,500 frames/s where a saturated bus carries 9,000.
    """

    def __init__(self, port: str, bitrate: int) -> None:
        self._decoder = SlcanDecoder()
        self._serial = SerialLink(port, 115200)
        self.name = f"slcan:{port}"
        for command in opening(bitrate):
            self._serial.send(command)

    def receive(self, timeout_s: float) -> tuple[Sequence[CanFrame], int] | None:
        end = time.monotonic() + timeout_s
        while True:
            found = self._serial.receive(max(0.0, end - time.monotonic()))
            if found is None:
                return None
            frames = self._decoder.feed(found[0])
            if frames:
                return frames, found[1]

    def send(self, packet: Sequence[CanFrame]) -> None:
        self._serial.send(encode(packet))

    def close(self) -> None:
        try:
            self._serial.send(closing())
        except SourceError:
            pass  # it is gone, which is what we want
        self._serial.close()

    def fileno(self) -> int:
        return self._serial.fileno()


def _usb_number(path: str) -> str:
    if not path.startswith(("/dev/ttyUSB", "/dev/ttyACM")):
        return ""
    from serial.tools import list_ports

    return next((p.serial_number or "" for p in list_ports.comports() if p.device == path), "")


def _reason(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return describe_error(error)


def _why(port: str, error: Exception) -> str:
    """Why a serial port cannot be opened, and what to do."""
    number = getattr(error, "errno", None)
    text = _reason(error)
    if number == errno.ENOENT or "No such file" in text:
        return "no such port: is it plugged in? `tactile-rt list` shows what there is"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission: `tactile-rt doctor` tells how to get it (group dialout, as a rule)"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return "in use by another program: close that first"
    if number in (errno.ENOTTY, errno.EISDIR, errno.EINVAL) or "configure port" in text:
        return f"not a serial port, or not at this baud rate ({text})"
    return f"cannot be opened ({text})"


def _why_bus(channel: str, error: Exception) -> str:
    text = _reason(error)
    if getattr(error, "errno", None) == errno.ENODEV or "No such device" in text:
        return (
            f"no such bus: `ip link show {channel}`; bring it up with "
            f"`sudo ip link set {channel} up type can bitrate ...`"
        )
    return f"cannot be opened ({text}); `tactile-rt doctor` looks for the cause"
