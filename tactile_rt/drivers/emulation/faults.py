"""Deliberate faults on the wire: their schedule, their effect on packets, and a record.

The schedule comes from TOML and a seed:

    seed = 1
    [[fault]]
    kind = "bit_flip"
    rate = 2.0          # twice a second, at random
    amount = 3          # bits
    [[fault]]
    kind = "unplug"
    at_s = 5.0          # once
    duration_s = 0.5

At most one fault hits a sample, so that the losses that a receiver counts can be compared with the
record, sample by sample. The first and the last half second are undisturbed, and nothing is lost
around a restart of the counter, where no receiver could count it.
"""

import heapq
import math
import random
from array import array
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import convert, no_such, read_toml
from tactile_rt.drivers.codec import Packet

FOR_EVER = ("clock_drift", "gather")  # kinds that may last to the end
QUIET_S = 0.5  # s without faults at the beginning and end of a stream
BESIDE_RESET_S = 0.05  # s without faults before and after a restart


class Kind(NamedTuple):
    """Parameters of a kind of fault: default amount, its unit, whether it has a duration."""

    amount: float
    unit: str
    lasts: bool = False
    whole: bool = True  # whether the amount must be an integer of at least one


KINDS = {
    "bit_flip": Kind(1, "bits inverted in the sample's packet; on CAN in its data"),
    "truncate": Kind(1, "bytes missing from the packet's end; frames, on CAN"),
    "duplicate": Kind(1, "further copies of the packet"),
    "burst": Kind(16, "random bytes before the packet; on CAN, frames of unknown identifiers"),
    "stall": Kind(0, "", lasts=True),
    "drop": Kind(1, "samples in succession that are not sent"),
    "clock_drift": Kind(100, "parts per million", lasts=True, whole=False),
    "clock_jump": Kind(1, "seconds, negative: back", whole=False),
    "sequence_reset": Kind(0, "", whole=False),
    "unplug": Kind(0, "", lasts=True),
    "gather": Kind(16, "ms for which an adapter keeps what has come", lasts=True),
    "can_error": Kind(1, "error frames"),
}


@dataclass(frozen=True)
class Fault:
    """Fault of one kind, at one time or repeatedly at random.

    Attributes:
        kind: Name of a kind in `KINDS`. With ``stall`` nothing is sent for a while, then all at
            once; with ``sequence_reset`` the device's counter and clock start again, as after a
            restart.
        rate: Mean number of faults per second, at random times; 0 if `at_s` is given.
        at_s: Time of the single fault, in seconds of the stream; None if `rate` is given.
        duration_s: Length of the fault, s, for ``stall``, ``unplug``, ``clock_drift`` and
            ``gather``; with 0, the last two go on to the end.
        amount: Size of the fault, in the unit given in `KINDS`; None for the default of its kind.
    """

    kind: str
    rate: float = 0.0
    at_s: float | None = None
    duration_s: float = 0.0
    amount: float | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ConfigError(no_such("fault kind", self.kind, KINDS))
        kind = KINDS[self.kind]
        for name in ("rate", "duration_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name)}")
        if (self.rate > 0) == (self.at_s is not None):
            raise ConfigError(
                "give either rate (faults per second) or at_s (time of a single fault)"
            )
        if self.at_s is not None and not QUIET_S <= self.at_s < math.inf:
            raise ConfigError(
                f"at_s must be {QUIET_S} or more (undisturbed before), not {self.at_s}"
            )
        if self.duration_s and not kind.lasts:
            raise ConfigError(f"{self.kind} takes no duration_s")
        if kind.lasts and self.kind not in FOR_EVER and not self.duration_s:
            raise ConfigError(f"duration_s must be more than 0 for {self.kind}")
        if self.amount is not None:
            if not kind.unit:
                raise ConfigError(f"{self.kind} takes no amount")
            if not math.isfinite(self.amount):
                raise ConfigError(f"amount must be a number, not {self.amount}")
            if kind.whole and (self.amount < 1 or self.amount % 1):
                raise ConfigError(
                    f"amount must be a whole number of {kind.unit}, not {self.amount}"
                )

    @property
    def size(self) -> float:
        """Size of the fault: `amount`, or the default of its kind."""
        return KINDS[self.kind].amount if self.amount is None else self.amount


class FaultSchedule:
    """Schedule of faults by sample; the same seed and sample times give the same faults."""

    def __init__(self, faults: tuple[Fault, ...] | list[Fault], seed: int = 0) -> None:
        self.faults = tuple(faults)
        self.random = random.Random(f"{seed} damage")
        self._draws = [random.Random(f"{seed} {k}") for k in range(len(self.faults))]
        self._due: list[tuple[float, int]] = []  # (time, index of the fault), heaps
        self._resets: list[tuple[float, int]] = []
        for k, fault in enumerate(self.faults):
            self._plan(k, QUIET_S if fault.at_s is None else fault.at_s)
        self._now: Fault | None = None  # the fault that lasts at present
        self._until_s = 0.0
        self._left = 0  # samples that it still hits
        self._last_s = self._reset_s = -math.inf  # the last fault except resets; the last reset

    def at(self, t_s: float, quiet: bool = False) -> Fault | None:
        """Return the fault that hits the sample at this time, or None.

        Call it once per sample, in order of time. A lasting fault is returned for each sample that
        it hits. Faults due at one sample hit successive samples. ``clock_drift`` is returned once,
        when it begins.

        Args:
            quiet: Whether the stream is about to end; then None is returned.
        """
        if quiet or t_s < QUIET_S:
            return None
        if self._now is not None and (self._left > 0 or t_s < self._until_s):
            self._left -= 1
            self._last_s = t_s
            return self._now
        self._now = None
        if self._resets and self._resets[0][0] < t_s + BESIDE_RESET_S:
            if self._resets[0][0] > t_s or t_s < self._last_s + BESIDE_RESET_S:
                return None  # a loss just before could not be distinguished from the restart
            self._reset_s = t_s
            return self._pop(self._resets)
        if t_s < self._reset_s + BESIDE_RESET_S or not self._due or self._due[0][0] > t_s:
            return None
        self._last_s = t_s
        fault = self._pop(self._due)
        if fault.kind == "drop":
            self._now, self._left, self._until_s = fault, int(fault.size) - 1, t_s
        elif fault.kind in ("stall", "unplug"):
            self._now, self._left, self._until_s = fault, 0, t_s + fault.duration_s
        return fault

    def _plan(self, k: int, after_s: float) -> None:
        fault = self.faults[k]
        wait = self._draws[k].expovariate(fault.rate) if fault.rate else 0.0
        due = self._resets if fault.kind == "sequence_reset" else self._due
        heapq.heappush(due, (after_s + wait, k))

    def _pop(self, due: list[tuple[float, int]]) -> Fault:
        when, k = heapq.heappop(due)
        if self.faults[k].rate:
            self._plan(k, when)
        return self.faults[k]


class Fate(IntEnum):
    """Fate of a sample's packet at the device's end of the line."""

    SENT = 0  # whole, once; also after random bytes
    DUPLICATED = 1  # whole, more than once
    CORRUPTED = 2  # with inverted bits; on CAN, without the frames that had them
    TRUNCATED = 3  # without its end
    DROPPED = 4  # not sent
    OVERFLOWED = 5  # not sent: the queue was full, since the host did not read
    UNHEARD = 6  # not sent: the port was not open, or the device was pulled out


class DeviceLog:
    """Record of the fate of each of a device's samples."""

    def __init__(self, kept: bool = True) -> None:
        self.counts: Counter[Fate] = Counter()
        self.duplicated = 0
        self._records_each = kept
        self._seq, self._t_ns, self._fate = array("q"), array("q"), bytearray()

    @property
    def sent(self) -> int:
        """Number of samples that the device has numbered, including lost ones."""
        return sum(self.counts.values())

    @property
    def seq(self) -> NDArray[np.int64]:
        """Device's counter at each sample, (n,), not wrapped; it restarts with the device."""
        return np.array(self._seq, np.int64)

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Device's clock at each sample, (n,), ns, not wrapped."""
        return np.array(self._t_ns, np.int64)

    @property
    def fate(self) -> NDArray[np.uint8]:
        """`Fate` of each sample, (n,)."""
        return np.array(self._fate, np.uint8)

    def add(self, seq: int, t_ns: int, fate: Fate) -> int:
        """Record one sample; return its index for `change`."""
        self.counts[fate] += 1
        if self._records_each:
            self._seq.append(seq)
            self._t_ns.append(t_ns)
            self._fate.append(fate)
        return len(self._fate) - 1

    def change(self, at: int, old: Fate, new: Fate) -> None:
        """Change the recorded fate of the sample with index `at`, which was held back."""
        self.counts[old] -= 1
        self.counts[new] += 1
        if self._records_each:
            self._fate[at] = new


def damage_packet(packet: Packet, fault: Fault, draw: random.Random) -> tuple[Packet, Fate]:
    """Apply a bit flip or a truncation; return the damaged packet and its fate.

    CAN has a checksum of its own: a frame with a wrong bit does not arrive. At least one byte of a
    serial packet remains; a CAN packet may lose all its frames.
    """
    amount = int(fault.size)
    if fault.kind == "truncate":
        if isinstance(packet, bytes):
            return packet[: max(1, len(packet) - amount)], Fate.TRUNCATED
        return packet[: max(0, len(packet) - amount)], Fate.TRUNCATED
    if isinstance(packet, bytes):
        hurt = bytearray(packet)
        for bit in draw.sample(range(8 * len(hurt)), min(amount, 8 * len(hurt))):
            hurt[bit // 8] ^= 1 << bit % 8
        return bytes(hurt), Fate.CORRUPTED
    lost = set(draw.sample(range(len(packet)), min(amount, len(packet))))
    left: Sequence[object] = [frame for i, frame in enumerate(packet) if i not in lost]
    return left, Fate.CORRUPTED  # type: ignore[return-value]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    seed: int = 0
    fault: tuple[Fault, ...] = ()


def read_faults(path: Path | str) -> FaultSchedule:
    """Read a schedule of faults from a TOML file; see this module's docstring."""
    path = Path(path)
    file: _File = convert(read_toml(path), _File)
    if not file.fault:
        raise ConfigError(f"{path}: has no [[fault]] tables; give at least one")
    return FaultSchedule(file.fault, file.seed)
