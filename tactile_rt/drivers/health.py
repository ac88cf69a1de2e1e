"""How a device is doing: one snapshot, true at the moment it is taken."""

from dataclasses import dataclass, field
from enum import StrEnum

from tactile_rt.drivers.codec import WireStats

__all__ = ["Health", "State"]


class State(StrEnum):
    """Of a device's stream."""

    CONNECTING = "connecting"  # opened, no sample yet
    STREAMING = "streaming"  # samples come
    STALE = "stale"  # the line is open, but no sample has come for too long
    LOST = "lost"  # the line is gone; it is tried again and again


@dataclass(frozen=True)
class Health:
    """What is known of a device.

    Attributes:
        state: of its stream.
        since_ns: since when, host CLOCK_MONOTONIC.
        reason: why it is not streaming, in words; empty when it is.
        connections: times it has been connected.
        newest_ns: arrival of the newest sample; 0: none yet.
        drift_ppm: how much faster the host's clock runs; 0 for a device that tells no time.
        clock_steps: times that the device's clock jumped or began anew.
        counter_resets: times that its sample counter began anew.
        status: what its status bits of the newest sample mean.
        can_errors: CAN error frames.
        wire: frames that came, and what was wrong with them.
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
