"""A source whose samples are corrected on their way, and may be declared to be another array's."""

import re
from dataclasses import replace
from typing import Any

from tactile_rt.calibration.device_calibration import Calibration
from tactile_rt.core.stream import ArraySpec, Chunk, Source


class CalibratedSource(Source):
    """A source whose samples are corrected; all else (statistics, health, commands) is its own.

    Args:
        source: of raw samples; closed with this one.

    Raises:
        SpecMismatch: it is for another array.
    """

    def __init__(self, source: Source, calibration: Calibration) -> None:
        # No `stats` of our own: like all that is not here, they are looked up in the source.
        self.source, self.calibration = source, calibration
        self.spec = calibration.output_spec(source.spec)
        self.live = source.live

    def read(self, timeout: float | None = None) -> Chunk | None:
        chunk = self.source.read(timeout)
        return None if chunk is None else self.calibration.apply(chunk)

    def close(self) -> None:
        self.source.close()

    def fileno(self) -> int:
        return self.source.fileno()

    def __getattr__(self, name: str) -> Any:
        # While it is copied or unpickled there is no source yet to ask.
        if name == "source" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.source, name)


def declare(source: Source, array: ArraySpec) -> Source:
    """The source as that of an array whose elements and channels it has, by whatever names.

    What a codec says of its device are names and places of its own. Declared, the stream has those
    of the array that the device was built into, and its own rate; see `Calibration.array`.

    Returns:
        The source itself, if it is of that array already; else a source that is closed with it.

    Raises:
        SpecMismatch: it has not as many elements, or lacks a channel.
    """
    if not array.differences(source.spec, ignore=("rate_hz",)):
        return source
    if isinstance(source, CalibratedSource):
        return CalibratedSource(source.source, replace(source.calibration, array=array))
    return CalibratedSource(source, declared(source.spec, array))


def declared(spec: ArraySpec, array: ArraySpec) -> Calibration:
    """A change of elements and channels from one array to another."""
    device = re.sub(r"[^\w.:+-]+", "-", spec.name, flags=re.ASCII).strip(".-") or "device"
    return replace(Calibration.of(device, spec), array=array)
