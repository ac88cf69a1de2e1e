"""What does not work, in words, and what goes on all the same."""

from collections.abc import Sequence

from tactile_rt.daemon.snapshot import ConsumerState, ModelState, PartState, SourceState
from tactile_rt.drivers.health import State

__all__ = ["degraded"]


def degraded(
    sources: Sequence[SourceState],
    models: Sequence[ModelState],
    consumers: Sequence[ConsumerState],
) -> tuple[str, ...]:
    """One line for each part that does not work. Reasons that count on are left out, so that a
    line stays the same as long as what it says."""
    lines = []
    recording = any(c.kind == "recorder" and c.part.state == "running" for c in consumers)
    for source in sources:
        device = source.device
        if _broken(source.part):
            lines.append(f"no samples: {_why(source.part)}")
        elif device is not None and device.state in (State.STALE, State.LOST):
            lines.append(f"no samples: {source.part.name}: the device is {device.state}")
    for model in models:
        if _broken(model.part):
            goes_on = "recording goes on" if recording else "acquisition goes on"
            lines.append(f"no decisions: {_why(model.part)}; {goes_on}")
    for consumer in consumers:
        if _broken(consumer.part):
            lines.append(f"{_what(consumer)}: {_why(consumer.part)}; acquisition goes on")
    return tuple(lines)


def _broken(part: PartState) -> bool:
    # While it is tried again it is not well yet.
    return part.state in ("waiting", "stalled") or (part.state == "starting" and part.failures > 0)


def _why(part: PartState) -> str:
    return f"{part.name} {'stalls' if part.state == 'stalled' else 'fails: ' + part.reason}"


def _what(consumer: ConsumerState) -> str:
    return {"recorder": "no recording", "page": "no page", "log": "no log"}.get(
        consumer.kind, "not published" if consumer.part.name.startswith("publisher.") else "missing"
    )
