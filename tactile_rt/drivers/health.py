"""Snapshot of a device's state at one moment."""

from dataclasses import dataclass, field
from enum import StrEnum

from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codec import WireStats


@dataclass(frozen=True)
class Identity:
    """Identity of an array: its spec, and serial numbers of its device and USB port."""

    spec: ArraySpec
    serial_number: str = ""
    usb_number: str = ""  # serial number of its USB port

    def difference(self, other: "Identity") -> str:
        """Return why this array cannot be `other`; empty if it can be the same."""
        if found := other.spec.differences(self.spec):
            return f"it describes itself otherwise: {found[0]}"
        for what in ("serial_number", "usb_number"):
            mine, theirs = getattr(self, what), getattr(other, what)
            if mine and theirs:  # the device's own number overrides that of its port
                name = what.replace("_", " ")
                return "" if mine == theirs else f"its {name} is {mine}, not {theirs}"
        return ""


class State(StrEnum):
    """State of a device's stream."""

    CONNECTING = "connecting"  # opened, no sample yet
    STREAMING = "streaming"  # samples come
    STALE = "stale"  # the line is open, but no sample has come for too long
    LOST = "lost"  # the line is gone; the source keeps trying to reopen it


@dataclass(frozen=True)
class Health:
    """State of a device at one moment.

    Attributes:
        since_ns: Host time (CLOCK_MONOTONIC) since which the stream is in this state, ns.
        reason: Why the device is not streaming, in words; empty when it is.
        newest_ns: Host time at which the newest sample arrived, ns; 0 before the first.
        drift_ppm: Excess speed of the host's clock over the device's, parts per million; 0 for a
            device that sends no time.
        clock_steps: Number of times that the device's clock jumped or restarted.
        counter_resets: Number of times that the device's sample counter restarted.
        status: Meanings of the status bits that are set in the newest sample.
        identity: Serial number of the device, or of its USB port; ``unknown`` for none.
        faults: Meanings of the fault bits set within the second before the newest sample.
    """

    state: State
    since_ns: int
    reason: str = ""
    connections: int = 0
    newest_ns: int = 0
    drift_ppm: float = 0.0
    clock_steps: int = 0
    counter_resets: int = 0
    status: tuple[str, ...] = ()
    can_errors: int = 0
    wire: WireStats = field(default_factory=WireStats)
    faults: tuple[str, ...] = ()
    identity: str = "unknown"
    counts: bool = True  # False if the device's counter stands still
