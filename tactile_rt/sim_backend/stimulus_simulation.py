"""Simulation of the six stimuli of the barrel-cortex recordings, and of a model's input.

Mice discriminated a convex from a concave surface, each presented close, at a medium distance or
far (Rodgers 2022). Chung et al. (2025) whisk against both sides of the mesh of a bent sheet. Here
the surface is an arc of a circle, extruded upward: approximate, with every number a parameter.

- Size, from the published mesh at its published scale: chord 50.84 mm, height 17.43 mm, sagitta
  5.30 mm, so radius 63.6 mm (the mesh keeps within 0.5 mm of that arc), thickness 1.73 mm.
- Position and rotation, from the published run script and the published simulator's source: it
  puts the sheet against its bounding box and the array 13 mm rostral and 1.5 mm dorsal of the head.
- From close to medium to far: (1, 1) mm each in the horizontal plane, 1.41 mm, from that script.
  In the recordings it was 2.7 mm (analysis code of Rodgers 2022): `step_mm=(1.91, 1.91, 0)`.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.packages import VERSION
from tactile_rt.core.stream import ArraySpec
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES, STIMULI
from tactile_rt.sim_backend.arrays.whiskers import rotation
from tactile_rt.sim_backend.whisking import WhiskSimulation
from tactile_rt.sim_backend.world import SAMPLE_MS, stamp_samples

# Middle of the close surfaces' faces, from the array's origin (see `whisking.HEAD`), mm.
CLOSE = {"convex": (17.26, 0.68, 1.46), "concave": (24.27, -5.37, 1.46)}
PERIOD_NS = 9_000_000  # of the model input
WINDOW_SAMPLES = 110  # 22 network steps of five sub-steps
AT_ONCE = 50  # samples


@dataclass(frozen=True)
class Surface:
    """A bent sheet, standing upright; whiskers meet its convex or its concave face.

    Attributes:
        shape: ``convex`` or ``concave``, the face that the whiskers meet.
        position_mm: The middle of the face, in the world frame of `whisking.HEAD`, mm.
        facing_deg: The azimuth of the face's normal at its middle, degrees from x to y.
        radius_mm: The radius of the face's arc, mm.
        chord_mm, height_mm: The straight width and height of the face, mm.
        thickness_mm: The thickness of the sheet, behind the face, mm.
        facets: The number of flat strips that the face is made of; their edges lie on the arc.
    """

    shape: str
    position_mm: tuple[float, float, float]
    facing_deg: float = -139.08
    radius_mm: float = 63.6
    chord_mm: float = 50.84
    height_mm: float = 17.43
    thickness_mm: float = 1.73
    facets: int = 16

    def __post_init__(self) -> None:
        if self.shape not in SHAPES:
            raise ConfigError(f"no shape {self.shape!r}: there are {', '.join(SHAPES)}")
        for name in ("radius_mm", "chord_mm", "height_mm", "thickness_mm", "facets"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"stimulus: {name} must be positive, not {getattr(self, name)}")
        if self.chord_mm > 1.9 * self.radius_mm:
            raise ConfigError(
                f"stimulus: chord_mm {self.chord_mm:g} is too wide for an arc of radius_mm "
                f"{self.radius_mm:g}; at most 1.9 times it"
            )

    @classmethod
    def make(
        cls,
        name: str,
        step_mm: tuple[float, float, float] = (1.0, 1.0, 0.0),
        radius_mm: float = 63.6,
    ) -> "Surface":
        """Make one of `STIMULI` by name; close, medium and far are `step_mm` apart."""
        if name not in STIMULI:
            raise ConfigError(f"no stimulus {name!r}: there are {', '.join(STIMULI)}")
        shape, _, distance = name.partition("-")
        x, y, z = np.array(CLOSE[shape]) + DISTANCES.index(distance) * np.array(step_mm)
        at = (round(float(x), 6), round(float(y), 6), round(float(z), 6))
        return cls(shape, at, radius_mm=radius_mm)

    @property
    def largest_gap_mm(self) -> float:
        """The largest distance between facets and arc, mm."""
        half = np.arcsin(self.chord_mm / 2 / self.radius_mm) / self.facets
        return float(self.radius_mm * (1 - np.cos(half)))

    def pieces(self) -> tuple[NDArray[np.float64], ...]:
        """Compute corners (points, 3) of the convex pieces in the world frame, mm.

        A convex face is one piece, which fills the hollow behind it. A concave face has a strip
        for each facet. Inside the sheet the strips overlap: beyond its edge a facet's plane
        continues behind the next facet. If the strips ended at the edge, a whisker pressed in
        near a seam would be pushed out sideways.
        """
        half = np.arcsin(self.chord_mm / 2 / self.radius_mm)
        angles = np.linspace(-half, half, self.facets + 1)
        # Seen from above: x out of the face, y along its chord. The arc bulges towards x if convex.
        bulge = 1 if self.shape == "convex" else -1
        out = -bulge * self.radius_mm * (1 - np.cos(angles))
        face = np.stack([out, self.radius_mm * np.sin(angles), np.zeros_like(out)], axis=1)
        outlines = [face] if bulge > 0 else [self._widen_facet(face, i) for i in range(self.facets)]
        up = np.array([0.0, 0.0, self.height_mm / 2])
        turn = rotation("z", np.radians(self.facing_deg)).T
        pieces = []
        for front in outlines:
            # The back is the same arc, shifted, as in the published mesh.
            corners = np.concatenate([front, front - np.array([self.thickness_mm, 0.0, 0.0])])
            pieces.append(np.concatenate([corners - up, corners + up]) @ turn + self.position_mm)
        return tuple(pieces)

    def _widen_facet(self, face: NDArray[np.float64], i: int) -> NDArray[np.float64]:
        """Return the ends (2, 3) of facet i, extended into the facets beside it."""
        first, last = face[i], face[i + 1]
        further = self.thickness_mm * (last - first) / np.linalg.norm(last - first)
        return np.stack([first - further * (i > 0), last + further * (i < self.facets - 1)])


@dataclass(frozen=True)
class Touch:
    """The loads and contacts of an array that whisked.

    Attributes:
        loads: The (sample, element, channel) base loads at 1 kHz, N and N m.
        touch: The (sample, element) flags of contact with the object.
    """

    loads: NDArray[np.float32]
    touch: NDArray[np.bool_]

    @property
    def first_ms(self) -> int | None:
        """Time of the first contact from the start, ms; None without contact."""
        touched = self.touch.any(axis=1)
        return int(touched.argmax()) if touched.any() else None


def whisk_against(
    simulation: WhiskSimulation, progress: Callable[[int], None] = lambda samples: None
) -> Touch:
    """Run a simulation to its end; call `progress` with each number of new samples."""
    loads: list[NDArray[np.float64]] = []
    touch: list[NDArray[np.bool_]] = []
    for _ in range(0, simulation.samples, AT_ONCE):
        piece, touched = simulation.advance(AT_ONCE)
        loads.append(piece)
        touch.append(touched)
        progress(len(piece))
    return Touch(np.concatenate(loads).astype(np.float32), np.concatenate(touch))


def model_input(felt: Touch) -> NDArray[np.float32]:
    """Resample a touch to the network's input: from the first contact on, every 9 ms.

    The first sample is centred on the first contact, through the same resampler as live data.

    Returns:
        (sample, element, channel) N and N m.

    Raises:
        ConfigError: nothing is touched, or the trajectory ends before the window does.
    """
    first = felt.first_ms
    if first is None:
        raise ConfigError("no whisker touches it: bring it closer, or whisk further")
    period = PERIOD_NS / (SAMPLE_MS * 1e6)
    start, stop = first - round(period), first + round(WINDOW_SAMPLES * period) + 1
    if start < 0 or stop > len(felt.loads):
        raise ConfigError(
            f"first contact is at {first} ms and {WINDOW_SAMPLES} samples of {period:g} ms follow "
            f"it: the trajectory must last {stop} ms or more, not {len(felt.loads)} ms, and begin "
            f"{round(period)} ms or more before the contact"
        )
    chunk = stamp_samples(felt.loads[start:stop])
    resampled = Resampler(PERIOD_NS, 1e3 / SAMPLE_MS).push(chunk)
    assert resampled is not None
    return resampled.values[:WINDOW_SAMPLES]


def write_input(
    path: Path,
    felt: Mapping[str, Touch],
    spec: ArraySpec,
    angles: NDArray[np.float64],
    parameters: Mapping[str, Any],
) -> None:
    """Write the network's input for all stimuli as .npz, and its provenance as .json.

    The .npz holds ``stimuli`` (names, in the order of the first axes), ``values`` (stimulus,
    sample, element, channel) from `model_input`, N and N m, ``values_1khz`` (the same, of the whole
    trajectory), ``touch`` (stimulus, sample at 1 kHz, element), ``angles`` (sample at 1 kHz,
    element, 3) rad, ``first_contact_ms`` (stimulus,), ``elements``, ``channels`` and ``units``.

    Args:
        path: ends in .npz; each file appears complete or not at all.
        angles: (sample, element, 3) base angles theta, phi, zeta at 1 kHz, rad.
    """
    windows = []
    for name, what in felt.items():
        try:
            windows.append(model_input(what))
        except ConfigError as error:
            raise ConfigError(f"{name}: {error}") from None
    values = np.stack(windows)
    touched = {
        name: [e for i, e in enumerate(spec.elements) if what.touch[:, i].any()]
        for name, what in felt.items()
    }
    description = {
        "version": 1,
        "stimuli": list(felt),
        **parameters,
        "first_contact_ms": {n: t.first_ms for n, t in felt.items()},
        "touched": touched,
        "period_ns": PERIOD_NS,
        "array": msgspec.to_builtins(spec),
        "versions": {
            "tactile_rt": VERSION,
            "mujoco": mujoco.__version__,
            "numpy": np.__version__,
        },
        "sha256_of_values": hashlib.sha256(values.tobytes()).hexdigest(),
    }
    arrays: dict[str, Any] = {
        "values": values,
        "values_1khz": np.stack([t.loads for t in felt.values()]),
        "touch": np.stack([t.touch for t in felt.values()]),
        "angles": angles,
        "first_contact_ms": np.array([t.first_ms for t in felt.values()]),
        "stimuli": np.array(list(felt)),
        "elements": np.array(spec.elements),
        "channels": np.array(spec.channels),
        "units": np.array(spec.units),
    }
    text = msgspec.json.format(msgspec.json.encode(description), indent=1)
    write_whole(path, lambda file: np.savez(file, **arrays))
    write_whole(path.with_suffix(".json"), lambda file: file.write(text + b"\n"))
