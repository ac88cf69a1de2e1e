"""Synthetic source: an array with artificial touches, which needs neither device nor simulator.

The bumps are no objects, so a model's decisions on them mean nothing; `replay:demo` has objects.

synthetic:                                    5 whiskers x 6 channels at 1 kHz, without end
synthetic:35x6?rate_hz=1000&seconds=10&pace=fast&seed=3
synthetic:mouse                               the array of the package's own model
"""

import re
import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.array_file import read_array
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source

COLUMNS = 7  # of the grid of whiskers
PITCH_M = 0.002
CHUNK_S = 0.009
BUMP_S, EVERY_S = 0.3, 1.5  # length of a bump, and period of bumps
REST_S = 0.6  # before the first bump, for a baseline
PEAK = {"N": 2e-3, "N m": 2e-5}
# peaks for devices on the market, by SI unit
LOADS = {"N": 5.0, "N m": 0.1, "T": 1e-3, "Pa": 1e4, "V": 5e-3, "m/s2": 5.0, "F": 1e-12, "1": 1e3}
REST = {"K": 298.15}
NOISE = 0.005  # RMS, in parts of the peak
NAMES = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True)
class SyntheticOptions:
    """Options of ``synthetic:``.

    Attributes:
        seconds: Length of the stream, s; 0 for an endless one.
        pace: ``realtime`` delivers samples when they are due, ``fast`` at once.
        touches: True if bumps pass over the array; False for an array at rest, with noise only.
    """

    rate_hz: float = 1000.0
    seconds: float = 0.0
    seed: int = 0
    pace: str = "realtime"
    touches: bool = True

    def __post_init__(self) -> None:
        if self.pace not in ("realtime", "fast"):
            raise ConfigError(f"pace must be realtime or fast, not {self.pace!r}")
        if not 0 < self.rate_hz <= 1e6:
            raise ConfigError(f"rate_hz must be above 0, at most 1e6, not {self.rate_hz:g}")
        for name in ("seconds", "seed"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name):g}")


def synthetic_spec(elements: int, channels: int, rate_hz: float) -> ArraySpec:
    """Make a spec of whiskers in rows of seven, 2 mm apart. Channels: forces, then moments."""
    grid = tuple(divmod(i, COLUMNS) for i in range(elements))
    return ArraySpec(
        name="synthetic",
        elements=tuple(f"{chr(65 + r) if r < 26 else f'R{r}'}{c}" for r, c in grid),
        grid=grid,
        positions=tuple((0.0, PITCH_M * c, -PITCH_M * r) for r, c in grid),
        orientations=((1.0, 0.0, 0.0, 0.0),) * elements,
        channels=NAMES[:channels],
        units=("N", "N", "N", "N m", "N m", "N m")[:channels],
        rate_hz=rate_hz,
        frame="mount",
    )


class SyntheticSource(Source):
    """Source of half-sine bumps that pass over an array row by row, with noise.

    Args:
        size: ``ELEMENTSxCHANNELS``, e.g. ``35x6``; empty for ``5x6``; ``mouse`` for the array of
            the model that comes with the package.
    """

    Options = SyntheticOptions

    def __init__(self, size: str, options: SyntheticOptions) -> None:
        super().__init__(_make_spec(size, options))
        self.live = options.pace == "realtime"
        self._rng = np.random.default_rng(options.seed)
        self._left = round(options.seconds * options.rate_hz) if options.seconds else None
        self._options = options
        self._peak = np.array([PEAK[unit] for unit in self.spec.units])
        self._rest = np.zeros(len(self._peak))
        self._touches = options.touches
        self._at = REST_S + np.array([r + c / 10 for r, c in self.spec.grid]) * 0.05  # s
        self._sent, self._start_ns, self._closed = 0, -1, False

    def like(self, spec: ArraySpec) -> "SyntheticSource":
        """Return a synthetic source for another array, at that array's rate and typical loads."""
        source = SyntheticSource("", replace(self._options, rate_hz=spec.rate_hz))
        Source.__init__(source, spec)
        source._peak = np.array([LOADS.get(unit, 1.0) for unit in spec.units])
        source._rest = np.array([REST.get(unit, 0.0) for unit in spec.units])
        source._at = REST_S + np.array([r + c / 10 for r, c in spec.grid]) * 0.05
        return source

    @staticmethod
    def check(size: str, options: SyntheticOptions) -> ArraySpec:
        """Return the spec of the source, or raise the `ConfigError` that opening would raise."""
        return _make_spec(size, options)

    def read(self, timeout: float | None = None) -> Chunk | None:
        n = max(1, round(CHUNK_S * self.spec.rate_hz))
        n = n if self._left is None else min(n, self._left)
        if self._closed or n == 0:
            raise EndOfStream
        if self._start_ns < 0:
            self._start_ns = time.monotonic_ns() if self.live else 0
        seq = self._sent + np.arange(n, dtype=np.int64)
        due = np.round(seq * (NS_PER_S / self.spec.rate_hz)).astype(np.int64)
        if self.live:
            wait = (self._start_ns + int(due[-1]) - time.monotonic_ns()) / NS_PER_S
            if timeout is not None and wait > timeout:
                time.sleep(max(timeout, 0))
                return None
            time.sleep(max(wait, 0))
        self._sent += n
        if self._left is not None:
            self._left -= n
        self.stats.delivered += n
        valid = np.ones((n, len(self.spec.elements)), np.bool_)
        return Chunk(seq, self._start_ns + due, self._make_values(due / NS_PER_S), valid)

    def close(self) -> None:
        self._closed = True

    def _make_values(self, t_s: NDArray[np.float64]) -> NDArray[np.float32]:
        """Compute the samples (n, element, channel) at times (n,) since the start, s."""
        phase = (t_s[:, None] - self._at) % EVERY_S / BUMP_S  # (n, element)
        bump = np.where(phase < 1, np.sin(np.pi * np.minimum(phase, 1)), 0.0)
        share = np.cos(np.arange(len(self._peak)) * 1.1)  # channels differ in size and sign
        clean = self._touches * bump[..., None] * (share * self._peak)
        noise = self._rng.normal(size=clean.shape) * (NOISE * self._peak)
        values: NDArray[np.float32] = (self._rest + clean + noise).astype(np.float32)
        return values


def _make_spec(size: str, options: SyntheticOptions) -> ArraySpec:
    if size == "mouse":
        from tactile_rt.classifier.model_file import shipped_model

        return replace(read_array(shipped_model()), rate_hz=options.rate_hz)
    return synthetic_spec(*_parse_size(size), options.rate_hz)


def _parse_size(size: str) -> tuple[int, int]:
    """Parse a size such as ``35x6`` into (elements, channels)."""
    found = re.fullmatch(r"(\d{1,4})x([1-6])", size or "5x6")
    if not found or int(found[1]) == 0:
        raise ConfigError(
            f"synthetic:{size} is not a size: ELEMENTSxCHANNELS, e.g. 35x6, at most 9999x6; or "
            "mouse"
        )
    return int(found[1]), int(found[2])
