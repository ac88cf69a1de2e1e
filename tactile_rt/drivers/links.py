"""Links to devices over serial ports and CAN buses, which only move bytes or frames."""

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
TERMINAL_BYTES = 4095  # most that a Linux terminal returns in one read
STALLED_S = 0.15  # since the last read, after which all waiting bytes are read as one packet
MOST_FRAMES = 512  # taken from a bus at a time
WAIT_S = 0.05  # longest read of a line without a descriptor, before it checks the time


class Link(abc.ABC, Generic[Packet]):
    """A line to a device, which the constructor opens."""

    name: str
    can_errors = 0
    usb_number = ""  # serial number of the line's USB device; empty if unknown

    @abc.abstractmethod
    def receive(self, timeout_s: float) -> tuple[Packet, int] | None:
        """Return (packet, host time of arrival in ns), or None if nothing came in time.

        Raises:
            SourceError: the line is gone.
        """

    @abc.abstractmethod
    def send(self, packet: Packet) -> None:
        """Send a packet; wait a moment if the line is full.

        Raises:
            SourceError: the line is gone, or full for too long.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Close the line; safe to call twice."""

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when input arrives; -1 if none exists."""
        return -1


class SerialLink(Link[bytes]):
    """Link over any port that pyserial opens: a device, a pty, ``socket://``, ``rfc2217://``.

    Args:
        baud: Speed of the line, bit/s.
        dtr: Whether to assert DTR; boards that reset when DTR rises are left alone with False.
    """

    def __init__(self, port: str, baud: int, parity: str = "N", dtr: bool = True) -> None:
        import serial

        self.name = port
        # a pty does not keep a parity and then refuses to be opened with it again
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
            raise SourceError(f"{port}: {_explain_port_error(port, error)}") from None
        self.usb_number = _find_usb_number(os.path.realpath(port))
        self._last_read_s = math.inf
        try:
            self._fd: int | None = self._port.fileno()
            self._terminal, self._blocks = os.isatty(self._fd), os.get_blocking(self._fd)
            self._poll = select.poll()
            self._poll.register(self._fd, select.POLLIN)
        except Exception:  # pyserial's handlers without a descriptor raise different errors
            self._fd = None

    def receive(self, timeout_s: float) -> tuple[bytes, int] | None:
        stalled = time.monotonic() - self._last_read_s > STALLED_S
        try:
            if self._fd is None:
                return self._receive_slowly(timeout_s)
            if timeout_s > 0 or self._blocks:
                if not self._poll.poll(1e3 * max(timeout_s, 0.0)):
                    return None
            data = self._read(self._fd, stalled)
            if not data and timeout_s <= 0 and self._terminal and not self._has_hung_up():
                return None  # an empty read of a terminal that has not hung up: no input
        except BlockingIOError:
            return None
        except (OSError, ValueError, TypeError) as error:  # closed by now, or unplugged
            raise SourceError(f"{self.name}: the line is gone ({_explain(error)})") from None
        finally:
            self._last_read_s = time.monotonic()
        if not data:
            raise SourceError(f"{self.name}: the line is gone (unplugged, or hung up)")
        return data, time.monotonic_ns()

    def _read(self, fd: int, whole: bool) -> bytes:
        """Read waiting bytes; if `whole`, read until none wait or `READ_BYTES` are read.

        A backlog that is read in parts would be dated as if its parts had arrived one by one.
        """
        data = newest = os.read(fd, READ_BYTES)
        while whole and len(newest) >= TERMINAL_BYTES and len(data) < READ_BYTES:
            try:
                if not self._poll.poll(0):
                    break
                newest = os.read(fd, READ_BYTES)
            except OSError:
                break  # the next call raises it, too
            data += newest
        return data

    def _has_hung_up(self) -> bool:
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
        """Change the speed and parity; discard input received before.

        Raises:
            SourceError: the port does not support the speed, or is gone.
        """
        try:
            self._port.baudrate = baud
            if not self._pty:
                self._port.parity = parity
            self._port.reset_input_buffer()
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise SourceError(f"{self.name}: not at {baud} bit/s ({_explain(error)})") from None

    def send(self, packet: bytes) -> None:
        try:
            self._port.write(packet)
        except (OSError, ValueError, TypeError) as error:
            raise SourceError(f"{self.name}: cannot be written to ({_explain(error)})") from None

    def close(self) -> None:
        self._fd = None
        try:
            self._port.close()
        except (OSError, TypeError):
            pass  # the port is gone already

    def fileno(self) -> int:
        return -1 if self._fd is None else self._fd


def convert_message(message: Any) -> CanFrame:
    """Convert a message of python-can to a `CanFrame`."""
    return CanFrame(
        message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_fd,
        message.is_remote_frame,
    )  # fmt: skip


class CanLink(Link[Sequence[CanFrame]]):
    """Link over any interface of python-can: socketcan, pcan, kvaser, virtual, ...

    Args:
        interface: Name of the interface in python-can, such as ``socketcan``.
        channel: Bus of that interface, such as ``can0``.
        bitrate: Speed of the bus, bit/s.
        data_bitrate: Speed of the data phase of CAN FD, bit/s.
        patience_s: Longest time that the bus may take to accept a frame, s.
    """

    def __init__(
        self, interface: str, channel: str, bitrate: int, fd: bool, data_bitrate: int | None = None,
        patience_s: float = 1.0,
    ) -> None:  # fmt: skip
        import can

        self.name, self._patience_s = f"{interface}:{channel}", patience_s
        options: dict[str, Any] = {"fd": True, "data_bitrate": data_bitrate} if fd else {}
        if interface == "virtual":
            options = {"protocol": can.CanProtocol.CAN_FD} if fd else {}
        try:
            self.bus: Any = can.Bus(channel, interface, bitrate=bitrate, **options)
        except can.CanInterfaceNotImplementedError as error:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise ConfigError(
                f"can:{self.name}: {_explain(error)}; python-can knows {known}"
            ) from None
        except (can.CanError, OSError, ValueError, ImportError, NotImplementedError) as error:
            raise SourceError(f"can:{self.name}: {_explain_bus_error(channel, error)}") from None

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
            if self._is_bus_off():
                raise SourceError(
                    f"can:{self.name}: the controller is bus-off after too many errors: check "
                    "bit rate, termination and wiring"
                ) from None
            raise SourceError(f"can:{self.name}: the bus is gone ({_explain(error)})") from None
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
            raise SourceError(f"can:{self.name}: cannot send ({_explain(error)})") from None

    def close(self) -> None:
        import can

        try:
            self.bus.shutdown()
        except (can.CanError, OSError):
            pass  # the bus is gone already

    def _is_bus_off(self) -> bool:
        import can

        try:
            return bool(self.bus.state == can.BusState.ERROR)
        except (NotImplementedError, can.CanError, OSError):
            return False


class SlcanLink(Link[Sequence[CanFrame]]):
    """Link over a CAN adapter that speaks slcan (LAWICEL) on a serial port.

    python-can reads it, too, but byte by byte: 5,500 frames/s, while a full bus carries 9,000.
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
            pass  # the port is gone already
        self._serial.close()

    def fileno(self) -> int:
        return self._serial.fileno()


def _find_usb_number(path: str) -> str:
    if not path.startswith(("/dev/ttyUSB", "/dev/ttyACM")):
        return ""
    from serial.tools import list_ports

    return next((p.serial_number or "" for p in list_ports.comports() if p.device == path), "")


def _explain(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return describe_error(error)


def _explain_port_error(port: str, error: Exception) -> str:
    """Explain why a serial port cannot be opened, and what to do."""
    number = getattr(error, "errno", None)
    text = _explain(error)
    if number == errno.ENOENT or "No such file" in text:
        return "no such port: is it plugged in? `tactile-rt list` shows what there is"
    if number in (errno.EACCES, errno.EPERM):
        return "no permission: `tactile-rt doctor` says how to get it (group dialout, as a rule)"
    if number in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return "in use by another program: close that first"
    if number in (errno.ENOTTY, errno.EISDIR, errno.EINVAL) or "configure port" in text:
        return f"not a serial port, or not at this baud rate ({text})"
    return f"cannot be opened ({text})"


def _explain_bus_error(channel: str, error: Exception) -> str:
    text = _explain(error)
    if getattr(error, "errno", None) == errno.ENODEV or "No such device" in text:
        return (
            f"no such bus: `ip link show {channel}`; bring it up with "
            f"`sudo ip link set {channel} up type can bitrate ...`"
        )
    return f"cannot be opened ({text}); `tactile-rt doctor` looks for the cause"
