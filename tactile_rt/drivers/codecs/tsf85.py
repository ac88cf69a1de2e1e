"""Robotiq TSF-85 (CoRo tactile sensor): two fingertips of 4 x 7 taxels, over USB.

A packet is 9A, a CRC that neither side computes, a command, the length of the rest (one byte), and
signals in sequence: a byte with the type in its high half, the finger in bits 2-3 and an index in
bits 0-1, then big-endian values. A packet is too short for a whole set of signals, so a set comes
in several packets, in no guaranteed order. The host's command 58 sets the period in ms at which the
device sends sets; 0 stops it.

Sources: facts of the public drivers that go back to Robotiq's tactile sensor interface
(UsbCommands, UsbSensorType and the scales of the motion sensor, +-2 g and +-250 deg/s).
"""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import Command, SampleBatch, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.framing import ByteBuffer

START: Final = b"\x9a"
READ, SEND, SEND_WHEN_NEW = 0x61, 0x58, 0x59  # commands; packets repeat the one they answer
STATIC, DYNAMIC, ACCELERATION, TURNING, FIELD, TEMPERATURE, TIME = range(1, 8)  # types
VALUES: Final = {  # of each type, as sent
    STATIC: np.dtype((">u2", 28)),
    DYNAMIC: np.dtype((">i2", 1)),
    ACCELERATION: np.dtype((">i2", 3)),
    TURNING: np.dtype((">i2", 3)),
    FIELD: np.dtype((">i2", 3)),
    TEMPERATURE: np.dtype((">i2", 1)),
    TIME: np.dtype((">u8", 1)),
}
ROWS, COLUMNS = 4, 7
MOTION: Final = np.array(  # per count: m/s2, rad/s
    [2 * 9.80665 / 32768] * 3 + [np.deg2rad(250) / 32768] * 3
)
SETTLE_S: Final = 0.1


@dataclass(frozen=True)
class Tsf85Options:
    """Options of the Robotiq TSF-85.

    Attributes:
        signals: The signals that become samples: ``taxels`` (28 of each finger) or ``fingers``
            (the dynamic taxel and motion sensor of each).
        fingers: Number of connected fingertips, 1 or 2.
        period_ms: Time between samples, 1 to 255 ms.
        times: Whether the firmware sends its time. Older firmware does not, and gives no samples
            unless this is false.
    """

    signals: str = "taxels"
    fingers: int = 2
    period_ms: int = 1
    times: bool = True

    def __post_init__(self) -> None:
        if self.signals not in ("taxels", "fingers"):
            raise ConfigError(f"signals must be taxels or fingers, not {self.signals!r}")
        if self.fingers not in (1, 2):
            raise ConfigError(f"fingers must be 1 or 2, not {self.fingers}")
        if not 1 <= self.period_ms <= 255:
            raise ConfigError(f"period_ms must be 1 to 255, not {self.period_ms}")


class Tsf85(SerialCodec):
    """Codec of the taxels' pressure counts, or of the fingers' motion.

    Motion is counts of the dynamic taxel, acceleration and angular velocity. Counts have no
    published scale (unit 1). A sample is complete when all of its signals have come. The first
    sample after START shows their order; a signal out of that order belongs to the next sample: a
    packet was lost, and the fingers with a missing signal are invalid. If a host joins a running
    stream, samples may begin at another signal, and a finger be one period late.
    """

    Options = Tsf85Options
    usb = True
    baud = 115_200  # nominal: USB has none
    tick_bits = 48  # of the 64 sent
    cannot_detect = (
        "damage that leaves a packet's structure intact (the checksum is not used); lost samples, "
        "but for steps of its clock in whole ms (no counter)"
    )

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [{"fingers": "1"}, {"times": "false"}, {"fingers": "1", "times": "false"}]

    def __init__(self, options: Tsf85Options) -> None:
        super().__init__(_make_spec(options))
        taxels = options.signals == "taxels"
        kinds = (STATIC,) if taxels else (DYNAMIC, ACCELERATION, TURNING)
        self._signals_used = [(kind, finger) for finger in range(options.fingers) for kind in kinds]
        self._signals_needed = list(self._signals_used)
        self._options = options
        if options.times:
            self.tick_ns = 1e6
            self._signals_needed.append((TIME, 0))
        self._buffer, self._host_bytes = ByteBuffer(), ByteBuffer()
        self.streaming = False
        self._damaged = 0
        self.forget()

    def forget(self) -> None:
        self._buffer.data.clear()
        self._synchronised = False
        self._set: dict[tuple[int, int], bytes] = {}  # signals of the incomplete sample
        self._order: list[tuple[int, int]] = []  # order of a sample's signals; empty if unknown

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        batch = SampleBatch()
        for command, signals in self._read_packets(self._buffer, packet):
            if command in (READ, SEND, SEND_WHEN_NEW):
                for signal, data in signals:
                    self._add_signal(batch, signal, data)
        assert self.spec is not None
        return batch.take(self.spec.shape, t_ns)

    def _add_signal(self, batch: SampleBatch, signal: tuple[int, int], data: bytes) -> None:
        if signal not in self._signals_needed:
            return
        if self._ends_sample(signal):
            self.stats.incomplete += 1
            if (TIME, 0) in self._set or not self._options.times:
                self._deliver(batch)
            self._set.clear()
        self._set[signal] = data
        if len(self._set) == len(self._signals_needed):
            self._order = list(self._set)
            self._deliver(batch)
            self._set.clear()

    def _ends_sample(self, signal: tuple[int, int]) -> bool:
        """Return whether a signal belongs to the next sample and so ends the present one."""
        if not self._set or not self._order:
            return signal in self._set
        return self._order.index(signal) <= self._order.index(next(reversed(self._set)))

    def _deliver(self, batch: SampleBatch) -> None:
        assert self.spec is not None
        got: list[NDArray[np.float64]] = []
        valid: list[bool] = []
        for kind, finger in self._signals_used:
            data = self._set.get((kind, finger))
            dtype = VALUES[kind]
            values = np.zeros(dtype.shape) if data is None else np.frombuffer(data, dtype.base)
            got.append(values.astype(np.float64))
            valid.append(data is not None)
        if self._options.signals == "taxels":
            flags = np.repeat(np.array(valid), ROWS * COLUMNS)
            values = np.concatenate(got)
        else:
            flags = np.array([all(valid[k : k + 3]) for k in range(0, len(valid), 3)])
            values = np.concatenate(got).reshape(-1, 7) * [1.0, *MOTION]
        batch.values.append(values)
        batch.valid.append(flags)
        batch.damaged.append(self._damaged)
        self._damaged = 0
        if self._options.times:
            ticks = int.from_bytes(self._set[TIME, 0], "big")
            batch.ticks.append(ticks % 2**self.tick_bits)

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        stop = Step(_make_packet(SEND, b"\0"), pause_s=SETTLE_S)
        if command == Command.START:
            return stop, Step(_make_packet(SEND, bytes((self._options.period_ms,))))
        return (stop,) if command == Command.STOP else ()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        values = np.nan_to_num(chunk.values.astype(np.float64))
        n = len(values)
        still: list[list[bytes]] = [[bytes(14)] * 2 for _ in range(n)]
        if self._options.signals == "taxels":
            counts = np.clip(np.rint(values), 0, 65535).astype(">u2").reshape(n, -1, 28)
            fingers = [[row.tobytes() for row in sample] for sample in counts]
        else:
            fingers = [[bytes(56)] * self._options.fingers for _ in range(n)]
            moves = np.clip(np.rint(values / [1.0, *MOTION]), -32768, 32767).astype(">i2")
            still = [[row.tobytes() for row in sample] for sample in moves]
        packets = []
        for taxels, moving, t_ns in zip(fingers, still, chunk.t_ns.tolist(), strict=True):
            wire, rest = b"", b""
            for finger, row in enumerate(taxels):
                wire += _make_packet(SEND, _pack(STATIC, finger, row))
                rest += _pack(DYNAMIC, finger, moving[finger][:2])
                rest += _pack(ACCELERATION, finger, moving[finger][2:8])
                rest += _pack(TURNING, finger, moving[finger][8:])
                if self._options.times:
                    rest += _pack(TIME, finger, (round(t_ns / 1e6) % 2**64).to_bytes(8, "big"))
            packets.append(wire + _make_packet(SEND, rest))
        return packets

    def respond(self, packet: bytes) -> bytes:
        host = self._host_bytes
        host.data += packet
        while True:
            host.skip_to(START)
            if len(host.data) < 4:
                return b""
            command, length = host.data[2], host.data[3]
            if (command, length) not in ((SEND, 1), (SEND_WHEN_NEW, 1), (READ, 0)):
                host.take(1)
                continue
            if len(host.data) < 4 + length:
                return b""
            data = host.take(4 + length)[4:]
            if command == READ:
                self.polled += 1
            else:
                self.streaming = data != b"\0"
                self.commanded_hz = 1000.0 / data[0] if data[0] else None

    # both

    def _read_packets(
        self, buffer: ByteBuffer, packet: bytes
    ) -> Iterator[tuple[int, list[tuple[tuple[int, int], bytes]]]]:
        """Yield (command, signals) of the valid packets that these bytes complete."""
        buffer.data += packet
        while True:
            skipped = buffer.skip_to(START)
            self._lose(skipped)
            if len(buffer.data) < 4:
                return
            command, length = buffer.data[2], buffer.data[3]
            signals = None
            if command in (READ, SEND, SEND_WHEN_NEW) and length:
                if len(buffer.data) < 4 + length:
                    return
                signals = _split_signals(bytes(buffer.data[4 : 4 + length]))
            if signals is None:
                self._lose(len(buffer.take(1)))
                continue
            buffer.take(4 + length)
            self._synchronised = True
            self.stats.intact += 1
            yield command, signals  # before any damage that follows is counted

    def _lose(self, n: int) -> None:
        self.stats.skipped += n
        if n and not self._order:  # the signals before may be of another sample
            self._set.clear()
        if n and self._synchronised:
            self.stats.corrupt += 1
            self._damaged += 1
            self._synchronised = False


def _make_spec(options: Tsf85Options) -> ArraySpec:
    fingers = range(options.fingers)
    if options.signals == "taxels":
        # side by side on the grid, an empty column between; the gripper determines the positions
        cells = {
            f"f{f}t{COLUMNS * r + c}": (r, f * (COLUMNS + 1) + c)
            for f, r, c in product(fingers, range(ROWS), range(COLUMNS))
        }
        channels = {"pressure": "1"}
    else:
        cells = {f"f{f}": (0, f) for f in fingers}
        channels = {"dynamic": "1", **dict.fromkeys(("ax", "ay", "az"), "m/s2")}
        channels |= dict.fromkeys(("wx", "wy", "wz"), "rad/s")
    return ArraySpec.at_origin("tsf85", 1000.0 / options.period_ms, channels, "fingers", cells)


def _make_packet(command: int, data: bytes) -> bytes:
    return START + bytes((0, command, len(data))) + data


def _pack(kind: int, finger: int, data: bytes) -> bytes:
    return bytes((kind << 4 | finger << 2,)) + data


def _split_signals(data: bytes) -> list[tuple[tuple[int, int], bytes]] | None:
    """Split packet data into ((type, finger), values) of each signal; None if malformed."""
    found = []
    at = 0
    while at < len(data):
        kind, finger, index = data[at] >> 4, data[at] >> 2 & 3, data[at] & 3
        if kind not in VALUES or finger > 1:
            return None
        size = VALUES[kind].itemsize
        if at + 1 + size > len(data):
            return None
        if index == 0:  # only signals with index 0 are known
            found.append(((kind, finger), data[at + 1 : at + 1 + size]))
        at += 1 + size
    return found
