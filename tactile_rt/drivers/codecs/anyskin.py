"""AnySkin and ReSkin: magnetometers under a magnetised elastomer.

A frame has neither beginning, counter nor check: per magnetometer temperature, x, y, z as float32
(little-endian, degrees Celsius and microtesla), then 0D 0A. Those two bytes also occur inside the
floats, so where frames end is concluded from several frames at once: the ending must come at every
length of a frame, and what lies between must be what a MLX90393 can measure.
"""

from bisect import bisect_left
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import Samples, SerialCodec
from tactile_rt.stream import ArraySpec, Chunk, ConfigError

__all__ = ["AnySkin", "AnySkinOptions"]

END: Final = b"\r\n"
FIRST: Final = 2  # frames in a row that must fit before any is believed
MOST: Final = 8  # frames to wait for while several places fit
ZERO_C: Final = 273.15  # K
TESLA: Final = 1e-6  # per unit on the wire
# What the chip can say: a raw temperature of 0 to 65535 is 25 C + (raw - 46244) / 45.2, and 2^15
# counts at the lowest gain are 0.32 T. A count is at least 0.02 C or 0.1 uT, so less than the
# rounding of 25 C - 25 C there is only 0; bytes that straddle a line end, read as a number, are
# mostly less.
COLDEST, HOTTEST = -999.0, 453.0
LARGEST, SMALLEST = 3.3e5, 1e-7
ABSENT: Final = -998.1  # a chip that does not answer: raw temperature 0
WORKING: Final = (-55.0, 150.0)  # C; outside, the chip or its bus is broken

# The 5X board as its viewer draws it, x to the right, y down: grid cell, and the angle about z that
# turns the chip's axes into the board's. The drawing gives no measures, so positions stay zero.
CROSS: Final = (
    ((1, 1), -np.pi / 2), ((1, 0), -np.pi / 2), ((1, 2), np.pi), ((0, 1), np.pi / 2), ((2, 1), 0.0)
)  # fmt: skip


@dataclass(frozen=True)
class AnySkinOptions:
    """Options of AnySkin.

    Attributes:
        magnetometers: Number of magnetometers on the board: 5 on the 5X board, 1 on a single one.
        temperature: Whether to deliver each chip's temperature (K) as a fourth channel.
        rate_hz: Rate at which the board sends, Hz; the firmware runs as fast as the I2C bus lets
            it.
    """

    magnetometers: int = 5
    temperature: bool = True
    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        if not 1 <= self.magnetometers <= 64:
            raise ConfigError(f"magnetometers must be 1 to 64, not {self.magnetometers}")
        if not 0 < self.rate_hz < np.inf:
            raise ConfigError(f"rate_hz must be positive, not {self.rate_hz}")


class AnySkin(SerialCodec):
    """n MLX90393 magnetometers of an AnySkin or ReSkin board.

    Source: github.com/raunaqbhirangi/anyskin, arduino/5X_binary_burst_stream (frame, order of the
    chips), anyskin/sensor.py (the host's side), visualizations/anyskin_viz.py (drawing).

    Attributes:
        lock_confidence: Certainty about the place of the frames: 0 while unknown, else 1 / (places
            at which every frame so far could end). The value reaches 1 once the bytes in question
            change.
    """

    Options = AnySkinOptions
    baud = 115200  # nominal: it speaks over USB
    cannot_detect = (
        "there is no counter and no checksum: lost and repeated frames leave no trace, and of "
        "changed bytes only a missing line end and impossible values are seen"
    )

    def __init__(self, options: AnySkinOptions) -> None:
        n = options.magnetometers
        chips = CROSS if n == len(CROSS) else tuple(((0, i), 0.0) for i in range(n))
        channels = ("bx", "by", "bz", "temperature")[: 3 + options.temperature]
        super().__init__(
            ArraySpec(
                name="anyskin",
                elements=tuple(f"M{i}" for i in range(n)),
                grid=tuple(cell for cell, _ in chips),
                positions=((0.0, 0.0, 0.0),) * n,
                orientations=tuple(
                    (float(np.cos(a / 2)), 0.0, 0.0, float(np.sin(a / 2))) for _, a in chips
                ),
                channels=channels,
                units=("T", "T", "T", "K")[: len(channels)],
                rate_hz=options.rate_hz,
                frame="board",
            )
        )
        self._n, self._size = n, 16 * n + len(END)
        self._data = bytearray()
        self._locked = self._joined = False  # whether the place is known, and was before
        self._rivals: list[int] = []  # other places in a frame where each one so far had an ending
        self._times: list[tuple[int, int]] = []  # (bytes until then, arrival) of what waits
        self._taken = 0  # bytes, of those come so far
        self._gap = 0  # bytes dropped since the last frame
        self._damaged = 0

    @property
    def lock_confidence(self) -> float:
        return 1.0 / (1 + len(self._rivals)) if self._locked else 0.0

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        self._data += packet
        self._times.append((self._taken + len(self._data), t_ns))
        frames: list[NDArray[np.uint8]] = []
        ends: list[int] = []
        damaged: list[int] = []
        while self._locked or self._lock():
            found = self._run()
            if len(found):
                frames.append(found)
                first = self._taken - len(found) * self._size
                ends += range(first + self._size, self._taken + 1, self._size)
                damaged += [self._damaged] + [0] * (len(found) - 1)
                self._damaged = 0
            if not self._skip_one():
                break
        # while the place was not known frames waited: each has arrived when its last byte did
        times = self._times
        arrived = [times[bisect_left(times, (end,))][1] for end in ends]
        del times[: bisect_left(times, (self._taken + 1,))]
        return self._samples(np.concatenate(frames), arrived, damaged) if frames else None

    def forget(self) -> None:
        self._data.clear()
        self._rivals.clear()
        self._times.clear()
        self._locked = self._joined = False
        self._taken = self._gap = self._damaged = 0

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        values = chunk.values.astype(np.float64)
        good = chunk.valid & np.isfinite(values).all(axis=2)
        wire = np.empty((len(chunk), self._n, 4), "<f4")
        field = np.clip(values[..., :3] / TESLA, -LARGEST, LARGEST)
        wire[..., 1:] = field
        wire[..., 0] = 25.0
        if values.shape[2] > 3:
            wire[..., 0] = np.clip(values[..., 3] - ZERO_C, *WORKING)
        wire[np.abs(wire) < SMALLEST] = 0.0
        wire[~good] = (ABSENT, 0.0, 0.0, 0.0)
        return [sample.tobytes() + END for sample in wire]

    # the place of the frames

    def _lock(self) -> bool:
        """Find where frames begin and drop what lies before; False while that is not known."""
        size = self._size
        while len(self._data) >= (FIRST + 1) * size - 1:
            data = np.frombuffer(bytes(self._data), np.uint8)
            ended = (data[:-1] == END[0]) & (data[1:] == END[1])
            often = ended[size - 2 : 2 * size - 2] & ended[2 * size - 2 : 3 * size - 2]
            fitting = [s for s in np.flatnonzero(often).tolist() if self._fits(data, s, FIRST)]
            k = FIRST
            while len(fitting) > 1 and k < MOST:
                k += 1
                if len(data) < (k + 1) * size - 1:
                    return False  # of several places, the next frame may exclude some
                fitting = [s for s in fitting if self._fits(data, s, k)] or fitting[:1]
            if not fitting:
                self._drop(size)
                continue
            start = fitting[0]
            self._drop(start)
            self._rivals = [(s - start) % size for s in fitting[1:]]
            self._locked = True
            lost = -(-self._gap // size) if self._joined else 0
            self.stats.corrupt += lost
            self._damaged += lost
            self._joined, self._gap = True, 0
            return True
        return False

    def _fits(self, data: NDArray[np.uint8], start: int, frames: int) -> bool:
        """Whether so many whole frames can lie there."""
        whole = data[start : start + frames * self._size].reshape(frames, self._size)
        if (whole[:, -2] != END[0]).any() or (whole[:, -1] != END[1]).any():
            return False
        return bool(_possible(_floats(whole)).all())

    def _run(self) -> NDArray[np.uint8]:
        """Take the whole frames up to the first without its ending."""
        size = self._size
        n = len(self._data) // size
        whole = np.frombuffer(bytes(self._data[: n * size]), np.uint8).reshape(n, size)
        ended = (whole[:, -2] == END[0]) & (whole[:, -1] == END[1])
        n = n if ended.all() else int(ended.argmin())
        whole = whole[:n]
        if self._rivals and n:
            self._rivals = [
                r for r in self._rivals
                if (whole[:, r - 2] == END[0]).all() and (whole[:, r - 1] == END[1]).all()
            ]  # fmt: skip
        del self._data[: n * size]
        self._taken += n * size
        self.stats.intact += n
        return whole

    def _skip_one(self) -> bool:
        """Decide about a frame without its ending; False while there is nothing to decide."""
        size = self._size
        if len(self._data) < 2 * size:
            return False
        # one damaged ending does not put the place in doubt, if nothing else does
        following = np.frombuffer(bytes(self._data[size : 2 * size]), np.uint8)
        if not self._rivals and self._fits(following, 0, 1):
            self._drop(size)
            self._gap = 0
            self.stats.corrupt += 1
            self._damaged += 1
        else:
            self._locked = False
        return True

    def _drop(self, n: int) -> None:
        del self._data[:n]
        self._taken += n
        self._gap += n
        self.stats.skipped += n

    def _samples(
        self, frames: NDArray[np.uint8], arrived: list[int], damaged: list[int]
    ) -> Samples:
        wire = _floats(frames)
        values = np.empty((*wire.shape[:2], 4))
        with np.errstate(over="ignore", invalid="ignore"):
            values[..., :3] = wire[..., 1:] * TESLA
            values[..., 3] = wire[..., 0] + ZERO_C
        working = (wire[..., 0] >= WORKING[0]) & (wire[..., 0] <= WORKING[1])
        assert self.spec is not None
        return Samples(
            values[..., : len(self.spec.channels)].astype(np.float32),
            working & _possible(wire).all(axis=2),
            np.array(arrived, np.int64),
            np.array(damaged, np.int64),
        )


def _floats(frames: NDArray[np.uint8]) -> NDArray[np.float64]:
    """(frame, chip, (temperature, x, y, z)) of (frame, byte)."""
    body = np.ascontiguousarray(frames[:, :-2]).view("<f4")
    with np.errstate(invalid="ignore"):  # a signalling NaN is only a NaN
        return body.reshape(len(frames), -1, 4).astype(np.float64)


def _possible(wire: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which numbers a MLX90393 can send; an array like `wire`."""
    size = np.abs(wire)
    possible: NDArray[np.bool_] = (size <= LARGEST) & ((size >= SMALLEST) | (size == 0))
    possible[..., 0] &= (wire[..., 0] >= COLDEST) & (wire[..., 0] <= HOTTEST)
    return possible
