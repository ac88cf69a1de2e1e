"""What one device's samples need to become SI loads of the array that a model knows."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, SpecMismatch
from tactile_rt.core.settings import no_such
from tactile_rt.core.stream import ArraySpec, Chunk, quaternion_product

Quaternion = tuple[float, float, float, float]

AXES = ("x", "y", "z")
# A component of a vector, as in fx, x, acc_x, bx2; and of what kind a vector of this unit is.
COMPONENT = re.compile(r"(?:[A-Za-z]?|.*[_.\- ])([xyz])\d*")
POLAR = ("N", "m", "m/s", "m/s^2", "m/s2")
AXIAL = ("N m", "T", "rad/s")
UNTOLD = ("rad", "1", "")  # angles about who knows what, counts of who knows what
Row = tuple[float, ...]
DEVICE = re.compile(r"[A-Za-z0-9_+-][\w.:+-]*")  # it names a file
HISTORY = 20  # entries kept: a robot that tares every morning must not grow a file for ever


@dataclass(frozen=True)
class Mirror:
    """The array's mirror image, as of a left array for a right one's model.

    Bases are reflected along an axis n of the mount frame, S = 1 - 2 n n^T. What is left of an
    element's frame R is turned into a right-handed one again by an axis a of its own,
    T = 1 - 2 a a^T: p' = S p, R' = S R T. A force is a vector, a moment a pseudovector: in the
    element's frame f' = T f and m' = -T m. The mirror image of the mirror image is the array
    itself.

    Attributes:
        axis: Axis of the mount frame, x, y or z, that points from side to side.
        element_axis: Axis of the element's frame that is flipped: for whiskers z, across the plane
            of their curvature; where elements have the mount's axes, the same as `axis`.
        signs: Factor 1 or -1 by output channel, where its name and unit do not tell (an angle, a
            count).
    """

    axis: str = "x"
    element_axis: str = "z"
    signs: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for what in ("axis", "element_axis"):
            if getattr(self, what) not in AXES:
                raise ConfigError(f"mirror.{what} is x, y or z, not {getattr(self, what)!r}")
        for channel, sign in self.signs.items():
            if sign not in (1, -1):
                raise ConfigError(f"mirror.signs.{channel} is 1 or -1, not {sign}")

    def sign(self, channel: str, unit: str) -> int:
        """Return the factor, 1 or -1, of a channel's values.

        Raises:
            ConfigError: neither its name and unit nor `signs` tell.
        """
        if channel in self.signs:
            return self.signs[channel]
        component = COMPONENT.fullmatch(channel)
        if component and unit in (*POLAR, *AXIAL):
            return -1 if (component[1] == self.element_axis) == (unit in POLAR) else 1
        if unit in (*POLAR, *AXIAL, *UNTOLD):
            raise ConfigError(
                f"mirror: nothing tells whether {channel} ({unit}) changes its sign; set "
                f"mirror.signs.{channel} to 1 or -1"
            )
        return 1

    def pose(
        self, position: tuple[float, float, float], orientation: Quaternion
    ) -> tuple[tuple[float, float, float], Quaternion]:
        """Mirror a position (m) and a unit quaternion (w, x, y, z), w >= 0."""
        x, y, z = (0.0 - p if a == self.axis else p for a, p in zip(AXES, position, strict=True))
        # S and T are half turns about their axes times -1, and the two -1 cancel in S R T.
        turned = quaternion_product(_half_turn(self.axis), orientation)
        w, *v = quaternion_product(turned, _half_turn(self.element_axis)).tolist()
        # The first that is not zero is positive: two quaternions of one rotation are then equal.
        flip = next((q < 0 for q in (w, *v) if q), False)
        a, b, c, d = ((0.0 - q if flip else q) + 0.0 for q in (w, *v))
        return (x, y, z), (a, b, c, d)


def _half_turn(axis: str) -> Quaternion:
    x, y, z = (float(a == axis) for a in AXES)
    return 0.0, x, y, z


@dataclass(frozen=True)
class Calibration:
    """From a device's raw samples to the output of its array, in SI units.

    Of each element, output = M (raw - tare). M is its own matrix; else the gain of each channel;
    else nothing is changed, if the output has the raw channels and units. Otherwise the element is
    uncalibrated, and never valid. Then elements are mapped, then mirrored. What comes out may be
    declared to be an array: then it has that array's names and places.

    Attributes:
        device: Id of the device, which names the file: letters, digits, and ``_ . : + -``.
        units: Units of the raw channels, which may be counts (``1``).
        output_channels: Names of the channels that come out; empty for the raw ones.
        output_units: Units of the channels that come out; empty for the raw ones.
        gain: (channel,) output unit per raw unit, of elements without a matrix; empty: none.
        tare: (channel,) offset in raw units by raw element; none: 0.
        noise: (channel,) standard deviation in raw units by raw element, when tared.
        changes: share of readings that differed from the one before then; see `Tare`.
        matrices: (output channel, channel) output unit per raw unit, by raw element.
        mapping: Raw element by output element, in the order of the output; empty if the elements
            come out as the device sends them.
        mirror: Reflection that makes the output the array's mirror image; None for none.
        array: Array that the output is declared to be; None for the device's own. Its elements are
            those of the same names or, if the names are not all the same, those in the same place
            of the order. Its channels are those of the same name and unit; others are left out.

    Raises:
        ConfigError: sizes disagree, a name is unknown, or a number is not finite.
        SpecMismatch: the output has not as many elements as `array`, or lacks a channel of it.
    """

    device: str
    elements: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    output_channels: tuple[str, ...] = ()
    output_units: tuple[str, ...] = ()
    gain: Row = ()
    tare: dict[str, Row] = field(default_factory=dict)
    noise: dict[str, Row] = field(default_factory=dict)
    changes: float = 0.0
    matrices: dict[str, tuple[Row, ...]] = field(default_factory=dict)
    mapping: dict[str, str] = field(default_factory=dict)
    mirror: Mirror | None = None
    array: ArraySpec | None = None
    history: tuple[str, ...] = ()

    @classmethod
    def of(cls, device: str, spec: ArraySpec) -> "Calibration":
        """One that changes nothing yet, of this device."""
        return cls(device, spec.elements, spec.channels, spec.units)

    def __post_init__(self) -> None:
        check_device(self.device)
        channels, units = self.output
        outputs, inputs = len(channels), len(self.channels)
        for what, names in (("elements", self.elements), ("channels", self.channels)):
            if not names or len(set(names)) < len(names):
                raise ConfigError(f"raw.{what}: name at least one, and none twice")
        if len(set(channels)) < outputs:
            raise ConfigError("output.channels: none may be there twice")
        _sized("raw.units", self.units, inputs, "raw channels")
        _sized("output.units", units, outputs, "output channels")
        if self.gain:
            _sized("gain", self.gain, inputs, "raw channels")
            if outputs != inputs:
                raise ConfigError(
                    f"gain: makes {inputs} channels of {inputs}, but output.channels has {outputs};"
                    f" give every element a matrix instead"
                )
            _finite("gain", self.gain)
        for what, rows in (("tare", self.tare), ("noise", self.noise)):
            for element, row in rows.items():
                _known(f"{what}.{element}", element, self.elements, "raw element")
                _sized(f"{what}.{element}", row, inputs, "raw channels")
                _finite(f"{what}.{element}", row)
        for element, matrix in self.matrices.items():
            _known(f"matrix.{element}", element, self.elements, "raw element")
            _sized(f"matrix.{element}", matrix, outputs, "output channels", "rows")
            for channel, row in zip(channels, matrix, strict=True):
                _sized(f"matrix.{element}, row {channel}", row, inputs, "raw channels")
                _finite(f"matrix.{element}, row {channel}", row)
        for element, source in self.mapping.items():
            _known(f"mapping.{element}", source, self.elements, "raw element")
        if len(set(self.mapping.values())) < len(self.mapping):
            raise ConfigError("mapping: one raw element is mapped twice")
        for channel in self.mirror.signs if self.mirror else ():
            _known(f"mirror.signs.{channel}", channel, channels, "output channel")
        _ = self.signs  # a mirror that cannot be must fail here, not on the robot's first sample
        if self.array is not None:
            self._check_array(self.array)

    @property
    def output(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Channels and units of the output."""
        return self.output_channels or self.channels, self.output_units or self.units

    @property
    def signs(self) -> Row:
        """(output channel,) 1 or -1: what mirroring multiplies by."""
        if self.mirror is None:
            return (1.0,) * len(self.output[0])
        return tuple(float(self.mirror.sign(c, u)) for c, u in zip(*self.output, strict=True))

    @cached_property
    def uncalibrated(self) -> tuple[str, ...]:
        """Raw elements that never give a valid value, for want of a matrix or gain."""
        if self.gain or self.output == (self.channels, self.units):
            return ()
        used = self.mapping.values() if self.mapping else self.elements
        return tuple(e for e in used if e not in self.matrices)

    def output_spec(self, raw: ArraySpec) -> ArraySpec:
        """What comes out for a device that describes itself so.

        Raises:
            SpecMismatch: it is not the device that this is for.
        """
        for what in ("elements", "channels", "units"):
            mine, theirs = getattr(self, what), getattr(raw, what)
            if mine != theirs:
                raise SpecMismatch(
                    f"calibration of {self.device} is for {what} {_listed(mine)}; "
                    f"{raw.name} has {_listed(theirs)}"
                )
        if self.array is not None:
            return replace(self.array, rate_hz=raw.rate_hz)
        at = self._plan.index
        poses = [(raw.positions[i], raw.orientations[i]) for i in at]
        if self.mirror is not None:
            poses = [self.mirror.pose(*pose) for pose in poses]
        channels, units = self.output
        return replace(
            raw,
            elements=tuple(self.mapping) or raw.elements,
            grid=tuple(raw.grid[i] for i in at),
            positions=tuple(position for position, _ in poses),
            orientations=tuple(orientation for _, orientation in poses),
            channels=channels,
            units=units,
        )

    def apply(self, chunk: Chunk) -> Chunk:
        """Correct n samples.

        Args:
            chunk: of the raw spec; it is left as it is.

        Returns:
            A chunk of `output_spec`. An element that is not valid stays so; one whose output is
            not finite becomes so.

        Raises:
            SpecMismatch: it has not as many elements or channels.
        """
        plan = self._plan
        if chunk.values.shape[1:] != plan.shape:
            raise SpecMismatch(
                f"calibration of {self.device} is for samples of {plan.shape} (element, channel), "
                f"not {chunk.values.shape[1:]}"
            )
        values, valid = chunk.values, chunk.valid
        if plan.moves:
            values, valid = values.take(plan.index, axis=1), valid.take(plan.index, axis=1)
        with np.errstate(over="ignore", invalid="ignore"):  # of what is not valid, or becomes so
            values = values - plan.tare
            if plan.gain is not None:
                # By number, not by a product with zeros: what is left out need not be finite.
                values = values[..., plan.channels] * plan.gain
            else:
                values = np.matmul(values.transpose(1, 0, 2), plan.matrix).transpose(1, 0, 2)
        if plan.lacking is not None:
            valid = valid & plan.lacking
        if not np.isfinite(values).all():
            valid = valid & np.isfinite(values).all(axis=2)
        return Chunk(chunk.seq, chunk.t_ns, values, valid)

    def _check_array(self, array: ArraySpec) -> None:
        names = tuple(self.mapping) or self.elements
        if len(names) != len(array.elements):
            raise SpecMismatch(
                f"elements: the array {array.name!r} has {len(array.elements)} "
                f"({_listed(array.elements)}), {self.device} {len(names)} ({_listed(names)})"
            )
        given, wanted = (
            [f"{channel} ({unit})" for channel, unit in zip(*both, strict=True)]
            for both in (self.output, (array.channels, array.units))
        )
        if lacking := [channel for channel in wanted if channel not in given]:
            raise SpecMismatch(
                f"channels: the array {array.name!r} has {_listed(lacking)}, {self.device} gives "
                f"{_listed(given)}: a calibration can rename and convert them"
            )

    @cached_property
    def _plan(self) -> "_Plan":
        mapped = self.mapping or dict(zip(self.elements, self.elements, strict=True))
        order, channels = list(mapped), self.output[0]
        if self.array is not None:
            channels = self.array.channels
            if set(self.array.elements) == set(order):
                order = list(self.array.elements)
        index = [self.elements.index(mapped[e]) for e in order]
        used = [self.elements[i] for i in index]
        shape = len(self.elements), len(self.channels)
        default = np.diag(self.gain) if self.gain else np.eye(len(self.output[0]), shape[1])
        matrix = np.stack([np.asarray(self.matrices.get(e, default), np.float64) for e in used])
        matrix = matrix * np.asarray(self.signs)[:, None]
        matrix = matrix[:, [self.output[0].index(c) for c in channels]]
        zero = (0.0,) * shape[1]
        tare = np.array([self.tare.get(e, zero) for e in used])
        lacking = np.array([e not in self.uncalibrated for e in used])
        one = np.abs(matrix).max(axis=0).argmax(axis=1)  # (output,) the channel, if it is one
        gain = np.take_along_axis(matrix, one[None, :, None], axis=2)
        alone = np.array_equal(matrix, gain * np.eye(shape[1])[one])
        return _Plan(
            shape,
            np.array(index, np.intp),
            index != list(range(shape[0])),
            tare.astype(np.float32),
            slice(None) if one.tolist() == list(range(shape[1])) else one,
            gain[..., 0].astype(np.float32) if alone else None,
            np.ascontiguousarray(matrix.transpose(0, 2, 1), dtype=np.float32),
            None if lacking.all() else lacking,
        )

    def noted(self, line: str, **changes: Any) -> "Calibration":
        """This one with other attributes, and a line more of history."""
        return replace(self, history=(*self.history, line)[-HISTORY:], **changes)


@dataclass(frozen=True, eq=False)
class _Plan:
    """A calibration as arrays, by output element; `matrix` is (element, channel, output).

    Where each output is a multiple of one channel, that is `channels` (output,) and `gain`
    (element, output).
    """

    shape: tuple[int, int]
    index: NDArray[np.intp]
    moves: bool
    tare: NDArray[np.float32]
    channels: NDArray[np.intp] | slice
    gain: NDArray[np.float32] | None
    matrix: NDArray[np.float32]
    lacking: NDArray[np.bool_] | None


def check_device(device: str) -> None:
    """Refuse an id that could not name a file."""
    if not DEVICE.fullmatch(device):
        raise ConfigError(f"device id {device!r}: use letters, digits, '_', '.', ':', '+' and '-'")


def _known(key: str, name: str, known: tuple[str, ...], what: str) -> None:
    if name not in known:
        raise ConfigError(f"{key}: {no_such(what, name, known)}")


def _sized(key: str, items: tuple[Any, ...], n: int, of: str, what: str = "values") -> None:
    if len(items) != n:
        raise ConfigError(f"{key} has {len(items)} {what} for {n} {of}")


def _finite(key: str, row: Row) -> None:
    if not all(map(math.isfinite, row)):
        raise ConfigError(f"{key} must be finite numbers")


def _listed(names: Sequence[str]) -> str:
    more = f" ... ({len(names)})" if len(names) > 12 else ""
    return ", ".join(names[:12]) + more
