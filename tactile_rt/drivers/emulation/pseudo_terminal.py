"""Pseudo-terminal as a device's port: raw, named, never blocking; it can be unplugged.

Data arrives at the host as late as over a line of the device's speed. Sources: the frame
of a UART (a start bit, eight bits, the lowest first, an optional parity bit, a stop bit); ISO
11898-1 for the bits of a CAN frame, without stuff bits, as in docs/reference/native-protocol.md.
"""

import fcntl
import itertools
import math
import os
import pty
import select
import struct
import sys
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from tactile_rt.core.errors import ConfigError
from tactile_rt.drivers.codec import CanFrame

STANDARD, EXTENDED = 47, 67  # bits of a frame without its data, with the gap to the next
FD_SLOW, FD_SLOW_EXTENDED = 30, 49  # bits of CAN FD at the arbitration speed
FD_FAST, FD_FAST_LONG = 31, 36  # bits at the data speed: up to 16 bytes, and more
LONG: Final = 16


class Wire:
    """Timing of a line that transmits one packet after another.

    Attributes:
        gather_s: Time for which an adapter gathers input before it passes it on, s: 1 ms for USB,
            16 ms for FTDI adapters by default.
    """

    def __init__(self) -> None:
        self.gather_s = 0.0
        self._free_at = -math.inf

    def heard_at(self, takes_s: float, now: float) -> float:
        """Return the arrival time, s, of data sent now that takes `takes_s` to send.

        Args:
            now: present time, s, on a monotonic clock.
        """
        self._free_at = max(self._free_at, now) + takes_s
        if self.gather_s:
            return math.ceil(self._free_at / self.gather_s) * self.gather_s
        return self._free_at


def bytes_s(n: int, baud: int, parity: str = "N") -> float:
    """Return the time that n bytes take on a serial line, s."""
    return n * (10 if parity == "N" else 11) / baud


def frames_s(frames: Sequence[CanFrame], bitrate: int, data_bitrate: int | None = None) -> float:
    """Return the time that frames take on a CAN bus, s."""
    slow = fast = 0
    for frame in frames:
        n = 0 if frame.remote else len(frame.data)
        if frame.fd:
            slow += FD_SLOW_EXTENDED if frame.extended else FD_SLOW
            fast += (FD_FAST if n <= LONG else FD_FAST_LONG) + 8 * n
        else:
            slow += (EXTENDED if frame.extended else STANDARD) + 8 * n
    return slow / bitrate + fast / (data_bitrate or bitrate)


def misheard(data: bytes, spoken: int, heard: int) -> bytes:
    """Return the bytes that a receiver with a wrong baud rate decodes.

    The receiver samples the line in the middle of its own bits, after the edge of a start bit.

    Args:
        spoken: speed of the sender, bit/s.
        heard: speed of the receiver, bit/s.
    """
    line = [bit for byte in data for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]
    line += [1] * 20
    step = spoken / heard
    found, at = bytearray(), 0.0
    while at < len(line) - 20:
        if line[int(at)]:  # idle: until the next edge
            at = math.floor(at) + 1.0
            continue
        places = [int(at + (k + 1.5) * step) for k in range(8)]
        bits = [line[p] if p < len(line) else 1 for p in places]
        found.append(sum(bit << k for k, bit in enumerate(bits)))
        at += 9.5 * step
    return bytes(found)


LOOK_S = 0.005  # interval at which a port that is not open is checked
READ_BYTES = 65_536
ANSWER_BYTES = 1 << 20
PIECE_S: Final = 0.001  # length of the pieces in which a long packet arrives
TCGETS2, SPEED_AT = (
    0x802C542A,
    40,
)  # Linux: request for a terminal's settings, offset of the speed in them


class Pty:
    """Pseudo-terminal, raw and without echo; only `read` must stay in one thread.

    Written data is queued up to a limit; `read` also passes it on to the host. Data that the host
    has not read when it closes the port is lost, as with a real port.

    Args:
        link: A symbolic link, created and removed with the terminal; None for none.
        fifo_bytes: Capacity of the queue for a host that does not read, in addition to the kernel's
            18 kB; with a wire, for data that it has not yet carried.
        wire: Timing of the line; None delivers written data at once.
        baud: Speed at which bytes are sent, bit/s: a host with another speed receives nonsense; 0
            for a line without a speed.
    """

    def __init__(
        self,
        link: str | Path | None,
        fifo_bytes: int,
        wire: Wire | None = None,
        baud: int = 0,
    ) -> None:
        self._wire, self._baud = wire, baud
        self.link = None if link is None else Path(link)
        self.path = ""
        self.heard = False
        self.fifo_bytes = fifo_bytes
        self.lock = threading.RLock()
        self._master = -1
        self._plugged = 0  # number of times: unique, while descriptors' numbers are reused
        self._fifo: deque[tuple[float, bytes]] = deque()  # (time of arrival, data)
        self.queued = 0
        self._waking = (-1, -1)

    @property
    def name(self) -> str:
        """Path that a host opens: that of the link, or of the terminal itself."""
        return self.path if self.link is None else str(self.link.absolute())

    def plug(self) -> None:
        """Create the terminal and its link.

        Raises:
            ConfigError: the link's name is taken, or the link cannot be made.
        """
        with self.lock:
            if self._master >= 0:
                return
            self._check_link()
            master, slave = pty.openpty()
            tty.setraw(slave)
            self.path = os.ttyname(slave)
            os.close(slave)  # from now on, a hang-up shows that no host has it open
            os.set_blocking(master, False)
            if self.link is not None:
                try:
                    os.symlink(self.path, self.link)
                except OSError as error:
                    os.close(master)
                    raise ConfigError(f"{self.link}: {error.strerror}") from None
            self._master = master
            self._plugged += 1
            if self._waking[0] < 0:
                self._waking = os.pipe()
                os.set_blocking(self._waking[0], False)
                os.set_blocking(self._waking[1], False)

    def pull(self) -> None:
        """Remove the terminal and its link; unread data is lost."""
        with self.lock:
            if self._master < 0:
                return
            if self.link is not None and self.link.is_symlink():
                if os.readlink(self.link) == self.path:  # else it is another device's by now
                    self.link.unlink()
            os.close(self._master)
            self._master, self.heard = -1, False
            self._fifo.clear()
            self.queued = 0
            self.wake()

    def close(self) -> None:
        """Remove the terminal for good; safe to call twice."""
        with self.lock:
            self.pull()
            for end in self._waking:
                if end >= 0:
                    os.close(end)
            self._waking = (-1, -1)

    def write(self, data: bytes, answer: bool = False, takes_s: float = 0.0) -> bool:
        """Queue data for the host; without a host or room, queue none and return False.

        Args:
            takes_s: Time that the data takes on the wire, s.
        """
        with self.lock:
            room = self.fifo_bytes + (ANSWER_BYTES if answer else 0)
            if not self.heard or self.queued + len(data) > room:
                return False
            if self._wire is not None:
                self._queue_delayed(self._wire, data, takes_s)
                return True
            if not self._fifo:
                data = data[self._write_now(data) :]
                if not data:
                    return True
                self.wake()  # so that `read` waits for room, too
            self._fifo.append((0.0, data))
            self.queued += len(data)
            return True

    def _queue_delayed(self, wire: Wire, data: bytes, takes_s: float) -> None:
        if not self._fifo:
            self.wake()  # so that `read` waits for the wire, too
        n = max(1, min(len(data), round(takes_s / PIECE_S)))
        edges = [k * len(data) // n for k in range(n + 1)]
        for first, last in itertools.pairwise(edges):
            share = takes_s * (last - first) / len(data)
            self._fifo.append((wire.heard_at(share, time.monotonic()), data[first:last]))
        self.queued += len(data)

    def gather(self, seconds: float) -> None:
        """Deliver written data only at multiples of this time, s; 0 delivers it at once."""
        with self.lock:
            if self._wire is None and seconds:
                self._wire = Wire()
            if self._wire is not None:
                self._wire.gather_s = seconds

    def read(self, timeout_s: float) -> bytes:
        """Pass queued data to the host, and return data from it; empty after the timeout."""
        with self.lock:
            master, plugged, wake = self._master, self._plugged, self._waking[0]
            sleep_s = timeout_s if self.heard else min(timeout_s, LOOK_S)
            left_s = self._fifo[0][0] - time.monotonic() if self._fifo else sleep_s
            mask = select.POLLIN | (select.POLLOUT if self._fifo and left_s <= 0 else 0)
            sleep_s = min(sleep_s, left_s) if left_s > 0 else sleep_s
            heard = self.heard
        if wake < 0:
            time.sleep(timeout_s)
            return b""
        poll = select.poll()
        poll.register(wake, select.POLLIN)
        if master < 0:
            poll.poll(1e3 * timeout_s)
        elif not heard:  # polling `master` would return a hang-up at once
            poll.poll(1e3 * sleep_s)
        else:
            poll.register(master, mask)
            poll.poll(1e3 * sleep_s)
        with self.lock:
            if self._waking[0] >= 0:
                try:
                    os.read(self._waking[0], 4096)
                except BlockingIOError:
                    pass
            if self._master < 0 or self._plugged != plugged:
                return b""
            return self._exchange()

    def wake(self) -> None:
        """Make a `read` that waits in another thread return."""
        with self.lock:
            if self._waking[1] >= 0:
                try:
                    os.write(self._waking[1], b"\0")
                except BlockingIOError:
                    pass  # it is awake already

    def _exchange(self) -> bytes:
        poll = select.poll()
        poll.register(self._master, select.POLLIN | select.POLLOUT)
        ((_, events),) = poll.poll(0) or [(0, 0)]
        if events & select.POLLHUP:
            if self.heard:
                self._hang_up()
        else:
            self.heard = True
        if self.heard and events & select.POLLOUT:
            now = time.monotonic()
            while self._fifo and self._fifo[0][0] <= now:
                due, data = self._fifo.popleft()
                done = self._write_now(data)
                self.queued -= done
                if done < len(data):
                    self._fifo.appendleft((due, data[done:]))
                    break
        if not events & select.POLLIN:
            return b""
        try:
            return os.read(self._master, READ_BYTES)
        except OSError:
            return b""

    def _write_now(self, data: bytes) -> int:
        heard = _read_speed(self._master) if self._baud else 0
        try:
            if heard and heard != self._baud:
                os.write(self._master, misheard(data, self._baud, heard))
                return len(data)
            return os.write(self._master, data)
        except OSError:  # no room, or no host
            return 0

    def _hang_up(self) -> None:
        """Discard all unread data, since the host has closed the port."""
        self.heard = False
        self._fifo.clear()
        self.queued = 0
        try:
            slave = os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:
            return
        try:
            termios.tcflush(slave, termios.TCIOFLUSH)
        except termios.error:
            pass
        finally:
            os.close(slave)

    def _check_link(self) -> None:
        if self.link is None or not (self.link.is_symlink() or self.link.exists()):
            return
        if self.link.is_symlink() and not self.link.exists():
            self.link.unlink()  # left by a device that no longer exists
            return
        raise ConfigError(f"{self.link} already exists: name another link, or remove it")


def _read_speed(master: int) -> int:
    """Return the speed to which the host has set the terminal, bit/s; 0 if unknown."""
    if not sys.platform.startswith("linux"):
        return 0
    try:
        settings = fcntl.ioctl(master, TCGETS2, bytes(64))
    except OSError:
        return 0
    return int(struct.unpack_from("I", settings, SPEED_AT)[0])
