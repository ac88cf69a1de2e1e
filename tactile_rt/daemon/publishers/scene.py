"""An array as a 3-D scene for Foxglove: bases and directions of its elements, forces as arrows."""

from collections.abc import Iterator

import numpy as np
from foxglove.messages import (
    ArrowPrimitive,
    Color,
    Duration,
    KeyValuePair,
    LinePrimitive,
    LinePrimitiveLineType,
    Point3,
    Pose,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneUpdate,
    SpherePrimitive,
    Timestamp,
    Vector3,
)
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec, rotation_matrices

FORCES = ("fx", "fy", "fz")
SINGLE_M = 0.05  # extent of an array of one element
LIFETIME_S = 1  # after which the arrows of a silent source disappear
NEVER = Duration(sec=0)
FORGET = 0.999  # decay of the largest force per picture: at 25 a second, to half in 28 s
BASE = Color(r=0.35, g=0.5, b=0.85, a=1.0)
STEM = Color(r=0.55, g=0.6, b=0.7, a=1.0)
FORCE = Color(r=0.95, g=0.5, b=0.1, a=1.0)


class Scene:
    """Builder of the 3-D scene updates of one array, in its mount frame.

    Args:
        m_per_n: Length of the arrow of 1 N, m; 0 scales the largest force of the last half minute
            to a third of the array's extent.
    """

    def __init__(self, source: str, spec: ArraySpec, m_per_n: float) -> None:
        self._source, self._spec, self._m_per_n = source, spec, m_per_n
        self._largest = 0.0
        self._at = np.array(spec.positions)
        self._turns = rotation_matrices(spec.orientations)
        self._columns = force_columns(spec)
        extent = float(np.ptp(self._at, axis=0).max())
        self._extent = extent if extent > 0 else SINGLE_M
        self._spacing = self._extent / max(1.0, len(self._at) ** 0.5)

    def bases(self, utc_ns: int) -> SceneUpdate:
        """Draw the elements' positions as spheres and their own x axes as lines."""
        ends = self._at + 0.5 * self._spacing * self._turns[:, :, 0]
        size = 0.15 * self._spacing
        spheres = [
            SpherePrimitive(
                pose=Pose(position=_make_vector(at), orientation=Quaternion(w=1.0)),
                size=Vector3(x=size, y=size, z=size), color=BASE,
            )
            for at in self._at.tolist()
        ]  # fmt: skip
        points = np.stack([self._at, ends], axis=1).reshape(-1, 3).tolist()
        lines = LinePrimitive(
            type=LinePrimitiveLineType.LineList, thickness=0.3 * size, color=STEM,
            points=[Point3(x=x, y=y, z=z) for x, y, z in points],
        )  # fmt: skip
        entity = SceneEntity(
            timestamp=_make_time(utc_ns), frame_id=self._spec.frame, id=f"{self._source}/array",
            lifetime=NEVER, spheres=spheres, lines=[lines],
            metadata=[KeyValuePair(key="array", value=self._spec.name)],
        )  # fmt: skip
        return SceneUpdate(entities=[entity])

    def forces(
        self, values: NDArray[np.float32], valid: NDArray[np.bool_], utc_ns: int
    ) -> SceneUpdate | None:
        """Draw the force of each valid element as an arrow; return None without force channels.

        Args:
            values: (element, channel) One sample, with forces in each element's own frame, N.
            valid: (element,) Whether the values of the element are trustworthy.
        """
        if not self._columns:
            return None
        own = np.zeros((len(values), 3))
        for axis, column in self._columns.items():
            own[:, axis] = values[:, column]
        own[~valid | ~np.isfinite(own).all(axis=1)] = 0.0
        force = (self._turns @ own[:, :, None])[:, :, 0]
        size = np.linalg.norm(force, axis=1)
        self._largest = max(FORGET * self._largest, float(size.max()))
        scale = self._m_per_n or (self._extent / 3 / self._largest if self._largest > 0 else 0.0)
        entity = SceneEntity(
            timestamp=_make_time(utc_ns), frame_id=self._spec.frame, id=f"{self._source}/forces",
            lifetime=Duration(sec=LIFETIME_S), arrows=list(self._draw_arrows(force, size, scale)),
            metadata=[KeyValuePair(key="m_per_N", value=f"{scale:.6g}")],
        )  # fmt: skip
        return SceneUpdate(entities=[entity])

    def gone(self, utc_ns: int) -> SceneUpdate:
        """Return the update that removes the array and its forces from the scene."""
        return SceneUpdate(
            deletions=[
                SceneEntityDeletion(timestamp=_make_time(utc_ns), id=f"{self._source}/{what}")
                for what in ("array", "forces")
            ]
        )

    def _draw_arrows(
        self, force: NDArray[np.float64], size: NDArray[np.float64], scale: float
    ) -> Iterator[ArrowPrimitive]:
        shown = np.flatnonzero(size > 0)
        quaternions = turn_x_to(force[shown] / size[shown, None])
        thick = 0.06 * self._spacing
        for i, (w, x, y, z) in zip(shown.tolist(), quaternions.tolist(), strict=True):
            length = scale * float(size[i])
            yield ArrowPrimitive(
                pose=Pose(
                    position=_make_vector(self._at[i].tolist()),
                    orientation=Quaternion(x=x, y=y, z=z, w=w),
                ),
                shaft_length=0.75 * length, shaft_diameter=thick,
                head_length=0.25 * length, head_diameter=2 * thick, color=FORCE,
            )  # fmt: skip


def force_columns(spec: ArraySpec) -> dict[int, int]:
    """Return the channel number of each force in N, by its axis (0 is x)."""
    return {
        axis: spec.channels.index(name)
        for axis, name in enumerate(FORCES)
        if name in spec.channels and spec.units[spec.channels.index(name)] == "N"
    }


def turn_x_to(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit quaternions (n, 4), w first, that rotate x to unit vectors (n, 3)."""
    x, y, z = directions.T
    # Half-way between the axis and the direction; for opposite ones, any half turn will do.
    found = np.stack([1 + x, np.zeros_like(x), -z, y], axis=1)
    found[x < -1 + 1e-9] = (0.0, 0.0, 0.0, 1.0)
    unit: NDArray[np.float64] = found / np.linalg.norm(found, axis=1, keepdims=True)
    return unit


def _make_vector(at: list[float]) -> Vector3:
    return Vector3(x=at[0], y=at[1], z=at[2])


def _make_time(utc_ns: int) -> Timestamp:
    return Timestamp(sec=utc_ns // 10**9, nsec=utc_ns % 10**9)
