"""Sources whose samples are calibrated as they are read, and may be declared to be of an array."""

import re
from dataclasses import replace
from typing import Any

from tactile_rt.calibration.device_calibration import Calibration
from tactile_rt.core.stream import ArraySpec, Chunk, Source


class CalibratedSource(Source):
    """Source with calibrated samples. Statistics, health and commands are those of the raw source.

    Args:
        source: the source of raw samples; closed with this one.

    Raises:
        SpecMismatch: the calibration is for another array.
    """

    def __init__(self, source: Source, calibration: Calibration) -> None:
        # No own `stats`: like all other missing attributes, they are looked up in the source.
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
        # While the object is copied or unpickled, it has no source yet.
        if name == "source" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.source, name)


def declare(source: Source, array: ArraySpec) -> Source:
    """Return the source with its elements named and placed as in an array.

    A codec gives its device's elements generic names and places. The returned source has those of
    the array that the device was built into, and keeps its own rate; see `Calibration.array`.

    Returns:
        The source itself if it has that array already; else a new source, which closes it.

    Raises:
        SpecMismatch: the source has another number of elements, or lacks a channel.
    """
    if not array.differences(source.spec, ignore=("rate_hz",)):
        return source
    if isinstance(source, CalibratedSource):
        return CalibratedSource(source.source, replace(source.calibration, array=array))
    return CalibratedSource(source, declare_calibration(source.spec, array))


def declare_calibration(spec: ArraySpec, array: ArraySpec) -> Calibration:
    """Return a calibration that only gives samples the names and places of an array."""
    device = re.sub(r"[^\w.:+-]+", "-", spec.name, flags=re.ASCII).strip(".-") or "device"
    return replace(Calibration.of(device, spec), array=array)
