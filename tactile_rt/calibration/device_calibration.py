"""Calibration of one device, which converts its samples to SI loads of an array."""

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
# Names of a vector's component, as fx, x, acc_x, bx2; units of polar and axial vectors.
COMPONENT = re.compile(r"(?:[A-Za-z]?|.*[_.\- ])([xyz])\d*")
POLAR = ("N", "m", "m/s", "m/s^2", "m/s2")
AXIAL = ("N m", "T", "rad/s")
UNTOLD = ("rad", "1", "")  # units that do not determine the sign: angles, counts
Row = tuple[float, ...]
DEVICE = re.compile(r"[A-Za-z0-9_+-][\w.:+-]*")  # valid in the name of a file
HISTORY = 20  # entries kept, so that the file of a robot that tares every morning stays small


@dataclass(frozen=True)
class Mirror:
    """Reflection of an array, so that a left array can use a right array's model.

    Bases are reflected along an axis n of the mount frame, S = 1 - 2 n n^T. This makes the frame R
    of an element left-handed; flipping an axis a of its own, T = 1 - 2 a a^T, makes it
    right-handed again: p' = S p, R' = S R T. A force is a vector, a moment a pseudovector: in the
    element's frame f' = T f and m' = -T m. The mirror image of the mirror image is the array
    itself.

    Attributes:
        axis: Axis of the mount frame, x, y or z, that points from side to side.
        element_axis: Axis of the element's frame that is flipped: for whiskers z, across the plane
            of their curvature; where elements have the mount's axes, the same as `axis`.
        signs: Factor 1 or -1 by output channel, where name and unit do not determine it (an angle,
            a count).
    """

    axis: str = "x"
    element_axis: str = "z"
    signs: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for what in ("axis", "element_axis"):
            if getattr(self, what) not in AXES:
                raise ConfigError(f"mirror.{what} must be x, y or z, not {getattr(self, what)!r}")
        for channel, sign in self.signs.items():
            if sign not in (1, -1):
                raise ConfigError(f"mirror.signs.{channel} must be 1 or -1, not {sign}")

    def sign(self, channel: str, unit: str) -> int:
        """Return the factor, 1 or -1, by which the reflection multiplies a channel.

        Raises:
            ConfigError: neither name and unit nor `signs` determine the factor.
        """
        if channel in self.signs:
            return self.signs[channel]
        component = COMPONENT.fullmatch(channel)
        if component and unit in (*POLAR, *AXIAL):
            return -1 if (component[1] == self.element_axis) == (unit in POLAR) else 1
        if unit in (*POLAR, *AXIAL, *UNTOLD):
            raise ConfigError(
                f"mirror: it is not known whether {channel} ({unit}) changes its sign; set "
                f"mirror.signs.{channel} to 1 or -1"
            )
        return 1

    def pose(
        self, position: tuple[float, float, float], orientation: Quaternion
    ) -> tuple[tuple[float, float, float], Quaternion]:
        """Reflect a position, m, and a unit quaternion (w, x, y, z). The result has w >= 0."""
        x, y, z = (0.0 - p if a == self.axis else p for a, p in zip(AXES, position, strict=True))
        # S and T are half turns about their axes times -1, and the two -1 cancel in S R T.
        rotated = quaternion_product(_make_half_turn(self.axis), orientation)
        w, *v = quaternion_product(rotated, _make_half_turn(self.element_axis)).tolist()
        # The first non-zero component is positive, so that equal rotations have equal quaternions.
        flip = next((q < 0 for q in (w, *v) if q), False)
        a, b, c, d = ((0.0 - q if flip else q) + 0.0 for q in (w, *v))
        return (x, y, z), (a, b, c, d)


def _make_half_turn(axis: str) -> Quaternion:
    x, y, z = (float(a == axis) for a in AXES)
    return 0.0, x, y, z


@dataclass(frozen=True)
class Calibration:
    """Conversion of a device's raw samples to calibrated samples of an array, in SI units.

    For each element, output = M (raw - tare). M is the element's matrix, else the diagonal gain,
    else the identity if the output has the raw channels and units. Otherwise the element is
    uncalibrated, and never valid. Then elements are mapped, then mirrored. The output may be
    declared to be of an array: then it has that array's names and places.

    Attributes:
        device: Id of the device, which names the file: letters, digits, and ``_ . : + -``.
        units: Units of the raw channels, which may be counts (``1``).
        output_channels: Names of the output channels; empty for the raw ones.
        output_units: Units of the output channels; empty for the raw ones.
        gain: (channel,) output unit per raw unit, for elements without a matrix; empty for none.
        tare: (channel,) offset in raw units, by raw element; 0 for elements without an entry.
        noise: (channel,) standard deviation in raw units, by raw element, during the tare.
        changes: share of readings that differed from the previous one, during the tare; see `Tare`.
        matrices: (output channel, channel) output unit per raw unit, by raw element.
        mapping: Raw element by output element, in the order of the output; empty if elements are
            output as the device sends them.
        mirror: Reflection that makes the output the array's mirror image; None for no reflection.
        array: Array whose samples the output is declared to be; None for the device's. Its elements
            are matched by name or, if the names are not all the same, by order. Its channels are
            matched by name and unit; others are left out.

    Raises:
        ConfigError: sizes disagree, a name is unknown, or a number is not finite.
        SpecMismatch: the output has another number of elements than `array`, or lacks a channel.
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
        """Make a calibration that changes nothing, for a device and its raw spec."""
        return cls(device, spec.elements, spec.channels, spec.units)

    def __post_init__(self) -> None:
        check_device(self.device)
        channels, units = self.output
        outputs, inputs = len(channels), len(self.channels)
        for what, names in (("elements", self.elements), ("channels", self.channels)):
            if not names or len(set(names)) < len(names):
                raise ConfigError(f"raw.{what}: must be one or more names, all different")
        if len(set(channels)) < outputs:
            raise ConfigError("output.channels: names must differ")
        _check_size("raw.units", self.units, inputs, "raw channels")
        _check_size("output.units", units, outputs, "output channels")
        if self.gain:
            _check_size("gain", self.gain, inputs, "raw channels")
            if outputs != inputs:
                raise ConfigError(
                    f"gain: makes {inputs} channels from {inputs}, but output.channels has "
                    f"{outputs}; give every element a matrix instead"
                )
            _check_finite("gain", self.gain)
        for what, rows in (("tare", self.tare), ("noise", self.noise)):
            for element, row in rows.items():
                _check_known(f"{what}.{element}", element, self.elements, "raw element")
                _check_size(f"{what}.{element}", row, inputs, "raw channels")
                _check_finite(f"{what}.{element}", row)
        for element, matrix in self.matrices.items():
            _check_known(f"matrix.{element}", element, self.elements, "raw element")
            _check_size(f"matrix.{element}", matrix, outputs, "output channels", "rows")
            for channel, row in zip(channels, matrix, strict=True):
                _check_size(f"matrix.{element}, row {channel}", row, inputs, "raw channels")
                _check_finite(f"matrix.{element}, row {channel}", row)
        for element, source in self.mapping.items():
            _check_known(f"mapping.{element}", source, self.elements, "raw element")
        if len(set(self.mapping.values())) < len(self.mapping):
            raise ConfigError("mapping: one raw element is mapped twice")
        for channel in self.mirror.signs if self.mirror else ():
            _check_known(f"mirror.signs.{channel}", channel, channels, "output channel")
        _ = self.signs  # an invalid mirror must fail here, not on the robot's first sample
        if self.array is not None:
            self._check_array(self.array)

    @property
    def output(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names and units of the output channels."""
        return self.output_channels or self.channels, self.output_units or self.units

    @property
    def signs(self) -> Row:
        """Factors of the reflection, (output channel,), each 1 or -1."""
        if self.mirror is None:
            return (1.0,) * len(self.output[0])
        return tuple(float(self.mirror.sign(c, u)) for c, u in zip(*self.output, strict=True))

    @cached_property
    def uncalibrated(self) -> tuple[str, ...]:
        """Raw elements that are never valid, as they have neither matrix nor gain."""
        if self.gain or self.output == (self.channels, self.units):
            return ()
        used = self.mapping.values() if self.mapping else self.elements
        return tuple(e for e in used if e not in self.matrices)

    def output_spec(self, raw: ArraySpec) -> ArraySpec:
        """Return the array spec of the calibrated samples, given the device's raw spec.

        Raises:
            SpecMismatch: the calibration is for another device.
        """
        for what in ("elements", "channels", "units"):
            mine, theirs = getattr(self, what), getattr(raw, what)
            if mine != theirs:
                raise SpecMismatch(
                    f"calibration of {self.device} is for {what} {_join(mine)}; "
                    f"{raw.name} has {_join(theirs)}"
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
        """Calibrate a chunk of samples.

        Args:
            chunk: samples of the raw spec; it is not modified.

        Returns:
            A chunk of `output_spec`. An invalid element stays invalid; one whose output is not
            finite becomes invalid.

        Raises:
            SpecMismatch: the chunk has another number of elements or channels.
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
        with np.errstate(over="ignore", invalid="ignore"):  # in elements that are or become invalid
            values = values - plan.tare
            if plan.gain is not None:
                # Selected, not multiplied by zeros: channels that are left out need not be finite.
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
                f"({_join(array.elements)}), {self.device} {len(names)} ({_join(names)})"
            )
        given, needed = (
            [f"{channel} ({unit})" for channel, unit in zip(*both, strict=True)]
            for both in (self.output, (array.channels, array.units))
        )
        if lacking := [channel for channel in needed if channel not in given]:
            raise SpecMismatch(
                f"channels: the array {array.name!r} has {_join(lacking)}, {self.device} gives "
                f"{_join(given)}: a calibration can rename and convert them"
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
        one = np.abs(matrix).max(axis=0).argmax(axis=1)  # (output,) dominant input channel
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

    def with_note(self, line: str, **changes: Any) -> "Calibration":
        """Return a copy with changed attributes, and one more line of history."""
        return replace(self, history=(*self.history, line)[-HISTORY:], **changes)


@dataclass(frozen=True, eq=False)
class _Plan:
    """Arrays that `Calibration.apply` computes with, in the order of the output elements.

    `matrix` is (element, channel, output). If each output is a multiple of one channel, `channels`
    (output,) and `gain` (element, output) are these channels and factors; else `gain` is None.
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
    """Refuse a device id that cannot name a file."""
    if not DEVICE.fullmatch(device):
        raise ConfigError(f"device id {device!r}: use letters, digits, '_', '.', ':', '+' and '-'")


def _check_known(key: str, name: str, known: tuple[str, ...], what: str) -> None:
    if name not in known:
        raise ConfigError(f"{key}: {no_such(what, name, known)}")


def _check_size(key: str, items: tuple[Any, ...], n: int, of: str, what: str = "values") -> None:
    if len(items) != n:
        raise ConfigError(f"{key} has {len(items)} {what} for {n} {of}")


def _check_finite(key: str, row: Row) -> None:
    if not all(map(math.isfinite, row)):
        raise ConfigError(f"{key} must be finite numbers")


def _join(names: Sequence[str]) -> str:
    more = f" ... ({len(names)})" if len(names) > 12 else ""
    return ", ".join(names[:12]) + more
