"""The nearest points of a segment and a convex piece: the distance algorithm of Gilbert, Johnson
and Keerthi (1988), and for what overlaps the face through which it is nearest to come out.
"""

import math
from typing import Any

import numpy as np

from tactile_rt.sim_backend.rods.compiled import compiled

__all__ = ["nearest"]

A = Any
MOST_ROUNDS = 40
OVERLAP_MM = 1e-7  # nearer than that, a direction between the nearest points means nothing


@compiled
def _weights(simplex: A, count: int, weights: A) -> float:
    """Squared distance from the origin to the hull of up to four points, and the nearest's weights.

    Every face of it is tried: there are fifteen at most, and the nearest inner point wins.
    """
    best = np.inf
    w = np.empty(4)
    at = np.empty(4, np.int64)
    for mask in range(1, 1 << count):
        size = 0
        for i in range(count):
            if (mask >> i) & 1:
                at[size] = i
                size += 1
        a0, a1, a2 = simplex[at[0], 0], simplex[at[0], 1], simplex[at[0], 2]
        if size == 1:
            w[0] = 1.0
        else:
            u0, u1, u2 = simplex[at[1], 0] - a0, simplex[at[1], 1] - a1, simplex[at[1], 2] - a2
            uu, au = u0 * u0 + u1 * u1 + u2 * u2, a0 * u0 + a1 * u1 + a2 * u2
            if size == 2:
                if uu < 1e-24 or not 0.0 < -au < uu:
                    continue
                w[1] = -au / uu
                w[0] = 1.0 - w[1]
            else:
                v0, v1, v2 = simplex[at[2], 0] - a0, simplex[at[2], 1] - a1, simplex[at[2], 2] - a2
                if size == 3:
                    vv, uv = v0 * v0 + v1 * v1 + v2 * v2, u0 * v0 + u1 * v1 + u2 * v2
                    av, det = a0 * v0 + a1 * v1 + a2 * v2, uu * vv - uv * uv
                    if det < 1e-14 * uu * vv:
                        continue
                    w[1], w[2] = (av * uv - au * vv) / det, (au * uv - av * uu) / det
                    w[0] = 1.0 - w[1] - w[2]
                    if w[0] <= 0.0 or w[1] <= 0.0 or w[2] <= 0.0:
                        continue
                else:
                    z0, z1 = simplex[at[3], 0] - a0, simplex[at[3], 1] - a1
                    z2 = simplex[at[3], 2] - a2
                    c0, c1, c2 = v1 * z2 - v2 * z1, v2 * z0 - v0 * z2, v0 * z1 - v1 * z0
                    det = u0 * c0 + u1 * c1 + u2 * c2
                    if abs(det) < 1e-18:
                        continue
                    # Cramer's rule for u w1 + v w2 + z w3 = -a
                    d0, d1, d2 = a2 * z1 - a1 * z2, a0 * z2 - a2 * z0, a1 * z0 - a0 * z1
                    w[1] = -(a0 * c0 + a1 * c1 + a2 * c2) / det
                    w[2] = (u0 * d0 + u1 * d1 + u2 * d2) / det
                    e0, e1, e2 = v2 * a1 - v1 * a2, v0 * a2 - v2 * a0, v1 * a0 - v0 * a1
                    w[3] = (u0 * e0 + u1 * e1 + u2 * e2) / det
                    w[0] = 1.0 - w[1] - w[2] - w[3]
                    if w[0] <= 0.0 or w[1] <= 0.0 or w[2] <= 0.0 or w[3] <= 0.0:
                        continue
        p0, p1, p2 = 0.0, 0.0, 0.0
        for i in range(size):
            p0 += w[i] * simplex[at[i], 0]
            p1 += w[i] * simplex[at[i], 1]
            p2 += w[i] * simplex[at[i], 2]
        square = p0 * p0 + p1 * p1 + p2 * p2
        if square < best * (1.0 - 1e-12) - 1e-30:
            best = square
            weights[:] = 0.0
            for i in range(size):
                weights[at[i]] = w[i]
    return best


@compiled
def nearest(a: A, b: A, corners: A, faces: A, start: int, found: A) -> int:
    """Distance of a segment from a convex piece, both in the piece's frame.

    Args:
        a, b: (3,) ends of the segment, mm.
        corners: (corner, 3) mm.
        faces: (face, 4) outward normals and offsets, for a segment that overlaps the piece; none:
            the piece is a point or a line.
        start: a corner to begin from, best the one that the last call returned.
        found: (5,) filled: distance (mm; negative: depth), place on the segment from 0 (a) to
            1 (b), and the direction from the piece to the segment.

    Returns:
        A corner near the segment.
    """
    simplex = np.empty((4, 3))
    place = np.empty(4)
    corner = np.empty(4, np.int64)
    weights = np.zeros(4)
    corner[0] = start if start < len(corners) else 0
    place[0], weights[0], count = 0.5, 1.0, 1
    for i in range(3):
        simplex[0, i] = (a[i] + b[i]) / 2 - corners[corner[0], i]
    p0, p1, p2 = simplex[0, 0], simplex[0, 1], simplex[0, 2]
    square = p0 * p0 + p1 * p1 + p2 * p2
    for _ in range(MOST_ROUNDS):
        onto_a = p0 * a[0] + p1 * a[1] + p2 * a[2]
        onto_b = p0 * b[0] + p1 * b[1] + p2 * b[2]
        t = 0.0 if onto_a < onto_b else 1.0
        far, furthest = 0, -np.inf
        for i in range(len(corners)):
            onto = p0 * corners[i, 0] + p1 * corners[i, 1] + p2 * corners[i, 2]
            if onto > furthest:
                furthest, far = onto, i
        if square - (min(onto_a, onto_b) - furthest) <= 1e-12 * square:
            break
        known = False
        for i in range(count):
            known |= corner[i] == far and place[i] == t
        if known:
            break
        for i in range(3):
            simplex[count, i] = (b[i] if t else a[i]) - corners[far, i]
        place[count], corner[count] = t, far
        count += 1
        nearer = _weights(simplex, count, weights)
        kept = 0
        for i in range(count):
            if weights[i] > 0.0:
                for k in range(3):
                    simplex[kept, k] = simplex[i, k]
                place[kept], corner[kept], weights[kept] = place[i], corner[i], weights[i]
                kept += 1
        count = kept
        p0, p1, p2 = 0.0, 0.0, 0.0
        for i in range(count):
            p0 += weights[i] * simplex[i, 0]
            p1 += weights[i] * simplex[i, 1]
            p2 += weights[i] * simplex[i, 2]
        ended = nearer >= square * (1.0 - 1e-14) or nearer < OVERLAP_MM**2
        square = nearer
        if ended:
            break
    distance = math.sqrt(square)
    if distance >= OVERLAP_MM or len(faces) == 0:
        t = 0.0
        for i in range(count):
            t += weights[i] * place[i]
        away = max(distance, 1e-300)
        found[0], found[1] = distance, t
        found[2], found[3], found[4] = p0 / away, p1 / away, p2 / away
        return int(corner[0])
    # Inside: the place on the segment, of three, that is deepest, and the face nearest to it.
    found[0] = np.inf
    for half in range(3):
        t = half / 2
        out, through = -np.inf, 0
        for i in range(len(faces)):
            ahead = -faces[i, 3]
            for k in range(3):
                ahead += faces[i, k] * (a[k] + t * (b[k] - a[k]))
            if ahead > out:
                out, through = ahead, i
        if out < found[0]:
            found[0], found[1] = out, t
            found[2], found[3], found[4] = faces[through, 0], faces[through, 1], faces[through, 2]
    return int(corner[0])
