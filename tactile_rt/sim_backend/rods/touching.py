"""Where a whisker is nearest to the pieces of an object: the places that a step has to mind."""

from typing import Any

import numpy as np

from tactile_rt.sim_backend.rods.compiled import compiled
from tactile_rt.sim_backend.rods.nearest import WORK, nearest

__all__ = ["MOST_CONTACTS", "NEAR_MM", "find_near"]

A = Any
NEAR_MM = 0.1  # places that are nearer are constraints of a step
STALE_MM, CLOSE_MM = 0.05, 1.0  # where it is near, a plane found so much way ago is found anew
MOST_CONTACTS = 8  # of one whisker at one time: the nearest ones


@compiled
def find_near(
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
    centre: A,
    reach: A,
    soonest: A,
    travelled: float,
    known: A,
    planes: A,
    ends: A,
    seen: A,
    gaps: A,
    normals: A,
    points: A,
    whose: A,
) -> int:
    """Find where a whisker is nearest to pieces that are near; returns at how many places.

    What is wanted of each piece is where the gap is least along each link. A plane through which
    a piece does not reach bounds the gap of a segment from below, and as the pieces do not turn,
    the plane of the last time still does: only the segments whose bound is the least of their
    neighbours' are looked at anew.

    Args:
        seg_link, seg_ends, seg_radii: of the segments: link, ends in its frame (2, 3), radii (2,).
        corners, corner_at, faces, face_at, rounding: of the pieces, about the object's place.
        centre: (3,) where the object is, mm.
        reach: (segment, piece) lower bound of the gap, plus what was travelled when it was found.
        soonest: (piece,) the least of them; filled.
        known: (segment, piece, 4) where to begin, see `nearest`.
        planes: (segment, piece, 5) outward normal and offset of a plane through which the piece
            does not reach, and what was travelled when it was found.
        ends: (segment, 2, 3) scratch.
        seen: (segment, 6) scratch.
        gaps, normals, points, whose: filled: gap (mm), direction from piece to whisker and point
            of the whisker's surface, in the world; segment and place on it.
    """
    count = 0
    found, work = np.empty(6), np.empty(WORK)
    segments = len(seg_link)
    for s in range(segments):
        ends[s, 0, 0] = np.inf  # not known
    for p in range(len(rounding)):
        if soonest[p] - travelled >= NEAR_MM:
            continue
        first, last = segments, -1
        for s in range(segments):
            seen[s, 0] = np.inf
            if reach[s, p] - travelled >= NEAR_MM:
                continue
            if ends[s, 0, 0] == np.inf:
                _place(seg_ends[s], nodes[seg_link[s]], frames[seg_link[s]], centre, ends[s])
            bound = np.inf
            for end in range(2):
                ahead = -planes[s, p, 3] - rounding[p] - seg_radii[s, end]
                for i in range(3):
                    ahead += planes[s, p, i] * ends[s, end, i]
                bound = min(bound, ahead)
            if travelled - planes[s, p, 4] > STALE_MM and bound < CLOSE_MM:
                bound = -np.inf
            reach[s, p] = bound + travelled
            if bound < NEAR_MM:
                seen[s, 0], seen[s, 5] = bound, 0.0
                first, last = min(first, s), s
        again = last >= 0
        while again:
            again = False
            for s in range(first, last + 1):
                if seen[s, 0] == np.inf or seen[s, 5] or not _least(s, seen, seg_link):
                    continue
                a, b = ends[s]
                nearest(
                    a,
                    b,
                    corners[corner_at[p] : corner_at[p + 1]],
                    faces[face_at[p] : face_at[p + 1]],
                    known[s, p],
                    work,
                    found,
                )
                t = found[1]
                gap = found[0] - rounding[p] - seg_radii[s, 0] * (1 - t) - seg_radii[s, 1] * t
                reach[s, p] = gap + travelled
                planes[s, p, 3], planes[s, p, 4] = found[5], travelled
                for i in range(3):
                    planes[s, p, i] = seen[s, 2 + i] = found[2 + i]
                seen[s, 0], seen[s, 1], seen[s, 5] = gap, t, 1.0
                if gap >= NEAR_MM:
                    seen[s, 0] = np.inf
                again = True
        soonest[p] = np.inf
        for s in range(segments):
            soonest[p] = min(soonest[p], reach[s, p])
        for s in range(first, last + 1):
            gap = seen[s, 0]
            if gap == np.inf or not _least(s, seen, seg_link):
                continue
            # Neighbours on two links share their ends, and a gap there.
            if s > 0 and seen[s, 1] == 0.0 and seen[s - 1, 0] <= gap and seen[s - 1, 5]:
                if seen[s - 1, 1] == 1.0:
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


@compiled
def _least(s: int, seen: A, seg_link: A) -> bool:
    """Whether no neighbour on the same link is nearer, for what is known of them."""
    gap, link = seen[s, 0], seg_link[s]
    if s > 0 and seg_link[s - 1] == link and seen[s - 1, 0] <= gap:
        return False
    return not (s + 1 < len(seg_link) and seg_link[s + 1] == link and seen[s + 1, 0] < gap)


@compiled
def _place(in_link: A, node: A, frame: A, centre: A, ends: A) -> None:
    """Fill in the (2, 3) ends of a segment, about the object's place."""
    for end in range(2):
        for i in range(3):
            ends[end, i] = node[i] - centre[i]
            for k in range(3):
                ends[end, i] += frame[i, k] * in_link[end, k]
