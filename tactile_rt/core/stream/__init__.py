"""Types that move through the program: few, frozen, in SI units.

    Source --read()--> Chunk --push()--> Classifier --> Classification

A `Source` hides where samples come from (simulation, serial port, CAN bus, recording).
Everything downstream sees `Chunk`s described by one `ArraySpec`.
"""

import abc
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.core.errors import ConfigError

__all__ = [
    "MOUSE",
    "NS_PER_S",
    "STEPS",
    "STEP_MS",
    "ArraySpec",
    "Chunk",
    "EndOfStream",
    "Source",
    "SourceStats",
    "Timing",
    "concatenate",
    "quaternion_product",
    "rotation_matrices",
]

NS_PER_S = 1_000_000_000
SPEC_VERSION = 1
POSE_TOLERANCE = 1e-6  # m and quaternion units: below what can be mounted or measured


class EndOfStream(Exception):
    """The source has delivered its last sample; every later read raises it again."""


@dataclass(frozen=True)
class ArraySpec:
    """Description of a sensor array. Hashable; stored in recordings and models.

    Attributes:
        elements: The names of the elements, whiskers or taxels, in the order of every sample.
        grid: The place (row, column) of each element on the array's topological grid, from 0.
        positions: The base point (x, y, z) of each element in the mount frame, m.
        orientations: The unit quaternion (w, x, y, z) that rotates each element's own frame into
            the mount frame.
        channels: The names of the quantities that each element measures, e.g. ``fx``.
        units: The SI unit of each channel, e.g. ``N``.
        frame: The name of the mount frame, which is right-handed.

    Raises:
        ConfigError: lengths disagree, names repeat, two elements share a grid cell, a pose is not
            finite, or the rate is not positive.
    """

    name: str
    elements: tuple[str, ...]
    grid: tuple[tuple[int, int], ...]
    positions: tuple[tuple[float, float, float], ...]
    orientations: tuple[tuple[float, float, float, float], ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    rate_hz: float
    frame: str

    def __post_init__(self) -> None:
        n = len(self.elements)
        for what in ("grid", "positions", "orientations"):
            if len(getattr(self, what)) != n:
                raise ConfigError(
                    f"array {self.name!r}: {what} has {len(getattr(self, what))} entries "
                    f"for {n} elements"
                )
        if n == 0 or not self.channels:
            raise ConfigError(f"array {self.name!r}: needs at least one element and one channel")
        if len(self.units) != len(self.channels):
            raise ConfigError(
                f"array {self.name!r}: {len(self.units)} units for {len(self.channels)} channels"
            )
        for what in ("elements", "channels", "grid"):
            items = getattr(self, what)
            if len(set(items)) != len(items):
                raise ConfigError(f"array {self.name!r}: {what} repeat")
        if min(min(cell) for cell in self.grid) < 0:
            raise ConfigError(f"array {self.name!r}: grid cells are counted from 0")
        for what in ("positions", "orientations"):
            if not np.isfinite(getattr(self, what)).all():
                raise ConfigError(f"array {self.name!r}: {what} must be finite")
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise ConfigError(f"array {self.name!r}: rate_hz must be positive, not {self.rate_hz}")

    @classmethod
    def at_origin(
        cls, name: str, rate_hz: float, channels: Mapping[str, str], frame: str = "sensor",
        elements: Mapping[str, tuple[int, int]] = MappingProxyType({"sensor": (0, 0)}),
    ) -> "ArraySpec":  # fmt: skip
        """Describe an array of unknown geometry, with all elements at the frame's origin.

        Args:
            channels: SI unit by channel name.
            elements: Place (row, column) on the grid by element name.
        """
        n = len(elements)
        return cls(
            name, tuple(elements), tuple(elements.values()), ((0.0, 0.0, 0.0),) * n,
            ((1.0, 0.0, 0.0, 0.0),) * n, tuple(channels), tuple(channels.values()), rate_hz, frame,
        )  # fmt: skip

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of one sample: (number of elements, number of channels)."""
        return len(self.elements), len(self.channels)

    @property
    def grid_shape(self) -> tuple[int, int]:
        """Numbers of rows and columns of the smallest grid that holds every element."""
        rows, columns = zip(*self.grid, strict=True)
        return max(rows) + 1, max(columns) + 1

    def differences(self, other: "ArraySpec", ignore: tuple[str, ...] = ()) -> list[str]:
        """List the attributes in which `other` differs from this spec, a phrase each.

        Args:
            ignore: attribute names not to compare (a model ignores ``name`` and ``rate_hz``).
        """
        found = []
        for what in self.__dataclass_fields__:
            mine, theirs = getattr(self, what), getattr(other, what)
            if what in ignore or mine == theirs:
                continue
            if what == "units" and len(mine) != len(theirs):
                continue  # reported for the channels
            if isinstance(mine, tuple) and len(mine) == len(theirs):
                pose = what in ("positions", "orientations")
                for at, (a, b) in enumerate(zip(mine, theirs, strict=True)):
                    if a != b and not (pose and np.allclose(a, b, rtol=0, atol=POSE_TOLERANCE)):
                        found.append(f"{what}[{at}] is {b!r}, not {a!r}")
                        break
            elif what in ("channels", "units"):
                found.append(f"{what} are ({', '.join(theirs)}), not ({', '.join(mine)})")
            elif isinstance(mine, tuple):
                found.append(f"{what}: {len(theirs)} entries, not {len(mine)}")
            else:
                found.append(f"{what} is {theirs!r}, not {mine!r}")
        return found

    def to_json(self) -> str:
        """Return the spec as one line of JSON, for recordings and models."""
        return msgspec.json.encode({"version": SPEC_VERSION, **msgspec.to_builtins(self)}).decode()

    @classmethod
    def from_json(cls, text: str) -> "ArraySpec":
        """Return the spec that `to_json` has written as JSON.

        Raises:
            ConfigError: not JSON, a field missing or of the wrong type, or another version.
        """
        try:
            fields: dict[str, Any] = msgspec.json.decode(text, type=dict[str, Any])
            version = fields.pop("version", None)
            if version != SPEC_VERSION:
                raise ConfigError(
                    f"array spec of version {version!r}; this release reads {SPEC_VERSION}"
                )
            return msgspec.convert(fields, cls)
        except msgspec.MsgspecError as error:
            raise ConfigError(f"not an array spec: {error}") from None


@dataclass(frozen=True)
class Chunk:
    """Block of n >= 1 consecutive samples; all samples move through the program in chunks.

    Attributes:
        seq: (n,) int64 sequence number of each sample; a gap means lost samples.
        t_ns: (n,) int64 host CLOCK_MONOTONIC at which each sample was taken, ns.
        values: (n, element, channel) float32 measurements in the units of the channels.
        valid: (n, element) bool; False where the element has no trustworthy value.
    """

    seq: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    values: NDArray[np.float32]
    valid: NDArray[np.bool_]

    def __post_init__(self) -> None:
        n = len(self.seq)
        shapes = (self.seq.shape, self.t_ns.shape, self.valid.shape)
        if n == 0 or self.values.ndim != 3 or shapes != ((n,), (n,), self.values.shape[:2]):
            raise ValueError(
                f"chunk of {n} samples with t_ns {self.t_ns.shape}, values {self.values.shape}, "
                f"valid {self.valid.shape}"
            )

    def __len__(self) -> int:
        return len(self.seq)

    def select(self, at: slice | NDArray[np.bool_]) -> "Chunk":
        """Return a chunk of the samples that a slice or a mask (n,) selects."""
        return Chunk(self.seq[at], self.t_ns[at], self.values[at], self.valid[at])


def concatenate(chunks: list[Chunk]) -> Chunk:
    """Join consecutive chunks of one stream into one chunk; copy the samples."""
    return Chunk(
        *(
            np.concatenate([getattr(c, name) for c in chunks])
            for name in ("seq", "t_ns", "values", "valid")
        )
    )


@dataclass
class SourceStats:
    """Counts of delivered, lost and repeated samples since the source was opened.

    ``sent + duplicated = delivered + corrupt + missing + dropped + duplicates`` where `sent` and
    `duplicated` are counts of the sender.

    Attributes:
        delivered: Samples that reached the reader.
        corrupt: Samples that arrived damaged and were discarded.
        missing: Samples that never arrived, as the gaps in the device's counter show.
        dropped: Samples that arrived and were discarded because they were not read in time.
        duplicates: Samples that arrived a second time and were discarded.
    """

    delivered: int = 0
    corrupt: int = 0
    missing: int = 0
    dropped: int = 0
    duplicates: int = 0


@dataclass(eq=False)  # compared by identity: two streams of one array are distinct in a set
class Source(abc.ABC):
    """Base class of sources of samples. Implementations provide `spec`, `read` and `close`.

    A source is its own context manager and iterates over its chunks until it ends.

    Attributes:
        live: True if samples come even if nothing reads them, as from a device or a simulation
            in real time; a source that is not live waits for its reader.
    """

    live = True  # a class attribute, not a field: most implementations never change it

    spec: ArraySpec
    stats: SourceStats = field(default_factory=SourceStats, init=False)

    @abc.abstractmethod
    def read(self, timeout: float | None = None) -> Chunk | None:
        """Return the samples that have arrived since the last read.

        Args:
            timeout: how long to wait for the first sample, s; None waits for ever.

        Returns:
            The next samples, or None when none arrived in time.

        Raises:
            EndOfStream: the stream is over; raised at every later call too.
            SourceError: the device broke.
        """

    @abc.abstractmethod
    def close(self) -> None:
        """Release the device; safe to call twice. Reading afterwards raises `EndOfStream`."""

    def fileno(self) -> int:
        """Return a file descriptor for `select`, or -1 if the source has none at present. Once it
        is readable, `read` with a timeout of 0 returns the samples that have arrived. It changes
        when a lost line is opened again."""
        return -1

    def __iter__(self) -> Iterator[Chunk]:
        while True:
            try:
                chunk = self.read()
            except EndOfStream:
                return
            if chunk is not None:
                yield chunk

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


STEPS, STEP_MS = 22, 45.0  # steps of a window, and length of a step (Chung et al. 2025)


@dataclass(frozen=True)
class Timing:
    """Number of steps in a window, and of samples in a step (`substeps`)."""

    steps: int = STEPS
    substeps: int = 5

    @classmethod
    def of(cls, period_ns: int) -> "Timing":
        """Return the timing for a sample period, with steps as near 45 ms as possible."""
        return cls(substeps=max(1, round(STEP_MS * 1e6 / period_ns)))

    @property
    def samples(self) -> int:
        """Number of samples of a window."""
        return self.steps * self.substeps


MOUSE = Timing()  # 22 steps of five 9 ms samples


def quaternion_product(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64]:
    """Return the Hamilton product of two quaternions (w, x, y, z)."""
    w, x, y, z = np.asarray(p, dtype=np.float64)
    rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
    return np.asarray(np.array(rows) @ np.asarray(q, dtype=np.float64))


def rotation_matrices(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Convert unit quaternions (..., 4), w first, to rotation matrices (..., 3, 3)."""
    q = np.asarray(quaternions, dtype=np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
