"""Advice on diagnostics: a sentence on what is wrong, since when, and what to do.

The page and `tactile-rt doctor --daemon` show it, `/health` and the ``state`` message carry it. A
sentence stays the same as long as its diagnostic lasts.
"""

import threading
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

from tactile_rt.daemon.states import BREAKS, Diagnostic

LOAD = "Stop other programs, or take a faster machine or a smaller model; see `tactile-rt top URL`."
VERIFY = "Look at the model's file: `tactile-rt model verify FILE`; then send SIGHUP."
# What to do, by what is missing.
ADVICE = {
    "late": LOAD,
    "UTC has jumped": "Let NTP or PTP set the clock before; times of samples do not depend on it.",
    "old configuration": "Mend the file (`tactile-rt config check FILE`), then send SIGHUP.",
    "no samples": "Look at power, cable and port: `tactile-rt doctor`. It is tried again.",
    "late samples": "Lower the latency timer of the USB adapter (`tactile-rt doctor`) or the load.",
    "lost samples": "Look at cable, connectors, baud rate and bus load: `tactile-rt hz URL`.",
    "bad samples": "Look at the wiring, and at the scale and codec in the source's URL.",
    "stuck-at fault": "Touch it. If still nothing changes, turn the device off and on.",
    "all zeros": "Touch it. If still nothing changes, look at the sensor's power and cable.",
    "slow": "Compare the device's rate with the one that it is described by; look at its load.",
    "fast": "Describe the device by the rate that it has: decisions depend on it.",
    "device fault": "See its manual on what it says; what touches a broken sensor is not felt.",
    "another array": "Plug in the one that was there, or accept the new one by SIGHUP.",
    "no counter": "Mend the device's program: its counter does not move.",
    "device clock": "Look at its program: rate and times by its clock are as wrong as that is.",
    "restarted": "Look at its power supply and its program: it starts anew, or sets its counter.",
    "repeated samples": "Look for what sends twice: a bridge, a second sender, a replayed log.",
    "no decisions": VERIFY,
    "late decisions": LOAD,
    "missing decisions": LOAD,
    "implausible loads": "Compare unit, gain and sensor with what the model learnt from; tare.",
    "old model": VERIFY,
    "no recording": "Look at disk, folder and permissions. It goes on by itself.",
    "not published": "Look at who reads it, and at its address or file. It goes on by itself.",
    "no page": "Close unused browser windows, or free its port.",
    "no metrics": "Free its port, or name another one.",
    "no log": "Look at the file's folder and disk; of stderr, at the program that reads it.",
    "no systemd": "Look at the unit: NotifyAccess and WatchdogSec.",
    "offset drifts": "Let the sensor warm up, then tare; keep draughts and heat off it.",
    "jitter grows": "Look at the load of host and bus; lower the USB adapter's latency timer.",
    "memory full soon": "Restart it when it is not needed, and report what it ran.",
    "disk full soon": "Move or delete recordings, or record less (see [recorder]).",
}


class DiagnosticOnsets:
    """A thread-safe record of when each current diagnostic was first found."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._onsets: dict[tuple[str, str], tuple[int, str]] = {}

    def explain(
        self, found: Sequence[Diagnostic], now_ns: int, utc_ns: int
    ) -> tuple[Diagnostic, ...]:
        """Return current diagnostics with onset and advice; `now_ns` is host CLOCK_MONOTONIC."""
        when = datetime.fromtimestamp(utc_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        with self._lock:
            keys = [(one.part, one.what) for one in found]
            begun = self._onsets = {key: self._onsets.get(key, (now_ns, when)) for key in keys}
        return tuple(_add_advice(one, *begun[one.part, one.what]) for one in found)


def _add_advice(one: Diagnostic, since_ns: int, when: str) -> Diagnostic:
    it = "it " if one.why.startswith(BREAKS) else ""
    still = f"; {one.still}" if one.still else ""
    says = f"{one.part}: {one.what} since {when}: {it}{one.why}{still}."
    return replace(one, since_ns=since_ns, says=says, do=ADVICE.get(one.what, ""))
