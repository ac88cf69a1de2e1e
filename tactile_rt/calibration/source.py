"""A source that delivers calibrated samples."""

from typing import Any

from tactile_rt.calibration.correction import Calibration
from tactile_rt.stream import Chunk, Source

__all__ = ["CalibratedSource"]


class CalibratedSource(Source):
    """A source whose samples are corrected; all else (statistics, health, commands) is its own.

    Args:
        source: of raw samples; closed with this one.
        calibration: for its device.

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

    def __getattr__(self, name: str) -> Any:
        # While it is copied or unpickled there is no source yet to ask.
        if name == "source" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.source, name)
