"""ATI force/torque transducers with the NETCANOEM board on CAN, polled for each sample."""

import struct
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import (
    CanCodec,
    CanFrame,
    Command,
    SampleBatch,
    Samples,
    Step,
    six_axis,
)

# the low four bits of an identifier; a request and its first reply have the same
GAUGES_A, GAUGES_B, ROW_A, ROW_B, ROW_C = range(5)
CALIBRATION, COUNTS, UNITS = 6, 7, 8
FRAME_A: Final = struct.Struct(">H3h")  # status, gauges 0, 2, 4
FRAME_B: Final = struct.Struct(">3h")  # gauges 1, 3, 5
WAITING: Final = 8  # first frames kept until their second frames come
NEVER_EMPTY: Final = 64  # samples after which a surplus first frame counts as without a second

POUND_N: Final = 4.4482216152605
# SI units of the unit codes
FORCES: Final = {1: POUND_N, 2: 1.0, 3: 1e3 * POUND_N, 4: 1e3, 5: 9.80665, 6: 9.80665e-3}
TORQUES: Final = {
    1: POUND_N * 0.0254, 2: POUND_N * 0.3048, 3: 1.0, 4: 1e-3, 5: 9.80665e-2, 6: 1e3,
}  # fmt: skip
INVALIDATING: Final = 0x01FE  # supply, reference, calibration, memory: values are not reliable


@dataclass(frozen=True)
class AtiCanOptions:
    """Options of a NETCANOEM board.

    Attributes:
        base: The upper seven bits of the board's CAN identifiers.
        calibration: Number of the calibration to use, of the board's 16, 0 to 15; -1 keeps the
            active one.
        rate_hz: Rate at which the board is asked for samples, Hz.
        force_n: Full scale of an emulated transducer's forces, N.
        torque_nm: Full scale of an emulated transducer's torques, N m.
    """

    base: int = 0x7F
    calibration: int = -1
    rate_hz: float = 200.0
    force_n: float = 290.0
    torque_nm: float = 10.0

    def __post_init__(self) -> None:
        if not 0 <= self.base <= 0x7F:
            raise ConfigError(f"base must be from 0 to 0x7f, not {self.base:#x}")
        if not -1 <= self.calibration <= 15:
            raise ConfigError(f"calibration must be from 0 to 15, or -1, not {self.calibration}")
        for what in ("rate_hz", "force_n", "torque_nm"):
            if not (np.isfinite(getattr(self, what)) and getattr(self, what) > 0):
                raise ConfigError(f"{what} must be positive, not {getattr(self, what)}")


class AtiCan(CanCodec):
    """Codec of six strain gauges in two frames; a matrix gives forces and torques.

    The matrix, its counts per unit and its units are read from the board at the start; samples
    received before are dropped. Two requests close together may be answered as
    first, first, second, second frame: they are paired in order of arrival.

    Source: ATI 9610-05-1030 (CAN interface), by way of the public drivers ati_netcanoem_ft_driver
    and Georgia Tech's lwa4_ft (unit codes).
    """

    Options = AtiCanOptions
    polls = True
    harmless_bits = frozenset((0,))
    status_bits: ClassVar[dict[int, str]] = {
        0: "restarted by its watchdog",
        1: "converter check too high",
        2: "converter check too low",
        3: "artificial ground out of range",
        4: "supply voltage too high",
        5: "supply voltage too low",
        6: "bad active calibration",
        7: "EEPROM failure",
        8: "invalid configuration",
        11: "temperature too high",
        12: "temperature too low",
        14: "CAN bus error",
        15: "some error",
    }
    cannot_detect = (
        "a lost sample (no counter); after a lost second frame up to 64 samples may mix "
        "two neighbouring ones while requests are never all answered"
    )

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [
            {"base": f"{base:#x}"}
            for base in sorted({i >> 4 for i in identifiers} - {AtiCanOptions.base})
            if base <= 0x7F
        ]

    def __init__(self, options: AtiCanOptions) -> None:
        self._options, self._base = options, options.base << 4
        super().__init__(six_axis("ati", options.rate_hz))
        self._matrix: NDArray[np.float64] | None = None  # counts to SI, gauges in order 0 to 5
        self.streaming = False
        self.forget()

    def forget(self) -> None:
        self._first: deque[bytes] = deque()  # first frames that wait for their second
        self._never_empty = 0  # samples since none waited
        self._row: list[bytes] = []
        self._rows: list[bytes] = []
        self._counts: tuple[int, int] | None = None
        self._units: tuple[float, float] | None = None

    # the host's side

    def feed(self, packet: Sequence[CanFrame], t_ns: int) -> Samples | None:
        batch = SampleBatch()
        for identifier, data, extended, _, remote in packet:
            code = identifier - self._base
            if extended or remote or not 0 <= code <= 15 or _is_request(code, data):
                self.stats.skipped += 1
            elif not self._decode_reply(batch, code, data):
                self.stats.corrupt += 1
            else:
                self.stats.intact += 1
        return batch.take((1, 6), t_ns)

    def _decode_reply(self, batch: SampleBatch, code: int, data: bytes) -> bool:
        """Decode a reply; return whether it is valid."""
        if code == GAUGES_A:
            if len(data) != FRAME_A.size:
                return False
            self._first.append(data)
            if len(self._first) > WAITING:
                self._drop_first()
        elif code == GAUGES_B:
            if len(data) != FRAME_B.size:
                return False
            self._pair_frames(batch, data)
        elif code in (ROW_A, ROW_B, ROW_C):
            return len(data) == 8 and self._add_row_part(code, data)
        elif code == COUNTS:
            if len(data) != 8:
                return False
            force, torque = struct.unpack(">2I", data)
            if not force or not torque:
                return False
            self._counts = force, torque
        elif code == UNITS:
            if len(data) != 2 or data[0] not in FORCES or data[1] not in TORQUES:
                return False
            self._units = FORCES[data[0]], TORQUES[data[1]]
            self._rows, self._row = [], []  # the matrix is requested next
        return True

    def _pair_frames(self, batch: SampleBatch, second: bytes) -> None:
        if not self._first:
            self.stats.incomplete += 1
            return
        status, g0, g2, g4 = FRAME_A.unpack(self._first.popleft())
        g1, g3, g5 = FRAME_B.unpack(second)
        self._never_empty = self._never_empty + 1 if self._first else 0
        if self._never_empty > NEVER_EMPTY:
            self._drop_first()
        if self._matrix is None:
            self.complaint = "it has not sent its matrix, which it sends at its start"
            return
        self.complaint = ""
        batch.values.append(self._matrix @ (g0, g1, g2, g3, g4, g5))
        batch.valid.append((not status & INVALIDATING,))
        batch.status.append(status)

    def _drop_first(self) -> None:
        self._first.popleft()
        self._never_empty = 0
        self.stats.incomplete += 1

    def _add_row_part(self, code: int, data: bytes) -> bool:
        """Add the next third of a matrix row; return whether it is valid."""
        if code == ROW_A:
            self._row = []
        if code - ROW_A != len(self._row):
            return False
        self._row.append(data)
        if len(self._row) < 3:
            return True
        row = b"".join(self._row)
        # skip a row that was requested again since its answer was late: no matrix has it twice
        if not self._rows or row != self._rows[-1]:
            self._rows.append(row)
        if len(self._rows) == 6 and self._counts and self._units:
            matrix = np.frombuffer(b"".join(self._rows), ">f4").reshape(6, 6).astype(np.float64)
            if not np.isfinite(matrix).all():
                return False
            scale = [u / n for u, n in zip(self._units, self._counts, strict=True)]
            self._matrix = np.repeat(scale, 3)[:, None] * matrix
        return len(self._rows) <= 6

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        if command == Command.POLL:
            return (Step((CanFrame(self._base | GAUGES_A),)),)
        if command != Command.START:
            return ()
        steps = [
            self._ask(COUNTS, b"", COUNTS, "its counts per unit"),
            self._ask(UNITS, b"", UNITS, "its units"),
        ]
        if self._options.calibration >= 0:
            index = bytes((self._options.calibration,))
            steps.insert(0, self._ask(CALIBRATION, index, CALIBRATION, "choosing its calibration"))
        for row in range(6):
            what = f"row {row} of its calibration matrix"
            steps.append(self._ask(ROW_A, bytes((row,)), ROW_C, what))
        return tuple(steps)

    def _ask(self, code: int, data: bytes, answer: int, what: str) -> Step[Sequence[CanFrame]]:
        return Step((CanFrame(self._base | code, data),), self._base | answer, what=what)

    # the device's side: a transducer without cross-talk, a million counts per N and N m

    def _make_matrix(self) -> NDArray[np.float32]:
        full = [self._options.force_n] * 3 + [self._options.torque_nm] * 3
        return np.diag(np.array(full) * 1e6 / 32767).astype(np.float32)

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        counts = np.nan_to_num(chunk.values[:, 0].astype(np.float64)) * 1e6
        gauges = np.clip(np.rint(counts / np.diag(self._make_matrix())), -32767, 32767).astype(int)
        return [
            [
                CanFrame(self._base | GAUGES_A, FRAME_A.pack(0, g[0], g[2], g[4])),
                CanFrame(self._base | GAUGES_B, FRAME_B.pack(g[1], g[3], g[5])),
            ]
            for g in gauges.tolist()
        ]

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        answers: list[CanFrame] = []
        for frame in packet:
            if frame.extended or frame.remote:
                continue
            code = frame.id - self._base
            if code == GAUGES_A and not frame.data:
                self.polled += 1
            elif code == ROW_A and len(frame.data) == 1 and frame.data[0] < 6:
                row = self._make_matrix()[frame.data[0]].astype(">f4").tobytes()
                answers += [
                    CanFrame(self._base | ROW_A + i, row[8 * i : 8 * i + 8]) for i in range(3)
                ]
            elif code == CALIBRATION and len(frame.data) == 1:
                answers.append(frame)
            elif code == COUNTS and not frame.data:
                answers.append(CanFrame(frame.id, struct.pack(">2I", 1_000_000, 1_000_000)))
            elif code == UNITS and not frame.data:
                answers.append(CanFrame(frame.id, b"\x02\x03"))
        return answers


def _is_request(code: int, data: bytes) -> bool:
    """Return whether a frame is another host's request; these are shorter than replies."""
    return len(data) == (code == ROW_A) and code in (GAUGES_A, ROW_A, COUNTS, UNITS)
