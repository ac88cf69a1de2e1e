"""Where a whisker is nearest to the pieces of an object: the places that a step has to mind."""

import math
from typing import Any

import numpy as np

from tactile_rt.sim_backend.rods.compiled import compiled
from tactile_rt.sim_backend.rods.nearest import nearest

__all__ = ["MOST_CONTACTS", "NEAR_MM", "find_near"]

A = Any
NEAR_MM = 0.1  # places that are nearer are constraints of a step
MOST_CONTACTS = 8  # of one whisker at one time: the nearest ones


@compiled
def find_near(
    links: int,
    nodes: A,
    frames: A,
    seg_link: A,
    seg_ends: A,
    seg_radii: A,
    corners: A,
    corner_at: A,
    faces: A,
    face_at: A,
    rounding: A,
    boxes: A,
    centre: A,
    reach: A,
    travelled: float,
    hints: A,
    seen: A,
    gaps: A,
    normals: A,
    points: A,
    whose: A,
) -> int:
    """Find where a whisker is nearest to pieces that are near; returns at how many places.

    Args:
        seg_link, seg_ends, seg_radii: of the segments: link, ends in its frame (2, 3), radii (2,).
        corners, corner_at, faces, face_at, rounding, boxes: of the pieces, about its place.
        centre: (3,) where the object is, mm.
        reach: (segment, piece) lower bound of the gap, plus what was travelled when it was found.
        hints: (segment, piece) corners to begin from.
        seen: (segment, 5) scratch.
        gaps, normals, points, whose: filled: gap (mm), direction from piece to whisker and point
            of the whisker's surface, in the world; segment and place on it.
    """
    count = 0
    a, b = np.empty(3), np.empty(3)
    found = np.empty(5)
    segments = len(seg_link)
    for p in range(len(rounding)):
        any_near = False
        for s in range(segments):
            seen[s, 0] = np.inf
            if reach[s, p] - travelled >= NEAR_MM:
                continue
            link = seg_link[s]
            d0 = nodes[link, 0] - centre[0]
            d1 = nodes[link, 1] - centre[1]
            d2 = nodes[link, 2] - centre[2]
            for end in range(2):
                e0, e1, e2 = seg_ends[s, end, 0], seg_ends[s, end, 1], seg_ends[s, end, 2]
                x0 = (
                    d0 + frames[link, 0, 0] * e0 + frames[link, 0, 1] * e1 + frames[link, 0, 2] * e2
                )
                x1 = (
                    d1 + frames[link, 1, 0] * e0 + frames[link, 1, 1] * e1 + frames[link, 1, 2] * e2
                )
                x2 = (
                    d2 + frames[link, 2, 0] * e0 + frames[link, 2, 1] * e1 + frames[link, 2, 2] * e2
                )
                place = b if end else a
                place[0], place[1], place[2] = x0, x1, x2
            thick = rounding[p] + max(seg_radii[s, 0], seg_radii[s, 1])
            square = 0.0
            for i in range(3):
                away = max(min(a[i], b[i]) - boxes[p, 1, i], boxes[p, 0, i] - max(a[i], b[i]), 0.0)
                square += away * away
            bound = math.sqrt(square) - thick
            if bound >= NEAR_MM:
                reach[s, p] = bound + travelled
                continue
            hints[s, p] = nearest(
                a,
                b,
                corners[corner_at[p] : corner_at[p + 1]],
                faces[face_at[p] : face_at[p + 1]],
                hints[s, p],
                found,
            )
            t = found[1]
            gap = found[0] - rounding[p] - seg_radii[s, 0] * (1 - t) - seg_radii[s, 1] * t
            reach[s, p] = gap + travelled
            if gap < NEAR_MM:
                any_near = True
                seen[s, 0] = gap
                for i in range(1, 5):
                    seen[s, i] = found[i]
        if not any_near:
            continue
        # Where the gap is least along each link. Segments share their ends, and a gap there.
        for s in range(segments):
            gap = seen[s, 0]
            if gap == np.inf:
                continue
            if s > 0 and seen[s - 1, 0] <= gap:
                if seg_link[s - 1] == seg_link[s] or (seen[s, 1] == 0.0 and seen[s - 1, 1] == 1.0):
                    continue
            if s + 1 < segments and seen[s + 1, 0] < gap and seg_link[s + 1] == seg_link[s]:
                continue
            slot = count
            if count == MOST_CONTACTS:
                slot = 0
                for c in range(count):
                    if gaps[c] > gaps[slot]:
                        slot = c
                if gaps[slot] <= gap:
                    continue
            else:
                count += 1
            t, link = seen[s, 1], seg_link[s]
            radius = seg_radii[s, 0] * (1 - t) + seg_radii[s, 1] * t
            gaps[slot] = gap
            whose[slot, 0], whose[slot, 1] = s, t
            for i in range(3):
                n = seen[s, 2 + i]
                normals[slot, i] = n
                points[slot, i] = nodes[link, i] - n * radius
                for k in range(3):
                    at = seg_ends[s, 0, k] * (1 - t) + seg_ends[s, 1, k] * t
                    points[slot, i] += frames[link, i, k] * at
    return count
