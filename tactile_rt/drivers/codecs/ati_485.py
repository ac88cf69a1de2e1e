"""ATI six-axis sensors with digital output on RS-485, streaming.

The sensor is a Modbus slave (RTU, even parity) until its function 46 is called with 55; it answers,
then sends frames of 13 bytes without a pause: the strain gauges 0, 2, 4, 1, 3, 5 as big-endian i16,
and the sum of those 12 bytes (low 7 bits) with the status in bit 7. Nothing marks the beginning of
a frame. A jam of 14 zero bytes makes it a slave again.

The beginning of frames is found by elimination: of the 13 offsets, only the right one passes the
sum every time. A wrong one passes with a chance of 1/64 (the sum minus one byte, plus the sum, must
be that byte: 2 sum = 2 byte modulo 128), independently each time that the sum changes, but always
if it does not: 17 % of all constant frames have such an offset (1 - (63/64)^12).

Sources: ATI, Digital F/T sensor manual (RS-485 streaming); request, answer and registers as in
public firmware for the sensor.
"""

import re
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.drivers.codec import SIX_AXES, Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs.framing import seal_modbus

SIZE: Final = 13
ORDER: Final = np.array([0, 2, 4, 1, 3, 5])  # of the gauges in a frame
STREAM: Final = b"\x46\x55"  # Modbus function and its argument
STREAMS: Final = b"\x46\x01"  # the answer
JAM: Final = bytes(14)
SILENCE_S: Final = 0.05
AHEAD: Final = 3  # frames by which the right place must lead the others
KEPT: Final = 64 * SIZE  # bytes kept while the place is uncertain
ANSWER: Final = 5  # bytes of the answer, with CRC


@dataclass(frozen=True)
class Ati485Options:
    """Options of an ATI sensor on RS-485.

    Attributes:
        matrix: Path of the sensor's calibration, 6 x 6 numbers: a row for each of fx, fy, fz (N per
            count), mx, my, mz (N m per count), a column for each gauge. Without it the samples are
            the gauges' counts.
        slave: Modbus address of the sensor, 1 to 247.
        rate_hz: Rate at which the sensor sends, Hz, which the protocol does not report.
    """

    matrix: str = ""
    slave: int = 10
    rate_hz: float = 8000.0

    def __post_init__(self) -> None:
        if not 1 <= self.slave <= 247:
            raise ConfigError(f"slave must be a Modbus address, 1 to 247, not {self.slave}")


class Ati485(SerialCodec):
    """Codec of a six-axis sensor: forces (N) and moments (N m), or gauge counts.

    Frames are delivered once their offset is certain: at once after the answer to START, else some
    frames later, when one offset leads by 3 frames. Until then up to 64 frames are buffered.
    """

    Options = Ati485Options
    baud = 1_250_000
    parity = "E"
    status_bits: ClassVar[dict[int, str]] = {0: "the sensor's status word is not zero"}
    cannot_detect = (
        "frames that never came or came twice (no counter, no clock); one damaged frame in 128, "
        "and every change of a highest bit (a sum of 7 bits). There is no header: of frames that "
        "stay constant 17 % fit at a second place too, and where they begin is known once they "
        "change (lock_confidence)"
    )

    def __init__(self, options: Ati485Options) -> None:
        self._matrix = _read_matrix(options.matrix)
        gauges = dict.fromkeys((f"g{k}" for k in range(6)), "1")
        channels = gauges if self._matrix is None else SIX_AXES
        super().__init__(ArraySpec.at_origin("ati_485", options.rate_hz, channels))
        self._request = seal_modbus(bytes((options.slave,)) + STREAM)
        self._answer = seal_modbus(bytes((options.slave,)) + STREAMS)
        self.streaming = False
        self._host_bytes = b""
        self._damaged = 0
        self.forget()

    def forget(self) -> None:
        self._data = bytearray()  # not yet decoded; if locked, it begins with a frame
        self._was_locked = False  # whether frames began at its offset before
        self._changes = 0  # frames whose sum differs from the previous one, since locked
        self._last = -1  # the last sum
        self._start_search()

    # the host's side

    @property
    def lock_confidence(self) -> float:
        """Confidence in the offset at which frames begin, 0 to 1.

        With k offsets that pass the checksums, and n later frames whose sum changed and passed:
        1 - (1 - 1/k) / 64^n; after the answer to START, k is 1. While none is chosen: 1/k.
        """
        if self._locked:
            return 1 - (1 - 1 / self._rivals) / 64.0 ** min(self._changes, 100)
        best = max(self._runs)
        return 1 / sum(run > best - AHEAD for run in self._runs) if best > 0 else 0.0

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        self._data += packet
        parts: list[NDArray[np.uint8]] = []
        damaged: list[int] = []
        while True:
            if not self._locked and not self._lock():
                break
            frames = self._take_frames()
            if len(frames):
                parts.append(frames)
                damaged += [self._damaged] + [0] * (len(frames) - 1)
                self._damaged = 0
            if self._locked:
                break
        if not parts:
            return None
        frames = np.concatenate(parts)
        n = len(frames)
        self.stats.intact += n
        gauges = np.empty((n, 6), np.float64)
        gauges[:, ORDER] = np.ascontiguousarray(frames[:, :-1]).view(">i2")
        values = gauges if self._matrix is None else gauges @ self._matrix.T
        status = frames[:, -1] >> 7
        return Samples(
            values.astype(np.float32)[:, None],
            (status == 0)[:, None],
            np.full(n, t_ns, np.int64),
            np.array(damaged, np.int64),
            status=status.astype(np.int64),
        )

    def _take_frames(self) -> NDArray[np.uint8]:
        """Remove and return the frames, (n, 13) bytes, before the first with a wrong checksum."""
        n = len(self._data) // SIZE
        frames = np.frombuffer(bytes(self._data[: n * SIZE]), np.uint8).reshape(n, SIZE)
        sums = frames[:, :-1].sum(axis=1, dtype=np.int64)
        bad = np.flatnonzero((sums ^ frames[:, -1]) & 127)
        if len(bad):
            n = int(bad[0])
            self._start_search()
            self._was_locked = True
        del self._data[: n * SIZE]
        if n:
            before = sums[0] if self._last < 0 else self._last
            self._changes += int((np.diff(sums[:n], prepend=before) % 64 != 0).sum())
            self._last = int(sums[n - 1])
        return frames[:n]

    def _start_search(self) -> None:
        self._locked = False
        self._at = 0  # bytes of data searched so far
        self._runs = [0] * SIZE  # successive frames with a right checksum, by offset
        self._rivals = 1

    def _lock(self) -> bool:
        """Find where frames begin, and drop the bytes before; return whether it was found."""
        data, runs = self._data, self._runs
        while self._at < len(data):
            self._at += 1
            end = self._at
            if data.endswith(self._answer, 0, end):
                del data[:end]
                self._set_lock(end - ANSWER, 1)
                return True
            if end < SIZE:
                continue
            place = end % SIZE
            if (sum(data[end - SIZE : end - 1]) ^ data[end - 1]) & 127:
                runs[place] = 0
                continue
            runs[place] += 1
            run = runs[place]
            most = max(r for k, r in enumerate(runs) if k != place)
            if run >= AHEAD and (
                run - most >= AHEAD or (self._was_locked and place == 0 and run >= most)
            ):
                start = max(end - run * SIZE, place)
                del data[:start]
                self._set_lock(start, sum(r > run - AHEAD for r in runs))
                return True
            if end >= KEPT + SIZE:
                del data[:SIZE]
                self._at -= SIZE
                self._skip(SIZE)
        return False

    def _set_lock(self, before: int, rivals: int) -> None:
        self._skip(before)
        self._locked, self._was_locked = True, True
        self._rivals, self._changes, self._last = rivals, 0, -1

    def _skip(self, n: int) -> None:
        self.stats.skipped += n
        if self._was_locked and n:  # round, since damage may add or remove bytes
            frames = max(1, round(n / SIZE))
            self.stats.corrupt += frames
            self._damaged += frames

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        jam = Step(JAM, pause_s=SILENCE_S)
        if command == Command.START:  # a streaming sensor accepts no request
            return jam, Step(self._request, self._answer, what="the request to stream")
        return (jam,) if command == Command.STOP else ()

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        values: NDArray[Any] = np.nan_to_num(chunk.values[:, 0].astype(np.float64))
        if self._matrix is not None:
            values = np.linalg.solve(self._matrix, values.T).T
        wire = np.clip(np.rint(values), -32768, 32767).astype(">i2")[:, ORDER]
        valid = np.asarray(chunk.valid.all(axis=1)).tolist()
        return [
            (body := row.tobytes()) + bytes((sum(body) & 127 | (0 if good else 128),))
            for row, good in zip(wire, valid, strict=True)
        ]

    def respond(self, packet: bytes) -> bytes:
        answer = b""
        for byte in packet:
            self._host_bytes = (self._host_bytes + bytes((byte,)))[-len(JAM) :]
            if self._host_bytes == JAM:
                self.streaming, self._host_bytes = False, b""
            elif not self.streaming and self._host_bytes.endswith(self._request):
                self.streaming, self._host_bytes = True, b""
                answer += self._answer
        return answer


def _read_matrix(path: str) -> NDArray[np.float64] | None:
    """Read the 6 x 6 calibration matrix from a file; None without a path."""
    if not path:
        return None
    try:
        with open(path, encoding="utf-8") as file:
            numbers = [float(word) for word in re.split(r"[\s,;]+", file.read().strip())]
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not a table of numbers ({error})") from None
    table: NDArray[Any] = np.array(numbers)
    if table.size != 36:
        raise ConfigError(f"{path}: a calibration must have 6 x 6 numbers, not {table.size}")
    table = table.reshape(6, 6)
    if not np.isfinite(table).all() or np.linalg.matrix_rank(table) < 6:
        raise ConfigError(f"{path}: the calibration matrix is singular")
    return table
