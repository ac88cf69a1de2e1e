"""Diagnostics: what does not work now, derived from measured facts.

A running thread does not prove that its work is done. So `diagnose` compares with limits of the
configuration: the age of the newest sample, how long samples are not on disk and messages not
published, and what was lost within the newest second.

The consequence of another diagnostic is not reported: without samples there are no decisions, and
while the whole process gets no processor time, none of its parts is to blame.

A diagnostic is one line that stays the same as long as it holds: it contains no number that keeps
changing. The numbers are in the snapshot.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Sequence

from msgspec import structs

from tactile_rt.classifier.classifier import IMPLAUSIBLE_LOADS
from tactile_rt.core.errors import name_some
from tactile_rt.daemon.config import LimitsConfig
from tactile_rt.daemon.rate_meter import SLOW
from tactile_rt.daemon.states import (
    ConsumerState,
    Diagnostic,
    Losses,
    ModelState,
    PartState,
    SourceState,
)
from tactile_rt.drivers.health import State

NS = 1e9
MINUTE_S, SECOND_S, LOOK_S = 60.0, 1.0, 0.05
REPEATED = 0.01  # of the samples of a second: a copy now and then is no harm
PERIODS = 3  # of a slow sensor, after which its newest sample is old


class LossWindow:
    """A meter of how much a count grew within the newest second and minute."""

    def __init__(self, first: int = 0) -> None:
        self._lock = threading.Lock()
        self._seen: deque[tuple[float, int]] = deque([(time.monotonic(), first)])

    def add(self, count: int) -> Losses:
        """Record the present count; return its growth. Safe from any thread."""
        now = time.monotonic()
        with self._lock:
            if now - self._seen[-1][0] >= LOOK_S:  # more frequent calls take no memory
                self._seen.append((now, count))
            while len(self._seen) > 1 and self._seen[1][0] <= now - MINUTE_S:
                self._seen.popleft()
            before = minute = self._seen[0][1]
            for seen, n in reversed(self._seen):
                before = n
                if seen <= now - SECOND_S:
                    break
        return Losses(count - before, count - minute)


def oldest_s(limits: LimitsConfig, rate_hz: float) -> float:
    """Return the greatest allowed age of a source's newest sample, s."""
    return max(limits.sample_age_s, PERIODS / rate_hz)


def diagnose(
    sources: Sequence[SourceState],
    models: Sequence[ModelState],
    consumers: Sequence[ConsumerState],
    limits: LimitsConfig,
    now_ns: int,
    starved_s: float = 0.0,
    clock_stepped: bool = False,
    refused: str = "",
) -> tuple[Diagnostic, ...]:
    """Return the diagnostics of the daemon, sources, models and consumers, in this order.

    Args:
        now_ns: The time of these states, host CLOCK_MONOTONIC, ns.
        starved_s: How long the whole process recently got no processor time, s.
        clock_stepped: Whether the wall clock jumped within the newest second.
        refused: The reason why the newest configuration is not in force, or an empty string.
    """
    found = []
    if starved_s:
        why = "it had no turn: it was stopped, or another program took the processor"
        found.append(Diagnostic("daemon", "late", why))
        # no part is to blame for being late meanwhile, but losses still count
        limits = structs.replace(limits, sample_age_s=math.inf, behind_s=math.inf)
    if clock_stepped:
        found.append(Diagnostic("daemon", "UTC has jumped", "the wall clock was set"))
    if refused:
        why = f"the new one is refused: {refused}"
        found.append(Diagnostic("daemon", "old configuration", why, "the one before is in force"))
    for source in sources:
        found += _diagnose_source(source, limits, now_ns, bool(starved_s))
    recording = any(c.kind == "recorder" and c.part.state == "running" for c in consumers)
    on = "recording goes on" if recording else "acquisition goes on"
    for model in models:
        found += _diagnose_model(model, limits, now_ns, on, bool(starved_s))
    for consumer in consumers:
        found += _diagnose_consumer(consumer, sources, limits, now_ns, bool(starved_s))
    return tuple(found)


def _diagnose_source(
    source: SourceState, limits: LimitsConfig, now_ns: int, starved: bool
) -> list[Diagnostic]:
    part, device = source.part, source.device
    name = part.name
    if _is_broken(part, starved):
        return [Diagnostic(name, "no samples", _describe_failure(part))]
    if part.state != "running":
        return []
    rate_hz = source.measured_hz if source.slow else source.rate_hz
    most = oldest_s(limits, rate_hz) if rate_hz else limits.sample_age_s
    read_s, taken_s = (now_ns - source.read_ns) / NS, (now_ns - source.newest_ns) / NS
    late = starved or (source.slow and read_s <= most)  # slow or starved, but not silent
    away = (State.LOST,) if late else (State.STALE, State.LOST)
    if device is not None and device.state in away:
        return [Diagnostic(name, "no samples", f"the device is {device.state}")]
    found = []
    if source.another:
        why = f"{source.another}; nothing is decided of it until a reload (SIGHUP) accepts it"
        found.append(Diagnostic(name, "another array", why))
    if source.live and source.newest_ns:
        if read_s > most:
            why = f"none has come for {oldest_s(limits, source.rate_hz):g} s"
            found.append(Diagnostic(name, "no samples", why))
        elif taken_s > most:
            why = f"when they come they are older than {most:g} s"
            found.append(Diagnostic(name, "late samples", why))
    if source.stuck_at_s or source.stuck:
        each = f"no value of {name_some(source.stuck)} changes: stuck, or out of range"
        all_of_it = f"{'all zeros' if source.zeros else 'no value changes'}: the device hangs"
        why = all_of_it if source.stuck_at_s else each
        found.append(Diagnostic(name, "stuck-at fault", why))
    if source.slow and read_s <= most and not starved:
        why = f"it measures less often than nine tenths of the {source.rate_hz:g} Hz that it has"
        found.append(Diagnostic(name, "slow", why))
    if device is not None and source.measured_hz > source.rate_hz / SLOW and not starved:
        why = f"it measures more often than ten ninths of the {source.rate_hz:g} Hz that it has"
        found.append(Diagnostic(name, "fast", why))
    if device is not None and not device.counts:
        why = "its counter does not go on: what is lost cannot be seen"
        found.append(Diagnostic(name, "no counter", why))
    if source.clock_off:
        why = "its clock runs at another speed than the host's: rates by it are as wrong"
        found.append(Diagnostic(name, "device clock", why))
    if source.restarts.second and not starved:
        why = "its counter began anew: what was lost meanwhile is not counted"
        found.append(Diagnostic(name, "restarted", why))
    if source.repeats.second > REPEATED * source.rate_hz:
        found.append(Diagnostic(name, "repeated samples", "more than one in a hundred comes twice"))
    if faults := device.faults if device is not None else ():
        found.append(Diagnostic(name, "device fault", f"it says: {', '.join(faults)}"))
    if source.losses.second:
        found.append(Diagnostic(name, "lost samples", "some did not come, or came damaged"))
    if source.bad.second and not faults:  # a failing device marks values invalid
        why = "some values are no numbers, or absurd, or none is valid"
        found.append(Diagnostic(name, "bad samples", why))
    return found


def _diagnose_model(
    model: ModelState, limits: LimitsConfig, now_ns: int, still: str, starved: bool
) -> list[Diagnostic]:
    part = model.part
    if _is_broken(part, starved):
        return [Diagnostic(part.name, "no decisions", _describe_failure(part), still)]
    if part.state == "starting" and now_ns - part.since_ns > limits.behind_s * NS:
        return [Diagnostic(part.name, "no decisions", "it is still being tried and loaded", still)]
    if part.state != "running":
        return []
    if model.behind_s > limits.behind_s:
        why = f"it is more than {limits.behind_s:g} s behind"
        return [Diagnostic(part.name, "late decisions", why, still)]
    if model.skips.second or model.lost.second:
        skips = "it cannot keep up, and skips to the newest sample"
        why = skips if model.skips.second else "it was too slow for its samples"
        return [Diagnostic(part.name, "missing decisions", why, still)]
    if model.implausible:
        return [Diagnostic(part.name, "implausible loads", IMPLAUSIBLE_LOADS, still)]
    if model.undecided:
        why = "its answer to the newest touch is no number: take another model"
        return [Diagnostic(part.name, "no decisions", why, still)]
    if model.refused:
        why = f"the new one is refused: {model.refused}"
        return [Diagnostic(part.name, "old model", why, "the one before decides")]
    return []


def _diagnose_consumer(
    consumer: ConsumerState,
    sources: Sequence[SourceState],
    limits: LimitsConfig,
    now_ns: int,
    starved: bool,
) -> list[Diagnostic]:
    part, still = consumer.part, "acquisition goes on"
    missing = "not published"
    if not part.name.startswith("publisher."):
        missing = "no recording" if consumer.kind == "recorder" else f"no {consumer.kind}"
    if _is_broken(part, starved):
        return [Diagnostic(part.name, missing, _describe_failure(part), still)]
    if part.state not in ("running", "starting"):
        return []
    if consumer.behind_s > limits.behind_s:
        why = f"it is more than {limits.behind_s:g} s behind"
    elif consumer.diagnostic:
        why = consumer.diagnostic
    elif consumer.losses.second:
        why = "it was too slow, and some of it was dropped"
    else:
        why = "" if starved else _diagnose_disk(consumer, sources, limits, now_ns)
    return [Diagnostic(part.name, missing, why, still)] if why else []


def _diagnose_disk(
    consumer: ConsumerState, sources: Sequence[SourceState], limits: LimitsConfig, now_ns: int
) -> str:
    """Return which samples are not on disk, and why, or an empty string."""
    for source in sources:
        name = source.part.name.partition(".")[2]
        disk = consumer.on_disk.get(name)
        if disk is None:
            continue
        if disk.slow_s and disk.waits_ns and now_ns - disk.waits_ns > disk.slow_s * NS:
            return f"a power cut would take more than {disk.slow_s:g} s of {name}: a slow disk"
        if disk.lost_ns and now_ns - disk.lost_ns < SECOND_S * NS:
            return f"samples of {name} are lost: {disk.lost_why}"
        if not disk.meant_ns or not source.live or not source.read_ns:
            continue
        written_ns = max(disk.written_ns, disk.meant_ns, source.flowing_ns, consumer.part.since_ns)
        most = max(limits.record_age_s, PERIODS / source.rate_hz)
        if source.read_ns - written_ns > most * NS:
            return f"samples of {name} are not on the disk after {limits.record_age_s:g} s"
    return ""


def _is_broken(part: PartState, starved: bool) -> bool:
    if part.state == "stalled":
        return not starved
    # A part that is being restarted still counts as broken.
    broken = part.state in ("waiting", "failed")
    return broken or (part.state == "starting" and part.failures > 0)


def _describe_failure(part: PartState) -> str:
    if part.state == "stalled":
        return "stalls"
    return f"{'has failed' if part.state == 'failed' else 'fails'}: {part.reason}"
