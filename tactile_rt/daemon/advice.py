"""Say of each diagnostic in a sentence what is wrong, since when, and what to do.

The page and `tactile-rt doctor --daemon` show these sentences, `/health` and the ``state`` message
carry them. A sentence stays the same as long as its diagnostic does.
"""

import threading
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

from tactile_rt.daemon.health import BREAKS, Diagnostic

__all__ = ["ADVICE", "Onsets"]

RESOURCES = "Stop other programs, or give it a faster machine; `tactile-rt top` shows what is late."
# Of each kind what it means, of which part, and what to do.
ADVICE: dict[str, tuple[str, str]] = {
    "late": ("the daemon had no turn on the processor", RESOURCES),
    "UTC has jumped": (
        "the wall clock jumped",
        "Let NTP or PTP set it before the daemon starts; times of samples do not depend on it.",
    ),
    "old configuration": (
        "the daemon goes on with its old configuration",
        "Mend the file (`tactile-rt config check FILE`), then send SIGHUP.",
    ),
    "no samples": (
        "{part} gives no samples",
        "Look at power and cable, and at the port (`tactile-rt doctor`, `tactile-rt sniff`). It "
        "is tried again by itself; one that has failed when the configuration changes.",
    ),
    "late samples": (
        "{part} gives its samples late",
        "Lower the latency timer of the USB adapter (`tactile-rt doctor`), or the load of the bus.",
    ),
    "lost samples": (
        "{part} loses samples",
        "Look at cable, connectors, baud rate and bus load; `tactile-rt hz URL` counts the losses.",
    ),
    "bad samples": (
        "{part} gives values that are no measurements",
        "Look at the element's wiring, and at the scale and codec in the source's URL.",
    ),
    "stuck-at fault": (
        "{part} is stuck",
        "Touch it. If still nothing changes, turn the device off and on, or exchange it.",
    ),
    "slow": (
        "{part} is slower than it should be",
        "Compare the device's rate with the one in its URL or description; look at its load.",
    ),
    "sensor fails": ("{part} says that a sensor fails", "Exchange it; touches of it are not felt."),
    "another array": (
        "another array is at {part}",
        "Plug in the one that was there, or accept the new one by SIGHUP.",
    ),
    "no counter": (
        "losses of {part} cannot be seen",
        "Let the device count its samples: its counter does not move.",
    ),
    "no decisions": (
        "{part} decides nothing",
        "Look at the model's file (`tactile-rt model verify FILE`) and its source.",
    ),
    "late decisions": ("{part} decides late", RESOURCES),
    "missing decisions": ("{part} misses decisions", RESOURCES),
    "implausible loads": (
        "{part} is given implausible loads",
        "Compare units, gain and sensor with what the model learnt from; tare again.",
    ),
    "old model": (
        "{part} goes on with its old model",
        "Look at the new file: `tactile-rt model verify FILE`; then send SIGHUP.",
    ),
    "no recording": (
        "not all is recorded",
        "Make room on the disk, and look at it and at the folder's permissions. It goes on by "
        "itself.",
    ),
    "not published": (
        "{part} does not hand on all",
        "Look at the one who reads it, and at its address or file. It goes on by itself.",
    ),
    "no page": ("not all see the page", "Close browsers that nobody looks at, or free its port."),
    "no metrics": ("not all can read the metrics", "Free its port, or name another."),
    "no log": (
        "not all is logged",
        "Make room, and look at the file's folder; of stderr, at the program that reads it.",
    ),
    "no systemd": ("systemd is not told how the daemon is", "Look at NOTIFY_SOCKET and the unit."),
    "disk full soon": (
        "the disk fills up",
        "Move or delete recordings, or record less (see [recorder]).",
    ),
    "memory grows": (
        "the daemon needs more and more memory",
        "Restart it when that does no harm, and report it with `tactile-rt top --once`.",
    ),
}


class Onsets:
    """Keeps when each diagnostic began; from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun: dict[tuple[str, str], tuple[int, str]] = {}

    def explain(
        self, found: Sequence[Diagnostic], now_ns: int, utc_ns: int
    ) -> tuple[Diagnostic, ...]:
        """Return the diagnostics of now with their beginnings and sentences.

        Args:
            now_ns: The time at which they are true, host CLOCK_MONOTONIC, ns; `utc_ns` in UTC.
        """
        when = datetime.fromtimestamp(utc_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        with self._lock:
            known = self._begun
            keys = [(one.part, one.what) for one in found]
            self._begun = {key: known.get(key, (now_ns, when)) for key in keys}
            begun = [self._begun[key] for key in keys]
        return tuple(map(_explain, found, begun))


def _explain(one: Diagnostic, begun: tuple[int, str]) -> Diagnostic:
    what, do = ADVICE.get(one.what, (f"{{part}}: {one.what}", ""))
    it = "it " if one.why.startswith(BREAKS) else ""
    says = f"{what.format(part=one.part)} since {begun[1]}: {it}{one.why}"
    says += f"; {one.still}." if one.still else "."
    return replace(one, since_ns=begun[0], says=says, do=do)
