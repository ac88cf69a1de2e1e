"""What goes wrong on the wire, on purpose: a schedule of faults, from TOML and a seed.

    seed = 1
    [[fault]]
    kind = "bit_flip"
    rate = 2.0          # twice a second, at random
    amount = 3          # bits
    [[fault]]
    kind = "unplug"
    at_s = 5.0          # once
    duration_s = 0.5

At most one fault hits any one sample, so that the losses a receiver counts can be compared with
what was done, sample by sample. The first and the last half second are undisturbed, and nothing is
lost beside a restart of the counter, where no receiver could count it.
"""

import heapq
import math
import random
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec

from tactile_rt.settings import convert, no_such, read_toml
from tactile_rt.stream import ConfigError

__all__ = ["KINDS", "QUIET_S", "Fault", "FaultSchedule", "read_faults"]

QUIET_S = 0.5  # undisturbed at either end
BESIDE_RESET_S = 0.05  # undisturbed on either side of a restart


class Kind(NamedTuple):
    """What a kind of fault takes: `amount` by default and in which unit; a duration or not."""

    amount: float
    unit: str
    lasts: bool = False
    whole: bool = True  # whether the amount is a whole number of at least one


KINDS = {
    "bit_flip": Kind(1, "bits inverted in the sample's packet; on CAN in its data"),
    "truncate": Kind(1, "bytes missing from the packet's end; frames, on CAN"),
    "duplicate": Kind(1, "further copies of the packet"),
    "burst": Kind(16, "random bytes before the packet; on CAN, frames that nobody knows"),
    "stall": Kind(0, "", lasts=True),
    "drop": Kind(1, "samples in succession that are not sent"),
    "clock_drift": Kind(100, "parts per million", lasts=True, whole=False),
    "clock_jump": Kind(1, "seconds, negative: back", whole=False),
    "sequence_reset": Kind(0, "", whole=False),
    "unplug": Kind(0, "", lasts=True),
    "can_error": Kind(1, "error frames"),
}


@dataclass(frozen=True)
class Fault:
    """One kind of fault, and when.

    Attributes:
        kind: one of `KINDS`. ``stall``: nothing is sent for a while, then all at once.
            ``sequence_reset``: the device's counter and clock start again, as after a restart.
        rate: how often, per second in the mean, at random times; or
        at_s: when, in seconds of the stream.
        duration_s: how long, of ``stall``, ``unplug`` and ``clock_drift`` (0: to the end).
        amount: how much, see `KINDS`; None: its default.

    Raises:
        ConfigError: which field, and what it can be.
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
            raise ConfigError("give either rate, per second, or at_s, once")
        if self.at_s is not None and not QUIET_S <= self.at_s < math.inf:
            raise ConfigError(
                f"at_s must be {QUIET_S} or more (undisturbed before), not {self.at_s}"
            )
        if self.duration_s and not kind.lasts:
            raise ConfigError(f"duration_s: {self.kind} has none")
        if kind.lasts and self.kind != "clock_drift" and not self.duration_s:
            raise ConfigError(f"duration_s must be more than 0 for {self.kind}")
        if self.amount is not None:
            if not kind.unit:
                raise ConfigError(f"amount: {self.kind} has none")
            if not math.isfinite(self.amount):
                raise ConfigError(f"amount must be a number, not {self.amount}")
            if kind.whole and (self.amount < 1 or self.amount % 1):
                raise ConfigError(
                    f"amount must be a whole number of {kind.unit}, not {self.amount}"
                )

    @property
    def size(self) -> float:
        """`amount`, or the default of its kind."""
        return KINDS[self.kind].amount if self.amount is None else self.amount


class FaultSchedule:
    """Which fault hits which sample; the same seed and times give the same faults.

    Args:
        faults: what may happen.
        seed: of the random times and of `random`.

    Attributes:
        faults: what may happen.
        random: for whoever carries the faults out.
    """

    def __init__(self, faults: tuple[Fault, ...] | list[Fault], seed: int = 0) -> None:
        self.faults = tuple(faults)
        self.random = random.Random(f"{seed} damage")
        self._draws = [random.Random(f"{seed} {k}") for k in range(len(self.faults))]
        self._due: list[tuple[float, int]] = []  # (when, which fault), heaps
        self._resets: list[tuple[float, int]] = []
        for k, fault in enumerate(self.faults):
            self._plan(k, QUIET_S if fault.at_s is None else fault.at_s)
        self._now: Fault | None = None  # lasts
        self._until_s = 0.0
        self._left = 0  # samples that it still hits
        self._last_s = self._reset_s = -math.inf  # the last fault but resets; the last reset

    def at(self, t_s: float, quiet: bool = False) -> Fault | None:
        """What hits the sample at this time; to be called once per sample, in order of time.

        A fault that lasts is returned for each sample that it hits. Faults that fall on one
        sample come one after the other. ``clock_drift`` is returned once, when it begins.

        Args:
            t_s: seconds since the first sample.
            quiet: whether the stream is about to end: nothing happens any more.
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
                return None  # a loss just before could not be told from the restart
            self._reset_s = t_s
            return self._take(self._resets)
        if t_s < self._reset_s + BESIDE_RESET_S or not self._due or self._due[0][0] > t_s:
            return None
        self._last_s = t_s
        fault = self._take(self._due)
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

    def _take(self, due: list[tuple[float, int]]) -> Fault:
        when, k = heapq.heappop(due)
        if self.faults[k].rate:
            self._plan(k, when)
        return self.faults[k]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    seed: int = 0
    fault: tuple[Fault, ...] = ()


def read_faults(path: Path | str) -> FaultSchedule:
    """Read a schedule; see the head of this module.

    Raises:
        ConfigError: one line that names the file, the fault, the key, and what to do.
    """
    path = Path(path)
    file: _File = convert(read_toml(path), _File)
    if not file.fault:
        raise ConfigError(f"{path}: has no [[fault]] tables; give at least one")
    return FaultSchedule(file.fault, file.seed)
