"""How far a project's device is from its description, kept for the report card."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from tactile_rt.errors import ConfigError
from tactile_rt.files import write_whole
from tactile_rt.project.folder import Project
from tactile_rt.sim_backend.measuring.findings import ArrayFinding

__all__ = ["DeviceFit", "keep_fit", "read_fit"]

CHANGED = "array.toml has been brought to that: what is described is what it said before."
LEFT = "array.toml has not been changed."


class DeviceFit(msgspec.Struct, frozen=True):
    """What `tactile-rt array fit` told, in words.

    Attributes:
        when: The UTC time of the measurement, ISO 8601.
        since: What has become of the array's file.
        rows: The name of each quantity, its unit, the value described, that measured, their ratio.
        notes: What could not be measured, and whose value deviates.
    """

    recording: str
    when: str
    since: str
    rows: list[tuple[str, str, str, str, str]]
    notes: list[str]


def keep_fit(array: Path, recording: str, findings: Sequence[ArrayFinding], changed: bool) -> None:
    """Write ``fit.json`` beside the array's file, if that is a project's.

    Args:
        changed: whether the array's file is brought to that.
    """
    try:
        project = Project(array.parent)
    except ConfigError:
        return
    if array.name != project.array.name:
        return
    fit = DeviceFit(
        recording,
        datetime.now(UTC).isoformat(timespec="seconds"),
        CHANGED if changed else LEFT,
        [f.words() for f in findings],
        [f"{f.what}: {f.note}" for f in findings if f.note],
    )
    write_whole(project.fit, lambda file: file.write(msgspec.json.encode(fit)))


def read_fit(project: Project) -> DeviceFit | None:
    """What was measured of a project's device; None: nothing was."""
    if not project.fit.exists():
        return None
    try:
        return msgspec.json.decode(project.fit.read_bytes(), type=DeviceFit)
    except msgspec.MsgspecError as error:
        raise ConfigError(f"{project.fit} is damaged ({error}): run `array fit` again") from None
