"""The nearest points of a segment and a convex piece: the distance algorithm of Gilbert, Johnson
and Keerthi (1988), and in an overlap the face through which the way out is shortest.
"""

import math
from typing import Any

import numpy as np

from tactile_rt.sim_backend.rods.compiled import compile_cached

A = Any
MOST_ROUNDS = 40
OVERLAP_MM = 1e-7  # below, the direction between the nearest points is undefined
WORK = (6, 4)  # shape of the scratch


@compile_cached
def _find_weights(simplex: A, count: int, weights: A, w: A) -> float:
    """Compute the squared distance from the origin to the hull of up to four points.

    All subsets are tried, at most fifteen; `weights` is filled with those of the nearest point.
    """
    best = np.inf
    for mask in range(1, 1 << count):
        size, i, j, k, m = 0, 0, 0, 0, 0
        for at in range(count):
            if (mask >> at) & 1:
                if size == 0:
                    i = at
                elif size == 1:
                    j = at
                elif size == 2:
                    k = at
                else:
                    m = at
                size += 1
        a0, a1, a2 = simplex[i, 0], simplex[i, 1], simplex[i, 2]
        p0, p1, p2 = a0, a1, a2
        w[0] = 1.0
        if size > 1:
            u0, u1, u2 = simplex[j, 0] - a0, simplex[j, 1] - a1, simplex[j, 2] - a2
            uu, au = u0 * u0 + u1 * u1 + u2 * u2, a0 * u0 + a1 * u1 + a2 * u2
            if size == 2:
                if uu < 1e-24 or not 0.0 < -au < uu:
                    continue
                w[1] = -au / uu
                w[0] = 1.0 - w[1]
                p0, p1, p2 = a0 + w[1] * u0, a1 + w[1] * u1, a2 + w[1] * u2
            else:
                v0, v1, v2 = simplex[k, 0] - a0, simplex[k, 1] - a1, simplex[k, 2] - a2
                if size == 3:
                    vv, uv = v0 * v0 + v1 * v1 + v2 * v2, u0 * v0 + u1 * v1 + u2 * v2
                    av, det = a0 * v0 + a1 * v1 + a2 * v2, uu * vv - uv * uv
                    if det < 1e-14 * uu * vv:
                        continue
                    w[1], w[2] = (av * uv - au * vv) / det, (au * uv - av * uu) / det
                    w[0] = 1.0 - w[1] - w[2]
                    if w[0] <= 0.0 or w[1] <= 0.0 or w[2] <= 0.0:
                        continue
                    p0 = a0 + w[1] * u0 + w[2] * v0
                    p1 = a1 + w[1] * u1 + w[2] * v1
                    p2 = a2 + w[1] * u2 + w[2] * v2
                else:
                    z0, z1, z2 = simplex[m, 0] - a0, simplex[m, 1] - a1, simplex[m, 2] - a2
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
        square = p0 * p0 + p1 * p1 + p2 * p2
        if square < best * (1.0 - 1e-12) - 1e-30:
            best = square
            weights[:] = 0.0
            weights[i] = w[0]
            if size > 1:
                weights[j] = w[1]
            if size > 2:
                weights[k] = w[2]
            if size > 3:
                weights[m] = w[3]
    return best


@compile_cached
def nearest(
    a: A, b: A, corners: A, faces: A, beside: A, beside_at: A, known: A, work: A, found: A
) -> None:
    """Compute the distance of a segment from a convex piece, in the piece's frame.

    Args:
        a, b: (3,) ends of the segment, mm.
        corners: (corner, 3) mm.
        faces: (face, 4) outward normals and offsets, for a segment that overlaps the piece; none:
            the piece is a point or a line.
        beside: numbers of the neighbours of each corner along its edges, concatenated over
            corners; `beside_at` (corner + 1,) has the start of each corner's. If empty, all
            corners are tried.
        known: (4,) pairs of a corner and an end between which the nearest points lie: twice the
            corner's number, plus one for b; entries from the first -1 on are unknown. Those of the
            last call, if little has moved since, or -1; filled.
        work: `WORK` scratch.
        found: (6,) filled: distance (mm; negative: depth), place on the segment from 0 (a) to
            1 (b), direction from the piece to the segment, and extent of the piece in that
            direction, mm from its frame's origin (infinite if unknown).
    """
    weights = work[4]
    if known[0] < 0:
        known[0], known[1] = 0, -1
    count = 0
    while count < 4 and known[count] >= 0:
        corner, end = known[count] // 2, b if known[count] % 2 else a
        for i in range(3):
            work[count, i] = end[i] - corners[corner, i]
        count += 1
    p0, p1, p2, square = 0.0, 0.0, 0.0, np.inf
    furthest = np.inf
    for _ in range(MOST_ROUNDS):
        nearer = _find_weights(work, count, weights, work[5])
        kept = 0
        p0, p1, p2 = 0.0, 0.0, 0.0
        for c in range(count):
            if weights[c] > 0.0:
                known[kept], weights[kept] = known[c], weights[c]
                for i in range(3):
                    work[kept, i] = work[c, i]
                p0 += weights[kept] * work[kept, 0]
                p1 += weights[kept] * work[kept, 1]
                p2 += weights[kept] * work[kept, 2]
                kept += 1
        count = kept
        ended = nearer >= square * (1.0 - 1e-14) or nearer < OVERLAP_MM**2
        square, furthest = nearer, np.inf
        if ended:
            break
        onto_a = p0 * a[0] + p1 * a[1] + p2 * a[2]
        onto_b = p0 * b[0] + p1 * b[1] + p2 * b[2]
        far, furthest = 0, -np.inf
        if beside_at[-1] == beside_at[0]:
            for c in range(len(corners)):
                onto = p0 * corners[c, 0] + p1 * corners[c, 1] + p2 * corners[c, 2]
                if onto > furthest:
                    furthest, far = onto, c
        else:  # uphill along the edges: a convex body has no other local maximum
            at = known[0] // 2
            while at >= 0:
                far, at = at, -1
                onto = p0 * corners[far, 0] + p1 * corners[far, 1] + p2 * corners[far, 2]
                furthest = max(furthest, onto)
                for k in range(beside_at[far], beside_at[far + 1]):
                    c = beside[k]
                    onto = p0 * corners[c, 0] + p1 * corners[c, 1] + p2 * corners[c, 2]
                    if onto > furthest:
                        furthest, at = onto, c
        if square - (min(onto_a, onto_b) - furthest) <= 1e-12 * square:
            break
        pair = 2 * far + (0 if onto_a < onto_b else 1)
        old = False
        for c in range(count):
            old |= known[c] == pair
        if old:
            break
        known[count], weights[count] = pair, 0.0
        for i in range(3):
            work[count, i] = (b[i] if pair % 2 else a[i]) - corners[far, i]
        count += 1
    for c in range(count, 4):
        known[c] = -1
    distance = math.sqrt(square)
    if distance >= OVERLAP_MM or len(faces) == 0:
        t = 0.0
        for c in range(count):
            t += weights[c] * (known[c] % 2)
        away = max(distance, 1e-300)
        found[0], found[1] = distance, t
        found[2], found[3], found[4] = p0 / away, p1 / away, p2 / away
        found[5] = furthest / away
        return
    # Overlap: of three places on the segment, the deepest, and the face nearest to it.
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
            for k in range(4):
                found[2 + k] = faces[through, k]
